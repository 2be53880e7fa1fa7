"""`adaafford export-policy`: a run's policy, small and with its model card, for a robot or for the package itself."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.settings import parse_flags
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class ExportPolicyCommand:
    """Write a policy of a run as weights.safetensors (half precision), policy.json and README.md (its model card)."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    out: Path
    """Folder to write to; files of an earlier export are replaced, and nothing else may lie there."""
    policy: int | None = None
    """Its version; the last where none is named."""
    licence: str = "MIT"
    """What the card says; weights that were trained on others' objects may be bound by those objects' terms."""


def main(args: list[str]) -> int:
    """Export."""
    command = parse_flags(ExportPolicyCommand, args, "export-policy")
    from cluster.model_card import export
    from cluster.run_folder import find
    from shared.files import write_atomically

    run, config = find(command.run)
    exported = export(run, config, command.policy, command.licence)
    if command.out.exists() and (
        not command.out.is_dir() or any(path.name not in exported.files for path in command.out.iterdir())
    ):
        raise UsageError(f"{command.out}: holds something that is no exported policy; name a new or an empty folder")
    command.out.mkdir(parents=True, exist_ok=True)
    for name, data in exported.files.items():
        write_atomically(command.out / name, data)
    total = sum(map(len, exported.files.values())) / 1e6
    print(f"{command.out}: policy {exported.version} of task {exported.policy.task}, {total:.1f} MB")
    return 0
