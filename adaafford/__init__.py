"""Affordance that adapts to one articulated object after a few interactions: the Python interface.

For a robot, implement `Environment` with its camera and arm, and let the policy choose the actions:

>>> adapter = Adapter(load_policy("pull-closed-door"))
>>> proposer, history = SpreadAipProposer(adapter, numpy.random.default_rng(1), budget=4), []
>>> while (action := proposer.propose(observation := robot.observe(), history)) is not None:
...     history.append(Interaction(observation, action, robot.execute(action)))
>>> heat = adapter.affordance(robot.observe(), history)      # [N], where the part can be moved

`open_store` reads collected data: tables, clouds, and by `InteractionDataset` samples for PyTorch.
`collect` and `train` are the commands of these names; `simulated` gives simulated objects for tests of a policy.
`gymnasium.make("adaafford/PullClosedDoor-v0")` and other ids give the same objects as Gymnasium environments.
Collection and simulation need `pip install 'adaafford[collect]'`, and import these packages only when they are used.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

from adaafford.gymnasium_ids import register_when_imported
from adaafford.packages import require_own_packages

require_own_packages()
register_when_imported()
__version__ = version("adaafford")

if TYPE_CHECKING:
    from adaafford.heatmaps import write_heatmap
    from adaafford.pretrained import load_policy
    from adaafford.scans import ScanFrame, checked_scan, doubtful_up, observation_of, read_scan
    from cluster.cli.library import collect, from_gymnasium, ray_source, simulated, train
    from shared.errors import AdaAffordError
    from shared.policies.adaptation import Adapter
    from shared.policies.policy import Policy
    from shared.policies.proposers import AipProposer, ExploitProposer, RepeatProposer, SpreadAipProposer
    from shared.store import Store
    from shared.store.streaming import InteractionDataset
    from shared.types import Action, Environment, Interaction, Observation, Outcome, OutcomeKind, Proposer

    open_store = Store.open
else:
    # Imported when it is first asked for: the command line begins here, too, and its help is not to wait for PyTorch.
    _HOMES = {
        "adaafford.heatmaps": ("write_heatmap",),
        "adaafford.pretrained": ("load_policy",),
        "adaafford.scans": ("ScanFrame", "checked_scan", "doubtful_up", "observation_of", "read_scan"),
        "cluster.cli.library": ("collect", "from_gymnasium", "ray_source", "simulated", "train"),
        "shared.policies.adaptation": ("Adapter",),
        "shared.errors": ("AdaAffordError",),
        "shared.policies.policy": ("Policy",),
        "shared.policies.proposers": ("AipProposer", "ExploitProposer", "RepeatProposer", "SpreadAipProposer"),
        "shared.store": ("Store",),
        "shared.store.streaming": ("InteractionDataset",),
        "shared.types": (
            *("Action", "Environment", "Interaction", "Observation"),
            *("Outcome", "OutcomeKind", "Proposer"),
        ),
    }

    def __getattr__(name: str) -> object:
        if name == "open_store":
            found = __getattr__("Store").open
        else:
            home = next((home for home, names in _HOMES.items() if name in names), None)
            if home is None:
                raise AttributeError(f"module 'adaafford' has no attribute {name!r}")
            found = getattr(import_module(home), name)
        globals()[name] = found
        return found

    def __dir__() -> list[str]:
        return sorted({*globals(), *__all__})


__all__ = [
    "Action",
    "AdaAffordError",
    "Adapter",
    "AipProposer",
    "Environment",
    "ExploitProposer",
    "Interaction",
    "InteractionDataset",
    "Observation",
    "Outcome",
    "OutcomeKind",
    "Policy",
    "Proposer",
    "RepeatProposer",
    "ScanFrame",
    "SpreadAipProposer",
    "Store",
    "__version__",
    "checked_scan",
    "collect",
    "doubtful_up",
    "from_gymnasium",
    "load_policy",
    "observation_of",
    "open_store",
    "ray_source",
    "read_scan",
    "simulated",
    "train",
    "write_heatmap",
]
