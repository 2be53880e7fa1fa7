"""Export: a store as plain files for people who want no store, with a card that says what they are.

OUT/
  README.md        the data card
  croissant.json   the same for programs (see `shared.store.maintenance.croissant`)
  setting.json     how all of it was collected
  ...              the data, as the format has them (see `shared.store.maintenance.formats`)

While it is written it is called OUT.unfinished. When it is killed, what is finished stays, and the same call goes on:

OUT.unfinished/.export/begun.json      what is exported
OUT.unfinished/.export/<n>.json        of each finished piece, its files and its summary
"""

import hashlib
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.errors import StoreError, UsageError
from shared.io.documents import parse_object
from shared.io.files import (
    DRIVER_LOCK,
    exclusive_lock,
    read_bounded,
    remove_tree,
    sync_file,
    sync_folder,
    write_atomically,
)
from shared.io.text import MAX_WORD, plain
from shared.seeds import generator
from shared.store.layout import MAX_DOCUMENT_BYTES
from shared.store.maintenance.croissant import croissant
from shared.store.maintenance.datacard import SplitFigures, data_card
from shared.store.maintenance.formats import EXPORT_FORMATS, PLAIN, ExportFormat, Summary
from shared.store.maintenance.hub import pusher
from shared.store.maintenance.steps import Content, Piece, Splits, survey
from shared.store.store import Store

UNFINISHED = ".unfinished"
SPLIT_NAME = r"[a-z][a-z0-9_]{0,30}"
_NOTES, _BEGUN, _PIECE = ".export", "begun.json", "piece"
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Export:
    """What an export wrote."""

    out: str
    splits: dict[str, SplitFigures]


def splits_by_share(store: Store, test_share: float, seed: int) -> dict[str, frozenset[str]]:
    """Objects drawn at random within each category: "train" and, if the share is above 0, "test".

    Raises:
        UsageError: the share is not one.
    """
    if not 0 <= test_share < 1:
        raise UsageError(f"--test-share {test_share} is not allowed; choose 0 to below 1")
    test: set[str] = set()
    by_category: dict[str, list[str]] = {}
    for ref in store.setting.objects:
        by_category.setdefault(ref.category, []).append(ref.id)
    for category, ids in sorted(by_category.items()):
        count = round(test_share * len(ids))
        test |= set(generator(seed, f"export/{category}").choice(sorted(ids), count, replace=False).tolist())
    train = {ref.id for ref in store.setting.objects} - test
    return {"train": frozenset(train)} | ({"test": frozenset(test)} if test_share else {})


def export(
    store: Store, out: Path, splits: Splits, progress: Progress | None = None, *, format: str = PLAIN, push: str = ""
) -> Export:
    """Write a store as plain files; `out` is there when all of it is. After a kill or on a full disk, the same goes on.

    Args:
        store: what is written.
        out: a folder that is not there yet.
        splits: objects of each split; rows of objects in none are left out.
        progress: called after each shard with how many are done and how many there are; each shard counts when its
            tables are looked through, and again when it is written.
        format: name in `EXPORT_FORMATS`.
        push: "USER/NAME" of a data set on the Hugging Face Hub, where the files are put, too, before `out` is there.

    Raises:
        UsageError: no such format; the folder is there, or cannot be written; or an object is in two splits, or
            in no store; or the Hub refuses.
        StoreError: the store is damaged, or a split comes out empty.
    """
    chosen = EXPORT_FORMATS.get(format)
    _check_splits(store, splits)
    if os.path.lexists(out):
        raise UsageError(f"{out}: is there already; name a new folder")
    say = progress or (lambda done, total: None)
    deliver = pusher(push, _NOTES) if push else None
    content = survey(store, splits, say)
    folder = out.with_name(out.name + UNFINISHED)
    try:
        with _unfinished(folder, _identity(content, chosen)):
            receipts = list(_pieces(content, chosen, folder, say))
            chosen.finish(content, folder, [receipt["summary"] for receipt in receipts])
            write_atomically(folder / "setting.json", _json(store.setting.as_document()))
            write_atomically(folder / "README.md", data_card(content, chosen).encode())
            write_atomically(folder / "croissant.json", _json(croissant(content, chosen)))
            if deliver is not None:
                deliver(folder)
            # It names this machine. The other notes stay until the folder has its name: a kill here loses nothing.
            (folder / _NOTES / DRIVER_LOCK).unlink()
            folder.rename(out)
            remove_tree(out / _NOTES)
            sync_folder(out.parent)
    except OSError as error:
        why = os.strerror(error.errno) if error.errno else str(error)
        left = f"; what is finished is in {folder}: repeat the command to go on" if folder.is_dir() else ""
        raise UsageError(f"{out}: cannot be written ({why}){left}, or name another folder") from None
    return Export(str(out), dict(content.figures))


def _identity(content: Content, chosen: ExportFormat) -> dict[str, Any]:
    """What an export that goes on must have in common with the one that was begun."""
    pieces = [str(piece) for piece in content.pieces(chosen.piece_bytes)]
    told = [content.digest, str(content.schema), pieces, {name: sorted(each) for name, each in content.splits.items()}]
    return {"format": chosen.name, "content": hashlib.sha256(json.dumps(told).encode()).hexdigest()}


@contextmanager
def _unfinished(folder: Path, identity: dict[str, Any]) -> Iterator[None]:
    """Hold the folder of an export: what the same one left there, or an empty one.

    Raises:
        UsageError: another process holds it, or it holds something that is no export.
        OSError: it cannot be made.
    """
    notes = folder / _NOTES
    folder.mkdir(parents=True, exist_ok=True)
    if not notes.is_dir() and any(folder.iterdir()):
        raise UsageError(f"{folder}: holds something that is no unfinished export; move it away or name another folder")
    notes.mkdir(exist_ok=True)
    with exclusive_lock(notes / DRIVER_LOCK):
        if _note(notes / _BEGUN) != identity:
            # Begun by another command, or before the store had grown.
            for path in [*folder.iterdir(), *notes.iterdir()]:
                if path not in (notes, notes / DRIVER_LOCK):
                    remove_tree(path)
            write_atomically(notes / _BEGUN, json.dumps(identity).encode())
        yield


def _pieces(content: Content, chosen: ExportFormat, folder: Path, progress: Progress) -> Iterator[dict[str, Any]]:
    """Write the pieces that are not there yet; what is known of each, in order."""
    pieces, done = content.pieces(chosen.piece_bytes), content.shards
    total = done + sum(len(piece.parts) for piece in pieces)
    for number, piece in enumerate(pieces):
        note = folder / _NOTES / f"{number}.json"
        receipt = _note(note)
        if receipt is None or any(_size(folder / name) != size for name, size in receipt["files"].items()):
            counted = itertools.count(done + 1)

            def shard_done(counted: Iterator[int] = counted) -> None:
                progress(next(counted), total)

            files, summary = _write_piece(content, chosen, piece, folder, shard_done)
            receipt = {"files": files, "summary": summary}
            write_atomically(note, json.dumps(receipt).encode())
        done += len(piece.parts)
        yield receipt


def _write_piece(
    content: Content, chosen: ExportFormat, piece: Piece, folder: Path, shard_done: Callable[[], None]
) -> tuple[dict[str, int], Summary]:
    """Write a piece beside the others, and move it among them once it is there."""
    aside = folder / _NOTES / _PIECE
    remove_tree(aside)
    aside.mkdir()
    summary = chosen.write(content, piece, aside, shard_done)
    files = {}
    for path in sorted(path for path in aside.rglob("*") if path.is_file()):
        name = path.relative_to(aside)
        sync_file(path)
        files[str(name)] = path.stat().st_size
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        path.replace(folder / name)
    remove_tree(aside)
    return files, summary


def _note(path: Path) -> dict[str, Any] | None:
    """A note of an export; None where it is missing or was damaged."""
    try:
        return parse_object(read_bounded(path, MAX_DOCUMENT_BYTES), str(path))
    except StoreError:
        return None


def _size(path: Path) -> int | None:
    return path.stat().st_size if path.is_file() else None


def _json(document: dict[str, Any]) -> bytes:
    return f"{json.dumps(document, indent=2)}\n".encode()


def _check_splits(store: Store, splits: Splits) -> None:
    known = {ref.id for ref in store.setting.objects}
    seen: set[str] = set()
    for name, objects in splits.items():
        if not re.fullmatch(SPLIT_NAME, name):
            raise UsageError(f"split '{plain(name, MAX_WORD)}': a name has lower-case letters, digits and underscores")
        for odd, what in ((objects - known, "is not in the store"), (objects & seen, "is in another split too")):
            if odd:
                raise UsageError(f"split '{name}': object '{min(odd)}' {what}; list each object of the store once")
        seen |= objects
