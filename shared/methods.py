"""The methods that are compared: who fills the set of interactions, who acts on it, and with which policy.

They share one loop and differ in one thing each (AdaAfford, Baselines and Ablation Study, and its supplement).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, get_args

from shared.errors import UsageError

BaselineName = Literal["where2act-interaction", "where2act-adaptation"]
"""Baselines with a network of their own, which are trained only where they are wanted."""
CriticName = Literal["where2act", "aap", BaselineName]
ModuleName = Literal["prior", "aap", "aip", BaselineName]
"""Networks that a policy may hold."""
TriesName = Literal["random", "aip", "fps", "purefps", "argfps", "where2act-fps"]
MethodName = Literal[
    "where2act",
    "where2act-interaction",
    "where2act-adaptation",
    "ours-random",
    "ours-purefps",
    "ours-argfps",
    "ours-fps",
    "ours-no-iteration",
    "ours-final",
]

FIRST_VERSION = 1
"""The policy of the first round of the alternation."""


@dataclass(frozen=True, slots=True)
class Method:
    """One method.

    Attributes:
        tries: who fills the set of interactions; None: nobody.
        critic: whose scores and actionability are judged, and choose the action in the end.
        in_one_shot: the number of tries that it takes whatever the budget, where it takes no other.
        version: the policy version that it uses; None: the one that is evaluated.
    """

    tries: TriesName | None
    critic: CriticName
    in_one_shot: int | None = None
    version: int | None = None

    def budgets(self, wanted: Sequence[int]) -> list[int]:
        """The numbers of tries after which it is judged, in ascending order."""
        return sorted(set(wanted)) if self.in_one_shot is None else [self.in_one_shot]

    @property
    def modules(self) -> tuple[ModuleName, ...]:
        """The networks that it needs, each once; the prior's proposals serve all."""
        wanted: list[ModuleName] = ["prior"]
        if self.critic != "where2act":
            wanted.append(self.critic)
        if self.tries in ("aip", "argfps", "fps"):
            wanted += ["aap", "aip"] if self.tries == "aip" else ["aap"]
        return tuple(dict.fromkeys(wanted))

    def policy_version(self, evaluated: int) -> int:
        """The policy version that it uses where version `evaluated` is evaluated."""
        return evaluated if self.version is None else min(self.version, evaluated)


METHODS: Mapping[MethodName, Method] = {
    "where2act": Method(None, "where2act"),
    "where2act-interaction": Method("where2act-fps", "where2act-interaction", in_one_shot=4),
    "where2act-adaptation": Method("where2act-fps", "where2act-adaptation"),
    "ours-random": Method("random", "aap"),
    "ours-purefps": Method("purefps", "aap"),
    "ours-argfps": Method("argfps", "aap"),
    "ours-fps": Method("fps", "aap"),
    "ours-no-iteration": Method("aip", "aap", version=FIRST_VERSION),
    "ours-final": Method("aip", "aap"),
}


def method_named(name: str) -> Method:
    """The method called `name`.

    Raises:
        UsageError: there is no such method; the message lists those there are.
    """
    for known, method in METHODS.items():
        if name == known:
            return method
    raise UsageError(f"unknown method '{name}'; allowed: {', '.join(METHODS)}")


def baselines_of(methods: Sequence[MethodName]) -> list[BaselineName]:
    """The networks of their own that methods need, each once."""
    wanted = {METHODS[name].critic for name in methods}
    return [name for name in get_args(BaselineName) if name in wanted]


def versions_of(methods: Sequence[MethodName], evaluated: int) -> list[int]:
    """The policy versions that methods use where version `evaluated` is evaluated, which is one of them."""
    return sorted({METHODS[name].policy_version(evaluated) for name in methods} | {evaluated})
