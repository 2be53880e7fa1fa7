"""`adaafford bench`: measure what helps to choose settings: fidelity, dynamics, collection, learning.

The scripts in the repository's folder `benchmarks/`, which measure what the documentation states, use this module, too.
"""

import json
import os
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import make_dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from pydantic import Field

from cluster.config.campaign_config import ObjectSelection
from cluster.config.flags import OutFolder, dispatch
from shared.config import FIDELITIES, CollectionConfig, Fidelity, FidelityVersion
from shared.formatting import finite
from shared.io.files import scratch_folder, write_atomically, writing
from shared.progress import Progress

if TYPE_CHECKING:
    from cluster.cli.benchmarks.fidelity import FidelityResult
    from shared.plan import Plan
    from shared.store import Store

CPU_INFO = Path("/proc/cpuinfo")


class BenchSettings(ObjectSelection):
    """Settings of every benchmark."""

    task: str = "push"
    """Which manipulation task: push, pull, pull-closed-door, push-faucet, one that a package adds, or a TOML file."""
    primitive: str | None = None
    """Instead of the task's own primitive."""
    seed: int = Field(1, ge=0, lt=2**63)
    """Everything random derives from it."""
    procedural_per_category: int = Field(2, ge=1, le=10_000)
    """Built-in objects: how many of each category that the task applies to."""
    as_json: Annotated[tyro.conf.FlagCreatePairsOff[bool], tyro.conf.arg(name="json")] = False
    """Print one JSON object as the last line."""
    out: OutFolder | None = None
    """A folder that also gets the result as a file, with date, hardware and versions."""
    collection: CollectionConfig = CollectionConfig()


class StoredSettings(BenchSettings):
    """Settings of benchmarks that need stored interactions."""

    task: str = "push-faucet"
    """Task of the store that is created if none is given."""
    procedural_per_category: int = Field(8, ge=1, le=10_000)
    """Its built-in objects: how many of each category that the task applies to."""
    store: str | None = None
    """Folder or s3:// URL of a store to read; default: a small one is created."""
    rollouts: int = Field(32, ge=2, le=1_000_000)
    """Seed of the created store."""
    threads: int | None = Field(None, ge=1, le=1024)
    """Of PyTorch; unset: as many as it chooses."""


class FidelitySettings(BenchSettings):
    """Execute the same trials in two fidelities, and print how well they agree."""

    trials: int = Field(200, ge=1, le=1_000_000)
    """How many."""
    reference: Fidelity = FIDELITIES["reference"]
    """The reference: the published timing."""
    candidate: Fidelity = FIDELITIES["fast"]
    """The fidelity that is compared: the default of collections."""
    versions: tuple[FidelityVersion, ...] = ()
    """Versions of it that are compared instead of its own, all in the same trials."""
    quiet_share: float = Field(1.0, gt=0, le=1)
    """Of the trials in which no candidate moves anything, the share that is also executed in the reference, which takes
    most of the time; each then counts for several."""
    again: tyro.conf.FlagCreatePairsOff[bool] = False
    """Also execute the trials of the reference again in it, with the hand 1e-5 m beside where it was, and print how far
    the reference agrees with itself."""


class DynamicsSettings(BenchSettings):
    """Print how often random actions succeed, and how often an outcome depends on the hidden dynamics."""

    rollouts: int = Field(60, ge=1, le=1_000_000)
    """One object and one state each."""
    draws: int = Field(6, ge=2, le=1000)
    """Draws of hidden dynamics; every (state, action) pair is executed under each."""
    actions: int = Field(6, ge=1, le=1000)
    """Actions from each state."""


class CollectSettings(BenchSettings):
    """Time collection by stage, and print the gain from more workers."""

    rollouts: int = Field(120, ge=1, le=1_000_000)
    """Of each repeat: enough that most objects come again, as they do hundreds of times in a large collection."""
    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""
    workers: int = Field(1, ge=1, le=256)
    """With more than one, the speed-up of this many Ray workers over one is measured as well."""


class LearnerSettings(StoredSettings):
    """Time training of each critic, by threads, device, precision and batch."""

    repeats: int = Field(5, ge=1, le=1000)
    """The median of these counts."""
    steps: int = Field(10, ge=1, le=100_000)
    """Of each critic in each repeat."""
    device: str = Field("cpu", pattern=r"^(auto|cpu|cuda(:[0-9]{1,3})?|mps)$")
    """auto, cpu, cuda, cuda:N or mps."""
    precision: Literal["fp32", "bf16"] = "fp32"
    """Of a training step's products."""
    batch_rollouts: int | None = Field(None, ge=1)
    """Rollouts a step of AAP and AIP; unset: what training uses."""


def main(args: list[str]) -> int:
    """Run one of the benchmarks."""
    actions = {
        name: (flags_of(kind), partial(run_benchmark, name, measure)) for name, (kind, measure) in BENCHMARKS.items()
    }
    return dispatch("bench", actions, args, "[FLAGS]")


def flags_of(settings: type[BenchSettings]) -> type[Any]:
    """What declares the flags of a benchmark with these settings; their docstring describes it."""
    field = "settings", Annotated[settings, tyro.conf.arg(name="")], settings()
    flags = make_dataclass(settings.__name__, [field], frozen=True)
    flags.__doc__ = settings.__doc__
    return flags


def run_benchmark(name: str, measure: Callable[[Any], dict[str, Any]], flags: Any) -> int:
    """Measure, keep and print.

    Args:
        name: of the benchmark.
        measure: prints a table and returns the result as JSON can hold it.
        flags: of a class that `flags_of` made.
    """
    from cluster.workers.session import without_foreign_settings

    command: BenchSettings = flags.settings
    # Some import Ray, which reads its settings then, before they start a session.
    with without_foreign_settings():
        result = measure(command)
    objects = "built-in" if command.objects is None else command.objects.name
    result = {"task": command.task, "objects_from": objects} | result | {"benchmark": name, "seed": command.seed}
    if command.primitive is not None:
        result["primitive"] = command.primitive
    if command.out is not None:
        what = result["task"] if command.primitive is None else f"{command.task}-as-{command.primitive}"
        print(f"kept in {keep(result, command.out, f'{name}-{what}-' + result['objects_from'])}")
    if command.as_json:
        print(json.dumps(finite(result), allow_nan=False))
    return 0


def _fidelity(command: FidelitySettings) -> dict[str, Any]:
    from cluster.cli.benchmarks.fidelity import compare

    versions = command.versions or (command.candidate.version,)
    candidates = [command.candidate.model_copy(update={"version": version}) for version in versions]
    with planned(command) as (plan, folder), Progress(f"trials, {command.task}", command.trials) as progress:
        reference, share = command.reference, command.quiet_share
        results = compare(plan, folder, reference, candidates, command.trials, progress.advance, share, command.again)
    itself = results.pop() if command.again else None
    for candidate, found in zip(candidates, results, strict=True):
        print_fidelity(found, reference, candidate)
    if itself is not None:
        print("again, with the hand placed 1e-5 m beside:")
        print_fidelity(itself, reference, reference)
    result = results[-1].as_json() | {"drawn": command.trials, "quiet_share": share}
    result |= {"reference": reference.model_dump(), "candidate": candidates[-1].model_dump()}
    if itself is not None:
        result["again"] = itself.as_json()
    if command.versions:
        result["by_version"] = {str(v): found.as_json() for v, found in zip(versions, results, strict=True)}
    return result


def print_fidelity(result: "FidelityResult", reference: Fidelity, candidate: Fidelity) -> None:
    """Print the figures of one candidate."""
    from cluster.cli.benchmarks.fidelity import NEAR_THRESHOLD

    low, high = NEAR_THRESHOLD
    print(
        f"{candidate.name}, version {candidate.version}: {result.trials} trials, which stand for "
        f"{result.stands_for:.0f}, on {result.objects} objects, {result.positives} positives in the reference"
    )
    print(f"  label agreement   {result.label_agreement:.2%}")
    print(f"  F1 of positives   {result.positive_f1:.3f} [{result.positive_f1_low:.3f}, {result.positive_f1_high:.3f}]")
    print(f"  kind agreement    {result.kind_agreement:.2%}")
    print(
        f"  near threshold    {result.near_threshold} trials with m of {low} to {high}, "
        f"{result.near_threshold_other_labels} with another label; without them: label agreement "
        f"{result.clear_label_agreement:.2%}, F1 {result.clear_positive_f1:.3f}"
    )
    print(f"  error of m        {result.motion_error_median:.2g} median, {result.motion_error_p95:.2g} at 95%")
    print(
        f"  CPU ms a trial    {result.reference_ms:.1f} {reference.name}, "
        f"{result.candidate_ms:.1f} {candidate.name} in {result.candidate_steps:.0f} steps"
    )
    for change, count in result.confusions:
        print(f"  {count:>4} x {change}")


def _dynamics(command: DynamicsSettings) -> dict[str, Any]:
    from cluster.cli.benchmarks.dynamics import ALL, measure

    with planned(command) as (plan, folder), Progress(f"rollouts, {command.task}", command.rollouts) as progress:
        found = measure(plan, folder, command.rollouts, command.draws, command.actions, progress.advance)
    print(f"{'category':<18}{'trials':>7}{'success':>9}{'pairs':>7}{'ever':>6}{'depends on draw':>17}  outcomes")
    for name, figures in found.items():
        outcomes = ", ".join(f"{kind} {share:.0%}" for kind, share in figures.outcomes.items())
        print(
            f"{name:<18}{figures.trials:>7}{figures.base_rate:>9.1%}{figures.pairs:>7}{figures.ever:>6}"
            f"{figures.depends_share:>17.1%}  {outcomes}"
        )
    categories = {name: figures.as_json() for name, figures in found.items() if name != ALL}
    told = {"draws": command.draws, "edge_share": plan.setting.collection.rollout.edge_share, "categories": categories}
    return found[ALL].as_json() | told


def _collect(command: CollectSettings) -> dict[str, Any]:
    if command.workers > 1:
        # Before SAPIEN and torch: where their libraries come first, Ray's start may abort in std::regex.
        import ray  # noqa: F401
    from cluster.cli.benchmarks.collecting import collect, jobs_of, speedup, summary
    from shared.store import Store

    with planned(command) as (plan, folder):
        runs = []
        with Progress(f"jobs, {command.task}", command.repeats * jobs_of(command.rollouts)) as progress:
            for _ in range(command.repeats):
                with scratch_folder("bench") as scratch:
                    store = Store.create(scratch / "store", plan.setting)
                    runs.append(collect(plan, folder, command.rollouts, store, progress.advance))
        result = summary(runs)
        print_collection(result)
        if command.workers > 1:
            with Progress(f"turns of 1 and {command.workers} workers", 2 * command.repeats + 2) as progress:
                result |= speedup(plan, folder, command.rollouts, command.repeats, command.workers, progress.advance)
            same = "the same content" if result["same_digest"] else "OTHER CONTENT"
            print(
                f"{result['workers']} workers                       {result['workers_speedup']:.2f} times one; {same}"
            )
    return result


def print_collection(result: dict[str, Any]) -> None:
    """Print what `cluster.cli.benchmarks.collecting.summary` made."""
    interactions, stages = result["interactions"], result["stage_core_seconds"].items()
    print(f"{interactions} interactions, {result['repeats']} times; medians of these")
    print(f"  interactions a core-second    {result['interactions_per_core_second']:.1f}")
    print(f"  interactions a second         {result['interactions_per_wall_second']:.1f} (one worker)")
    print(f"  core-ms an interaction        {', '.join(f'{n} {1e3 * s / interactions:.2f}' for n, s in stages)}")
    print(f"  bytes an interaction          {result['bytes_per_interaction']:.0f}")


def _learner(command: LearnerSettings) -> dict[str, Any]:
    from cluster.cli.benchmarks.learning import NETWORKS, LearningBenchmark
    from learner.settings import LearnerConfig
    from learner.training.hardware import hardware

    config = LearnerConfig(
        seed=command.seed, threads=command.threads, device=command.device, precision=command.precision
    )
    if command.batch_rollouts is not None:
        batch = {"batch_rollouts": command.batch_rollouts}
        aap = config.aap.model_copy(update=batch | {"oracle_batch_rollouts": command.batch_rollouts})
        config = config.model_copy(update={"aap": aap, "aip": config.aip.model_copy(update=batch)})
    with stored(command) as store, hardware(config) as found:
        benchmark = LearningBenchmark(store, config, found, command.repeats, command.steps)
        with Progress("turns of training", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store) | {"batch_rollouts": config.aap.batch_rollouts}
    print(f"{command.repeats} times {command.steps} steps; medians, interactions a second")
    for name in NETWORKS:
        rate = result[f"{name.replace('-', '_')}_interactions_per_second"]
        print(f"  {name:<18}{rate:>9,.0f}")
    return result


BENCHMARKS: dict[str, tuple[type[BenchSettings], Callable[[Any], dict[str, Any]]]] = {
    "fidelity": (FidelitySettings, _fidelity),
    "dynamics": (DynamicsSettings, _dynamics),
    "collect": (CollectSettings, _collect),
    "learner": (LearnerSettings, _learner),
}


@contextmanager
def planned(command: BenchSettings) -> Iterator[tuple["Plan", Path]]:
    """A plan of random interactions, and the folder of its objects; built-in objects last as long as the context."""
    task = command.task_record
    from cluster.config.objects import objects_for
    from collector.setting import make_setting
    from shared.plan import Plan

    own = {} if command.primitive is None else {"primitive": command.primitive}
    collection = command.collection.model_copy(update=own)
    with scratch_folder("bench") as scratch:
        built_in = scratch / "objects"
        catalogue, folder = objects_for(task, command, built_in, command.procedural_per_category, command.seed)
        refs = tuple(entry.ref for entry in catalogue.usable)
        yield Plan(setting=make_setting(task, collection, seed=command.seed, objects=refs)), folder


@contextmanager
def stored(command: StoredSettings) -> Iterator["Store"]:
    """The store to read: the one that was named, or one of random interactions that lasts as long as the context."""
    _ = command.task_record
    import torch

    from shared.store import Store

    if command.threads is not None:
        torch.set_num_threads(command.threads)
    if command.store is not None:
        yield Store.open(command.store)
        return
    from cluster.cli.benchmarks.collecting import collect, jobs_of

    with planned(command) as (plan, folder), scratch_folder("bench") as scratch:
        store = Store.create(scratch / "store", plan.setting)
        with Progress(f"jobs of collection, {command.task}", jobs_of(command.rollouts)) as progress:
            collect(plan, folder, command.rollouts, store, progress.advance)
        yield store


def source_of(command: StoredSettings, store: "Store") -> dict[str, str]:
    """What the figures were measured on."""
    named = {} if command.store is None else {"objects_from": f"store-{command.store.rstrip('/').rpartition('/')[2]}"}
    return {"task": store.setting.task} | named


def keep(result: dict[str, Any], folder: Path, name: str) -> Path:
    """Write a result, with date, hardware and versions, to `folder`/DATE-`name`.json.

    Raises:
        UsageError: the folder cannot be made or written.
    """
    from shared.software import software_versions

    now = datetime.now(UTC)
    path = folder / f"{now:%Y-%m-%d}-{name}.json"
    document = {
        "date": now.isoformat(timespec="seconds"),
        "hardware": {
            "processor": _processor(),
            "cores": os.cpu_count(),
            "memory_gib": round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30),
            "system": f"{platform.system()} {platform.machine()}",
            "load_of_last_minute": round(os.getloadavg()[0], 2),
        },
        "software": software_versions(),
        "result": result,
    }
    with writing(path, "name another folder"):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomically(path, (json.dumps(finite(document), indent=2, allow_nan=False) + "\n").encode())
    return path


def _processor() -> str:
    """The processor's name, as far as the system tells."""
    try:
        lines = CPU_INFO.read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
