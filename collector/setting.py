"""Settings as commands make them: everything decided, and whose packages it takes."""

from typing import Any

from collector.sim.grippers import GRIPPERS
from collector.sim.simulator import SIMULATORS
from shared.config import CollectionConfig
from shared.errors import UsageError
from shared.extensions import added_by_packages
from shared.plan import EvaluationConfig, Setting, found_by_name
from shared.primitives import PRIMITIVES
from shared.tasks import TASKS, Task


def make_setting(
    task: Task, collection: CollectionConfig, evaluation: EvaluationConfig | None = None, **rest: Any
) -> Setting:
    """A setting that says all that was decided, and names the packages that add to this software what it uses.

    Args:
        task: the task; one that has no name in a registry is written out.
        collection: what it leaves to the task is filled in.
        evaluation: methods and budgets, in a store of an evaluation.
        rest: the other fields of `Setting`.

    Raises:
        UsageError: nothing is called as the setting says.
    """
    return Setting(
        task=task.name,
        task_definition=None if task.name in TASKS.names() else task,
        collection=task.resolve(collection),
        evaluation=evaluation,
        extensions=packages_used(task, collection, evaluation),
        **rest,
    )


def packages_used(
    task: Task, collection: CollectionConfig, evaluation: EvaluationConfig | None = None
) -> tuple[str, ...]:
    """What other packages add of what a setting uses, such as "primitive twist: my-package 1.2".

    Raises:
        UsageError: something is not there.
    """
    terms = task.terms(collection)
    return added_by_packages(
        [
            (PRIMITIVES, terms.primitive),
            (GRIPPERS, collection.gripper),
            (SIMULATORS, collection.simulator),
            *terms.dynamics.extensions,
            *found_by_name(task, evaluation),
        ]
    )


def check_packages(setting: Setting) -> None:
    """Hold what is installed on this machine to the packages that a setting names.

    Raises:
        UsageError: it needs others, or other versions of them.
    """
    here = packages_used(setting.task_record, setting.collection, setting.evaluation)
    if here != setting.extensions:
        wanted, found = ("; ".join(packages) or "no package" for packages in (setting.extensions, here))
        raise UsageError(f"the store is of {wanted}, but here is {found}; install the same on every machine")
