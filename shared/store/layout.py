"""The layout of a store, and the documents that describe it.

    STORE/
      store.json                     schema version, setting, software; written once
      plans/<plan key>.json          the proposer and its policy
      shards/<shard id>/             complete if, and only if, manifest.json is there
        interactions.parquet         one row an interaction
        rollouts.parquet             one row a rollout
        observations.zarr/           the clouds
        manifest.json                counts, checksums, content digests, provenance; written last
      policies/<version>/            whatever the learner publishes, and index.json
      underway/                      heartbeats of live workers (`shared.store.crash_log`); no data
      status/                        how the last collection stands (`cluster.collection.status_writer`); no data
      aside/                         what `store repair` or `store compact` took out; no data, and nothing reads it

Names that begin with ".tmp-" are work in progress or its remnants; names that begin with ".lock-" are locks.
"""

import re
import shlex
import sys
from collections.abc import Mapping, Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, Field, ValidationError, model_validator

from shared.config import MAX_DEPTH_SIZE, StrictModel
from shared.errors import SchemaVersionError, StoreError
from shared.io.documents import MAX_VALUES, checked_content, has_checksum, parse_object, problem_of
from shared.plan import Job, Setting

STORE, OBJECTS = "STORE", "OBJECTS"
"""What stands for the store and the objects in a command that is kept, since both may move."""


def reproduction(store: Path | str, shard_id: str, objects: Path | str, rollout: int | None = None) -> str:
    """The command, as a shell takes it.

    Args:
        store: folder of the store.
        shard_id: the job's shard.
        objects: folder of the objects.
        rollout: number of the rollout within the plan; None for the whole job.
    """
    words = ["adaafford", "store", "replay", str(store), shard_id, "--objects", str(objects)]
    return shlex.join(words if rollout is None else [*words, "--rollout", str(rollout)])


SCHEMA_VERSION = 1
"""docs/compatibility.md says what the number promises and when it is increased."""
HIDDEN_VERSION = 2
"""Of stores with further hidden parameters: software that knows version 1 alone would compute another digest."""
DEPTH_VERSION = 3
"""Of stores that keep depth images, with or without further hidden parameters: older software does not know them."""
ARM_VERSION = 4
"""Of stores whose hand an arm carries, with or without these two: older software does not know its outcomes."""
READ_VERSIONS = (SCHEMA_VERSION, HIDDEN_VERSION, DEPTH_VERSION, ARM_VERSION)
STORE_FILE = "store.json"
MANIFEST_FILE = "manifest.json"
INTERACTIONS_FILE = "interactions.parquet"
ROLLOUTS_FILE = "rollouts.parquet"
OBSERVATIONS_FOLDER = "observations.zarr"
PLANS_FOLDER = "plans"
SHARDS_FOLDER = "shards"
POLICIES_FOLDER = "policies"
STATUS_FOLDER = "status"
LOCK_PREFIX = ".lock-"
ASIDE_FOLDER = "aside"

MAX_DOCUMENT_BYTES = 64 << 20
"""No document of a store is larger; a million objects in a setting would be."""
MAX_ROWS = 1 << 16
MAX_POINTS = 1 << 14
MAX_ALL_POINTS = 1 << 25
MAX_ALL_PIXELS = 1 << 29
"""Bounds of one shard: rollouts, interactions and observations; N; points of all clouds; pixels of all depth images. A
hostile manifest cannot ask for unbounded work."""

MAX_MANIFEST_VALUES = 6 * MAX_ROWS
"""A digest of each rollout, four values where it was given up, and the files."""
MAX_ROLLOUTS = 10**12
"""Of a plan: the names of shards have room for no more."""
MAX_REASON = 500
"""Characters."""

_SHA256 = r"^[0-9a-f]{64}$"
PLAN_KEY = r"[a-z][a-z0-9-]{0,30}-v[0-9]{1,9}"
_SHARD_ID = re.compile(rf"(?P<plan>{PLAN_KEY})-(?P<start>[0-9]{{8,12}})-(?P<stop>[0-9]{{8,12}})")


def schema_version(added: Sequence[str], keeps_depth: bool, has_arm: bool) -> int:
    """The version of documents about rollouts, by what not every store has.

    Args:
        added: hidden parameters.
        keeps_depth: whether there are depth images.
        has_arm: whether an arm carries the hand.
    """
    if has_arm or keeps_depth:
        return ARM_VERSION if has_arm else DEPTH_VERSION
    return HIDDEN_VERSION if added else SCHEMA_VERSION


class FileEntry(StrictModel):
    """What a file of a shard must be."""

    size: int = Field(ge=0)
    sha256: str = Field(pattern=_SHA256)


def file_entries(files: Mapping[str, bytes]) -> dict[str, FileEntry]:
    """What some files are, by name."""
    return {name: FileEntry(size=len(data), sha256=sha256(data).hexdigest()) for name, data in files.items()}


class Quarantined(StrictModel):
    """A rollout that was given up, since its execution failed again and again."""

    rollout: int = Field(ge=0)
    reason: str = Field(max_length=MAX_REASON)
    """One line."""
    command: str = Field(max_length=1 << 14)
    """What executes it alone, in the foreground."""


class ShardManifest(StrictModel):
    """What a shard holds. Its presence commits the shard."""

    schema_version: int = SCHEMA_VERSION
    plan_key: str = Field(pattern=rf"^{PLAN_KEY}$")
    start: int = Field(ge=0, lt=MAX_ROLLOUTS)
    stop: int = Field(ge=1, le=MAX_ROLLOUTS)
    interactions: int = Field(ge=0, le=MAX_ROWS)
    observations: int = Field(ge=0, le=MAX_ROWS)
    points: int = Field(ge=1, le=MAX_POINTS)
    """N, of every cloud."""
    depth_size: int = Field(0, ge=0, le=MAX_DEPTH_SIZE, exclude_if=lambda size: size == 0)
    """Width and height of every depth image; 0 where none is kept."""
    files: dict[str, FileEntry]
    """By path within the shard; all but the manifest itself."""
    digests: tuple[str, ...] = Field(max_length=MAX_ROWS)
    """Content digest of each rollout, from `start` on."""
    software: dict[str, str]
    provenance: dict[str, str]
    quarantined: tuple[Quarantined, ...] = Field((), max_length=MAX_ROWS)
    """Why rollouts of that status are; like provenance, not part of the content digests."""

    @model_validator(mode="after")
    def _consistent(self) -> "ShardManifest":
        if self.stop - self.start != len(self.digests) or not self.digests:
            raise ValueError(f"rollouts {self.start} to {self.stop} need as many digests, not {len(self.digests)}")
        if not all(re.fullmatch(_SHA256, digest) for digest in self.digests):
            raise ValueError("a digest is not a SHA-256")
        if self.observations * self.points > MAX_ALL_POINTS:
            raise ValueError(f"{self.observations} clouds of {self.points} points; allowed: {MAX_ALL_POINTS} points")
        if self.observations * self.depth_size**2 > MAX_ALL_PIXELS:
            raise ValueError(
                f"{self.observations} depth images of {self.depth_size} pixels square; allowed: {MAX_ALL_PIXELS} pixels"
            )
        if not all(self.start <= each.rollout < self.stop for each in self.quarantined):
            raise ValueError("a rollout of another shard is quarantined")
        return self

    @property
    def job(self) -> Job:
        """The rollouts that it holds."""
        return Job(self.plan_key, self.start, self.stop)

    @property
    def shard_id(self) -> str:
        """Name of the shard's folder."""
        return self.job.shard_id

    @property
    def rollouts(self) -> int:
        """How many rollouts it holds, those without interactions included."""
        return self.stop - self.start

    @property
    def bytes(self) -> int:
        """Size of the shard on disk, the manifest left out."""
        return sum(entry.size for entry in self.files.values())


def _version_of(setting: Setting) -> int:
    collection = setting.collection
    return schema_version(setting.dynamics.added, collection.camera.keep_depth, collection.arm is not None)


class StoreDocument(StrictModel):
    """What store.json says."""

    setting: Setting
    schema_version: int = Field(default_factory=lambda data: _version_of(data["setting"]))
    software: dict[str, str]
    created: str
    """UTC, ISO 8601."""


Document = TypeVar("Document", bound=BaseModel)


def parse_sealed(model: type[Document], data: bytes, source: str, what: str, values: int = MAX_VALUES) -> Document:
    """A sealed document from hostile bytes; fields that this software does not know are kept, wherever they are.

    Args:
        model: what it must be.
        data: the file.
        source: what messages call it.
        what: what it should be, for messages, such as "a manifest".
        values: the most that it may hold.

    Raises:
        SchemaVersionError: it is of another schema version.
        StoreError: it is damaged or foreign.
    """
    content = parse_object(data, source, values)
    if "schema_version" in model.model_fields:
        check_schema_version(content, source)
    try:
        return model.model_validate(checked_content(content, data, source), extra="allow")
    except ValidationError as error:
        raise StoreError(f"{source}: not {what} ({problem_of(error)}); the file is damaged or foreign") from None


def parse_manifest(data: bytes, source: str) -> ShardManifest:
    """A manifest from hostile bytes; raises as `parse_sealed` does."""
    return parse_sealed(ShardManifest, data, source, "a manifest", MAX_MANIFEST_VALUES)


def parse_store_document(data: bytes, source: str) -> StoreDocument:
    """store.json from hostile bytes; raises as `parse_sealed` does."""
    return parse_sealed(StoreDocument, data, source, "a store's description")


def check_schema_version(content: dict[str, Any], source: str) -> None:
    """Refuse documents of other schema versions.

    Raises:
        SchemaVersionError: the version is another.
        StoreError: it names no version, or was damaged where it names it.
    """
    version = content.get("schema_version")
    if version in READ_VERSIONS and type(version) is int:
        return
    # A flipped bit in the number itself is damage: with the right number, the document is what was sealed.
    if not isinstance(version, int) or any(
        has_checksum(content | {"schema_version": right}) for right in READ_VERSIONS
    ):
        raise StoreError(f"{source}: names no schema version; the file is damaged: restore it from a copy")
    raise SchemaVersionError(
        f"{source}: schema version {version}, but this software reads {SCHEMA_VERSION} to {READ_VERSIONS[-1]}; use the "
        "software that wrote it, or newer"
    )


def parse_shard_id(name: str) -> Job | None:
    """The job whose shard would be called `name`; None if no shard is called that."""
    match = _SHARD_ID.fullmatch(name)
    if match is None:
        return None
    # One text for all jobs of a plan, since there may be millions.
    job = Job(sys.intern(match["plan"]), int(match["start"]), int(match["stop"]))
    return job if job.start < job.stop and job.shard_id == name else None
