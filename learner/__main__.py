"""`python -m learner prior|aap|aip`: train one stage from a store alone; needs neither Ray nor SAPIEN."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from learner.configuration import LearnerConfig
from learner.stages import DONE_FILE, StageJob, run_stage
from shared.configuration import MAX_CONFIGURATION_BYTES, load_toml, parse
from shared.errors import AdaAffordError, UsageError


def main(arguments: Sequence[str] | None = None) -> int:
    """Run a stage; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        values = load_toml(options.config) if options.config else {}
        config = parse(LearnerConfig, values, str(options.config or "defaults"))
        job = StageJob(
            stage=options.stage,
            store=options.store,
            out=options.out,
            init=options.init,
            train_objects=_object_list(options.train_objects),
            validation_objects=_object_list(options.validation_objects),
        )
        if config.threads is not None:
            torch.set_num_threads(config.threads)
        policy = run_stage(job, config)
    except AdaAffordError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(f"{job.out / DONE_FILE}: '{job.stage}' for '{policy.task}' is done")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m learner", description="Train one stage from a store.")
    parser.add_argument("stage", choices=("prior", "aap", "aip"))
    parser.add_argument("--store", type=Path, required=True, help="folder of the store")
    parser.add_argument("--out", type=Path, required=True, help="folder for the policy; the same again resumes")
    parser.add_argument("--init", type=Path, help="folder of the policy to start from")
    parser.add_argument("--config", type=Path, help="TOML file of settings (see learner/configuration.py)")
    parser.add_argument("--train-objects", type=Path, help="ids of the objects to learn from, one a line")
    parser.add_argument("--validation-objects", type=Path, help="ids of the objects to judge by, one a line")
    return parser


def _object_list(path: Path | None) -> frozenset[str] | None:
    """Object ids, one a line; what follows a blank (such as Where2Act's category) is ignored.

    Raises:
        UsageError: the file is missing, too large, not text, or lists nothing.
    """
    if path is None:
        return None
    try:
        if path.stat().st_size > MAX_CONFIGURATION_BYTES:
            raise UsageError(f"{path}: larger than {MAX_CONFIGURATION_BYTES} bytes; not a list of objects")
        names = frozenset(line.split()[0] for line in path.read_text(encoding="utf-8").splitlines() if line.split())
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: cannot be read ({error}); name a text file with one object id a line") from None
    if not names:
        raise UsageError(f"{path}: lists no object; write one object id a line")
    return names


if __name__ == "__main__":
    sys.exit(main())
