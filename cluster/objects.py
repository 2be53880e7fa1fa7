"""Which objects a run uses: a folder that the user names, or built-in procedural ones that are generated once."""

from pathlib import Path

from collector.catalogue import Catalogue, for_task, scan
from collector.procedural.catalogue import CATEGORIES
from collector.procedural.writing import generate
from shared.errors import UsageError
from shared.tasks import Task


def objects_for(task: Task, given: Path | None, built_in: Path, per_category: int, seed: int) -> tuple[Catalogue, Path]:
    """The catalogue of objects that suit `task`, and the folder that they lie in.

    Args:
        task: what is to be done with them.
        given: the user's folder; None for built-in objects.
        built_in: where those are generated, and found again.
        per_category: how many of each category that the task applies to.
        seed: of the built-in objects.

    Raises:
        UsageError: the folder cannot be read, or nothing in it suits the task.
    """
    folder = given.expanduser().resolve() if given is not None else built_in
    if given is None:
        categories = [name for name in CATEGORIES if not task.categories or name in task.categories]
        generate(built_in, dict.fromkeys(categories, per_category), seed)
    catalogue = for_task(scan(folder), task)
    if not catalogue.usable:
        why = f"; the first: {catalogue.refused[0][0]}: {catalogue.refused[0][1]}" if catalogue.refused else ""
        raise UsageError(f"{folder}: none of {len(catalogue.refused)} objects suits the task '{task.name}'{why}")
    return catalogue, folder
