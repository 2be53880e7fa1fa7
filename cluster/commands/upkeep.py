"""`adaafford store repair|compact|merge|export`: what makes stores out of stores."""

import json
from dataclasses import asdict, dataclass
from typing import Annotated

import tyro

from cluster.settings import parse_flags
from shared.errors import UsageError

MOST_SHOWN = 20
"""Lines of one kind that are printed; --json has all."""


@dataclass(frozen=True, slots=True)
class RepairCommand:
    """Set aside what is broken, delete nothing, and say what to collect again. Stop all collection first."""

    store: Annotated[str, tyro.conf.Positional]
    """Folder or s3:// URL of the store."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print one JSON object instead of text."""


def main(args: list[str]) -> int:
    """Dispatch; `args` begin with the action."""
    match args[0]:
        case "repair":
            return _repair(parse_flags(RepairCommand, args[1:], "store repair"))
    raise UsageError(f"no action '{args[0]}'")


def _repair(command: RepairCommand) -> int:
    from cluster.benchmarks.progress import advancing
    from shared.reproduction import reproduction
    from shared.store import repair

    with advancing("verifying, shards") as advance:
        store, done = repair(command.store, advance)
    commands = [reproduction(store.where, job.shard_id, "OBJECTS") for job in done.to_collect]
    if command.json:
        jobs = [job.shard_id for job in done.to_collect]
        print(json.dumps(asdict(done) | {"to_collect": jobs, "commands": commands}, indent=2))
        return 0
    for problem in done.problems:
        print(f"{problem.where}: {problem.what}")
    for key in done.set_aside:
        print(f"set aside      {key}")
    for key in done.made_anew:
        print(f"made anew      {key}")
    for version in done.lost_policies:
        print(f"policy lost    {version}; what it proposed stays, but it cannot propose again")
    for line in commands[:MOST_SHOWN]:
        print(f"collect again  {line}")
    if len(commands) > MOST_SHOWN:
        print(f"  and {len(commands) - MOST_SHOWN} more; the same `adaafford collect` as before collects all of them")
    print(f"{len(done.problems)} problems repaired" if done.problems or done.made_anew else "nothing to repair")
    return 0
