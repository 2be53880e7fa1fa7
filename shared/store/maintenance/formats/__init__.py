"""File formats that a store is exported in: one file each, found by name, also in other packages.

They differ in their files and in what stands around these; the rows come from `shared.store.maintenance.steps`.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.extensions import Registry
from shared.store.maintenance.steps import Content, Piece

Summary = dict[str, Any]
"""What a format must know of a piece in the end: a JSON object, which an export that goes on reads back."""
PLAIN = "plain"
"""The format that is written unless told otherwise."""


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """One file format.

    Attributes:
        name: that users choose it by.
        piece_bytes: a piece ends with the shard that brings its clouds above this; None: one piece a split.
        write: writes a piece into an empty folder, by the paths that its files are to have in the export; the last
            argument is to be called after each shard.
        finish: writes what stands beside the pieces, into the folder of the export, given their summaries in order.
        files: lines of the data card that say what the files are, in Markdown.
        tags: of the data card.
        patterns: which files a program opens for each split; none where no reader takes lists of files.
        mime_type: of these files.
        schema: of these files where they are Parquet.
    """

    name: str
    piece_bytes: int | None
    write: Callable[[Content, Piece, Path, Callable[[], None]], Summary]
    finish: Callable[[Content, Path, Sequence[Summary]], None]
    files: Callable[[Content], Sequence[str]]
    tags: tuple[str, ...] = ()
    patterns: Callable[[Content], Mapping[str, Sequence[str]]] = lambda content: {}
    mime_type: str = "application/x-parquet"
    schema: Callable[[Content], Any] = lambda content: None


def word(text: str) -> str:
    """A text of a store, which may be anybody's, as a part of a file's name that leads nowhere."""
    return re.sub(r"[^A-Za-z0-9_-]", "-", text)


def nothing_to_finish(content: Content, folder: Path, summaries: Sequence[Summary]) -> None:
    """The `finish` of a format whose pieces are all that there is."""


EXPORT_FORMATS = Registry(
    "export format",
    ExportFormat,
    {
        PLAIN: "shared.store.maintenance.formats.plain:PLAIN",
        "hf": "shared.store.maintenance.formats.hf:HF",
        "lerobot": "shared.store.maintenance.formats.lerobot:LEROBOT",
        "webdataset": "shared.store.maintenance.formats.webdataset:WEBDATASET",
        "minari": "shared.store.maintenance.formats.minari:MINARI",
    },
)
"""By name; those of other packages come by the entry points `adaafford.export_formats`."""
