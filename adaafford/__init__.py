"""Affordance that adapts to one articulated object after a few tries: the public face.

A robot's author implements `Environment` over a camera and an arm, and lets the policy choose:

>>> adapter = Adapter(load_policy("pull-closed-door"))
>>> proposer, history = AipProposer(adapter, numpy.random.default_rng(1), budget=4), []
>>> while (action := proposer.propose(observation := robot.observe(), history)) is not None:
...     history.append(Interaction(observation, action, robot.execute(action)))
>>> heat = adapter.affordance(robot.observe(), history)      # [N], where the part can be moved
"""

from importlib.metadata import version

from adaafford.pretrained import load_policy
from adaafford.scans import ScanFrame, checked_scan, doubtful_up, observation_of, read_scan
from shared.adaptation import Adapter
from shared.errors import AdaAffordError
from shared.policy import Policy
from shared.proposers import AipProposer, ExploitProposer
from shared.store import Store
from shared.vocabulary import (
    Action,
    Environment,
    Interaction,
    Observation,
    Outcome,
    OutcomeKind,
    Proposer,
)

__version__ = version("adaafford")
open_store = Store.open

__all__ = [
    "Action",
    "AdaAffordError",
    "Adapter",
    "AipProposer",
    "Environment",
    "ExploitProposer",
    "Interaction",
    "Observation",
    "Outcome",
    "OutcomeKind",
    "Policy",
    "Proposer",
    "ScanFrame",
    "Store",
    "__version__",
    "checked_scan",
    "doubtful_up",
    "load_policy",
    "observation_of",
    "open_store",
    "read_scan",
]
