"""`adaafford bench`: measure collection, what its data are worth, and how fast they are learnt from."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from pydantic import Field

from cluster.selection import ObjectSelection
from cluster.settings import parse_flags
from shared.configuration import FIDELITIES, CollectionConfig, Fidelity
from shared.errors import UsageError

if TYPE_CHECKING:
    from shared.plan import Plan

ACTIONS = ("fidelity", "dynamics", "collect", "store", "scale", "learner", "adapt", "hints")


class BenchSettings(ObjectSelection):
    """What every benchmark may be told."""

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
    out: Path | None = None
    """A folder that also gets the result as a file, with date, hardware and versions."""
    collection: CollectionConfig = CollectionConfig()


class FidelitySettings(BenchSettings):
    """Of `adaafford bench fidelity`."""

    trials: int = Field(200, ge=1, le=1_000_000)
    """How many."""
    reference: Fidelity = FIDELITIES["reference"]
    """The truth: the published timing."""
    candidate: Fidelity = FIDELITIES["fast"]
    """What is judged: what collection uses by default."""


class DynamicsSettings(BenchSettings):
    """Of `adaafford bench dynamics`."""

    rollouts: int = Field(60, ge=1, le=1_000_000)
    """One object and one state each."""
    draws: int = Field(6, ge=2, le=1000)
    """Of hidden dynamics, under which every (state, action) pair is tried."""
    actions: int = Field(6, ge=1, le=1000)
    """Tried from each state."""


class CollectSettings(BenchSettings):
    """Of `adaafford bench collect`."""

    rollouts: int = Field(120, ge=1, le=1_000_000)
    """Of each repeat: enough that most objects come again, as they do hundreds of times in earnest."""
    repeats: int = Field(3, ge=1, le=1000)
    """The median of these counts."""
    sample: int = Field(9, ge=1, le=10_000)
    """Trials by the published protocol in all: a process and a scene each, a few seconds."""
    workers: int = Field(1, ge=1, le=256)
    """With more than one, the speed-up of a Ray fleet over one worker is measured as well."""


@dataclass(frozen=True, slots=True)
class FidelityCommand:
    """Execute the same trials in two fidelities, and say how far they agree."""

    settings: Annotated[FidelitySettings, tyro.conf.arg(name="")] = FidelitySettings()


@dataclass(frozen=True, slots=True)
class DynamicsCommand:
    """Say how often random actions succeed, and how often the same action hangs on the hidden dynamics."""

    settings: Annotated[DynamicsSettings, tyro.conf.arg(name="")] = DynamicsSettings()


@dataclass(frozen=True, slots=True)
class CollectCommand:
    """Time what users run, and beside it the published protocol on a sample of the same trials."""

    settings: Annotated[CollectSettings, tyro.conf.arg(name="")] = CollectSettings()


def check_picture(flag: str, path: Path | None) -> None:
    """Refuse a picture that could not be kept, before the work that it shows.

    Raises:
        UsageError: it is no PNG, its folder is not there, or a folder has its name.
    """
    if path is None:
        return
    if path.suffix.lower() != ".png" or path.is_dir():
        raise UsageError(f"{flag} {path}: give the name of a PNG file")
    if not path.absolute().parent.is_dir():
        raise UsageError(f"{flag} {path}: its folder is not there; make it, or name another")


def main(args: list[str]) -> int:
    """Run one of the benchmarks."""
    from cluster.session import without_foreign_settings

    # Some import Ray, which reads its settings then, before they start a session.
    with without_foreign_settings():
        return _dispatch(args)


def _dispatch(args: list[str]) -> int:
    match args[:1]:
        case ["fidelity"]:
            return _fidelity(parse_flags(FidelityCommand, args[1:], "bench fidelity").settings)
        case ["dynamics"]:
            return _dynamics(parse_flags(DynamicsCommand, args[1:], "bench dynamics").settings)
        case ["collect"]:
            return _collect(parse_flags(CollectCommand, args[1:], "bench collect").settings)
        case ["store"]:
            from cluster.commands.bench_store import store

            return store(args[1:])
        case ["scale"]:
            from cluster.commands.bench_scale import scale

            return scale(args[1:])
        case ["learner"]:
            from cluster.commands.bench_learner import learner

            return learner(args[1:])
        case ["adapt"]:
            from cluster.commands.bench_learner import adapt

            return adapt(args[1:])
        case ["hints"]:
            from cluster.commands.bench_hints import hints

            return hints(args[1:])
        case ["-h" | "--help"]:
            print(f"usage: adaafford bench {{{','.join(ACTIONS)}}}; `adaafford bench fidelity --help` tells more")
            return 0
    given = f"'{args[0]}'" if args else "nothing"
    raise UsageError(f"bench needs one of {', '.join(ACTIONS)}; given {given}")


def _fidelity(command: FidelitySettings) -> int:
    from cluster.benchmarks.fidelity import compare
    from shared.progress import Progress

    with planned(command) as (plan, folder), Progress(f"trials, {command.task}", command.trials) as progress:
        result = compare(plan, folder, command.reference, command.candidate, command.trials, progress.advance)
    print(f"{result.trials} trials on {result.objects} objects, {result.positives} positives in the reference")
    print(f"  label agreement   {result.label_agreement:.1%}")
    print(f"  F1 of positives   {result.positive_f1:.3f}")
    print(f"  kind agreement    {result.kind_agreement:.1%}")
    print(f"  error of m        {result.motion_error_median:.2g} median, {result.motion_error_p95:.2g} at 95%")
    print(f"  CPU ms a trial    {result.reference_ms:.1f} {command.reference.name}, ", end="")
    print(f"{result.candidate_ms:.1f} {command.candidate.name}")
    for change, count in result.confusions:
        print(f"  {count:>4} x {change}")
    fidelities = {"reference": command.reference.model_dump(), "candidate": command.candidate.model_dump()}
    return finish(command, "fidelity", result.as_json() | fidelities)


def _dynamics(command: DynamicsSettings) -> int:
    from cluster.benchmarks.dynamics import ALL, measure
    from shared.progress import Progress

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
    return finish(command, "dynamics", found[ALL].as_json() | told)


def _collect(command: CollectSettings) -> int:
    if command.workers > 1:
        # Before SAPIEN and torch: where their libraries come first, Ray's start may abort in std::regex.
        import ray  # noqa: F401
    from cluster.benchmarks.collecting import CollectionBenchmark
    from shared.progress import Progress

    with planned(command) as (plan, folder):
        benchmark = CollectionBenchmark(plan, folder, command.rollouts, command.repeats, command.sample)
        with Progress(f"jobs and published trials, {command.task}", benchmark.steps) as progress:
            benchmark.run(progress.advance)
        result = benchmark.as_json()
        if command.workers > 1:
            from cluster.benchmarks.speedup import speedup

            with Progress(f"turns of 1 and {command.workers} workers", 2 * command.repeats + 2) as progress:
                result |= speedup(plan, folder, command.rollouts, command.repeats, command.workers, progress.advance)
    _print_collect(result)
    return finish(command, "collect", result)


def _print_collect(result: dict[str, Any]) -> None:
    interactions, published = result["interactions"], result["published_stage_seconds"]
    print(f"{interactions} interactions, {result['repeats']} times; medians of these")
    print(f"  interactions a core-second    {result['interactions_per_core_second']:.1f}")
    print(f"  interactions a second         {result['interactions_per_wall_second']:.1f} (one worker)")
    stages = result["stage_core_seconds"].items()
    print(f"  core-ms an interaction        {', '.join(f'{n} {1e3 * s / interactions:.2f}' for n, s in stages)}")
    print(f"  bytes an interaction          {result['bytes_per_interaction']:.0f}")
    print(f"published protocol, {result['published_trials']} of the same trials")
    print(f"  core-seconds a trial          {result['published_core_seconds_per_trial']:.2f}")
    parts = ("start", "load", "settle", "trial")
    print(f"  of these                      {', '.join(f'{name} {published[name]:.2f}' for name in parts)}")
    print(f"  same label as stored          {result['published_label_agreement']:.0%}")
    print(f"times the published protocol    {result['times_published_protocol']:.0f}")
    short = result["times_published_protocol_with_short_settling"]
    print(f"  with AdaAfford's settling     {short:.0f} (150 still steps of at most 200, not 5,000 of 20,000)")
    if "workers" in result:
        same = "the same content" if result["same_digest"] else "OTHER CONTENT"
        print(f"{result['workers']} workers                       {result['workers_speedup']:.2f} times one; {same}")


@contextmanager
def planned(command: BenchSettings) -> Iterator[tuple["Plan", Path]]:
    """A plan of random interactions, and the folder of its objects; built-in objects last as long as the context."""
    task = command.task_record
    from cluster.objects import objects_for
    from collector.setting import make_setting
    from shared.plan import Plan

    own = {} if command.primitive is None else {"primitive": command.primitive}
    collection = command.collection.model_copy(update=own)
    with TemporaryDirectory(prefix="adaafford-bench-") as scratch:
        built_in = Path(scratch) / "objects"
        catalogue, folder = objects_for(task, command, built_in, command.procedural_per_category, command.seed)
        refs = tuple(entry.ref for entry in catalogue.usable)
        yield Plan(setting=make_setting(task, collection, seed=command.seed, objects=refs)), folder


def finish(command: BenchSettings, name: str, result: dict[str, Any]) -> int:
    """Keep and print the result."""
    from cluster.benchmarks.results import as_line, keep

    objects = "built-in" if command.objects is None else command.objects.name
    result = {"task": command.task, "objects_from": objects} | result | {"benchmark": name, "seed": command.seed}
    if command.primitive is not None:
        result["primitive"] = command.primitive
    if command.out is not None:
        what = result["task"] if command.primitive is None else f"{command.task}-as-{command.primitive}"
        print(f"kept in {keep(result, command.out, f'{name}-{what}-' + result['objects_from'])}")
    if command.as_json:
        print(as_line(result))
    return 0
