"""`adaafford resume`: go on with a run that was stopped, however it was stopped."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.flags import parse_flags
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class ResumeCommand:
    """Go on with a run; its configuration is taken from its folder."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    workers: int | None = None
    """Instead of the number of workers that the run was begun with."""
    objects: Path | None = None
    """Where the folder of objects that the run was begun with lies now; the run remembers it."""
    start_from: str | None = None
    """Where the policy that the run is to start from lies now; the run remembers it."""


def main(args: list[str]) -> int:
    """Go on with a campaign."""
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
