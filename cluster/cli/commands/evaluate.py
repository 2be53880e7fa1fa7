"""`adaafford evaluate`: the paper's table of a finished run or of any policy, on test objects or on any others."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.campaign_config import EvaluateSettings
from cluster.config.flags import OutFolder, parse_flags
from shared.errors import UsageError
from shared.policies.methods import METHODS


@dataclass(frozen=True, slots=True)
class EvaluateCommand:
    """Evaluate methods on objects that were not trained on, and write the table as Markdown, CSV and JSON.

    The same command again goes on where it was stopped, and ends in the same table.
    """

    settings: Annotated[EvaluateSettings, tyro.conf.arg(name="")]
    run: Path | None = None
    """Folder of a run that has published a policy."""
    policy: str | None = None
    """Instead of a run: a name of the policies that the package brings, a folder with policy.json, or a file there."""
    out: OutFolder | None = None
    """Folder for the trials and the table; default: one named after the settings, in RUN/evaluations or, without a run,
    in evaluations/ of the working folder."""


def main(args: list[str]) -> int:
    """Evaluate."""
    command = parse_flags(EvaluateCommand, args, "evaluate", EvaluateCommand(EvaluateSettings()))
    if (command.run is None) == (command.policy is None):
        given = "both" if command.run is not None else "neither"
        raise UsageError(
            f"give either --run RUN or --policy POLICY; given: {given} (--policy-version names one of a run's policies)"
        )
    if command.settings.task is not None:
        _ = command.settings.task_record
    for method in command.settings.methods:
        METHODS.get(method)
    from cluster.evaluation.run_evaluation import evaluate_run, evaluate_without_run

    if command.run is not None:
        evaluate_run(command.run, command.settings, command.out)
    elif command.policy is not None:
        evaluate_without_run(command.policy, command.settings, command.out)
    return 0
