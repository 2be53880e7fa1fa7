"""`adaafford export-policy`: a policy, small and with its model card, for a robot or for the package itself."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import parse_flags


@dataclass(frozen=True, slots=True)
class ExportPolicyCommand:
    """Write a policy as weights.safetensors (half precision), policy.json and README.md (its model card)."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, or --out of an `adaafford train`; the latter wants --store."""
    out: Path
    """Folder to write to; files of an earlier export are replaced, and nothing else may lie there."""
    policy: int | None = None
    """Its version, of a run; the last where none is named."""
    store: str | None = None
    """Folder or s3:// URL of the store that was trained on, of a training."""
    results: Path | None = None
    """A table that a training's card is to show, such as curve.md of `adaafford curve`; a run has its own."""
    origin: str = "objects of a user's store"
    """What the card says of a training's objects."""
    licence: str = "MIT"
    """What the card says; weights that were trained on others' objects may be bound by those objects' terms."""


def main(args: list[str]) -> int:
    """Export."""
    command = parse_flags(ExportPolicyCommand, args, "export-policy")
    from cluster.reporting.model_card import export, source_of_run, source_of_training, write_export
    from cluster.runs.run_folder import find
    from shared.store import Store

    if command.store is None:
        source = source_of_run(find(command.run)[0], command.policy)
    else:
        source = source_of_training(command.run, Store.open(command.store), command.results, command.origin)
    files = export(source, command.licence)
    write_export(command.out, files)
    total = sum(map(len, files.values())) / 1e6
    print(f"{command.out}: {source.name} of task {source.policy.task}, {total:.1f} MB")
    return 0
