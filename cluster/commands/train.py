"""`adaafford train`: the learner alone, from a store; needs neither Ray nor SAPIEN."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from cluster.settings import early_flags, layered, parse_flags
from learner.configuration import LearnerConfig
from shared.errors import UsageError
from shared.methods import BASELINES

if TYPE_CHECKING:
    from learner.stages import Memory

STAGES = ("prior", "aap", "aip", *BASELINES.names(), "alternate")
USAGE = f"""usage: adaafford train {{{",".join(STAGES)}}} --store STORE --out RUN [--init RUN] [SETTINGS]

  prior      the Where2Act prior, from nothing
  aap        Adaptive Affordance Prediction; --init names the --out of a prior
  aip        Adaptive Interaction Proposal; --init names the --out of an aap
  {", ".join(BASELINES.names())}
             baselines; the policy keeps what else it holds
  alternate  prior, aap and aip, and the last two again until validation improves no more

The same command again goes on where it was stopped. `torchrun --nproc-per-node N -m cluster train ...` shares each
batch among N processes. `adaafford train prior --help` lists all settings."""


@dataclass(frozen=True, slots=True)
class TrainCommand:
    """Train networks from a finished store. The same command again goes on where it was stopped."""

    settings: Annotated[LearnerConfig, tyro.conf.arg(name="")]
    store: str
    """Folder or s3:// URL of the store; it is only read."""
    out: Path
    """Folder for the policy, its metrics and checkpoints: new, or of the same training."""
    init: Path | None = None
    """The --out of the stage before, to start from."""
    train_objects: Path | None = None
    """A text file with the ids of the objects to learn from, one a line."""
    validation_objects: Path | None = None
    """The same, of the objects to judge by; without both, one object in five is kept for that."""
    config: Path | None = None
    """A TOML file of settings; flags are laid over it."""


def main(args: list[str], memory: "Memory | None" = None) -> int:
    """Train; `memory` is of the stages that this process ran before."""
    stage, rest = args[:1], args[1:]
    if stage in ([], ["-h"], ["--help"]):
        if stage:
            print(USAGE)
            return 0
        raise UsageError(f"train needs one of {', '.join(STAGES)}; given nothing")
    if stage[0] not in STAGES:
        raise UsageError(f"train needs one of {', '.join(STAGES)}; given '{stage[0]}'")
    early = early_flags(rest, "config")
    config = Path(early["config"]) if early["config"] else None
    defaults = TrainCommand(layered(LearnerConfig, None, config), tyro.MISSING, tyro.MISSING, config=config)
    _train(stage[0], parse_flags(TrainCommand, rest, f"train {stage[0]}", defaults), memory)
    return 0


def _train(stage: str, command: TrainCommand, memory: "Memory | None") -> None:
    from learner.alternation import alternate
    from learner.data import read_object_list
    from learner.hardware import hardware
    from learner.recipes import check_baselines
    from learner.stages import StageJob, run_stage

    job = StageJob(
        stage="prior" if stage == "alternate" else stage,
        store=command.store,
        out=command.out,
        init=command.init,
        train_objects=read_object_list(command.train_objects),
        validation_objects=read_object_list(command.validation_objects),
    )
    check_baselines(command.settings)
    with hardware(command.settings) as used:
        if stage == "alternate":
            alternate(job, command.settings, used)
        else:
            run_stage(job, command.settings, used, memory)
