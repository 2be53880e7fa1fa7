"""Checkpoints: one safetensors file with weights, best weights and Adam's moments, and the cursor in its header.

One file, put in place by a rename, so that no kill can leave weights of one step beside a cursor of another.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pydantic import Field, ValidationError
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from shared.configuration import StrictModel
from shared.errors import StoreError, UsageError
from shared.files import write_atomically
from shared.policy import check_tensors

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


def write_checkpoint(
    path: Path, cursor: Cursor, module: nn.Module, best: Mapping[str, Tensor], optimiser: torch.optim.Optimizer
) -> None:
    """Write a checkpoint, replacing the one that is there."""
    tensors = {f"module.{name}": tensor for name, tensor in module.state_dict().items()}
    tensors |= {f"best.{name}": tensor for name, tensor in best.items()}
    for number, moments in optimiser.state_dict()["state"].items():
        tensors |= {f"optimiser.{number}.{name}": moments[name] for name in _MOMENTS}
    whole = {name: tensor.detach().clone().contiguous() for name, tensor in tensors.items()}
    write_atomically(path, save(whole, metadata={"cursor": cursor.model_dump_json()}))


def read_checkpoint(
    path: Path, module: nn.Module, optimiser: torch.optim.Optimizer
) -> tuple[Cursor, dict[str, Tensor]]:
    """Put a checkpoint's state into a module and its optimiser.

    Returns:
        The cursor, and the best weights so far.

    Raises:
        StoreError: the file is damaged, or of another network.
    """
    cursor, tensors = _read(path)
    state = module.state_dict()
    current, best = _named(tensors, "module."), _named(tensors, "best.")
    check_tensors(current, state, str(path))
    check_tensors(best, state, str(path))
    module.load_state_dict(current)
    _load_optimiser(optimiser, _named(tensors, "optimiser."), str(path))
    return cursor, best


def read_cursor(path: Path) -> Cursor:
    """The cursor of a checkpoint alone.

    Raises:
        StoreError: the file is damaged or foreign.
    """
    return _read(path, tensors_too=False)[0]


def check_fingerprint(cursor: Cursor, fingerprint: str, out: Path) -> None:
    """Hold a checkpoint's cursor to the run that wants to go on from it.

    Raises:
        UsageError: it is of a run with other data or settings.
    """
    if cursor.fingerprint != fingerprint:
        raise UsageError(f"{out}: holds a run with other data or settings; choose another --out")


def _read(path: Path, *, tensors_too: bool = True) -> tuple[Cursor, dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            cursor = Cursor.model_validate_json((file.metadata() or {}).get("cursor", ""))
            names = file.keys() if tensors_too else []
            return cursor, {name: file.get_tensor(name) for name in names}
    except ValidationError as error:
        problem = error.errors()[0]
        reason = f"{'.'.join(map(str, problem['loc'])) or 'cursor'}: {problem['msg']}"
    except (SafetensorError, OSError) as error:
        reason = str(error)
    line = " ".join(reason.split())[:100]
    raise StoreError(f"{path}: not a checkpoint of this version ({line}); remove it to begin this stage anew")


def _load_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor], source: str) -> None:
    parameters = [parameter for group in optimiser.param_groups for parameter in group["params"]]
    numbers = {name.split(".")[0] for name in tensors}
    # A parameter that no gradient has reached yet has no moments.
    expected = {
        f"{number}.{name}": torch.zeros(()) if name == "step" else parameter
        for number, parameter in enumerate(parameters)
        for name in _MOMENTS
        if str(number) in numbers
    }
    check_tensors(tensors, expected, source)
    state: dict[int, dict[str, Any]] = {
        int(number): {name: tensors[f"{number}.{name}"] for name in _MOMENTS} for number in numbers
    }
    optimiser.load_state_dict({"state": state, "param_groups": optimiser.state_dict()["param_groups"]})


def _named(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {name.removeprefix(prefix): tensor for name, tensor in tensors.items() if name.startswith(prefix)}
