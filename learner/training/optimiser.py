"""Adam without PyTorch's compiler: its methods import that, for two seconds, and here nothing is compiled."""

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")

COMPILER = "torch._dynamo"


def without_compiler(method: Callable[P, T]) -> Callable[P, T]:
    """The same method; while it runs, something that does nothing stands for the compiler, unless that is imported."""

    @functools.wraps(method)
    def call(*args: P.args, **kwargs: P.kwargs) -> T:
        with _stand_in():
            return method(*args, **kwargs)

    return call


@contextmanager
def _stand_in() -> Iterator[None]:
    if COMPILER in sys.modules:
        yield
        return
    module = ModuleType(COMPILER)
    module.__dict__.update(disable=lambda function, *_, **__: function, graph_break=lambda: None)
    sys.modules[COMPILER] = module
    try:
        yield
    finally:
        del sys.modules[COMPILER]


class Adam(torch.optim.Adam):
    """`torch.optim.Adam`, with the same steps."""

    __init__ = without_compiler(torch.optim.Adam.__init__)
    step = without_compiler(torch.optim.Adam.step)
    zero_grad = without_compiler(torch.optim.Adam.zero_grad)
    state_dict = without_compiler(torch.optim.Adam.state_dict)
    load_state_dict = without_compiler(torch.optim.Adam.load_state_dict)
