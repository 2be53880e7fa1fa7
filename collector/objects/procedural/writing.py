"""Makes folders of procedural objects."""

from collections.abc import Mapping
from pathlib import Path

from collector.objects.procedural.catalogue import EVERY_CATEGORY, build
from collector.objects.writing import write_object
from shared.errors import UsageError
from shared.io.files import TEMPORARY_PREFIX, remove_if_abandoned
from shared.io.text import short


def generate(out: Path, counts: Mapping[str, int], seed: int) -> list[Path]:
    """Write `counts[category]` objects of each category below `out`; what is there already is kept.

    Object number i of a category depends on the seed, the category and i alone. An object appears whole or not at all.

    Args:
        out: folder of objects; made if need be.
        counts: how many of each category of `EVERY_CATEGORY`.
        seed: of the whole collection, non-negative.

    Returns:
        The objects' folders, category by category.

    Raises:
        UsageError: an unknown category, a negative count or seed, or a folder that cannot be written or holds another
            object of the same name.
    """
    unknown = sorted(set(counts) - set(EVERY_CATEGORY))
    if unknown:
        raise UsageError(f"unknown category {short(unknown[0])}; allowed: {', '.join(EVERY_CATEGORY)}")
    if seed < 0 or min(counts.values(), default=0) < 0:
        raise UsageError(f"seed and counts must not be negative; given seed {seed}, counts {dict(counts)}")
    try:
        out.mkdir(parents=True, exist_ok=True)
        for remnant in out.glob(f"{TEMPORARY_PREFIX}*"):
            remove_if_abandoned(remnant)
        return [
            write_object(out / f"{category.lower()}-{index:04d}", build(category, seed, index))
            for category, count in counts.items()
            for index in range(count)
        ]
    except OSError as error:
        raise UsageError(f"{out}: cannot be written ({error.strerror}); name a folder that can") from None
