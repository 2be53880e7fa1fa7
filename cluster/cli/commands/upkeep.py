"""`adaafford store repair|compact|merge|export`: what makes stores out of stores."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import Action
from shared.errors import UsageError
from shared.formatting import counted
from shared.io.text import plain
from shared.progress import Progress

MOST_SHOWN = 20
"""Lines of one kind that are printed; --json has all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StoreCommand:
    """Flags of the actions on one store that also print JSON."""

    store: Annotated[str, tyro.conf.Positional]
    """Folder or s3:// URL of the store."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RepairCommand(StoreCommand):
    """Set aside what is broken, delete nothing, and say what to collect again. Stop all collection first."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CompactCommand(StoreCommand):
    """Make large shards of small ones; the small ones are set aside, the digest stays. Stop all collection first."""

    rollouts: int = 256
    """The most that one shard may hold."""


@dataclass(frozen=True, slots=True)
class MergeCommand:
    """Put what several stores of the same setting hold into one; of a single store, copy it."""

    stores: Annotated[tuple[str, ...], tyro.conf.Positional]
    """Folders or s3:// URLs."""
    out: str
    """Folder or s3:// URL of the new store."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of text."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExportCommand(StoreCommand):
    """Write a store as plain files that other tools open, with a data card. The same command again goes on."""

    out: str
    """A new folder, or s3:// URL with nothing below it."""
    format: str = "plain"
    """plain (Parquet and Zarr), hf (Parquet with the clouds), lerobot, webdataset, minari, or one of an installed
    package."""
    test_share: float = 0.0
    """Share of each category's objects that go into the split "test"; without it there is one split, "train"."""
    seed: int = 1
    """Of the draw of test objects."""
    train_objects: Path | None = None
    """Instead: a text file with the ids of the objects of the split "train", one a line."""
    test_objects: Path | None = None
    """The same for "test"."""
    push: str = ""
    """USER/NAME of a data set on the Hugging Face Hub to put the files into; needs huggingface_hub, and HF_TOKEN in the
    environment."""


def _refuse_while_collecting(where: str) -> None:
    """Refuse a store whose last driver says that it is at work; another machine's lock may not be seen from here."""
    import time

    from cluster.collection.status_writer import SILENT_S, read_status
    from shared.store.backends.base import backend_of

    status = read_status(backend_of(where))
    if status is not None and status.is_alive(time.time()):
        raise UsageError(
            f"{where} is in use by process {status.process}, which collects {status.title}; wait for it or stop it "
            f"(one that was killed is forgotten after {SILENT_S:.0f} s)"
        )


def _repair(command: RepairCommand) -> int:
    from shared.store import repair
    from shared.store.layout import reproduction

    _refuse_while_collecting(command.store)
    with Progress("verifying, shards") as progress:
        store, done = repair(command.store, progress.show)
    commands = [reproduction(store.where, job.shard_id, "OBJECTS") for job in done.to_collect]
    if command.json:
        jobs = [job.shard_id for job in done.to_collect]
        print(json.dumps(asdict(done) | {"to_collect": jobs, "commands": commands}, indent=2))
        return 0
    for problem in done.problems:
        print(plain(f"{problem.where}: {problem.what}"))
    for key in done.set_aside:
        print(plain(f"set aside      {key}"))
    for key in done.made_anew:
        print(plain(f"made anew      {key}"))
    for version in done.lost_policies:
        print(f"policy lost    {version}; what it proposed stays, but it cannot propose again")
    for line in commands[:MOST_SHOWN]:
        print(f"collect again  {line}")
    if len(commands) > MOST_SHOWN:
        print(f"  and {len(commands) - MOST_SHOWN} more; the same `adaafford collect` as before collects all of them")
    print(f"{len(done.problems)} problems repaired" if done.problems or done.made_anew else "nothing to repair")
    return 0


def _compact(command: CompactCommand) -> int:
    from shared.store import Store, compact

    store = Store.open(command.store)
    _refuse_while_collecting(command.store)
    with Progress("compacting, shards") as progress:
        done = compact(store, command.rollouts, progress.show)
    if command.json:
        print(json.dumps(asdict(done) | {"digest": store.digest()}, indent=2))
        return 0
    aside = counted(len(done.set_aside), "small one is", "small ones are")
    print(f"{counted(done.before, 'shard')} became {done.after}; {aside} in {store.where}/aside")
    return 0


def _merge(command: MergeCommand) -> int:
    from shared.store import Store, merge

    if not command.stores:
        raise UsageError("store merge needs one store or more, and --out")
    _refuse_while_collecting(command.out)
    with Progress(f"merging into {command.out}, shards") as progress:
        store, done = merge([Store.open(where) for where in command.stores], command.out, progress.show)
    if command.json:
        print(json.dumps(asdict(done) | {"digest": store.digest()}, indent=2))
        return 0
    made = f"{counted(done.rollouts, 'rollout')} in {counted(done.shards, 'shard')}"
    print(f"{made}, {done.in_several} of them in several stores alike")
    print(f"into {store.where}, digest {store.digest()}")
    return 0


def _export(command: ExportCommand) -> int:
    from learner.data.sampling import read_object_list
    from shared.store import Store, export
    from shared.store.maintenance.export import splits_by_share

    store = Store.open(command.store)
    lists = {"train": read_object_list(command.train_objects), "test": read_object_list(command.test_objects)}
    splits = {name: objects for name, objects in lists.items() if objects is not None}
    if splits and command.test_share:
        raise UsageError("--test-share and lists of objects exclude each other; give one")
    with Progress(f"exporting into {command.out}, shards") as progress:
        done = export(
            store,
            command.out,
            splits or splits_by_share(store, command.test_share, command.seed),
            progress.show,
            format=command.format,
            push=command.push,
        )
    if command.json:
        described = {
            name: asdict(figures) | {"objects": sorted(figures.objects)} for name, figures in done.splits.items()
        }
        print(json.dumps({"out": done.out, "splits": described}, indent=2))
        return 0
    for name, figures in done.splits.items():
        print(f"{name:<6} {figures.interactions} interactions of {len(figures.objects)} objects")
    print(f"into {done.out}; its README.md says what they are")
    return 0


ACTIONS: dict[str, Action] = {
    "repair": (RepairCommand, _repair),
    "compact": (CompactCommand, _compact),
    "merge": (MergeCommand, _merge),
    "export": (ExportCommand, _export),
}
