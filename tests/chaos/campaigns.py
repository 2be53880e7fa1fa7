"""Campaigns that are small but real: what users run, on built-in objects, with every number as small as it may be.

    Siege(name, victims, ...).lay(trial)

runs a campaign undisturbed, and then under fire, anew as often as it takes to strike `KILLS[name]` times. Each has to
end with the undisturbed result.
"""

import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from cluster.config.campaign_config import CampaignConfig
from learner.settings import AlternationConfig
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE
from tests.chaos.counts import Counts
from tests.chaos.killer import Campaign, Killer
from tests.chaos.processes import Marked, Role
from tests.support.as_toml import as_toml
from tests.support.small_trainings import FAST

SERIAL_DISK, SERIAL_BUCKET = "collect, one process, disk", "collect, one process, bucket"
SESSION_DISK, SESSION_BUCKET = "collect, own Ray session, disk", "collect, own Ray session, bucket"
CLUSTER_DISK, CLUSTER_BUCKET = "collect, Ray cluster, disk", "collect, Ray cluster, bucket"
TRAINING, BESIDE, WHOLE = "train, all stages", "learn beside collect, in rounds", "run, the whole campaign"

KILLS = {
    SERIAL_DISK: 60,
    SERIAL_BUCKET: 40,
    SESSION_DISK: 6,
    SESSION_BUCKET: 4,
    CLUSTER_DISK: 24,
    CLUSTER_BUCKET: 10,
    TRAINING: 48,
    BESIDE: 7,
    WHOLE: 4,
}
assert sum(KILLS.values()) >= 200, "this is what is promised"

COLLECT = (
    *("collect", "--task", "push-faucet", "--per-shard", "1"),
    *("--collection.camera.points", "64", "--collection.rollout.interactions", "4"),
)
LEARNER = FAST.model_copy(update={"alternation": AlternationConfig(rounds=2, patience=2), "threads": 1})


@dataclass(frozen=True, slots=True)
class Trial:
    """One time that a campaign is run.

    Attributes:
        commands: arguments of `adaafford`.
        look: raises AssertionError where a promise is broken.
        result: what has to be the same whatever was killed.
    """

    commands: Sequence[Sequence[str]]
    look: Callable[[], object]
    result: Callable[[], object]


@dataclass(frozen=True, slots=True)
class Siege:
    """How a campaign is run under fire.

    Attributes:
        name: one of `KILLS`.
        victims: roles by their odds.
        folder: for logs.
        seed: of all moments and victims.
        counts: of all kills.
        everybody: is told who was started, and should not outlive the suite.
        marked: makes whatever starts the commands of one trial.
        mend: see `Killer`.
        most: kills of one trial.
        within_s: see `Campaign`; None: as long as it took undisturbed.
    """

    name: str
    victims: Mapping[Role, float]
    folder: Path
    seed: int
    counts: Counts
    everybody: list[Marked]
    marked: Callable[[], Marked] = Marked
    mend: Callable[[Role], None] = lambda role: None
    most: int = 1000
    within_s: float | None = None

    def lay(self, trial: Callable[[str], Trial], at_once: int = 1) -> None:
        """Run it once undisturbed, then under fire until there were as many kills as there should be.

        Args:
            trial: makes one, by its name.
            at_once: how many are run at the same time.
        """
        began = time.monotonic()
        undisturbed = trial("undisturbed")
        self._run(undisturbed, "undisturbed", 0.0, 0)
        within_s = time.monotonic() - began if self.within_s is None else self.within_s
        wanted = undisturbed.result()
        assert wanted, "nothing was made at all"
        done = number = 0
        with ThreadPoolExecutor(at_once) as pool:
            while done < KILLS[self.name]:
                kills = min(self.most, math.ceil((KILLS[self.name] - done) / at_once))
                names = [str(number + k) for k in range(at_once)]
                number += at_once
                one = partial(self._one, trial, within_s=within_s, kills=kills, wanted=wanted)
                done += sum(pool.map(one, names))

    def _one(self, trial: Callable[[str], Trial], name: str, within_s: float, kills: int, wanted: object) -> int:
        """Run a trial under fire; returns how often it was struck."""
        this = trial(name)
        struck = self._run(this, name, within_s, kills)
        assert this.result() == wanted, f"{self.name}, {name}: the result is another one"
        self.counts.ended(self.name)
        return struck

    def _run(self, trial: Trial, name: str, within_s: float, kills: int) -> int:
        campaign = Campaign(self.name, trial.commands, within_s, self.victims)
        rng = np.random.default_rng([self.seed, *f"{self.name}/{name}".encode()])
        folder = self.folder / f"log-{name}"
        marked = self.marked()
        self.everybody.append(marked)
        killer = Killer(campaign, marked, trial.look, rng, self.counts, folder, self.mend)
        killer.harass(kills)
        return killer.kills


def policies_in(folder: Path) -> dict[str, str]:
    """SHA-256 of each policy's files that a learner is done with, by their paths."""
    return {
        str((done.parent / name).relative_to(folder)): hashlib.sha256((done.parent / name).read_bytes()).hexdigest()
        for done in sorted(folder.rglob("done.json"))
        for name in (WEIGHTS_FILE, POLICY_FILE)
    }


@dataclass(slots=True)
class LearnerWitness:
    """Wants what a learner was done with to stay what it is."""

    folder: Path
    seen: dict[str, str] = field(default_factory=dict)

    def look(self) -> None:
        """Look now; raises AssertionError if something is gone, or another one."""
        now = policies_in(self.folder)
        assert now.items() >= self.seen.items(), "a finished stage is gone, or another one"
        self.seen = now


def learner_file(folder: Path) -> Path:
    """A file of the smallest learner's settings."""
    path = folder / "learner.toml"
    path.write_text(as_toml(LEARNER.model_dump(mode="json")))
    return path


def run_file(folder: Path) -> Path:
    """A file of the smallest campaign's settings."""
    path = folder / "run.toml"
    defaults = CampaignConfig()
    told = {
        "task": "push-faucet",
        "rollouts": {"random": 8, "aip": 6, "evaluation": 2, "per_shard": 1},
        "procedural": {"per_category": 5},
        "collection": {"camera": {"points": 256}, "rollout": {"interactions": 8}},
        "learner": {name: getattr(FAST, name).model_dump(mode="json") for name in ("network", "prior", "aap", "aip")},
        "evaluation": {**defaults.evaluation.model_dump(mode="json"), "budgets": [1], "queries": 2},
    }
    path.write_text(as_toml(told))
    return path
