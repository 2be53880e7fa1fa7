"""The Ray actor: a thin wrapper around a worker that pulls weights by version. The only module here that knows Ray."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import ray

from collector.guard import Guard, Limits, UnderWay
from shared.files import process_name
from shared.plan import Job, Plan
from shared.underway import Underway

if TYPE_CHECKING:
    from collector.worker import Receipt


class WrappedWorker(Protocol):
    """What is wrapped; `collector.worker.Worker` in earnest, a fake in tests."""

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Make the policy `version` ready."""
        ...

    def run(self, plan: Plan, job: Job, quarantined: Mapping[int, str], under_way: UnderWay) -> "Receipt":
        """Execute and commit `job`; see `collector.worker.Worker.run`."""
        ...


class WorkerActor:
    """Executes one job at a time in a process of its own.

    The worker is made by the first job, not in `__init__`, so that whatever is wrong with a store or a folder reaches
    the driver as the job's own exception. After any failure the driver replaces the process, since an engine may then
    be in any state, and memory may have grown.

    Args:
        make_worker: makes the worker.
        underway: where breadcrumbs go.
        limits: what a rollout may take.
    """

    def __init__(self, make_worker: Callable[[], WrappedWorker], underway: Underway, limits: Limits) -> None:
        self._make_worker = make_worker
        self._guard = Guard(underway, limits)
        self._worker: WrappedWorker | None = None
        self._loaded: set[int] = set()

    def arrive(self) -> str:
        """Return this process's name, by which its breadcrumbs go; which also says that it is up."""
        self._guard.stand()
        return process_name()

    def run(
        self,
        plan: Plan,
        job: Job,
        policy: "list[ray.ObjectRef[Mapping[str, bytes]]]",
        quarantined: Mapping[int, str],
    ) -> "Receipt":
        """Execute `job` and return its receipt; arrays never cross.

        Args:
            plan: the plan that the job belongs to.
            job: the job.
            policy: the reference to the weights of `plan.policy_version`, within a list so that Ray hands over the
                reference and the bytes are pulled at most once a version; empty if the plan uses none.
            quarantined: rollouts of the job that are not to be executed, and why.
        """
        worker = self._live_worker()
        if policy and plan.policy_version not in self._loaded:
            worker.load_policy(plan.policy_version, ray.get(policy[0]))
            self._loaded.add(plan.policy_version)
        with self._guard.job(job) as under_way:
            return worker.run(plan, job, quarantined, under_way)

    def _live_worker(self) -> WrappedWorker:
        """The worker, made if there is none."""
        if self._worker is None:
            self._worker = self._make_worker()
            self._guard.bound_memory()
        return self._worker
