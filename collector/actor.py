"""The Ray actor: a thin wrapper around a worker that pulls weights by version. The only module here that knows Ray."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Protocol

import ray

from shared.plan import Job, Plan

if TYPE_CHECKING:
    from collector.worker import Receipt


class WrappedWorker(Protocol):
    """What is wrapped; `collector.worker.Worker` in earnest, a fake in tests."""

    def load_policy(self, version: int, files: Mapping[str, bytes]) -> None:
        """Make the policy `version` ready."""
        ...

    def run(self, plan: Plan, job: Job) -> "Receipt":
        """Execute and commit `job`."""
        ...


class WorkerActor:
    """Executes one job at a time in a process of its own.

    The worker is made by the first job, not in `__init__`, so that whatever is wrong with a store or a folder reaches
    the driver as the job's own exception. It is thrown away after a failure, since an engine may then be in any state.
    """

    def __init__(self, make_worker: Callable[[], WrappedWorker]) -> None:
        self._make_worker = make_worker
        self._worker: WrappedWorker | None = None
        self._loaded: set[int] = set()

    def arrive(self) -> None:
        """Return, which says that the process is up and has imported what it needs."""

    def run(self, plan: Plan, job: Job, policy: "list[ray.ObjectRef[Mapping[str, bytes]]]") -> "Receipt":
        """Execute `job` and return its receipt; arrays never cross.

        Args:
            plan: the plan that the job belongs to.
            job: the job.
            policy: the reference to the weights of `plan.policy_version`, within a list so that Ray hands over the
                reference and the bytes are pulled at most once a version; empty if the plan uses none.
        """
        try:
            worker = self._live_worker()
            if policy and plan.policy_version not in self._loaded:
                worker.load_policy(plan.policy_version, ray.get(policy[0]))
                self._loaded.add(plan.policy_version)
            return worker.run(plan, job)
        except BaseException:
            self._worker = None
            raise

    def _live_worker(self) -> WrappedWorker:
        """The worker, made if there is none."""
        if self._worker is None:
            self._worker = self._make_worker()
            self._loaded = set()
        return self._worker
