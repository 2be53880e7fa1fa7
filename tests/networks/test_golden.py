"""What every network computes of given weights and inputs, kept as numbers: a change of them is seen, and meant.

Weights and inputs follow a formula, so that no random generator has a say. Whoever means to change what a network
computes writes the numbers anew: `python -m tests.networks.test_golden`.
"""

import json
from pathlib import Path
from typing import TypeVar

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from shared.networks.aap import Aap, OracleEncoder
from shared.networks.actions import orthonormal_frames
from shared.networks.aip import Aip
from shared.networks.network_config import NetworkConfig
from shared.networks.pointnet2 import CloudBatch, group_cloud
from shared.networks.prior import Prior
from shared.policies.where2act_adaptation import Where2ActAdaptation
from tests.support.small_networks import TINY

GOLDEN = Path(__file__).with_name("golden.json")
CONFIGURATIONS = {
    "ours": TINY,
    "published": TINY.model_copy(
        update={
            "normalisation": "batch",
            "action_features": False,
            "surroundings": 0,
            "outcome_features": False,
            "products": False,
            "evidence": False,
        }
    ),
}
POINTS, ASKED, TRIES = 48, 5, 3
Module = TypeVar("Module", bound=nn.Module)


def waves(*shape: int, phase: float = 0.0) -> Tensor:
    """Numbers in [-1, 1] that look like noise and are the same everywhere."""
    places = np.arange(1, np.prod(shape) + 1)
    return torch.as_tensor(np.sin(12.9898 * places**1.1 + phase), dtype=torch.float32).reshape(shape)


def with_waves(module: Module) -> Module:
    """A module whose weights follow the formula."""
    state = module.state_dict()
    for number, (name, tensor) in enumerate(state.items()):
        if tensor.is_floating_point():
            drawn = waves(*tensor.shape, phase=number) if tensor.dim() else waves(1, phase=number)[0]
            state[name] = drawn.abs() + 0.5 if name.endswith(("running_var", "norm.weight")) else 0.4 * drawn
    module.load_state_dict(state)
    return module.eval()


@torch.no_grad()
def computed(config: NetworkConfig) -> dict[str, Tensor]:
    """What the networks of one configuration make of one cloud."""
    prior, aap, aip = with_waves(Prior(config)), with_waves(Aap(config)), with_waves(Aip(config))
    cloud = 0.5 * waves(POINTS, 3)
    batch = CloudBatch.of([cloud.numpy()], [group_cloud(cloud.numpy(), config)])
    which, point = torch.zeros(ASKED, dtype=torch.long), torch.arange(ASKED) * 7
    known = [module.encoder.at(module.encoder(batch), which, point) for module in (prior, aap, aip)]
    places, frames = cloud[point], orthonormal_frames(waves(ASKED, 6, phase=1.0))
    motions = waves(TRIES, phase=2.0).abs() / 10
    codes, weights = aap.interaction_codes(
        known[1][:TRIES], places[:TRIES], frames[:TRIES], motions, (motions > 0.05).float()
    )
    latents = aap.prefix_latents(codes, weights)
    logits = aap.action_logits(known[1], places, frames, latents[:, None])
    believed = aap.actionability(known[1], places, latents[-1])
    found = {
        "features": known[0],
        "proposals": prior.propose(known[0][:, None], waves(ASKED, 2, config.noise_width, phase=3.0)),
        "prior logits": prior.action_logits(known[0], places, frames),
        "prior actionability": prior.actionability(known[0], places),
        "codes": codes,
        "attention": weights,
        "latents": latents,
        "aap logits": logits,
        "aap actionability": believed,
        "aip scores": aip.action_scores(known[2], places, frames, latents[-1], torch.sigmoid(logits[-1])),
        "aip actionability": aip.actionability(known[2], places, latents[-1], believed),
        "oracle": with_waves(OracleEncoder(9, config))(waves(2, 9, phase=4.0)),
    }
    other = known[0].flip(0)
    found["similarities"] = with_waves(Where2ActAdaptation(config)).similarities(
        known[0], other, cloud[point].norm(dim=-1)
    )
    assert all(torch.isfinite(tensor).all() for tensor in found.values())
    return found


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_networks_compute_what_they_did(name: str) -> None:
    kept = json.loads(GOLDEN.read_text())[name]
    found = computed(CONFIGURATIONS[name])
    assert found.keys() == kept.keys()
    for key, tensor in found.items():
        assert torch.allclose(tensor, torch.tensor(kept[key]), rtol=1e-4, atol=1e-5), key


if __name__ == "__main__":
    numbers = {
        name: {key: np.round(tensor.numpy().astype(np.float64), 7).tolist() for key, tensor in computed(config).items()}
        for name, config in CONFIGURATIONS.items()
    }
    GOLDEN.write_text(json.dumps(numbers) + "\n")
