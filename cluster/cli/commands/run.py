"""`adaafford run`: a whole campaign in one command."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.campaign_config import CampaignConfig
from cluster.config.flags import OutFolder, early_flags, layered, parse_flags
from shared.errors import UsageError
from shared.policies.methods import METHODS


@dataclass(frozen=True, slots=True)
class RunCommand:
    """Collect random interactions, train, collect proposed interactions, fine-tune, and evaluate on unseen objects.

    The same command again goes on where it was stopped.
    """

    settings: Annotated[CampaignConfig, tyro.conf.arg(name="")]
    out: OutFolder | None = None
    """Folder of the run: new, empty, or of the same run. A dry run needs none."""
    preset: str = "smoke"
    """A set of settings: smoke, laptop or paper."""
    config: Path | None = None
    """A TOML file of settings, which replace those of the preset; flags replace both."""
    dry_run: bool = False
    """Only print the cost by stage: interactions, core-hours and disk. Nothing is simulated or written."""


def main(args: list[str]) -> int:
    """Run or continue a campaign."""
    early = early_flags(args, "preset", "config")
    preset, config = early["preset"] or "smoke", Path(early["config"]) if early["config"] else None
    defaults = RunCommand(layered(CampaignConfig, preset, config), None, preset, config)
    command = parse_flags(RunCommand, args, "run", defaults)
    _ = command.settings.task_record
    for method in command.settings.evaluation.methods:
        METHODS.get(method)
    if command.settings.learner.baselines:
        from learner.stages.trainers import check_baselines

        check_baselines(command.settings.learner)
    from cluster.runs.warm_start import with_needed_depth

    settings = with_needed_depth(command.settings, command.out)
    if command.dry_run:
        from cluster.campaign.estimate import RATES, estimate, print_estimate

        print_estimate(estimate(settings), settings.workers, RATES)
        return 0
    if command.out is None:
        raise UsageError("run needs --out FOLDER, or --dry-run to say what it will cost")
    from cluster.campaign.campaign import Campaign
    from cluster.runs.run_folder import begin

    Campaign(begin(command.out, settings), settings).execute()
    return 0
