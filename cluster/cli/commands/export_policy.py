"""`adaafford export-policy`: a policy, small and with its model card, for a robot or for the package itself."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import OutFolder, parse_flags
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class ExportPolicyCommand:
    """Write a policy as weights.safetensors (half precision), policy.json and README.md (its model card)."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or --out of an `adaafford train`; the latter needs --store."""
    out: OutFolder
    """Folder to write to; files of an earlier export are replaced; other files are not allowed."""
    policy: int | None = None
    """Version of a run's policy; default: the last."""
    store: str | None = None
    """For a training: folder or s3:// URL of its store."""
    results: Path | None = None
    """For a training: a table for the model card, such as curve.md of `adaafford curve`; a run has its own."""
    origin: str = "objects of a user's store"
    """For a training: the card's text about its objects."""
    licence: str = "MIT"
    """The licence in the card; the terms of the training objects may also apply to the weights."""


def main(args: list[str]) -> int:
    """Export."""
    command = parse_flags(ExportPolicyCommand, args, "export-policy")
    from cluster.reporting.model_card import export, source_of_run, source_of_training, write_export
    from cluster.runs.run_folder import find
    from learner.alternation import is_training
    from shared.store import Store

    if command.store is None:
        if is_training(command.run):
            raise UsageError(
                f"{command.run}: has a policy and no run; add --store, the store of the interactions it was trained on"
            )
        source = source_of_run(find(command.run)[0], command.policy)
    else:
        source = source_of_training(command.run, Store.open(command.store), command.results, command.origin)
    files = export(source, command.licence)
    write_export(command.out, files)
    total = sum(map(len, files.values())) / 1e6
    print(f"{command.out}: {source.name} of task {source.policy.task}, {total:.1f} MB")
    return 0
