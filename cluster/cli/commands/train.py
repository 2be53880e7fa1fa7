"""`adaafford train`: training from a store; needs neither Ray nor SAPIEN."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar

import tyro
from pydantic import Field

from cluster.config.flags import OutFolder, early_flags, layered, parse_flags
from learner.settings import LearnerConfig, SegmentationConfig
from shared.errors import UsageError
from shared.policies.methods import BASELINES

if TYPE_CHECKING:
    from learner.stages.jobs import StageJob, StageName

ALTERNATE, SEGMENTATION = "alternate", "segmentation"
STAGES = ("prior", "aap", "aip", *BASELINES.names(), ALTERNATE, SEGMENTATION)
USAGE = f"""usage: adaafford train {{{",".join(STAGES)}}} --store STORE --out RUN [--init RUN] [SETTINGS]

  prior      the Where2Act prior, from nothing
  aap        Adaptive Affordance Prediction; --init names the --out of a prior
  aip        Adaptive Interaction Proposal; --init names the --out of an aap
  {", ".join(BASELINES.names())}
             baselines; the policy keeps what else it holds
  alternate  prior, aap and aip, and the last two again until validation improves no more
  segmentation
             finds the movable parts of raw scans; learns from --scenes (`adaafford objects scenes`), not from a store

The same command again goes on where it was stopped. `torchrun --nproc-per-node N -m cluster train ...` shares each
batch among N processes. `adaafford train prior --help` lists all settings."""


@dataclass(frozen=True, slots=True)
class LearnerCommand:
    """Flags of all commands that train."""

    settings: Annotated[LearnerConfig, tyro.conf.arg(name="")]
    store: str
    """Folder or s3:// URL of the store."""
    out: OutFolder
    """Folder for policies, metrics and checkpoints: new, or of the same training."""
    train_objects: Path | None = None
    """A text file with the ids of the objects to learn from, one a line."""
    validation_objects: Path | None = None
    """The same for validation; without both files, one object in five is used for validation."""
    config: Path | None = None
    """A TOML file of settings; flags replace them."""

    def job(self, stage: "StageName" = "prior", init: str | None = None) -> "StageJob":
        """What is trained on."""
        from cluster.runs.warm_start import folder_of
        from learner.data.sampling import read_object_list
        from learner.stages.jobs import StageJob

        train, validation = read_object_list(self.train_objects), read_object_list(self.validation_objects)
        return StageJob(stage, self.store, self.out, None if init is None else folder_of(init), train, validation)


@dataclass(frozen=True, slots=True)
class TrainCommand(LearnerCommand):
    """Train networks from a finished store. Give the same command again to continue."""

    init: str | None = None
    """The --out of the previous stage, whose networks are the start, or a bundled policy by name (./NAME: a folder).
    The prior, and an alternation, may start from any policy; if --network.pinch-profile or --network.roll-symmetry is
    set and it lacks it, AAP and AIP are trained anew from its weights."""


@dataclass(frozen=True, slots=True)
class SegmentationCommand:
    """Train the segmentation network from labelled scenes. Give the same command again to continue."""

    scenes: Annotated[tuple[Path, ...], Field(min_length=1)]
    """Folders that `adaafford objects scenes` made."""
    out: OutFolder
    """Folder for the network, its metrics and its checkpoint: new, or of the same training."""
    init: Path | None = None
    """The --out of another training, whose network is the start."""
    settings: Annotated[SegmentationConfig, tyro.conf.arg(name="")] = SegmentationConfig()
    seed: Annotated[int, Field(ge=0)] = 0
    """Of all randomness."""
    threads: Annotated[int, Field(ge=1, le=1024)] | None = None
    """Of PyTorch; unset: as many as it chooses. Bits may differ between numbers of threads."""


Command = TypeVar("Command", bound=LearnerCommand)


def parse_learner(command: type[Command], args: list[str], prog: str) -> Command:
    """Parse the flags of a command that trains, laid over the file that --config names.

    Raises:
        UsageError: a setting is unknown or not allowed, also one of a package's baseline.
    """
    early = early_flags(args, "config")["config"]
    config = Path(early) if early else None
    defaults = command(layered(LearnerConfig, None, config), tyro.MISSING, tyro.MISSING, config=config)
    parsed = parse_flags(command, args, prog, defaults)
    if parsed.settings.baselines:
        from learner.stages.trainers import check_baselines

        check_baselines(parsed.settings)
    return parsed


def main(args: list[str]) -> int:
    """Train."""
    stage = args[0] if args else "nothing"
    if stage in ("-h", "--help"):
        print(USAGE)
        return 0
    if stage not in STAGES:
        given = f"'{stage}'" if args else stage
        raise UsageError(f"train needs one of {', '.join(STAGES)}; given {given}")
    if stage == SEGMENTATION:
        return _segmentation(parse_flags(SegmentationCommand, args[1:], "train segmentation"))
    command = parse_learner(TrainCommand, args[1:], f"train {stage}")
    from learner.alternation import Finished, alternate
    from learner.stages.jobs import run_stage
    from learner.training.hardware import hardware

    job = command.job("prior" if stage == ALTERNATE else stage, command.init)
    with hardware(command.settings) as used:
        if stage == ALTERNATE:
            alternate(Finished(job), command.settings, used)
        else:
            run_stage(job, command.settings, used)
    return 0


def _segmentation(command: SegmentationCommand) -> int:
    import torch

    from adaafford.parts import read_segmenter
    from learner.stages.segmentation import train_segmentation

    if command.threads is not None:
        torch.set_num_threads(command.threads)
    if command.init is None and command.settings.blend != 1:
        raise UsageError(
            f"--blend {command.settings.blend:g}: say between what by --init, the --out of another training"
        )
    init = None if command.init is None else read_segmenter(command.init)
    train_segmentation(command.scenes, command.out, command.settings, command.seed, init)
    return 0
