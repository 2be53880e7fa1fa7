"""Where2Act-interaction: Where2Act with four interactions as an additional input.

How it is trained stands in `learner.stages.where2act_interaction`.
"""

from functools import partial

from shared.networks.aap import Aap
from shared.networks.prior import Prior
from shared.policies.critics import AdaptiveCritic
from shared.policies.methods import Baseline, Method

NAME = "where2act-interaction"
TRIES = 4
"""Interactions that it is shown (AdaAfford, Baselines and Ablation Study)."""
METHOD = Method("where2act-fps", NAME, in_one_shot=TRIES)


class Where2ActInteraction(Aap):
    """Where2Act and "an additional encoding branch similar to the Adaptive Information Encoder" (AdaAfford, Baselines).

    That branch and a critic that reads its z are AAP's own, so that what the two differ in is how they are trained:
    this one starts from Where2Act, sees sets of exactly `TRIES` interactions at points spread by furthest-point
    sampling, and its D follows the mean score of all proposals, as Where2Act's.
    """

    @classmethod
    def starting_from(cls, prior: Prior) -> "Where2ActInteraction":
        """A network that predicts the same as the prior, for any interactions, until it is trained.

        The weights of the branch are drawn from PyTorch's global random state.
        """
        network = cls(prior.config)
        network.encoder.load_state_dict(prior.encoder.state_dict())
        network.action_encoder.load_state_dict(prior.action_encoder.state_dict())
        network.critic_head.start_from(prior.critic_head)
        network.affordance_head.start_from(prior.affordance_head)
        if network.place_encoder is not None and prior.place_encoder is not None:
            network.place_encoder.load_state_dict(prior.place_encoder.state_dict())
        return network


BASELINE = Baseline(
    Where2ActInteraction,
    partial(AdaptiveCritic, name=NAME),
    training="learner.stages.where2act_interaction:TRAINING",
    begin=Where2ActInteraction.starting_from,
)
