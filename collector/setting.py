"""Settings as commands make them: everything decided, and whose packages it takes."""

from typing import Any

from collector.grippers import GRIPPERS
from collector.simulator import SIMULATORS
from shared.configuration import CollectionConfig
from shared.errors import UsageError
from shared.extensions import added_by_packages
from shared.plan import Setting
from shared.primitives import PRIMITIVES
from shared.tasks import Task, task_named


def make_setting(task: str, collection: CollectionConfig, **rest: Any) -> Setting:
    """A setting that says all that was decided, and names the packages that add to this software what it uses.

    Args:
        task: name of the task.
        collection: what it leaves to the task is filled in.
        rest: the other fields of `Setting`.

    Raises:
        UsageError: nothing is called as the setting says.
    """
    named = task_named(task)
    resolved = named.resolve(collection)
    return Setting(task=task, collection=resolved, extensions=packages_used(named, collection), **rest)


def packages_used(task: Task, collection: CollectionConfig) -> tuple[str, ...]:
    """What other packages add of what a setting uses, such as "primitive twist: my-package 1.2".

    Raises:
        UsageError: something is not there.
    """
    return added_by_packages(
        [
            (PRIMITIVES, task.terms(collection).primitive),
            (GRIPPERS, collection.gripper),
            (SIMULATORS, collection.simulator),
        ]
    )


def check_packages(setting: Setting) -> None:
    """Hold what is installed on this machine to the packages that a setting names.

    Raises:
        UsageError: it needs others, or other versions of them.
    """
    here = packages_used(task_named(setting.task), setting.collection)
    if here != setting.extensions:
        wanted, found = ("; ".join(packages) or "no package" for packages in (setting.extensions, here))
        raise UsageError(f"the store is of {wanted}, but here is {found}; install the same on every machine")
