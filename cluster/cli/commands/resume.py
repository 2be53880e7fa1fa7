"""`adaafford resume`: continue a run that was stopped in any way."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import parse_flags
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class ResumeCommand:
    """Continue a run with the configuration in its folder."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    workers: int | None = None
    """Another number of workers than at the start of the run."""
    objects: Path | None = None
    """The new path of the run's folder of objects; the run records it."""
    start_from: str | None = None
    """The new path of the policy that the run starts from; the run records it."""


def main(args: list[str]) -> int:
    """Continue a campaign."""
    command = parse_flags(ResumeCommand, args, "resume")
    from cluster.campaign.campaign import Campaign
    from cluster.config.campaign_config import CampaignConfig
    from cluster.config.objects import require_same_objects
    from cluster.runs.run_folder import find, note_places
    from shared.config import parse

    folder, config = find(command.run)
    moved = {name: value for name in ("objects", "start_from") if (value := getattr(command, name)) is not None}
    for name in moved:
        if getattr(config, name) is None:
            raise UsageError(f"{command.run}: was begun without '{name}'; leave --{name.replace('_', '-')} out")
    own = {} if command.workers is None else {"workers": command.workers}
    config = parse(CampaignConfig, config.model_dump() | moved | own, "resume")
    if config.objects is not None and command.objects is not None and folder.objects_file.is_file():
        require_same_objects(folder.objects_used().all, config.objects)
    if moved:
        note_places(folder, config)
    Campaign(folder, config).execute()
    return 0
