"""What a Python program calls instead of the command line; `adaafford` has these names."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared.config import PANDA, CollectionConfig, parse
from shared.errors import UsageError
from shared.extras import require, require_packages
from shared.policies.methods import BASELINES
from shared.policies.policy import Policy
from shared.store import Store
from shared.store.selection import Condition, check_fields
from shared.tasks import task_of

if TYPE_CHECKING:
    import gymnasium

    from cluster.cli.ray_source import RaySource
    from collector.gym.environment import FromGymnasium
    from collector.sim.simulator import SimEnvironment
    from collector.simulated_objects import SimulatedObjects
    from learner.stages.jobs import StageName
    from shared.plan import Plan


def collect(store: str | Path, **settings: Any) -> Store:
    """Collect random interactions into a store until it holds as many rollouts as the settings say.

    Args:
        store: folder or s3:// URL: new, or of the same settings, to go on with.
        settings: as the flags of `adaafford collect`: `task`, `objects`, `rollouts`, `workers`, `seed`, and so on; a
            group of flags, such as `collection`, as a dict.

    Raises:
        AdaAffordError: as the command; the message says what to do.
    """
    from cluster.cli.commands.collect import CollectCommand, CollectSettings, run_collection

    require("adaafford.collect", "collect", without=("ray",))
    chosen = parse(CollectSettings, settings, "adaafford.collect")
    _ = chosen.task_record
    run_collection(CollectCommand(chosen, str(store)))
    return Store.open(store)


def train(
    stage: "StageName", store: str | Path, out: str | Path, init: str | Path | None = None, **settings: Any
) -> Policy:
    """Train one stage from a store alone, or go on with it; returns the policy that it leaves in `out`.

    Args:
        stage: "prior", "aap", "aip", or a baseline.
        store: folder or s3:// URL; it is only read.
        out: folder for the policy, its metrics and checkpoints.
        init: the `out` of the stage before, or the name of a bundled policy; every stage but the prior needs one.
        settings: as the flags of `adaafford train`: `seed`, `device`, and so on; a group, such as `aap`, as a dict.

    Raises:
        AdaAffordError: as the command; the message says what to do.
    """
    from cluster.runs.warm_start import folder_of
    from learner.settings import LearnerConfig
    from learner.stages.jobs import NEEDED, StageJob, run_stage
    from learner.stages.trainers import check_baselines
    from learner.training.hardware import hardware

    stages = (*NEEDED, *BASELINES.names())
    if stage not in stages:
        raise UsageError(f"unknown stage '{stage}'; allowed: {', '.join(stages)}")
    config = parse(LearnerConfig, settings, "adaafford.train")
    check_baselines(config)
    job = StageJob(stage, store=store, out=Path(out), init=None if init is None else folder_of(str(init)))
    with hardware(config) as used:
        return run_stage(job, config, used)


def simulated(
    objects: str | Path, task: str, seed: int = 1, gripper: str = PANDA, arm: str | None = None
) -> Iterator["SimEnvironment"]:
    """Simulated objects at rest and in view, one after the other, each with hidden dynamics that are drawn for it.

    Each is an `Environment`, like a robot in front of an object; its `object.ref.id` says which object it is. Every
    object comes once, in a random order, before any comes again; there is no end.

    Args:
        objects: a folder of objects in PartNet-Mobility's layout.
        task: a name or a TOML file, as for `adaafford collect`; objects that it does not apply to are left out.
        seed: everything random derives from it.
        gripper: the hand, as `collection.gripper` names it.
        arm: that carries the hand, as for `adaafford collect --collection.arm`; None: the hand flies.

    Raises:
        UsageError: there is no such task, hand or arm, the seed is negative, or no object of the task comes to rest in
            view of the camera.
    """
    return (environment for environment, _ in simulated_again(objects, task, seed, gripper, arm))


def simulated_again(
    objects: str | Path, task: str, seed: int = 1, gripper: str = PANDA, arm: str | None = None
) -> Iterator[tuple["SimEnvironment", Callable[[], "SimEnvironment"]]]:
    """The environments of `simulated`, each with what makes the same one anew; raises as `simulated` does."""
    require("adaafford.simulated", "collect", without=("ray",))
    from collector.simulated_objects import SimulatedObjects

    # Like a robot's scans, observations have all that the sensor measured, so any policy can be asked.
    collection = parse(CollectionConfig, {"gripper": gripper, "arm": arm}, "adaafford.simulated").keeping_depth()
    if not 0 <= seed < 2**63:
        raise UsageError(f"adaafford.simulated: seed {seed}; needs a whole number from 0 on, below 2**63")
    found = SimulatedObjects(Path(objects), task_of(task), collection)
    plan, first = found.plan(seed), 0
    while True:
        start = found.start(plan, first)
        first = start.draw.index + 1
        yield start.environment, partial(_begun, found, plan, start.draw.index)


def _begun(found: "SimulatedObjects", plan: "Plan", index: int) -> "SimEnvironment":
    return found.start(plan, index).environment


def from_gymnasium(
    env: "gymnasium.Env[Any, Any]", seed: int | None = None, options: dict[str, Any] | None = None
) -> "FromGymnasium":
    """A Gymnasium environment of this package as an `Environment`, in which proposers can act.

    Args:
        env: from `gymnasium.make("adaafford/...")`.
        seed: of the first `reset`.
        options: likewise.

    Raises:
        UsageError: Gymnasium or the simulator is not installed, or the environment cannot be reset in this way.
    """
    from collector.gym.environment import FromGymnasium

    return FromGymnasium(env, seed, options)


def ray_source(
    store: str | Path,
    columns: Sequence[str] | None = None,
    where: Sequence[Condition] = (),
    clouds: Sequence[str] = (),
) -> "RaySource":
    """The interactions of a store for `ray.data.read_datasource`: one read task for a group of shards.

    Args:
        store: folder or s3:// URL, which every node must be able to read.
        columns: as for `Store.interactions`.
        where: likewise.
        clouds: fields of `shared.types.Observation` that become columns of tensors, such as "points"; none: no cloud is
            read.

    Raises:
        UsageError: Ray Data is not installed, there is no such column or field, or a condition is not valid.
        StoreError: the store cannot be read.
    """
    require_packages("adaafford.ray_source", "ray", "pandas")
    from cluster.cli.ray_source import RaySource

    opened = Store.open(store)
    opened.select(columns, where)
    check_fields(clouds)
    return RaySource(opened, columns, where, clouds)
