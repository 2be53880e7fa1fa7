"""The card of exported data: what it is, how much, how often things succeed, where it comes from, who may use it."""

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from shared.formatting import markdown_table
from shared.io.text import markdown
from shared.types import OutcomeKind

if TYPE_CHECKING:
    from shared.store.maintenance.formats import ExportFormat
    from shared.store.maintenance.steps import Content

SPLIT_COLUMNS = ("split", "objects", "rollouts", "clouds", "interactions", "success rate")
ABOUT = (
    "Trials of a flying gripper on articulated objects in simulation (SAPIEN), after AdaAfford (ECCV 2022): where",
    "and how it touched, the hidden dynamics, and what came of it, failures included.",
)
LICENCE = (
    "The objects' shapes can be seen in the clouds, so the licence of the objects holds for them. PartNet-Mobility",
    "may be used for research and not be redistributed; what this software's generator made is free of that.",
)


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


def data_card(content: "Content", chosen: "ExportFormat") -> str:
    """The card, as Markdown; what programs read of it stands before it, as YAML."""
    store, splits = content.store, content.figures
    setting, software = store.setting, store.document.software
    categories = sorted({category for figures in splits.values() for category in figures.labels})
    by_category = ["category", *(f"{name}: {what}" for name in splits for what in ("labels", "success rate"))]
    lines = [
        *_front_matter(content, chosen),
        f"# {title(content)}",
        "",
        *ABOUT,
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
        *chosen.files(content),
        "- `setting.json`: camera, fidelity, ranges of hidden dynamics, objects with the hashes of their files.",
        "- `croissant.json`: this card for programs, in the Croissant format.",
        "- The columns of hidden dynamics and `joint_twist` are what a method must infer: no input at test time.",
        "",
        "## Provenance",
        "",
        f"- content digest of the store: `{content.digest}`",
        f"- plans: {', '.join(plan.key for plan in store.plans())}; seed {setting.seed}",
        f"- begun: {markdown(store.document.created)}",
        f"- software: {_listed(software)}",
        "",
        "## Licence",
        "",
        *LICENCE,
        "",
    ]
    return "\n".join(lines)


def title(content: "Content") -> str:
    """What the data are called."""
    return f"Interactions with articulated objects: {content.store.setting.task}"


def _front_matter(content: "Content", chosen: "ExportFormat") -> list[str]:
    """What the Hugging Face Hub reads; JSON is YAML, and quotes every text."""
    front: dict[str, Any] = {
        "pretty_name": title(content),
        "license": "other",
        "task_categories": ["robotics"],
        "size_categories": [size_category(content.figures.values())],
        "tags": ["robotics", "affordance", "articulated-objects", "point-cloud", *chosen.tags],
    }
    if patterns := chosen.patterns(content):
        files = [{"split": split, "path": list(paths)} for split, paths in patterns.items()]
        front["configs"] = [{"config_name": "default", "data_files": files}]
    return ["---", *(f"{key}: {json.dumps(value)}" for key, value in front.items()), "---", ""]


def size_category(figures: Iterable[SplitFigures]) -> str:
    """How the Hub calls so many steps, such as "10K<n<100K"."""
    steps, names = sum(each.interactions for each in figures), ["1K", "10K", "100K", "1M", "10M", "100M", "1B", "10B"]
    power = min(max(0, len(str(steps)) - 3), len(names))
    return (
        f"n<{names[0]}"
        if not power
        else f"n>{names[-1]}"
        if power == len(names)
        else "<n<".join(names[power - 1 : power + 1])
    )


def _listed(values: Mapping[str, object]) -> str:
    return ", ".join(f"{markdown(name)} {markdown(value)}" for name, value in sorted(values.items()))


def _split_cells(name: str, figures: SplitFigures) -> list[str]:
    counts = (len(figures.objects), figures.rollouts, figures.observations, figures.interactions)
    return [name, *map(str, counts), _rate(figures, None)]


def _category_cells(category: str, splits: Mapping[str, SplitFigures]) -> list[str]:
    counted = ((str(f.labels.get(category, 0)), _rate(f, category)) for f in splits.values())
    return [markdown(category), *itertools.chain.from_iterable(counted)]


def _rate(figures: SplitFigures, category: str | None) -> str:
    names = list(figures.labels) if category is None else [category]
    labels = sum(figures.labels.get(name, 0) for name in names)
    return f"{sum(figures.successes.get(name, 0) for name in names) / labels:.1%}" if labels else "none"
