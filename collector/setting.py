"""Complete settings, with the packages that they need."""

import logging
from typing import Any

from collector.sim.grippers import GRIPPERS
from collector.sim.simulator import SIMULATORS
from shared.arms.arm import ARMS, URDF, arm_of
from shared.config import FIDELITIES, CollectionConfig
from shared.errors import UsageError
from shared.extensions import added_by_packages
from shared.plan import EvaluationConfig, Setting, found_by_name
from shared.primitives import PRIMITIVES
from shared.tasks import TASKS, Task

logger = logging.getLogger(__name__)


def make_setting(
    task: Task, collection: CollectionConfig, evaluation: EvaluationConfig | None = None, **rest: Any
) -> Setting:
    """A complete setting, with the packages that add the things it uses.

    Args:
        task: the task; if no registry has it, its definition is part of the setting.
        collection: settings of the collection; missing ones are taken from the task.
        evaluation: methods and budgets, in a store of an evaluation.
        rest: the other fields of `Setting`.

    Raises:
        UsageError: nothing is called as the setting says.
    """
    from_file = collection.arm is not None and collection.arm not in ARMS.names()
    return Setting(
        task=task.name,
        task_definition=None if task.name in TASKS.names() else task,
        arm_definition=arm_of(str(collection.arm)) if from_file else None,
        # Where the file lies says something about this machine.
        collection=task.resolve(collection.model_copy(update={"arm": URDF}) if from_file else collection),
        evaluation=evaluation,
        extensions=packages_used(task, collection, evaluation),
        **rest,
    )


def packages_used(
    task: Task, collection: CollectionConfig, evaluation: EvaluationConfig | None = None
) -> tuple[str, ...]:
    """The things of a setting that other packages add, such as "primitive twist: my-package 1.2".

    Raises:
        UsageError: something is not there.
    """
    terms = task.terms(collection)
    return added_by_packages(
        [
            (PRIMITIVES, terms.primitive),
            (GRIPPERS, collection.gripper),
            (SIMULATORS, collection.simulator),
            *([(ARMS, collection.arm)] if collection.arm in ARMS.names() else []),
            *terms.dynamics.extensions,
            *found_by_name(task, evaluation),
        ]
    )


def check_packages(setting: Setting) -> None:
    """Check that the packages of a setting are installed on this machine.

    Raises:
        UsageError: it needs others, or other versions of them.
    """
    here = packages_used(setting.task_record, setting.collection, setting.evaluation)
    if here != setting.extensions:
        wanted, found = ("; ".join(packages) or "no package" for packages in (setting.extensions, here))
        raise UsageError(f"the store is of {wanted}, but here is {found}; install the same on every machine")


def in_fidelity_of(where: str, begun: Setting | None, collection: CollectionConfig) -> CollectionConfig:
    """`collection`, which asks for the default fidelity, in the one that was the default when a store was begun.

    Args:
        where: place of the store, for the warning.
        begun: the store's setting; None: there is no store yet.
        collection: what is asked for.
    """
    default = FIDELITIES["fast"]
    if begun is None or collection.fidelity != default or begun.collection.fidelity == default:
        return collection
    fidelity = begun.collection.fidelity
    if fidelity.model_copy(update={"version": default.version}) != default:
        return collection
    logger.warning("%s: was begun with fidelity version %d; it goes on with that", where, fidelity.version)
    return collection.model_copy(update={"fidelity": fidelity})
