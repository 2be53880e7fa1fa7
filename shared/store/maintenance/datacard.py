"""The card of exported data: what it is, how much, how often things succeed, where it comes from, who may use it.

`data_card` is for people, `croissant` for programs.
"""

import itertools
import json
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pyarrow as pa

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


_TERMS = (
    *("citeAs", "column", "extract", "field", "fileProperty", "fileObject", "fileSet", "format", "includes"),
    *("isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex", "repeated"),
    *("replace", "separator", "source", "subField", "transform"),
)
"""What the vocabulary has for the names that documents use."""
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    **{term: f"cr:{term}" for term in _TERMS},
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
}


def croissant(content: "Content", chosen: "ExportFormat") -> dict[str, Any]:
    """What the data are, for programs that look for data sets: Croissant 1.0 by MLCommons, JSON-LD."""
    patterns = chosen.patterns(content)
    schema = chosen.schema(content)
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": f"adaafford-{content.store.setting.task}",
        "alternateName": title(content),
        "description": " ".join(ABOUT),
        "license": " ".join(LICENCE),
        "version": "1.0.0",
        "datePublished": content.store.document.created,
        "isLiveDataset": False,
        "keywords": ["robotics", "affordance", "articulated objects", "point clouds", *chosen.tags],
        "distribution": [
            {
                "@type": "cr:FileSet",
                "@id": split,
                "name": split,
                "description": f"files of the split {split}",
                "encodingFormat": chosen.mime_type,
                "includes": list(paths) if len(paths) > 1 else paths[0],
            }
            for split, paths in patterns.items()
        ],
        "recordSet": [_record_set(split, schema) for split in patterns] if schema is not None else [],
    }


def _record_set(split: str, schema: Any) -> dict[str, Any]:
    return {
        "@type": "cr:RecordSet",
        "@id": f"{split}/steps",
        "name": f"{split}/steps",
        "description": f"rows of the split {split}",
        "field": [_field(split, each) for each in schema],
    }


def _field(split: str, each: Any) -> dict[str, Any]:
    number, repeated = each.type, pa.types.is_nested(each.type)
    shape = []
    while pa.types.is_nested(number):
        shape.append(getattr(number, "list_size", None))
        number = number.value_type
    described = (each.metadata or {}).get(b"description", b"").decode()
    size = f"; shape {json.dumps(shape)}" if repeated and None not in shape else ""
    return {
        "@type": "cr:Field",
        "@id": f"{split}/steps/{each.name}",
        "name": each.name,
        "description": f"{described}{size}",
        "dataType": _data_type(number),
        **({"repeated": True} if repeated else {}),
        "source": {"fileSet": {"@id": split}, "extract": {"column": each.name}},
    }


def _data_type(kind: Any) -> str:
    if pa.types.is_boolean(kind):
        return "sc:Boolean"
    if pa.types.is_integer(kind):
        return "sc:Integer"
    return "sc:Float" if pa.types.is_floating(kind) else "sc:Text"
