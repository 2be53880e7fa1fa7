"""Policies: what the learner publishes for the collectors, by version, immutable once there."""

import hashlib
import re
from collections.abc import Mapping
from pathlib import Path

from pydantic import ValidationError

from shared.configuration import StrictModel
from shared.errors import StoreError
from shared.files import read_bounded, remove_tree, sync_folder, temporary_name, write_durably
from shared.store.layout import MAX_DOCUMENT_BYTES, SCHEMA_VERSION, FileEntry, check_schema_version
from shared.store.sealed import parse_object, seal, unseal

INDEX_FILE = "index.json"
MAX_POLICY_BYTES = 1 << 30
MAX_VERSION = 999_999
_FILE_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,99}")


class PolicyIndex(StrictModel):
    """What a policy's folder holds."""

    schema_version: int = SCHEMA_VERSION
    version: int
    files: dict[str, FileEntry]


def publish_policy(policies: Path, version: int, files: Mapping[str, bytes]) -> None:
    """Put a policy's files into the store, all or none; publishing the same again changes nothing.

    Raises:
        StoreError: the version or a file's name is not allowed, or the version exists with other content.
    """
    if not 1 <= version <= MAX_VERSION:
        raise StoreError(f"policy version {version} is not allowed; choose 1 to {MAX_VERSION}")
    for name in files:
        if not _allowed(name):
            raise StoreError(f"policy file {name!r} is not allowed; use lower-case letters, digits, '.', '_' and '-'")
    if not files or sum(map(len, files.values())) > MAX_POLICY_BYTES:
        raise StoreError(f"policy {version}: needs at least one file, and at most {MAX_POLICY_BYTES} bytes in all")
    final = policies / folder_name(version)
    policies.mkdir(exist_ok=True)
    temporary = policies / temporary_name(final.name)
    entries = {n: FileEntry(size=len(data), sha256=hashlib.sha256(data).hexdigest()) for n, data in files.items()}
    index = seal(PolicyIndex(version=version, files=entries).model_dump(mode="json"))
    try:
        temporary.mkdir()
        for name, data in files.items():
            write_durably(temporary / name, data)
        write_durably(temporary / INDEX_FILE, index)
        sync_folder(temporary)
        # A rename does not replace a folder that holds something: the first publisher wins.
        temporary.rename(final)
        sync_folder(policies)
    except OSError:
        if not (final / INDEX_FILE).exists():
            raise
        if read_policy(policies, version) != dict(files):
            raise StoreError(f"{final}: exists with other content; publish under the next version") from None
    finally:
        remove_tree(temporary)


def read_policy(policies: Path, version: int) -> dict[str, bytes]:
    """A policy's files, of the sizes and checksums that its index states.

    Raises:
        StoreError: there is no such policy, or it is damaged.
    """
    folder = policies / folder_name(version)
    if not folder.is_dir() or folder.is_symlink():
        known = ", ".join(str(v) for v in policy_versions(policies)) or "none"
        raise StoreError(f"{folder}: there is no policy {version}; published: {known}")
    path = folder / INDEX_FILE
    data = read_bounded(path, MAX_DOCUMENT_BYTES)
    check_schema_version(parse_object(data, str(path)), str(path))
    try:
        index = PolicyIndex.model_validate(unseal(data, str(path)))
    except ValidationError:
        raise StoreError(f"{path}: not the index of a policy; the file is damaged or foreign") from None
    sizes = sum(entry.size for entry in index.files.values())
    if index.version != version or not all(map(_allowed, index.files)) or sizes > MAX_POLICY_BYTES:
        raise StoreError(f"{path}: not the index of policy {version}; the file is foreign")
    return {name: _read(folder / name, entry) for name, entry in index.files.items()}


def policy_versions(policies: Path) -> tuple[int, ...]:
    """The versions that are published, in order."""
    names = [path.name for path in policies.iterdir()] if policies.is_dir() else []
    return tuple(sorted(int(name) for name in names if re.fullmatch(r"[0-9]{6}", name)))


def folder_name(version: int) -> str:
    """Name of a policy's folder."""
    return f"{version:06d}"


def _allowed(name: str) -> bool:
    return _FILE_NAME.fullmatch(name) is not None and name != INDEX_FILE


def _read(path: Path, entry: FileEntry) -> bytes:
    data = read_bounded(path, entry.size)
    if len(data) != entry.size or hashlib.sha256(data).hexdigest() != entry.sha256:
        raise StoreError(f"{path}: not what was published; the file is damaged: restore it from a copy")
    return data
