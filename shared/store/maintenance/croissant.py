"""Croissant: what exported data are, for programs that look for data sets (JSON-LD by MLCommons, version 1.0)."""

import json
from typing import Any

import pyarrow as pa

from shared.store.maintenance.datacard import ABOUT, LICENCE, title
from shared.store.maintenance.formats import ExportFormat
from shared.store.maintenance.steps import Content

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


def croissant(content: Content, chosen: ExportFormat) -> dict[str, Any]:
    """The document."""
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
