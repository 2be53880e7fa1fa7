"""Export: a store as plain files for people who want no store, with a card that says what they are.

OUT/
  README.md        the data card
  croissant.json   the same for programs (see `shared.store.maintenance.datacard`)
  setting.json     how all of it was collected
  ...              the data, as the format has them (see `shared.store.maintenance.formats`)

See `shared.store.maintenance.destinations` for how it is called while it is written, and how it goes on.
"""

import hashlib
import importlib
import itertools
import json
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shared.errors import UsageError
from shared.extras import require_packages
from shared.io.files import write_atomically
from shared.io.text import MAX_WORD, plain
from shared.seeds import generator
from shared.store.backends.base import is_url
from shared.store.maintenance.datacard import SplitFigures, croissant, data_card
from shared.store.maintenance.destinations import CROISSANT, IDENTIFIER, NOTES, Destination, destination
from shared.store.maintenance.formats import EXPORT_FORMATS, PLAIN, ExportFormat
from shared.store.maintenance.steps import Content, Splits, survey
from shared.store.store import Store

SPLIT_NAME = r"[a-z][a-z0-9_]{0,30}"
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
    store: Store,
    out: str | Path,
    splits: Splits,
    progress: Progress | None = None,
    *,
    format: str = PLAIN,
    push: str = "",
) -> Export:
    """Write a store as plain files; `out` is there when all of it is. After a kill or on a full disk, the same goes on.

    A complete export of the same content is left as it is.

    Args:
        store: what is written.
        out: a folder that is not there yet, or s3://BUCKET/PREFIX with nothing below it.
        splits: objects of each split; rows of objects in none are left out.
        progress: called after each shard with how many are done and how many there are; each shard counts when its
            tables are looked through, and again when it is written.
        format: name in `EXPORT_FORMATS`.
        push: "USER/NAME" of a data set on the Hugging Face Hub, where the files are put, too, before `out` is there.

    Raises:
        UsageError: no such format; something else is at the place, or it cannot be written; or an object is in two
            splits, or in no store; or the Hub refuses.
        StoreError: the store is damaged, or a split comes out empty.
    """
    chosen = EXPORT_FORMATS.get(format)
    _check_splits(store, splits)
    if push and is_url(out):
        raise UsageError(f"{out}: --push puts the files of a folder on the Hub; name a folder, or leave it out")
    place = destination(out)
    say = progress or (lambda done, total: None)
    deliver = pusher(push, NOTES) if push else None
    content = survey(store, splits, say)
    identity = _identity(content, chosen)
    try:
        if place.is_complete(identity):
            if deliver is not None:
                deliver(Path(out))
            return Export(str(out), dict(content.figures))
        with place.begin(identity):
            receipts = list(_pieces(content, chosen, place, say))
            folder = place.folder
            chosen.finish(content, folder, [receipt["summary"] for receipt in receipts])
            write_atomically(folder / "setting.json", _json(store.setting.as_document()))
            write_atomically(folder / "README.md", data_card(content, chosen).encode())
            write_atomically(folder / CROISSANT, _json(croissant(content, chosen) | {IDENTIFIER: identity}))
            if deliver is not None:
                deliver(folder)
            place.complete()
    except OSError as error:
        raise place.on_error(error) from None
    return Export(str(out), dict(content.figures))


def _identity(content: Content, chosen: ExportFormat) -> str:
    """What an export that goes on must have in common with the one that was begun."""
    pieces = [str(piece) for piece in content.pieces(chosen.piece_bytes)]
    told = [content.digest, str(content.schema), pieces, {name: sorted(each) for name, each in content.splits.items()}]
    return f"{chosen.name}:{hashlib.sha256(json.dumps(told).encode()).hexdigest()}"


def _pieces(content: Content, chosen: ExportFormat, place: Destination, progress: Progress) -> Iterator[dict[str, Any]]:
    """Write the pieces that are not there yet; what is known of each, in order."""
    pieces, done = content.pieces(chosen.piece_bytes), content.shards
    total = done + sum(len(piece.parts) for piece in pieces)
    for number, piece in enumerate(pieces):
        receipt = place.note(f"{number}.json")
        if receipt is None or not place.has(receipt["files"]):
            counted = itertools.count(done + 1)

            def shard_done(counted: Iterator[int] = counted) -> None:
                progress(next(counted), total)

            aside = place.piece()
            summary = chosen.write(content, piece, aside, shard_done)
            receipt = {"files": place.take(aside), "summary": summary}
            place.add_note(f"{number}.json", receipt)
        done += len(piece.parts)
        yield receipt


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


TOKEN = "HF_TOKEN"  # noqa: S105 - the variable's name.
_REPO = r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}/[A-Za-z0-9][A-Za-z0-9._-]{0,95}"
_LONGEST = 200
_REASONS = {401: f"the token in {TOKEN} is not accepted", 403: f"the token in {TOKEN} may not write there"}
"""By the status of an answer."""
_LATER = "try again later"


def pusher(repo: str, leave: str) -> Callable[[Path], None]:
    """What puts a folder on the Hugging Face Hub; whatever can be known before the work starts is checked here.

    The token is taken from HF_TOKEN alone, and the server from HF_ENDPOINT, if that is set.

    Args:
        repo: "USER/NAME" of the data set, which is made where it is not there.
        leave: name of a folder within that is not put there.

    Raises:
        UsageError: it is no such name, the package is not installed, or there is no token. What is returned
            raises it, too, where the server refuses or cannot be reached.
    """
    if not re.fullmatch(_REPO, repo):
        raise UsageError(f"--push '{plain(repo, _LONGEST)}': is no name of a data set; give USER/NAME")
    require_packages("--push", "huggingface_hub")
    if not os.environ.get(TOKEN):
        raise UsageError(f"--push needs a token that may write; put it into the environment as {TOKEN}")

    def push(folder: Path) -> None:
        hub: Any = importlib.import_module("huggingface_hub")
        api = hub.HfApi(endpoint=os.environ.get("HF_ENDPOINT") or None, token=os.environ[TOKEN])
        try:
            api.create_repo(repo, repo_type="dataset", exist_ok=True)
            api.upload_folder(repo_id=repo, folder_path=folder, repo_type="dataset", ignore_patterns=[f"{leave}/*"])
        except Exception as error:
            status = getattr(getattr(error, "response", None), "status_code", None)
            lines = str(error).strip().splitlines() or [type(error).__name__]
            why = _LATER if status and status >= 500 else _REASONS.get(status or 0, plain(lines[0], _LONGEST))
            answer = "the Hub cannot be reached" if status is None else f"the Hub answered {status}"
            raise UsageError(f"--push {repo}: {answer} ({why}); the same command goes on") from error

    return push
