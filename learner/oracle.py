"""The oracle critic: AAP's critic with z told outright; the upper bound of adaptation, and a teacher."""

from torch import Tensor, nn

from learner.data import Dataset
from learner.facts import FACTS_WIDTH
from learner.sampling import OrderedRows
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

    def logits(self, dataset: Dataset, ordered: OrderedRows) -> Tensor:
        """Logits of the rows' scores, [B, n]."""
        rows, index, aap = dataset.rows, ordered.rows, self.aap
        encoded = aap.encoder(dataset.clouds.select(ordered.clouds))
        flat = aap.encoder.at(encoded, ordered.cloud.flatten(), rows.point[index].flatten())
        latents = self.oracle(rows.facts[index])
        return aap.action_logits(flat.reshape(*index.shape, -1), rows.xyz[index], rows.frame[index], latents)
