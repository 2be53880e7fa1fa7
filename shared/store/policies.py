"""Policies, which the learner publishes for the collectors, by version; a version never changes."""

import hashlib
import re
from collections.abc import Collection, Mapping

from shared.config import StrictModel
from shared.errors import StoreError
from shared.io.documents import with_checksum
from shared.store.backends.base import Folder, StorageBackend, Transaction
from shared.store.layout import (
    MAX_DOCUMENT_BYTES,
    POLICIES_FOLDER,
    SCHEMA_VERSION,
    FileEntry,
    file_entries,
    parse_sealed,
)

INDEX_FILE = "index.json"
MAX_POLICY_BYTES = (1 << 28) + (1 << 20)
MAX_VERSION = 999_999
_FILE_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,99}")


class PolicyIndex(StrictModel):
    """The files of a policy, with sizes and checksums."""

    schema_version: int = SCHEMA_VERSION
    version: int
    files: dict[str, FileEntry]


def publish_policy(backend: StorageBackend, version: int, files: Mapping[str, bytes]) -> None:
    """Publish a policy's files atomically; publishing the same files again changes nothing.

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
    folder = _folder(backend, version)

    def describe(held: Mapping[str, bytes]) -> bytes:
        if held != files:
            raise StoreError(f"{folder}: another attempt left other files here; run `adaafford store repair`")
        return with_checksum(PolicyIndex(version=version, files=file_entries(held)).as_document())

    published = backend.publish(
        Transaction(folder.key, files, INDEX_FILE, describe=describe, check=lambda: None, lock="policies")
    )
    if not published and read_policy(backend, version) != dict(files):
        raise StoreError(f"{folder}: exists with other content; publish under the next version")


def read_policy(backend: StorageBackend, version: int) -> dict[str, bytes]:
    """A policy's files, of the sizes and checksums that its index states.

    Raises:
        StoreError: there is no such policy, or it is damaged.
        SchemaVersionError: its index is of another schema version.
    """
    folder = _folder(backend, version)
    index = _read_index(backend, version)
    contents = folder.read_all([(name, entry.size) for name, entry in index.files.items()])
    return {
        name: _checked(f"{folder}/{name}", data, index.files[name])
        for name, data in zip(index.files, contents, strict=True)
    }


def version_of(backend: StorageBackend, files: Mapping[str, bytes], besides: Collection[int] = ()) -> int | None:
    """The first version that was published with exactly these files; None if there is none.

    Raises:
        StoreError: an index is damaged.
    """
    entries = file_entries(files)
    alike = (v for v in policy_versions(backend) if v not in besides and _read_index(backend, v).files == entries)
    return next(alike, None)


def _read_index(backend: StorageBackend, version: int) -> PolicyIndex:
    folder = _folder(backend, version)
    if not folder.has(INDEX_FILE):
        known = ", ".join(str(v) for v in policy_versions(backend)) or "none"
        raise StoreError(f"{folder}: there is no policy {version}; published: {known}")
    path = f"{folder}/{INDEX_FILE}"
    index = parse_sealed(PolicyIndex, folder.read(INDEX_FILE, MAX_DOCUMENT_BYTES), path, "the index of a policy")
    sizes = sum(entry.size for entry in index.files.values())
    if index.version != version or not all(map(_allowed, index.files)) or sizes > MAX_POLICY_BYTES:
        raise StoreError(f"{path}: not the index of policy {version}; the file is foreign")
    return index


def policy_versions(backend: StorageBackend) -> tuple[int, ...]:
    """The published versions, ascending."""
    versions = [int(name) for name in backend.names(POLICIES_FOLDER) if re.fullmatch(r"[0-9]{6}", name)]
    if backend.writes_in_place:
        versions = [version for version in versions if _folder(backend, version).has(INDEX_FILE)]
    return tuple(versions)


def folder_name(version: int) -> str:
    """Name of a policy's folder."""
    return f"{version:06d}"


def _allowed(name: str) -> bool:
    return _FILE_NAME.fullmatch(name) is not None and name != INDEX_FILE


def _folder(backend: StorageBackend, version: int) -> Folder:
    return Folder(backend, f"{POLICIES_FOLDER}/{folder_name(version)}")


def _checked(path: str, data: bytes, entry: FileEntry) -> bytes:
    if len(data) != entry.size or hashlib.sha256(data).hexdigest() != entry.sha256:
        raise StoreError(f"{path}: not what was published; the file is damaged: restore it from a copy")
    return data
