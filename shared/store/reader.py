"""Reading shards, which are hostile until their sizes, checksums, schemas and references have been checked."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from shared.errors import StoreError
from shared.files import read_bounded
from shared.plan import Job, ObjectRef
from shared.records import InteractionRecord, RolloutRecord, RolloutStatus
from shared.store import observations
from shared.store.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS
from shared.store.layout import (
    INTERACTIONS_FILE,
    MANIFEST_FILE,
    MAX_DOCUMENT_BYTES,
    OBSERVATIONS_FOLDER,
    ROLLOUTS_FILE,
    ShardManifest,
    parse_manifest,
    parse_shard_id,
)
from shared.store.observations import ObservationArrays
from shared.store.tables import INTERACTION_SCHEMA, MAX_ROW_BYTES, ROLLOUT_SCHEMA, column_values, read_table
from shared.store.validity import check_rollouts
from shared.vocabulary import (
    Action,
    Direction,
    HiddenDynamics,
    Observation,
    Order,
    Outcome,
    OutcomeKind,
    Primitive,
    Role,
)


def is_committed(shard: Path) -> bool:
    """Whether a shard's folder holds a manifest."""
    return (shard / MANIFEST_FILE).exists()


def committed_shards(shards: Path, plan_key: str | None = None) -> Iterator[Path]:
    """Folders of the committed shards, in order of name."""
    names = sorted(path.name for path in shards.iterdir()) if shards.is_dir() else []
    for name in names:
        job = parse_shard_id(name)
        if job is not None and plan_key in (None, job.plan_key) and is_committed(shards / name):
            yield shards / name


def read_manifest(shard: Path) -> ShardManifest:
    """The manifest of a shard.

    Raises:
        StoreError: it is damaged, foreign, of another schema version, or another shard's.
    """
    path = shard / MANIFEST_FILE
    manifest = parse_manifest(read_bounded(path, MAX_DOCUMENT_BYTES), str(path))
    if manifest.shard_id != shard.name:
        raise StoreError(f"{path}: belongs to shard {manifest.shard_id}; put the folder back under its own name")
    expected = expected_files(manifest)
    if manifest.files.keys() != expected.keys():
        odd = sorted(manifest.files.keys() ^ expected.keys())[0]
        raise StoreError(f"{path}: lists other files than a shard of this size has ({odd[:80]!r}); it is foreign")
    for name, entry in manifest.files.items():
        if entry.size > expected[name]:
            raise StoreError(f"{path}: claims {entry.size} bytes for {name}, at most {expected[name]} are possible")
    return manifest


def expected_files(manifest: ShardManifest) -> dict[str, int]:
    """Paths of all files that the shard must have, and the most bytes each may have, from the counts alone."""
    clouds = observations.size_limit(manifest.observations, manifest.points)
    names = observations.file_names(manifest.observations, manifest.points)
    return {
        ROLLOUTS_FILE: (manifest.rollouts + 16) * MAX_ROW_BYTES,
        INTERACTIONS_FILE: (manifest.interactions + 16) * MAX_ROW_BYTES,
        **{f"{OBSERVATIONS_FOLDER}/{name}": clouds for name in names},
    }


def read_file(shard: Path, manifest: ShardManifest, name: str) -> bytes:
    """A file of a shard, of the size and checksum that the manifest states.

    Raises:
        StoreError: it is missing, or is not what was committed.
    """
    path, entry = shard / name, manifest.files[name]
    if any(parent.is_symlink() for parent in path.parents if parent.is_relative_to(shard)):
        raise StoreError(f"{path}: reached through a symbolic link; replace it by the folder itself")
    data = read_bounded(path, entry.size)
    if len(data) != entry.size:
        raise StoreError(f"{path}: has {len(data)} bytes, the manifest says {entry.size}; restore it from a copy")
    if hashlib.sha256(data).hexdigest() != entry.sha256:
        raise StoreError(f"{path}: its SHA-256 is not the manifest's; the file is damaged: restore it from a copy")
    return data


def read_interactions(shard: Path, manifest: ShardManifest, names: Sequence[str] | None = None) -> Any:
    """The table of a shard's interactions, or some columns of it."""
    data = read_file(shard, manifest, INTERACTIONS_FILE)
    return read_table(data, INTERACTION_SCHEMA, manifest.interactions, f"{shard / INTERACTIONS_FILE}", names)


def read_rollout_table(shard: Path, manifest: ShardManifest) -> Any:
    """The table of a shard's rollouts."""
    data = read_file(shard, manifest, ROLLOUTS_FILE)
    return read_table(data, ROLLOUT_SCHEMA, manifest.rollouts, f"{shard / ROLLOUTS_FILE}")


def read_observations(shard: Path, manifest: ShardManifest) -> ObservationArrays:
    """All clouds of a shard."""
    prefix = f"{OBSERVATIONS_FOLDER}/"
    names = [name for name in manifest.files if name.startswith(prefix)]
    files = {name.removeprefix(prefix): read_file(shard, manifest, name) for name in names}
    return observations.decode(files, manifest.observations, manifest.points, str(shard / OBSERVATIONS_FOLDER))


def read_rollouts(shard: Path, manifest: ShardManifest) -> tuple[RolloutRecord, ...]:
    """The records of a shard, bit for bit as they were committed.

    Raises:
        StoreError: a file is damaged or foreign, or a row breaks the rules of a record.
    """
    heads = _rows(read_rollout_table(shard, manifest), ROLLOUT_COLUMNS)
    rows = _rows(read_interactions(shard, manifest), INTERACTION_COLUMNS)
    arrays = read_observations(shard, manifest)
    counts = [int(head["observations"]) for head in heads], [int(head["interactions"]) for head in heads]
    firsts = np.cumsum([0, *counts[0]])[:-1].tolist()
    if min((*counts[0], *counts[1])) < 0 or [sum(c) for c in counts] != [len(arrays), len(rows)]:
        raise StoreError(f"{shard}: the rollouts do not add up to the shard's rows and observations; it is foreign")
    if [int(head["first_observation"]) for head in heads] != firsts:
        raise StoreError(f"{shard}: the rollouts do not follow each other in the observations; it is foreign")
    rollouts, row = [], 0
    try:
        for head, first, clouds, tries in zip(heads, firsts, *counts, strict=True):
            seen = tuple(arrays.observation(k) for k in range(first, first + clouds))
            rollouts.append(_rollout(head, seen, rows[row : row + tries]))
            row += tries
    except ValueError as error:
        line = " ".join(str(error).split())[:120]
        raise StoreError(f"{shard}: a row is not a record ({line}); the file is foreign") from None
    job = Job(manifest.plan_key, manifest.start, manifest.stop)
    check_rollouts(rollouts, job, manifest.points, str(shard))
    return tuple(rollouts)


def _rows(table: Any, columns: Sequence[Any]) -> list[dict[str, Any]]:
    names = [column.name for column in columns]
    values = [column_values(table, column) for column in columns]
    return [dict(zip(names, cells, strict=True)) for cells in zip(*values, strict=True)]


def _rollout(
    head: dict[str, Any], observations: tuple[Observation, ...], rows: Sequence[dict[str, Any]]
) -> RolloutRecord:
    return RolloutRecord(
        index=int(head["rollout"]),
        plan_key=head["plan_key"],
        object=ObjectRef(id=head["object_id"], category=head["object_category"], content_hash=head["object_hash"]),
        dynamics=HiddenDynamics(
            part_mass=float(head["part_mass"]),
            joint_friction=float(head["joint_friction"]),
            surface_friction=float(head["surface_friction"]),
            direction=Direction(head["direction"]),
        ),
        azimuth_deg=float(head["azimuth_deg"]),
        elevation_deg=float(head["elevation_deg"]),
        seed=int(head["seed"]),
        fidelity=head["fidelity"],
        status=RolloutStatus(head["status"]),
        observations=observations,
        interactions=tuple(_interaction(row) for row in rows),
    )


def _interaction(row: dict[str, Any]) -> InteractionRecord:
    return InteractionRecord(
        step=int(row["step"]),
        observation=int(row["rollout_observation"]),
        action=Action(point_index=int(row["point_index"]), point=row["point"], rotation=row["rotation"].reshape(3, 3)),
        outcome=Outcome(
            kind=OutcomeKind(row["outcome"]),
            motion=float(row["motion"]),
            success=bool(row["success"]),
            start_joint_position=float(row["start_joint_position"]),
            end_joint_position=float(row["end_joint_position"]),
            displacement=row["displacement"],
            grasp_opening=float(row["grasp_opening"]),
            steps=int(row["steps"]),
        ),
        normal=row["normal"],
        primitive=Primitive(row["primitive"]),
        order=Order(row["order"]),
        role=Role(row["role"]),
        proposer=row["proposer"],
        policy_version=int(row["policy_version"]),
        method=row["method"],
        budget=int(row["budget"]),
        target_part=int(row["target_part"]),
        target_link=row["target_link"],
        target_joint=row["target_joint"],
        joint_names=tuple(map(str, json.loads(row["joint_names"]))),
        joint_positions=row["joint_positions"],
        joint_limits=row["joint_limits"].reshape(-1, 2),
        joint_twist=row["joint_twist"],
        hand_start=row["hand_start"],
        seconds=float(row["seconds"]),
    )
