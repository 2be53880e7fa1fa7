"""One evaluation, of a campaign or by itself: trials of every method on unseen objects, then the table.

A trial is one rollout: an object with freshly drawn hidden dynamics and camera, on which every method fills its set of
interactions anew and then acts. So ten trials a shape (AdaAfford, Evaluation Metrics) are ten rollouts for each object.
"""

from collections.abc import Callable, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cluster.collection.driver import Collected, collect
from cluster.runs.subprocesses import Child
from cluster.workers.session import CurrentWorkerGroup
from shared.errors import UsageError
from shared.plan import EvaluationConfig, Plan
from shared.policies.methods import METHODS, versions_of
from shared.policies.policy import Policy
from shared.store import Store

PROPOSER = "evaluation"
"""What an evaluation's plan calls its proposer: the methods of its setting."""


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What is evaluated, and what with.

    Attributes:
        store: of the evaluation's setting.
        policies: reads a policy's files by version; they are copied, so that the evaluation stands alone.
        version: the policy that is evaluated.
        rollouts: how many trials there shall be in all, those of earlier attempts included.
        per_shard: trials a shard.
        objects: folder of the objects.
        oracle: folder of the training of AAP, which may have left an oracle.
        out: folder of the table.
        root: folder of all this, which may be published; what is printed names paths relative to it.
    """

    store: Store
    policies: Callable[[int], Mapping[str, bytes]]
    version: int
    rollouts: int
    per_shard: int
    objects: Path
    oracle: Path
    out: Path
    root: Path

    @property
    def config(self) -> EvaluationConfig:
        """What is tried on each object."""
        config = self.store.setting.evaluation
        assert config is not None, "an evaluation store says what is evaluated"
        return config

    def execute(self, worker_group: CurrentWorkerGroup, say: Callable[[str], None]) -> Collected:
        """Do what is left of the trials, and write the table.

        Args:
            worker_group: executes the trials; dismissed before the table, which wants its cores.
            say: is told what the process that judges prints.

        Raises:
            UsageError: a method needs networks that are not trained, or the store holds trials of another policy.
            WorkerError: a job or the judging failed.
        """
        plan = Plan(setting=self.store.setting, proposer=PROPOSER, policy_version=self.version)
        if others := [other.key for other in self.store.plans() if other.key != plan.key]:
            raise UsageError(f"{self.store.where}: holds trials of another policy ({others[0]}); name another folder")
        self._publish()
        with self.store.only_driver():
            open_worker_group = partial(worker_group.for_store, self.store, self.objects)
            collected = collect(self.store, plan, self.rollouts, self.per_shard, open_worker_group, self.objects)
            worker_group.dismiss()
            told = {"store": self.store.where, "version": self.version, "out": str(self.out), "aap": str(self.oracle)}
            with closing(Child(say, self.root)) as child:
                child.run("cluster.evaluation.tables:write_judgement", told, self.out)
        return collected

    def _publish(self) -> None:
        """Copy the policies that the methods use, after a look at whether they hold all networks that are needed."""
        for version in versions_of(self.config.methods, self.version):
            files = self.policies(version)
            policy = Policy.from_files(files)
            policy.check_camera(self.store.setting.collection.camera)
            policy.warn_of_other_hand(self.store.setting.collection.gripper)
            for name in self.config.methods:
                if METHODS.get(name).policy_version(self.version) == version:
                    policy.require(*METHODS.get(name).modules)
            if version in self.store.policy_versions() and self.store.read_policy(version) != files:
                raise UsageError(f"{self.store.where}: holds trials of another policy; name another folder")
            self.store.publish_policy(version, files)


def figures_of(collected: Collected) -> Mapping[str, Any]:
    """What a run log notes of a collection: of the last attempt alone, as the wall time is."""
    return {"tally": asdict(collected.tally), "wall_s": collected.seconds, "workers": collected.workers}
