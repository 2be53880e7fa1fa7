"""`adaafford resume`: go on with a run that was stopped, however it was stopped."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.settings import parse_flags


@dataclass(frozen=True, slots=True)
class ResumeCommand:
    """Go on with a run; its configuration is taken from its folder."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the run."""
    workers: int | None = None
    """Instead of the number of workers that the run was begun with."""


def main(args: list[str]) -> int:
    """Go on with a campaign."""
    command = parse_flags(ResumeCommand, args, "resume")
    from cluster.campaign import Campaign
    from cluster.configuration import CampaignConfig
    from cluster.run_folder import find
    from shared.configuration import parse

    folder, config = find(command.run)
    if command.workers is not None:
        config = parse(CampaignConfig, config.model_dump() | {"workers": command.workers}, "resume")
    Campaign(folder, config).execute()
    return 0
