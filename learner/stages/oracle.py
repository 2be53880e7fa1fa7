"""The oracle critic: AAP's critic with z told outright; the upper bound of adaptation, and a teacher.

Shapes: I interactions, B rollouts, n rows of each.
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from learner.data.dataset import FACTS_WIDTH
from learner.data.features import FrozenFeatures
from learner.data.sampling import Batch
from shared.errors import UsageError
from shared.io.files import read_bounded
from shared.networks.aap import Aap, OracleEncoder
from shared.networks.network_config import NetworkConfig
from shared.policies.policy import MAX_WEIGHTS_BYTES, read_tensors, tensor_header

MAX_FACTS = 1 << 10
"""More are not believed of a file."""


class OracleCritic(nn.Module):
    """AAP's point encoder, action encoder and critic, with z = h(hidden facts).

    Attributes:
        aap: its interaction encoder and affordance network are not used.
        oracle: h.
    """

    def __init__(self, aap: Aap, facts: int = FACTS_WIDTH) -> None:
        super().__init__()
        self.aap = aap
        self.facts = facts
        self.oracle = OracleEncoder(facts, aap.config)
        for unused in (aap.outcome_encoder, aap.code_head, aap.attention_head, aap.affordance_network()):
            unused.requires_grad_(False)
        aap.empty_latent.requires_grad_(False)

    def logits(self, batch: Batch) -> Tensor:
        """Logits of the rows' scores, [B, n]."""
        features = batch.features(self.aap.encoder)
        return self.aap.action_logits(features, batch.xyz, batch.frame, self.oracle(batch.facts))


@dataclass(frozen=True, slots=True)
class Teacher:
    """What an oracle says of all rows of a data set, which does not change while others learn from it.

    Attributes:
        latents: z = h(hidden facts), [I, latent_width].
        scores: s_u, [I].
    """

    latents: Tensor
    scores: Tensor

    @classmethod
    @torch.no_grad()
    def of(cls, oracle: OracleCritic, known: FrozenFeatures) -> "Teacher":
        """Ask the oracle about everything.

        Raises:
            UsageError: it was trained on a store with other hidden parameters.
        """
        oracle.eval().requires_grad_(False)
        rows = known.dataset.rows
        if rows.facts.shape[1] != oracle.facts:
            raise UsageError(
                f"the oracle knows {oracle.facts} hidden facts of a row, the store tells {rows.facts.shape[1]}; train "
                "AAP anew on a store with these hidden parameters"
            )
        features = known.rows(oracle.aap.encoder)
        latents = oracle.oracle(rows.facts)
        scores = torch.sigmoid(oracle.aap.action_logits(features, rows.xyz, rows.frame, latents))
        return cls(latents, scores)


def read_oracle(path: Path, config: NetworkConfig) -> OracleCritic:
    """The oracle that the training of AAP left in a file, trusting nothing.

    How many facts it knows is told by the file alone: as many as there were hidden parameters in its store.

    Raises:
        StoreError: the file is damaged, foreign, or of networks of another size.
    """
    data = read_bounded(path, MAX_WEIGHTS_BYTES)
    with torch.device("meta"):
        oracle = OracleCritic(Aap(config), _facts_told(data, str(path)))
    tensors = read_tensors(data, oracle.state_dict(), str(path))
    oracle.load_state_dict(tensors, assign=True)
    return oracle.eval().requires_grad_(False)


def _facts_told(data: bytes, source: str) -> int:
    """How many facts an oracle of hostile bytes was told; where they do not say, it is refused later."""
    match tensor_header(data, source).get("oracle.first.first.weight"):
        case {"shape": [_, int(facts)]} if 0 < facts <= MAX_FACTS:
            return facts
    return FACTS_WIDTH
