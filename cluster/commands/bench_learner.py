"""`adaafford bench learner` and `adaafford bench adapt`: how fast networks learn, and how fast they adapt."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import Field

from cluster.commands.bench import BenchSettings, finish, planned
from cluster.settings import parse_flags
from shared.progress import Progress

if TYPE_CHECKING:
    from shared.store import Store


class StoredSettings(BenchSettings):
    """Of benchmarks that need stored interactions."""

    task: str = "push-faucet"
    """Of the store that is made where none is given."""
    procedural_per_category: int = Field(8, ge=1, le=10_000)
    """Its built-in objects: how many of each category that the task applies to."""
    store: str | None = None
    """Folder or s3:// URL of a store to read; a small one is made where none is given."""
    rollouts: int = Field(32, ge=2, le=1_000_000)
    """Of the store that is made."""
    threads: int | None = Field(None, ge=1, le=1024)
    """Of PyTorch; unset: as many as it chooses."""


class RepeatedSettings(StoredSettings):
    """Of those that time something several times."""

    repeats: int = Field(5, ge=1, le=1000)
    """The median of these counts."""


class LearnerSettings(RepeatedSettings):
    """Of `adaafford bench learner`."""

    steps: int = Field(10, ge=1, le=100_000)
    """Of each network in each repeat."""
    port_interactions: int = Field(4, ge=2, le=32)
    """Of the published step in each repeat, seconds each."""


class AdaptSettings(RepeatedSettings):
    """Of `adaafford bench adapt`."""


@dataclass(frozen=True, slots=True)
class LearnerCommand:
    """Time training of the prior, AAP and AIP, and beside it a straightforward port of the published training step."""

    settings: Annotated[LearnerSettings, tyro.conf.arg(name="")] = LearnerSettings()


@dataclass(frozen=True, slots=True)
class AdaptCommand:
    """Time a test-time step: AIP proposes, the outcome is added, and the adapted affordance is computed."""

    settings: Annotated[AdaptSettings, tyro.conf.arg(name="")] = AdaptSettings()


def learner(args: list[str]) -> int:
    """`adaafford bench learner`."""
    command = parse_flags(LearnerCommand, args, "bench learner").settings
    from cluster.benchmarks.learning import LearningBenchmark
    from learner.configuration import LearnerConfig

    with stored(command) as store:
        config = LearnerConfig(seed=command.seed)
        benchmark = LearningBenchmark(store, config, command.repeats, command.steps, command.port_interactions)
        with Progress("turns of training, and of the published step", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store)
    _print_learner(result)
    return finish(command, "learner", result)


def adapt(args: list[str]) -> int:
    """`adaafford bench adapt`."""
    command = parse_flags(AdaptCommand, args, "bench adapt").settings
    from cluster.benchmarks.adapting import AdaptationBenchmark
    from shared.networks.configuration import NetworkConfig
    from shared.policy import Policy

    with stored(command) as store:
        policy = Policy.untrained(store.setting.task, NetworkConfig(), command.seed)
        benchmark = AdaptationBenchmark(store, policy, command.repeats)
        with Progress("rollouts of test-time steps", benchmark.turns) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json() | source_of(command, store)
    print(f"{result['steps']} steps at each size, {result['threads']} threads; medians in ms")
    print(f"  {'points':>7}{'propose':>9}{'update':>9}{'step':>9}{'known observation':>20}")
    for size, figures in result["milliseconds"].items():
        known = figures["step_at_known_observation"]
        print(f"  {size:>7}{figures['propose']:>9.1f}{figures['update']:>9.1f}{figures['step']:>9.1f}{known:>20.1f}")
    return finish(command, "adapt", result)


def _print_learner(result: dict[str, Any]) -> None:
    port = result["straightforward_port_interactions_per_second"]
    print(f"{result['repeats']} times {result['steps']} steps, {result['threads']} threads; medians")
    for name, parts in result["step_seconds"].items():
        rate = result[f"{name.replace('-', '_')}_interactions_per_second"]
        print(f"  {name:<6}{rate:>9,.0f} interactions/s; ms a step: ", end="")
        print(", ".join(f"{part} {1e3 * seconds:.1f}" for part, seconds in parts.items()))
    print(f"  port  {port:>9.2f} interactions/s at {result['port_points']:,} points each")
    print(f"AAP is {result['times_straightforward_port']:,.0f} times the straightforward port")


def source_of(command: StoredSettings, store: "Store") -> dict[str, str]:
    """What the figures were measured on."""
    named = {} if command.store is None else {"objects_from": f"store-{command.store.rstrip('/').rpartition('/')[2]}"}
    return {"task": store.setting.task} | named


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
    from collector.worker import Worker
    from shared.plan import missing_jobs

    with planned(command) as (plan, folder), TemporaryDirectory(prefix="adaafford-bench-") as scratch:
        store = Store.create(Path(scratch) / "store", plan.setting)
        worker, jobs = Worker(store.path, folder), missing_jobs(plan.key, command.rollouts, [], 4)
        with Progress(f"jobs of collection, {command.task}", len(jobs)) as progress:
            for job in jobs:
                worker.run(plan, job)
                progress.advance()
        yield store
