"""Checkpoints: one safetensors file with weights, best weights and Adam's moments, and the cursor in its header.

One file, put in place by a rename, so that no kill can leave weights of one step beside a cursor of another.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from pydantic import Field, ValidationError
from safetensors.torch import save
from torch import Tensor, nn

from shared.config import StrictModel
from shared.errors import StoreError, UsageError
from shared.io.documents import problem_of
from shared.io.files import read_bounded, write_atomically
from shared.io.text import plain
from shared.policies.policy import MAX_WEIGHTS_BYTES, METADATA, read_tensors, tensor_header

MAX_CHECKPOINT_BYTES = 4 * MAX_WEIGHTS_BYTES
"""Weights, best weights and two moments of each."""
CURSOR = "cursor"
"""Name of the metadata that hold it."""
_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


class Cursor(StrictModel):
    """Where a run is; all randomness follows from the seed and `step`."""

    fingerprint: str = ""
    step: int = 0
    interactions: int = 0
    seconds: float = 0.0
    """Spent on steps, over all sittings."""
    misses: int = 0
    """Validations since the best."""
    best_score: float = 1e30
    best_step: int = 0
    best_metrics: dict[str, float] = Field(default_factory=dict)

    model_config = StrictModel.model_config | {"allow_inf_nan": True, "ser_json_inf_nan": "constants"}


def refuse_foreign(out: Path, ours: str) -> None:
    """Refuse a folder with files of which none is of a training.

    Args:
        out: the folder, which need not be there.
        ours: a pattern of the names, of which a training that was begun has left one or more.

    Raises:
        UsageError: it is such a folder.
    """
    names = sorted(path.name for path in out.iterdir() if not path.name.startswith(".")) if out.is_dir() else []
    if names and not any(re.fullmatch(ours, name) for name in names):
        raise UsageError(
            f"{out}: holds '{plain(names[0], 80)}' and no training; name a new or an empty folder as --out"
        )


def write_checkpoint(
    path: Path, cursor: Cursor, module: nn.Module, best: Mapping[str, Tensor], optimiser: torch.optim.Optimizer
) -> None:
    """Write a checkpoint, replacing the one that is there."""
    tensors = {f"module.{name}": tensor for name, tensor in module.state_dict().items()}
    tensors |= {f"best.{name}": tensor for name, tensor in best.items()}
    for number, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": moments[name] for name in _MOMENTS}
    whole = {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}
    write_atomically(path, save(whole, metadata={CURSOR: cursor.model_dump_json()}))


def read_checkpoint(
    path: Path, module: nn.Module, optimiser: torch.optim.Optimizer
) -> tuple[Cursor, dict[str, Tensor]]:
    """Put a checkpoint's state into a module and its optimiser.

    Returns:
        The cursor, and the best weights so far.

    Raises:
        StoreError: the file is damaged, or of another network.
    """
    state = {name: tensor.detach() for name, tensor in module.state_dict().items()}
    with _as_checkpoint(path):
        data = read_bounded(path, MAX_CHECKPOINT_BYTES)
        cursor = _cursor(data)
        moments = _moments_in(tensor_header(data, CURSOR), optimiser)
        expected = {f"{part}.{name}": tensor for part in ("module", "best") for name, tensor in state.items()}
        tensors = read_tensors(data, expected | {f"optimiser.{n}": tensor for n, tensor in moments.items()}, CURSOR)
    module.load_state_dict(_named(tensors, "module."))
    _load_optimiser(optimiser, _named(tensors, "optimiser."))
    return cursor, _named(tensors, "best.")


def read_cursor(path: Path) -> Cursor:
    """The cursor of a checkpoint alone.

    Raises:
        StoreError: the file is damaged or foreign.
    """
    with _as_checkpoint(path):
        return _cursor(read_bounded(path, MAX_CHECKPOINT_BYTES))


def check_fingerprint(cursor: Cursor, fingerprint: str, out: Path) -> None:
    """Hold a checkpoint's cursor to the run that wants to go on from it.

    Raises:
        UsageError: it is of a run with other data or settings.
    """
    if cursor.fingerprint != fingerprint:
        raise UsageError(f"{out}: holds a run with other data or settings; choose another --out")


def _cursor(data: bytes) -> Cursor:
    told = tensor_header(data, CURSOR).get(METADATA)
    text = told.get(CURSOR) if isinstance(told, dict) else None
    try:
        # Unlike in other documents a number may be infinite here.
        return Cursor.model_validate_json(text if isinstance(text, str) else "")
    except ValidationError as error:
        raise StoreError(f"{CURSOR}: {problem_of(error)}") from None


@contextmanager
def _as_checkpoint(path: Path) -> Iterator[None]:
    """Say of what is wrong with a checkpoint what to do about it."""
    try:
        yield
    except StoreError as error:
        line = str(error).removeprefix(f"{path}: ")[:160]
        raise StoreError(
            f"{path}: not a checkpoint of this version ({line}); remove it to begin this stage anew"
        ) from None


def _moments_in(names: Iterable[str], optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """What a checkpoint's moments must look like, by number of the parameter and name."""
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    # A parameter that no gradient has reached yet has no moments.
    numbers = {name.split(".")[1] for name in names if name.startswith("optimiser.")}
    return {
        f"{number}.{name}": torch.zeros(()) if name == "step" else parameter.detach()
        for number, parameter in enumerate(parameters)
        for name in _MOMENTS
        if str(number) in numbers
    }


def _load_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    numbers = {name.split(".")[0] for name in tensors}
    state: dict[int, dict[str, Any]] = {
        int(number): {name: tensors[f"{number}.{name}"] for name in _MOMENTS} for number in numbers
    }
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _named(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
