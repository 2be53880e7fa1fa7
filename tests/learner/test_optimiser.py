"""Adam without PyTorch's compiler: the same steps, and neither its import nor anything in its place afterwards."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
PROGRAM = """
import copy, sys
import torch
from learner.training.loop import COMPILER, Adam

def trained(make):
    torch.manual_seed(0)
    matrix, vector = (torch.nn.Parameter(torch.randn(shape)) for shape in ((3, 4), (4,)))
    optimiser = make([{"params": [matrix]}, {"params": [vector]}], lr=1e-2, weight_decay=1e-3)
    for step in range(6):
        if step == 4:
            kept = copy.deepcopy(optimiser.state_dict())
            optimiser = make([{"params": [matrix]}, {"params": [vector]}], lr=1e-2, weight_decay=1e-3)
            optimiser.load_state_dict(kept)
        optimiser.zero_grad(set_to_none=True)
        (matrix @ vector).square().sum().backward()
        optimiser.step()
    return matrix, vector

ours = trained(Adam)
assert COMPILER not in sys.modules, "it was imported, or its stand-in stays"
theirs = trained(torch.optim.Adam)
assert sys.modules[COMPILER].__file__, "PyTorch's own Adam imports it"
again = trained(Adam)
assert all(torch.equal(*pair) for others in (theirs, again) for pair in zip(ours, others))
doubled = torch.compile(lambda tensor: 2 * tensor, backend="eager")
assert doubled(torch.ones(2)).tolist() == [2.0, 2.0]
"""


def test_steps_are_those_of_pytorch_and_the_compiler_is_left_alone() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, cwd=ROOT, timeout=100)
    assert done.returncode == 0, done.stderr
