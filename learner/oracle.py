"""The oracle critic: AAP's critic with z told outright; the upper bound of adaptation, and a teacher."""

from torch import Tensor, nn

from learner.facts import FACTS_WIDTH
from learner.sampling import Batch
from shared.networks.aap import Aap, OracleEncoder


class OracleCritic(nn.Module):
    """AAP's point encoder, action encoder and critic, with z = h(hidden facts).

    Attributes:
        aap: its interaction encoder and affordance network are not used.
        oracle: h.
    """

    def __init__(self, aap: Aap) -> None:
        super().__init__()
        self.aap = aap
        self.oracle = OracleEncoder(FACTS_WIDTH, aap.config)
        for unused in (aap.outcome_encoder, aap.code_head, aap.attention_head, aap.affordance_head):
            unused.requires_grad_(False)
        aap.empty_latent.requires_grad_(False)

    def logits(self, batch: Batch) -> Tensor:
        """Logits of the rows' scores, [B, n]."""
        features = batch.features(self.aap.encoder)
        return self.aap.action_logits(features, batch.xyz, batch.frame, self.oracle(batch.facts))
