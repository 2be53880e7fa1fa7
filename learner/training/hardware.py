"""What training runs on: a device, the precision of its products, and how many processes share a batch."""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor, distributed

from learner.settings import LearnerConfig
from learner.training import data_parallel
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class Hardware:
    """Where and how to compute.

    Attributes:
        device: of networks and data.
        bf16: whether products are taken in bfloat16 (autocast); weights stay in float32.
    """

    device: torch.device = torch.device("cpu")
    bf16: bool = False

    def describe(self) -> str:
        """One line, such as "device: cpu (2 threads)"."""
        threads = torch.get_num_threads()
        if self.device.type == "cpu":
            name = f"cpu ({threads} thread{'s' * (threads > 1)})"
        elif self.device.type == "cuda":
            name = f"{self.device} {torch.cuda.get_device_name(self.device)}"
        else:
            name = str(self.device)
        together = f", {data_parallel.processes()} processes" if data_parallel.processes() > 1 else ""
        return f"device: {name}{', bf16' * self.bf16}{together}"

    def products(self) -> AbstractContextManager[object]:
        """The precision that a training step is computed in."""
        return torch.autocast(self.device.type, torch.bfloat16) if self.bf16 else nullcontext()

    def home(self) -> AbstractContextManager[object]:
        """New tensors are made on the device; on the CPU they are anyway, and the context would cost each of them."""
        return nullcontext() if self.device.type == "cpu" else self.device


@contextmanager
def hardware(config: LearnerConfig) -> Iterator[Hardware]:
    """What the settings and the machine come to; says so in one line.

    Where torchrun started this process beside others, they are joined for as long as the context lasts.

    Raises:
        UsageError: the device is not there.
    """
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    together = int(os.environ.get("WORLD_SIZE", "1")) > 1
    device = choose_device(config.device, int(os.environ.get("LOCAL_RANK", "0")) if together else 0)
    if together:
        distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    try:
        found = Hardware(device, config.precision == "bf16")
        if data_parallel.rank() == 0:
            print(found.describe(), flush=True)
        yield found
    finally:
        if together:
            distributed.destroy_process_group()


def choose_device(name: str, number: int = 0) -> torch.device:
    """The device of a name; "auto" is the GPU of this number where there is one, else Apple's, else the CPU.

    Raises:
        UsageError: it is not there.
    """
    mps = torch.backends.mps.is_available()
    kind, _, given = name.partition(":")
    if kind == "auto":
        kind = "cuda" if torch.cuda.is_available() else "mps" if mps else "cpu"
    count = torch.cuda.device_count()
    if kind == "cuda":
        index = int(given) if given else number
        if index >= count:
            raise UsageError(f"device '{name}': PyTorch sees {count} CUDA devices; use auto, cpu or a smaller number")
        return torch.device("cuda", index)
    if kind == "mps" and not mps:
        raise UsageError("device 'mps': PyTorch sees no Apple GPU; use auto or cpu")
    return torch.device(kind)


def moved(value: Any, device: torch.device) -> Any:
    """A data class with all its tensors, those of nested data classes and tuples of tensors included, on a device."""
    if isinstance(value, Tensor):
        return value.to(device)
    if isinstance(value, tuple) and value and isinstance(value[0], Tensor):
        return tuple(entry.to(device) for entry in value)
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{field.name: moved(getattr(value, field.name), device) for field in fields(value)})
    return value
