"""Stages as jobs: a store and a policy in, a better policy out, finished at most once.

OUT/ of a stage
    config.json            what it was told, resolved
    metrics.jsonl          one line a validation
    checkpoint.safetensors until it is done
    affordance/            the last two of the affordance network, where the stage has one
    oracle/                privileged AAP only: the same of the oracle critic
    oracle.safetensors     its weights; they go along to the stages that start from this one, and teach them
    tensorboard/           the metrics again, for TensorBoard, where it is installed
    weights.safetensors    the policy, all its modules
    policy.json
    done.json              written last
"""

import hashlib
import json
import re
from collections.abc import Callable, Collection, Mapping
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

from pydantic import BaseModel, Field, TypeAdapter

from learner.data.dataset import Dataset, load_dataset
from learner.data.features import FrozenFeatures
from learner.data.sampling import Split, split, without_later
from learner.settings import METRICS_FILE, OUTPUT_FILE, LearnerConfig
from learner.stages.aap import train_aap
from learner.stages.aip import train_aip
from learner.stages.oracle import read_oracle
from learner.stages.prior import train_prior
from learner.stages.trainers import (
    AFFORDANCE_FOLDER,
    ORACLE_FILE,
    ORACLE_FOLDER,
    Runner,
    StageTrainer,
    settings_of,
    training_of,
)
from learner.training import data_parallel
from learner.training.checkpoint import check_fingerprint, read_cursor, refuse_foreign
from learner.training.hardware import Hardware, hardware
from learner.training.loop import CHECKPOINT_FILE, TrainingResult
from shared.errors import UsageError
from shared.formatting import finite
from shared.io.documents import read_document
from shared.io.files import exclusive_lock, make_folder, read_bounded, write_atomically
from shared.networks.network_config import NetworkConfig
from shared.policies.methods import BASELINES, ModuleName
from shared.policies.policy import MAX_POLICY_JSON_BYTES, MAX_WEIGHTS_BYTES, POLICY_FILE, WEIGHTS_FILE, Policy
from shared.seeds import generator, torch_seed
from shared.store.coverage import Snapshot
from shared.store.store import Store

DONE_FILE = "done.json"
CONFIG_FILE = "config.json"
LOCK_FILE = ".lock-learner"
MAX_DONE_BYTES = 16 << 20
"""done.json names every object that was seen, in some 70 bytes each."""
CHECKPOINT_FOLDERS = ("", ORACLE_FOLDER, AFFORDANCE_FOLDER)
STAGE_LEAVES = "|".join(
    map(re.escape, (CONFIG_FILE, DONE_FILE, METRICS_FILE, CHECKPOINT_FILE, OUTPUT_FILE, *CHECKPOINT_FOLDERS[1:]))
)
"""Names in a stage's folder; one of them is there as soon as it trains."""

StageName = ModuleName
"""A stage is called by the module that it trains."""
NEEDED: dict[StageName, tuple[ModuleName, ...]] = {
    "prior": (),
    "aap": ("prior",),
    "aip": ("prior", "aap"),
}
"""What must have been trained before; the last of them is the stage to start from. Baselines say it themselves."""
TRAINED_BY: dict[StageName, Callable[[StageTrainer], TrainingResult]] = {
    "prior": train_prior,
    "aap": train_aap,
    "aip": train_aip,
}
"""What trains the networks of a stage. Baselines say it themselves."""


def needed(stage: StageName) -> tuple[ModuleName, ...]:
    """What must have been trained before a stage."""
    return NEEDED[stage] if stage in NEEDED else BASELINES.get(stage).needs


@dataclass(frozen=True, slots=True)
class StageJob:
    """What one stage is run on.

    Attributes:
        stage: which one.
        store: folder or URL of the store.
        out: folder for what it makes.
        init: folder with the policy to start from; None: random weights (the prior only).
        train_objects: ids of the objects to learn from (see `learner.data.sampling.split`).
        validation_objects: ids of the objects to judge by.
        snapshot: learn from these rollouts alone; None: from all that the store holds.
        newest_policy: rollouts that later policies proposed are left out of what is learnt from; None: all are in.
    """

    stage: StageName
    store: str | Path
    out: Path
    init: Path | None = None
    train_objects: frozenset[str] | None = None
    validation_objects: frozenset[str] | None = None
    snapshot: Snapshot | None = None
    newest_policy: int | None = None


_JOB = TypeAdapter(StageJob)


class Memory:
    """What the stages of one process share: the interactions that the last one learnt from, and features of them.

    The next stage mostly learns from the same, under encoders that the last one used; to read and encode them anew
    would take three quarters of its time.
    """

    def __init__(self) -> None:
        self._known: FrozenFeatures | None = None
        self._key: tuple[object, ...] = ()

    def features(self, store: Store, network: NetworkConfig, seed: int, hardware: Hardware) -> FrozenFeatures:
        """All interactions of a store, with a pool of points drawn by a seed.

        Raises:
            StoreError: the store is damaged, or holds no label at all.
        """
        key = store.digest(), network, seed, hardware
        if self._known is None or key != self._key:
            # Two data sets at once may be more than there is room for.
            self._known = None
            dataset = load_dataset(store, network).on(hardware.device)
            with hardware.home():
                self._known = FrozenFeatures.with_pool(dataset, generator(seed, "learner.pool"))
            self._key = key
        return self._known


def run_stage(
    job: StageJob, config: LearnerConfig, hardware: Hardware | None = None, memory: Memory | None = None
) -> Policy:
    """Run a stage, go on with it after a kill, or return what it made where it is done; the policy is on the CPU.

    Args:
        job: what on.
        config: the settings.
        hardware: what to train on; the CPU where none is given.
        memory: of the stages that this process ran before; what they made does not depend on it.

    Raises:
        UsageError: the store or the policy is missing or of another task, objects leak between the parts, or `out`
            holds another run, or is being written by another learner.
        StoreError: the store, the policy or a checkpoint is damaged.
    """
    store = Store.open(job.store)
    if job.snapshot is not None:
        store = store.as_of(job.snapshot)
    policy = _initial_policy(job, store, config)
    oracle = _oracle_of(job)
    fingerprint = _fingerprint(job, config, store, policy, oracle)
    refuse_foreign(job.out, STAGE_LEAVES)
    done = (job.out / DONE_FILE).exists()
    # Nobody may make the folder of a finished stage before everybody has looked.
    data_parallel.wait_for_all()
    if done:
        if read_done(job.out / DONE_FILE).fingerprint != fingerprint:
            raise UsageError(f"{job.out}: holds a finished run with other data or settings; choose another --out")
        _say(f"{job.out / DONE_FILE}: '{job.stage}' for '{policy.task}' is done")
        return read_policy_folder(job.out)
    make_folder(job.out)
    with exclusive_lock(job.out / LOCK_FILE) if data_parallel.rank() == 0 else nullcontext():
        _train(job, config, store, policy, oracle, fingerprint, hardware or Hardware(), memory or Memory())
    _say(f"{job.out / DONE_FILE}: '{job.stage}' for '{policy.task}' is done")
    return policy


def as_json(job: StageJob, config: LearnerConfig) -> dict[str, Any]:
    """A stage as a message to another process, which calls `run_from_json` with it."""
    return {"job": _JOB.dump_python(job, mode="json"), "config": config.model_dump(mode="json")}


def run_from_json(job: Mapping[str, Any], config: Mapping[str, Any]) -> None:
    """Run a stage in a process that runs one after another; raises as `run_stage` does."""
    settings = LearnerConfig.model_validate(config)
    with hardware(settings) as used:
        run_stage(_JOB.validate_python(job), settings, used, _memory())


@cache
def _memory() -> Memory:
    return Memory()


def _train(
    job: StageJob,
    config: LearnerConfig,
    store: Store,
    policy: Policy,
    oracle: Path | None,
    fingerprint: str,
    hardware: Hardware,
    memory: Memory,
) -> None:
    """Train the policy, and leave it in the stage's folder, which no other learner writes meanwhile."""
    _check_checkpoints(job.out, fingerprint)
    known = memory.features(store, policy.config, config.seed, hardware)
    dataset = known.dataset
    parts = split(dataset, job.train_objects, job.validation_objects)
    if job.newest_policy is not None:
        parts = without_later(dataset, parts, job.newest_policy)
    _say(
        f"{job.stage}: {len(parts.train)} rollouts to learn from, {len(parts.validation)} of other objects to judge "
        f"by; leaves {WEIGHTS_FILE}, {POLICY_FILE} and {METRICS_FILE} in {job.out}"
    )
    if data_parallel.rank() == 0:
        write_atomically(job.out / CONFIG_FILE, config.model_dump_json(indent=1).encode())
    policy.modules().to(hardware.device)
    with hardware.home():
        runner = Runner(job.out, config.seed, fingerprint, hardware)
        told = None if oracle is None else read_oracle(oracle, policy.config).to(hardware.device)
        result = _train_module(StageTrainer(config, policy, known, parts, runner, told), job.stage)
    policy.modules().to("cpu")
    policy.with_trained(job.stage)
    if data_parallel.rank() == 0:
        if oracle is not None:
            write_atomically(job.out / ORACLE_FILE, read_bounded(oracle, MAX_WEIGHTS_BYTES))
        _finish(job, policy, result, fingerprint, _seen(job, store, dataset, parts))
    data_parallel.wait_for_all()


def _train_module(recipe: StageTrainer, stage: StageName) -> TrainingResult:
    """Train one module of the policy; the others stay as they are."""
    recipe.policy.modules().eval().requires_grad_(False)
    if stage in TRAINED_BY:
        return TRAINED_BY[stage](recipe)
    return training_of(stage).train(recipe, settings_of(recipe.config, stage))


def _finish(job: StageJob, policy: Policy, result: TrainingResult, fingerprint: str, seen: Collection[str]) -> None:
    """Write what the stage made, and clear away what only it needed."""
    for name, data in policy.to_files().items():
        write_atomically(job.out / name, data)
    done = {"stage": job.stage, "fingerprint": fingerprint, **asdict(result), "metrics": finite(result.metrics)}
    done["objects"] = sorted(seen)
    write_atomically(job.out / DONE_FILE, json.dumps(done, indent=1).encode())
    for folder in CHECKPOINT_FOLDERS:
        (job.out / folder / CHECKPOINT_FILE).unlink(missing_ok=True)


def _seen(job: StageJob, store: Store, dataset: Dataset, parts: Split) -> frozenset[str]:
    """Content hashes of all objects that this stage and those before it learned from or were judged by."""
    names = {dataset.objects[number] for number in (*parts.train, *parts.validation)}
    before = objects_seen(job.init) if job.init is not None else frozenset()
    return before | {ref.content_hash for ref in store.setting.objects if ref.id in names}


def objects_seen(folder: Path) -> frozenset[str]:
    """Content hashes of the objects that a finished stage's policy has seen; none, where the folder does not say.

    Raises:
        StoreError: its done.json is damaged.
    """
    path = folder / DONE_FILE
    if not path.is_file():
        return frozenset()
    return frozenset(read_done(path).objects)


class Done(BaseModel):
    """What is read again of done.json; of a policy that a run adopted only the objects are known."""

    fingerprint: str = ""
    objects: tuple[str, ...] = ()
    metrics: dict[str, float | None] = Field(default_factory=dict)


def read_done(path: Path) -> Done:
    """What done.json says.

    Raises:
        StoreError: it is damaged.
    """
    return read_document(Done, path, MAX_DONE_BYTES, "damaged; remove the folder to train this stage again")


def _say(line: str) -> None:
    if data_parallel.rank() == 0:
        print(line, flush=True)


def read_policy_folder(folder: Path) -> Policy:
    """The policy that a stage left in its folder.

    Raises:
        UsageError: there is none.
        StoreError: it is damaged.
    """
    if not (folder / POLICY_FILE).is_file():
        # Of a run, or of an alternation.
        stages = [*folder.glob(f"*/{POLICY_FILE}"), *folder.glob(f"*/*/{POLICY_FILE}")]
        newest = max(stages, key=lambda path: path.stat().st_mtime, default=None)
        known = "the --out of a finished stage" if newest is None else f"a stage in it, such as {newest.parent}"
        raise UsageError(f"{folder}: holds no {POLICY_FILE}; name {known}, or a bundled policy")
    limits = {POLICY_FILE: MAX_POLICY_JSON_BYTES, WEIGHTS_FILE: MAX_WEIGHTS_BYTES}
    return Policy.from_files({name: read_bounded(folder / name, limit) for name, limit in limits.items()})


def _initial_policy(job: StageJob, store: Store, config: LearnerConfig) -> Policy:
    task, definition = store.setting.task, store.setting.task_definition
    gripper = store.setting.collection.gripper
    if job.init is None:
        if job.stage != "prior":
            before = needed(job.stage)[-1]
            raise UsageError(f"the stage '{job.stage}' starts from a policy: add --init with the --out of '{before}'")
        seed = torch_seed(config.seed, "learner.weights") % 2**32
        return Policy.untrained(task, config.network, seed).of_hand(gripper).defined_as(definition)
    policy = read_policy_folder(job.init)
    policy.require_task(task, str(job.init))
    told, has = config.network, policy.config
    if job.stage == "prior" and (told.pinch_profile > has.pinch_profile or told.roll_symmetry > has.roll_symmetry):
        profile, symmetry = has.pinch_profile or told.pinch_profile, has.roll_symmetry or told.roll_symmetry
        policy = policy.with_pinch(profile, symmetry, torch_seed(config.seed, "learner.weights") % 2**32)
    policy.require(*needed(job.stage))
    if policy.gripper != gripper:
        _say(f"{job.init}: was trained with the hand '{policy.gripper}'; it is now trained with '{gripper}'")
    policy.of_hand(gripper).defined_as(definition)
    if job.stage in BASELINES.names():
        policy.begin_baseline(job.stage, torch_seed(config.seed, f"learner.{job.stage}.weights") % 2**32)
    return policy


def _oracle_of(job: StageJob) -> Path | None:
    """The oracle that the stage before has or was taught by, which teaches this one too."""
    path = None if job.init is None else job.init / ORACLE_FILE
    return path if path is not None and job.stage in ("aap", "aip") and path.is_file() else None


def _fingerprint(job: StageJob, config: LearnerConfig, store: Store, policy: Policy, oracle: Path | None) -> str:
    """SHA-256 of all that the stage's result depends on."""
    told = {
        "stage": job.stage,
        "config": config.model_dump(mode="json"),
        "store": store.digest(),
        "newest_policy": job.newest_policy,
        "train": None if job.train_objects is None else sorted(job.train_objects),
        "validation": None if job.validation_objects is None else sorted(job.validation_objects),
    }
    digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
    for _, data in sorted(policy.to_files().items()):
        digest.update(data)
    if oracle is not None:
        digest.update(read_bounded(oracle, MAX_WEIGHTS_BYTES))
    return digest.hexdigest()


def _check_checkpoints(out: Path, fingerprint: str) -> None:
    """Refuse a folder with checkpoints of another run before anything in it is touched.

    Raises:
        UsageError: a checkpoint is of a run with other data or settings.
        StoreError: a checkpoint is damaged.
    """
    for path in (out / folder / CHECKPOINT_FILE for folder in CHECKPOINT_FOLDERS):
        if path.exists():
            check_fingerprint(read_cursor(path), fingerprint, out)
