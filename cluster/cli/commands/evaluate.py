"""`adaafford evaluate`: the paper's table of a finished run, on its own test objects or on any others."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from cluster.config.evaluation_settings import EvaluateSettings
from cluster.config.flags import parse_flags
from shared.policies.methods import method_named


@dataclass(frozen=True, slots=True)
class EvaluateCommand:
    """Evaluate methods on objects that were not trained on, and write the table as Markdown, CSV and JSON.

    The same command again goes on where it was stopped, and ends in the same table.
    """

    settings: Annotated[EvaluateSettings, tyro.conf.arg(name="")]
    run: Path
    """Folder of a run that has published a policy."""
    out: Path | None = None
    """Folder for the trials and the table; default: one in RUN/evaluations, named after the settings."""


def main(args: list[str]) -> int:
    """Evaluate."""
    command = parse_flags(EvaluateCommand, args, "evaluate", EvaluateCommand(EvaluateSettings(), tyro.MISSING))
    if command.settings.task is not None:
        _ = command.settings.task_record
    for method in command.settings.methods:
        method_named(method)
    from cluster.evaluation.run_evaluation import evaluate_run

    evaluate_run(command.run, command.settings, command.out)
    return 0
