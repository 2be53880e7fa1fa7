"""The methods that are compared: who fills the set of interactions, who acts on it, and with which policy.

They share one loop and differ in one thing each (AdaAfford, Baselines and Ablation Study, and its supplement). Methods
and what they consist of are found by name: ours, and what packages add by entry points (docs/extending.md). Ours are
named by their place here, so that this module, which every command imports, needs no network.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from shared.config import Name
from shared.errors import UsageError
from shared.extensions import Registry
from shared.types import Proposer

if TYPE_CHECKING:
    from torch import nn

    from shared.networks.network_config import NetworkConfig
    from shared.networks.prior import Prior
    from shared.policies.adaptation import Adapter
    from shared.policies.critics import Critic

MethodName = Name
BaselineName = Name
CriticName = Name
"""The name of a critic: where2act, aap, or a baseline."""
REPEATING = "repeat-"
"""Prefix of a critic's name; names the proposer that repeats what succeeded, by the scores of this critic."""
ModuleName = Name
"""The name of a network of a policy: prior, aap, aip, or a baseline."""

RANDOM = "random"
"""The proposer that needs no policy, and that everything is compared with."""
FIRST_VERSION = 1
"""The policy of the first round of the alternation."""


@dataclass(frozen=True, slots=True)
class ProposerKind:
    """A kind of proposer.

    Attributes:
        make: makes one from an `Adapter`, a random generator and the most interactions that it may propose; the adapter
            may be None if no networks are needed.
        modules: the networks that it needs; empty: it needs no policy.
        draw: makes, in the same way, one that draws its points from a share of the cloud, the last argument, where that
            of `make` takes the best; None: its points are not chosen so.
    """

    make: Callable[[Any, np.random.Generator, int], Proposer]
    modules: tuple[ModuleName, ...] = ()
    draw: Callable[[Any, np.random.Generator, int, float], Proposer] | None = None


@dataclass(frozen=True, slots=True)
class Baseline:
    """A network that is compared with AAP; it is trained only if a method uses it.

    Attributes:
        network: makes the untrained network.
        critic: makes its critic from an adapter whose policy has the trained network.
        training: "module:attribute" of its `learner.stages.trainers.BaselineTraining`. Only the learner imports that,
            because a robot that uses the network does not train it.
        begin: makes the network before its training from a trained prior; None: `network` is used.
        needs: networks that are trained before it; the last of them is the stage to start from.
    """

    network: "Callable[[NetworkConfig], nn.Module]"
    critic: "Callable[[Adapter], Critic]"
    training: str
    begin: "Callable[[Prior], nn.Module] | None" = None
    needs: tuple[ModuleName, ...] = ("prior",)


PROPOSERS = Registry(
    "proposer",
    ProposerKind,
    {
        "aip": "shared.policies.proposers:AIP",
        "aip-spread": "shared.policies.proposers:SPREAD_AIP",
        "information-gain": "shared.policies.imagined_outcomes:INFORMATION_GAIN",
        "information-value": "shared.policies.imagined_outcomes:INFORMATION_VALUE",
        "fps": "shared.policies.proposers:FPS",
        "purefps": "shared.policies.proposers:PURE_FPS",
        "argfps": "shared.policies.proposers:WEIGHTED_FPS",
        "where2act-fps": "shared.policies.proposers:WHERE2ACT_FPS",
    },
)
BASELINES = Registry(
    "baseline",
    Baseline,
    {
        "where2act-interaction": "shared.policies.where2act_interaction:BASELINE",
        "where2act-adaptation": "shared.policies.where2act_adaptation:BASELINE",
    },
)


@dataclass(frozen=True, slots=True)
class Method:
    """One method.

    Attributes:
        tries: the proposer of the interactions; None: there are no interactions.
        critic: the critic that is evaluated and chooses the final action.
        in_one_shot: the fixed number of interactions, independent of the budget; None: the budget.
        version: the policy version that it uses; None: the one that is evaluated.
        reference: whether it is compared only where an evaluation names it, because the paper does not have it.
    """

    tries: Name | None
    critic: CriticName
    in_one_shot: int | None = None
    version: int | None = None
    reference: bool = False

    def budgets(self, wanted: Sequence[int]) -> list[int]:
        """The numbers of interactions after which it is evaluated, ascending."""
        return sorted(set(wanted)) if self.in_one_shot is None else [self.in_one_shot]

    @property
    def modules(self) -> tuple[ModuleName, ...]:
        """The networks that it needs, each once; the prior's proposals serve all."""
        own = () if self.critic == "where2act" else (self.critic,)
        tried_by = () if self.tries is None or self.tries == RANDOM else PROPOSERS.get(self.tries).modules
        return tuple(dict.fromkeys(("prior", *own, *tried_by)))

    @property
    def draws_tries(self) -> bool:
        """Whether its interactions can be drawn from a share of the points; others are the same whatever the share."""
        return self.tries in PROPOSERS.names() and PROPOSERS.get(str(self.tries)).draw is not None

    def policy_version(self, evaluated: int) -> int:
        """The policy version that it uses where version `evaluated` is evaluated."""
        return evaluated if self.version is None else min(self.version, evaluated)


METHODS: Registry[Method] = Registry(
    "method",
    Method,
    {
        "where2act": Method(None, "where2act"),
        "where2act-interaction": "shared.policies.where2act_interaction:METHOD",
        "where2act-adaptation": "shared.policies.where2act_adaptation:METHOD",
        "ours-random": Method("random", "aap"),
        "ours-purefps": Method("purefps", "aap"),
        "ours-argfps": Method("argfps", "aap"),
        "ours-fps": Method("fps", "aap"),
        "ours-no-iteration": Method("aip", "aap", version=FIRST_VERSION),
        "ours-final": Method("aip", "aap"),
        "ours-spread": Method("aip-spread", "aap", reference=True),
        "ours-gain": Method("information-gain", "aap", reference=True),
        "ours-value": Method("information-value", "aap", reference=True),
    },
)
"""In the order of the paper's table, then what it does not have."""


def needs_policy(proposer: Name) -> bool:
    """Whether a proposer uses networks.

    Raises:
        UsageError: there is no such proposer; the message lists those there are.
    """
    if proposer != RANDOM and proposer not in PROPOSERS.names():
        raise UsageError(f"unknown proposer '{proposer}'; allowed: {', '.join((RANDOM, *PROPOSERS.names()))}")
    return proposer != RANDOM and bool(PROPOSERS.get(proposer).modules)


def baselines_of(methods: Sequence[MethodName]) -> list[BaselineName]:
    """The baselines whose networks the methods need, each once."""
    wanted = {METHODS.get(name).critic for name in methods}
    return [name for name in BASELINES.names() if name in wanted]


def versions_of(methods: Sequence[MethodName], evaluated: int) -> list[int]:
    """The policy versions that methods use where version `evaluated` is evaluated, which is one of them."""
    return sorted({METHODS.get(name).policy_version(evaluated) for name in methods} | {evaluated})
