"""Valid records out of thin air, for tests that need data and no simulator.

setting = fabricate_setting(objects=3, points=64)
plan = Plan(setting=setting)
rollout = fabricate_rollout(plan, index=5, interactions=32)
"""

import dataclasses
import hashlib
import shutil
import struct
from pathlib import Path
from typing import Any

import numpy as np

from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.depth import DepthMap
from shared.geometry import camera_pose, gripper_rotation
from shared.io.documents import with_checksum
from shared.plan import InteractionRecord, Job, ObjectRef, Plan, RolloutRecord, RolloutStatus, Setting
from shared.store import Store
from shared.store.codecs.columns import INTERACTION_COLUMNS, ROLLOUT_COLUMNS, InteractionRow, RolloutRow
from shared.store.codecs.tables import table_bytes
from shared.store.writer import rollout_digest
from shared.types import (
    Action,
    Direction,
    HiddenDynamics,
    Observation,
    Order,
    Outcome,
    OutcomeKind,
    Role,
    round_normals,
    round_points,
)


def fabricate_setting(objects: int = 3, points: int = 64, seed: int = 7, keep_depth: bool = False) -> Setting:
    """A setting of `objects` objects of two categories; depth images that are kept are small."""
    refs = tuple(
        ObjectRef(
            id=f"object-{k}",
            category=("StorageFurniture", "Faucet")[k % 2],
            content_hash=hashlib.sha256(str(k).encode()).hexdigest(),
        )
        for k in range(objects)
    )
    collection = CollectionConfig(
        camera=CameraConfig(points=points, keep_depth=keep_depth, image_size=32 if keep_depth else 448),
        rollout=RolloutConfig(interactions=32),
    )
    return Setting(task="push", seed=seed, objects=refs, collection=collection)


def fabricate_rollout(plan: Plan, index: int, interactions: int = 8, per_observation: int = 8) -> RolloutRecord:
    """A rollout that depends on the plan and the index alone; none of the physics is meant to make sense."""
    setting = plan.setting
    rng = np.random.default_rng([setting.seed, index, *plan.key.encode()])
    azimuth, elevation = rng.uniform(135, 225), rng.uniform(30, 60)
    parts = int(rng.integers(1, 5))
    pose = camera_pose(azimuth, elevation, 5.0)
    clouds = -(-interactions // per_observation)
    camera = setting.collection.camera
    observations = tuple(fabricate_observation(rng, camera.points, pose, parts) for _ in range(clouds))
    if camera.keep_depth:
        observations = tuple(
            dataclasses.replace(seen, dense=fabricate_depth(rng, camera.image_size, pose)) for seen in observations
        )
    return RolloutRecord(
        index=index,
        plan_key=plan.key,
        object=setting.objects[index % len(setting.objects)],
        dynamics=HiddenDynamics(
            part_mass=rng.uniform(0.05, 0.5),
            joint_friction=rng.uniform(0.0, 2.0),
            surface_friction=rng.uniform(0.1, 4.0),
            direction=list(Direction)[int(rng.integers(len(Direction)))],
        ),
        azimuth_deg=azimuth,
        elevation_deg=elevation,
        seed=setting.seed,
        fidelity=setting.collection.fidelity.name,
        status=RolloutStatus.OK if interactions else RolloutStatus.NOTHING_TO_ACT_ON,
        observations=observations,
        interactions=tuple(
            fabricate_interaction(
                rng, step, step // per_observation, observations[step // per_observation], plan, parts
            )
            for step in range(interactions)
        ),
    )


def fabricate_rollouts(plan: Plan, job: Job, interactions: int = 8, per_observation: int = 8) -> list[RolloutRecord]:
    """All rollouts of a job."""
    return [fabricate_rollout(plan, index, interactions, per_observation) for index in range(job.start, job.stop)]


def fabricate_observation(rng: np.random.Generator, points: int, pose: np.ndarray, parts: int) -> Observation:
    """A cloud on a box's front, with some of it on each part."""
    places = rng.uniform([-0.5, -0.6, -0.7], [-0.4, 0.6, 0.7], (points, 3))
    normals = np.array([-1.0, 0.0, 0.0]) + rng.normal(scale=0.1, size=(points, 3))
    part_ids = rng.integers(0, parts + 1, points, dtype=np.uint8)
    part_ids[0] = parts
    return Observation(
        points=round_points(places),
        normals=round_normals(normals / np.linalg.norm(normals, axis=1, keepdims=True)),
        part_ids=part_ids,
        movable=part_ids > 0,
        pixels=rng.choice(448 * 448, points, replace=False).astype(np.uint32),
        world_from_camera=pose,
    )


def fabricate_depth(rng: np.random.Generator, size: int, pose: np.ndarray) -> DepthMap:
    """A depth map of a rough surface that is some centimetres from pixel to pixel and fills most of the image."""
    pixels = np.flatnonzero(rng.random(size * size) < 0.9).astype(np.uint32)
    return DepthMap.of(pixels, rng.uniform(4.4, 4.6, len(pixels)), size, 5.0 * size / 1.6, pose)


def fabricate_interaction(
    rng: np.random.Generator, step: int, index: int, observation: Observation, plan: Plan, parts: int
) -> InteractionRecord:
    """A try at a movable point of the observation with this index."""
    point = int(rng.choice(np.flatnonzero(observation.movable)))
    normal = observation.normals[point].astype(np.float64)
    normal /= np.linalg.norm(normal)
    success = bool(rng.random() < 0.3)
    kinds = [OutcomeKind.NO_CONTACT, OutcomeKind.START_COLLISION, OutcomeKind.WRONG_PART, OutcomeKind.HAND_CONTACT]
    start = rng.uniform(0.0, 1.0)
    motion = rng.uniform(0.02, 0.5) if success else 0.0
    part = int(observation.part_ids[point])
    return InteractionRecord(
        step=step,
        observation=index,
        action=Action(
            point_index=point,
            point=observation.points[point].astype(np.float64),
            rotation=gripper_rotation(-normal, rng.normal(size=3)),
        ),
        outcome=Outcome(
            kind=OutcomeKind.OK if success else kinds[int(rng.integers(len(kinds)))],
            motion=motion,
            success=success,
            start_joint_position=start,
            end_joint_position=start + motion,
            displacement=rng.normal(size=3) if success else np.full(3, np.nan),
            steps=int(rng.integers(1, 1440)),
        ),
        normal=normal,
        primitive="push",
        order=Order.RESTART,
        role=Role.COLLECT,
        proposer=plan.proposer,
        policy_version=plan.policy_version,
        method="",
        budget=-1,
        target_part=part,
        target_link=f"link_{part}",
        target_joint=f"joint_{part}",
        joint_names=tuple(f"joint_{k}" for k in range(1, parts + 1)),
        joint_positions=rng.uniform(0.0, 1.0, parts),
        joint_limits=np.stack([np.zeros(parts), rng.uniform(1.0, 2.0, parts)], axis=1),
        joint_twist=rng.normal(size=6),
        hand_start=rng.normal(size=7),
        seconds=rng.uniform(0.01, 0.04),
    )


def identical(one: Any, other: Any) -> bool:
    """Whether two records are the same bit for bit: signs of zero, NaNs, types and shapes included."""
    if type(one) is not type(other):
        return False
    if dataclasses.is_dataclass(one):
        names = [field.name for field in dataclasses.fields(one)]
        return all(identical(getattr(one, name), getattr(other, name)) for name in names)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(identical, one, other))
    if isinstance(one, np.ndarray):
        return bool(one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes())
    if isinstance(one, float):
        return struct.pack("<d", one) == struct.pack("<d", other)
    return bool(one == other)


def fabricate_store(path: Path, shards: int, rollouts: int = 2, points: int = 64, interactions: int = 1) -> Store:
    """A store of many shards that verifies; they share the files of their clouds, and none is synchronised.

    Each rollout has one cloud, from which all of its interactions are tried.
    """
    setting = fabricate_setting(points=points)
    plan, store = Plan(setting=setting), Store.create(path, setting)
    job = Job(plan.key, 0, rollouts)
    first = store.commit(plan, job, fabricate_rollouts(plan, job, interactions, interactions), {})
    clouds = {name: (store.path / "shards" / first.shard_id / name) for name in first.files if "/" in name}
    made = store.read_rollouts(first.shard_id)
    content = first.model_dump(mode="json")
    for number in range(1, shards):
        job = Job(plan.key, number * rollouts, (number + 1) * rollouts)
        folder = store.path / "shards" / job.shard_id
        records = [dataclasses.replace(one, index=job.start + k) for k, one in enumerate(made)]
        heads = [RolloutRow(one, k) for k, one in enumerate(records)]
        rows = [InteractionRow(one, each, k) for k, one in enumerate(records) for each in one.interactions]
        tables = {"rollouts.parquet": table_bytes(ROLLOUT_COLUMNS, heads)}
        tables["interactions.parquet"] = table_bytes(INTERACTION_COLUMNS, rows)
        for parent in sorted({str((folder / name).parent) for name in clouds}):
            Path(parent).mkdir(parents=True, exist_ok=True)
        for name, source in clouds.items():
            # A file system allows only so many links of a file.
            if number % 30_000 == 0:
                clouds[name] = Path(shutil.copy(source, folder / name))
            else:
                (folder / name).hardlink_to(source)
        for name, data in tables.items():
            (folder / name).write_bytes(data)
        entries = {n: {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()} for n, data in tables.items()}
        described = content | {
            "start": job.start,
            "stop": job.stop,
            "files": content["files"] | entries,
            "digests": [rollout_digest(one) for one in records],
        }
        (folder / "manifest.json").write_bytes(with_checksum(described))
    return store
