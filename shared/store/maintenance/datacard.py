"""The card of exported data: what it is, how much, how often things succeed, where it comes from, who may use it."""

import itertools
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from shared.formatting import markdown_table
from shared.io.text import markdown
from shared.store.store import Store
from shared.types import OutcomeKind

DEPTH_LINES = (
    "- `depth` there: packed depth images. With x a number of an image, s is x / 2 where x is even, else -(x + 1) / 2.",
    "  Sums of s along rows, then along columns, modulo 65,536, are steps of 0.25 mm along the camera's forward axis;",
    "  32,768 is the depth of the world's origin, and 0 no surface. `focal`: pixels.",
)
SPLIT_COLUMNS = ("split", "objects", "rollouts", "clouds", "interactions", "success rate")


@dataclass(frozen=True, slots=True)
class SplitFigures:
    """What a split holds; of labels, infrastructure failures are no part."""

    objects: frozenset[str]
    rollouts: int
    observations: int
    interactions: int
    labels: dict[str, int]
    """By category."""
    successes: dict[str, int]
    """By category."""
    outcomes: dict[str, int]

    @classmethod
    def nothing(cls) -> "SplitFigures":
        """Of no rows."""
        return cls(frozenset(), 0, 0, 0, {}, {}, {})

    def with_rows(self, rollouts: Any, rows: Any, observations: int) -> "SplitFigures":
        """With some more rollouts and rows, given as tables."""
        columns = rows.select(["object_category", "outcome", "success"]).to_pydict()
        judged = [
            (category, success)
            for category, kind, success in zip(*columns.values(), strict=True)
            if OutcomeKind(kind).is_label
        ]
        return SplitFigures(
            self.objects | set(rollouts.column("object_id").to_pylist()),
            self.rollouts + len(rollouts),
            self.observations + observations,
            self.interactions + len(rows),
            dict(Counter(self.labels) + Counter(category for category, _ in judged)),
            dict(Counter(self.successes) + Counter(category for category, success in judged if success)),
            dict(Counter(self.outcomes) + Counter(columns["outcome"])),
        )


def data_card(store: Store, splits: dict[str, SplitFigures]) -> str:
    """The card, as Markdown."""
    setting, software = store.setting, store.document.software
    categories = sorted({category for figures in splits.values() for category in figures.labels})
    by_category = ["category", *(f"{name}: {what}" for name in splits for what in ("labels", "success rate"))]
    lines = [
        f"# Interactions with articulated objects: {setting.task}",
        "",
        "Trials of a flying gripper on articulated objects in simulation (SAPIEN), after AdaAfford (ECCV 2022): where",
        "and how it touched, the hidden dynamics, and what came of it, failures included.",
        "",
        *markdown_table(SPLIT_COLUMNS, itertools.starmap(_split_cells, splits.items()), left=len(SPLIT_COLUMNS)),
        "",
        "## Base rates by category",
        "",
        *markdown_table(by_category, (_category_cells(name, splits) for name in categories), left=len(by_category)),
        "",
        "## How trials ended",
        "",
        *(f"- {name}: {_listed(f.outcomes)}" for name, f in splits.items()),
        "",
        "## Files",
        "",
        "- `<split>/interactions.parquet`: one row an interaction; every column is described in the file's schema.",
        "  `observation` counts the clouds of the same split.",
        "- `<split>/observations.zarr`: points (world), normals (times 127), part ids, movable mask, pixels, camera.",
        *(DEPTH_LINES if setting.collection.camera.keep_depth else ()),
        "- `setting.json`: camera, fidelity, ranges of hidden dynamics, objects with the hashes of their files.",
        "- The columns of hidden dynamics and `joint_twist` are what a method must infer: no input at test time.",
        "",
        "## Provenance",
        "",
        f"- content digest of the store: `{store.digest()}`",
        f"- plans: {', '.join(plan.key for plan in store.plans())}; seed {setting.seed}",
        f"- begun: {markdown(store.document.created)}",
        f"- software: {_listed(software)}",
        "",
        "## Licence",
        "",
        "The objects' shapes can be seen in the clouds, so the licence of the objects holds for them. PartNet-Mobility",
        "may be used for research and not be redistributed; what this software's generator made is free of that.",
        "",
    ]
    return "\n".join(lines)


def _listed(values: Mapping[str, object]) -> str:
    return ", ".join(f"{markdown(name)} {markdown(value)}" for name, value in sorted(values.items()))


def _split_cells(name: str, figures: SplitFigures) -> list[str]:
    counts = (len(figures.objects), figures.rollouts, figures.observations, figures.interactions)
    return [name, *map(str, counts), _rate(figures, None)]


def _category_cells(category: str, splits: dict[str, SplitFigures]) -> list[str]:
    counted = ((str(f.labels.get(category, 0)), _rate(f, category)) for f in splits.values())
    return [markdown(category), *itertools.chain.from_iterable(counted)]


def _rate(figures: SplitFigures, category: str | None) -> str:
    names = list(figures.labels) if category is None else [category]
    labels = sum(figures.labels.get(name, 0) for name in names)
    return f"{sum(figures.successes.get(name, 0) for name in names) / labels:.1%}" if labels else "none"
