"""`adaafford store`: inspect, verify, replay and maintain a store, or test a storage backend."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from cluster.cli.commands import upkeep
from cluster.cli.commands.replay import ReplayCommand, replay
from cluster.config.flags import Action, dispatch
from shared.errors import UsageError
from shared.formatting import counted, finite
from shared.io.text import plain
from shared.progress import Progress

if TYPE_CHECKING:
    from cluster.evaluation.resimulation import Divergence
    from shared.store import Store

MOST_WRITERS, MOST_ROUNDS = 64, 10_000
MOST_QUARANTINED = 20
"""Quarantined rollouts that `info` lists as text; `--json` lists all."""
MOST_SHOWN = 20
"""Rows with other labels that `verify --resimulate` prints; `--json` lists all."""


@dataclass(frozen=True, slots=True, kw_only=True)
class InfoCommand(upkeep.StoreCommand):
    """Print the contents of a store."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VerifyCommand(upkeep.StoreCommand):
    """Recompute every checksum and rule of a store; the exit code is 1 if anything is wrong."""

    resimulate: int = 0
    """Also execute this many random rows again, and print how much the results differ; needs --objects."""
    objects: Path | None = None
    """Folder of the store's objects."""
    seed: int = 1
    """Seed for the choice of rows."""


@dataclass(frozen=True, slots=True)
class DigestCommand:
    """Print the content digest as the last line; it depends on the interactions, not on workers or times."""

    store: Annotated[str, tyro.conf.Positional]
    """Folder or s3:// URL of the store."""


@dataclass(frozen=True, slots=True)
class CheckPlaceCommand:
    """Check that exactly one of several concurrent writers of a new file succeeds, which commits rely on.

    It needs no store and leaves nothing behind, so any bucket server can be tested. A command that creates a store in a
    bucket does the same in 3 rounds of 8 writers.
    """

    place: Annotated[str, tyro.conf.Positional]
    """A folder, or s3://BUCKET/PREFIX."""
    rounds: int = 100
    """Number of files."""
    writers: int = 16
    """Concurrent writers of each file."""


def _info(command: InfoCommand) -> int:
    from shared.store import Store, SuccessCount, info

    store = Store.open(command.store)
    held = info(store)
    if command.json:
        described = asdict(held) | {
            "quarantined": [each.model_dump() for each in held.quarantined],
            "bytes_per_interaction": held.bytes_per_interaction,
            "task": store.setting.task,
            "kind": store.setting.kind,
            "seed": store.setting.seed,
            "objects": len(store.setting.objects),
            "policy_versions": store.policy_versions(),
        }
        print(json.dumps(finite(described), indent=2, allow_nan=False))
        return 0

    def tallies(counts: dict[str, SuccessCount]) -> str:
        each = [f"{plain(name)} {tally.interactions} ({tally.success_rate:.1%})" for name, tally in counts.items()]
        return ", ".join(each) or "none"

    per_interaction = f", {held.bytes_per_interaction:.0f} B/interaction" if held.interactions else ""
    print(f"{command.store}: {store.setting.kind}, task {store.setting.task}, seed {store.setting.seed}")
    print(f"  objects       {len(store.setting.objects)}")
    print(f"  shards        {held.shards}, {held.bytes / 1e6:.1f} MB{per_interaction}")
    print(f"  rollouts      {held.rollouts}: {', '.join(f'{plain(name)} {n}' for name, n in held.by_status.items())}")
    print(f"  interactions  {held.interactions}, on {held.observations} observations")
    print(f"  outcomes      {', '.join(f'{plain(name)} {n}' for name, n in held.by_outcome.items()) or 'none'}")
    print(f"  proposers     {tallies(held.by_proposer)}")
    print(f"  roles         {tallies(held.by_role)}")
    print(f"  categories    {tallies(held.by_category)}")
    if held.quarantined:
        print(f"  quarantined   {len(held.quarantined)}")
    for each in held.quarantined[:MOST_QUARANTINED]:
        print(plain(f"    rollout {each.rollout}: {each.reason}"))
        print(plain(f"      {each.command}"))
    print(f"  policies      {', '.join(map(str, store.policy_versions())) or 'none'}")
    return 0


def _verify(command: VerifyCommand) -> int:
    from shared.store import Store, verify

    if command.resimulate < 0 or (command.resimulate > 0) != (command.objects is not None):
        raise UsageError("--resimulate N (1 or more) needs --objects FOLDER, and the other way round")
    store = Store.open(command.store)
    with Progress("verifying, shards") as progress:
        problems = verify(store, progress.show)
    said: dict[str, Any] = {"ok": not problems, "problems": [asdict(problem) for problem in problems]}
    divergence = None
    if command.objects is not None and not problems:
        divergence = _resimulated(store, command.objects, command)
        said["resimulated"] = _as_json(divergence)
    if command.json:
        print(json.dumps(finite(said), indent=2))
        return 1 if problems else 0
    for problem in problems:
        print(plain(f"{problem.where}: {problem.what}"))
    shards = counted(len(store.jobs()), "shard")
    print(counted(len(problems), "problem") if problems else f"no problems in {shards}")
    if divergence is not None:
        _print_divergence(divergence)
    return 1 if problems else 0


def _resimulated(store: "Store", objects: Path, command: VerifyCommand) -> "Divergence":
    from cluster.evaluation.resimulation import resimulate

    with Progress("executing rows again", command.resimulate) as progress:
        return resimulate(store, objects, command.resimulate, command.seed, progress.advance)


def _as_json(divergence: "Divergence") -> dict[str, Any]:
    import numpy as np

    errors = divergence.joint_errors
    return {
        "rows": len(divergence.rows),
        "other_labels": [
            {"shard": row.shard, "rollout": row.rollout, "step": row.step, "stored": row.stored.success}
            for row in divergence.other_labels
        ],
        "other_kinds": divergence.other_kinds,
        "joint_error_median": float(np.median(errors)) if len(errors) else None,
        "joint_error_max": float(errors.max()) if len(errors) else None,
    }


def _print_divergence(divergence: "Divergence") -> None:
    said = _as_json(divergence)
    print(f"{said['rows']} rows executed again")
    print(f"  other labels   {len(said['other_labels'])}")
    print(f"  other kinds    {said['other_kinds']}")
    if said["joint_error_max"] is not None:
        print(f"  joint error    {said['joint_error_median']:.2g} median, {said['joint_error_max']:.2g} at most")
    for row in divergence.other_labels[:MOST_SHOWN]:
        print(f"  {row.shard}, rollout {row.rollout}, step {row.step}: stored {row.stored.kind}, now {row.again.kind}")


def _digest(command: DigestCommand) -> int:
    from shared.store import Store

    print(Store.open(command.store).digest())
    return 0


def _check_place(command: CheckPlaceCommand) -> int:
    from shared.errors import StoreError
    from shared.store import check_place
    from shared.store.backends.base import backend_of

    for name, given, most in (("writers", command.writers, MOST_WRITERS), ("rounds", command.rounds, MOST_ROUNDS)):
        least = 2 if name == "writers" else 1
        if not least <= given <= most:
            raise UsageError(f"--{name} {given}: allowed: {least} to {most}")
    place = backend_of(command.place)
    if not place.is_there():
        raise UsageError(f"{command.place}: there is no such folder; create it, or name another")
    try:
        check_place(place, command.writers, command.rounds)
    except OSError as error:
        raise StoreError(f"{command.place}: cannot be used ({error.strerror}); name another place") from None
    print(f"{place.where}: no problems in {command.rounds} rounds of {command.writers} concurrent writers")
    return 0


ACTIONS: dict[str, Action] = {
    "info": (InfoCommand, _info),
    "verify": (VerifyCommand, _verify),
    "digest": (DigestCommand, _digest),
    "replay": (ReplayCommand, replay),
    **upkeep.ACTIONS,
    "check-place": (CheckPlaceCommand, _check_place),
}


def main(args: list[str]) -> int:
    """Run one of the actions."""
    return dispatch("store", ACTIONS, args, "STORE")
