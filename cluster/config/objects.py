"""The objects of a run: a folder of the user, or procedural ones; and their split."""

import logging
from collections.abc import Iterable
from pathlib import Path

from cluster.config.campaign_config import ObjectSelection, SplitConfig
from collector.objects.catalogue import Catalogue, ObjectSplit, for_task, of_categories, read_list, scan, split
from collector.objects.procedural.catalogue import EVERY_CATEGORY, categories_of, generate
from shared.errors import UsageError
from shared.io.text import short
from shared.plan import ObjectRef
from shared.tasks import Task, expanded

MOST_NOTED = 10
"""Objects of which a command says what was left out of their files."""

logger = logging.getLogger(__name__)


def objects_for(
    task: Task,
    selection: ObjectSelection,
    built_in: Path,
    per_category: int,
    seed: int,
    lists: tuple[Path, ...] = (),
) -> tuple[Catalogue, Path]:
    """The catalogue of objects that suit `task`, and their folder.

    Args:
        task: the task.
        selection: the user's folder, list and categories; without a folder, built-in objects are made.
        built_in: where those are generated, and found again.
        per_category: how many of each category that the task applies to.
        seed: of the built-in objects.
        lists: where the selection has no list, only objects of these are looked at.

    Raises:
        UsageError: the folder or a list cannot be read, or nothing in it suits the task.
    """
    categories, folder = expanded(selection.categories), selection.objects or built_in
    if selection.objects is None:
        generate(built_in, dict.fromkeys(built_in_categories(task, selection.categories), per_category), seed)
    lists = lists if selection.object_list is None else (selection.object_list,)
    found = scan(folder, *lists)
    catalogue = for_task(of_categories(found, categories), task)
    if not catalogue.usable:
        why = f"; the first: {catalogue.refused[0][0]}: {catalogue.refused[0][1]}" if catalogue.refused else ""
        raise UsageError(f"{folder}: none of {len(catalogue.refused)} objects suits the task '{task.name}'{why}")
    # Those that are of no use for this task are as expected.
    refused = [f"object {object_id} cannot be used: {reason}" for object_id, reason in found.refused]
    _say(refused, "more objects cannot be used; `adaafford objects check` says why")
    notes = [f"object {entry.ref.id}: {'; '.join(entry.notes)}" for entry in catalogue.usable if entry.notes]
    _say(notes, "more objects have something left out; `adaafford objects check` says what")
    return catalogue, folder


def require_same_objects(wanted: Iterable[ObjectRef], folder: Path) -> None:
    """Check that a folder holds some objects, by their content; it may hold others, too.

    Raises:
        UsageError: it cannot be read, or an object is missing or has other content.
    """
    there = {entry.ref for entry in scan(folder).usable}
    missing = [ref.id for ref in wanted if ref not in there]
    if missing:
        raise UsageError(
            f"{folder}: {len(missing)} of the objects wanted are not there or have other content, such as "
            f"{short(missing[0])}; name the folder that holds the same files"
        )


def _say(lines: list[str], others: str) -> None:
    """Say the first of some lines, and what is true of the others, after their number."""
    for line in lines[:MOST_NOTED]:
        logger.warning("%s", line)
    if len(lines) > MOST_NOTED:
        logger.warning("%d %s", len(lines) - MOST_NOTED, others)


def built_in_categories(task: Task, categories: tuple[str, ...]) -> list[str]:
    """The categories that built-in objects are made of: those that are named, or all, as far as the task applies.

    Raises:
        UsageError: an unknown category, or none of those that are named suits the task.
    """
    named = expanded(categories) or tuple(categories_of(task) or EVERY_CATEGORY)
    allowed = [name for name in EVERY_CATEGORY if not task.categories or name in task.categories]
    suited = [name for name in named if name in allowed]
    wrong = next((name for name in named if name not in EVERY_CATEGORY), None if suited else named[0])
    if wrong is not None:
        raise UsageError(f"no built-in {short(wrong)} for the task '{task.name}'; allowed: {', '.join(allowed)}")
    return suited


def lists_of(splits: SplitConfig) -> tuple[Path, ...]:
    """The lists that together name every object that is used; none where others are used as well."""
    if splits.train_list is None or splits.test_list is None:
        return ()
    return splits.train_list, splits.test_list


def split_as_told(refs: Iterable[ObjectRef], splits: SplitConfig, seed: int) -> ObjectSplit:
    """Split objects by the user's lists or categories, otherwise by fractions within each category.

    If the test objects are given, training and validation divide the others in proportion to their fractions.

    Raises:
        UsageError: a list cannot be read, or the lists have an object in common.
    """
    refs = tuple(refs)
    if splits.test_categories:
        categories = expanded(splits.test_categories)
        tested = {ref.id for ref in refs if ref.category in categories}
        trained = {ref.id for ref in refs} - tested
    elif splits.train_list is not None or splits.test_list is not None:
        trained, tested = _listed({ref.id for ref in refs}, splits)
    else:
        return split(refs, splits.fractions, seed)
    both = splits.train + splits.validation
    shares = (splits.train / both, splits.validation / both, 0.0)
    parts = split((ref for ref in refs if ref.id in trained), shares, seed)
    test = sorted((ref for ref in refs if ref.id in tested), key=lambda ref: ref.id)
    return ObjectSplit(parts.train, parts.validation, tuple(test))


def _listed(ids: set[str], splits: SplitConfig) -> tuple[set[str], set[str]]:
    """Which of `ids` are trained on and which are tested on, where there is a list of either."""
    train, test = (None if path is None else set(read_list(path)) for path in (splits.train_list, splits.test_list))
    if train is None:
        train = ids - (test or set())
    if test is None:
        test = ids - train
    if common := sorted(train & test):
        raise UsageError(
            f"{splits.test_list}: '{common[0]}' is in {splits.train_list} too; test on objects that are not trained on"
        )
    return ids & train, ids & test
