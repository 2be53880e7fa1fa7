"""The Ray actor: a thin wrapper around a worker that pulls weights by version. The only module here that knows Ray."""

from collections.abc import Mapping

import ray

from collector.job_result import JobResult, JobWorker, WorkerFactory
from collector.watchdog import Limits, Watchdog
from shared.io.files import process_name
from shared.plan import Job, Plan
from shared.store.crash_log import CrashLog


class WorkerActor:
    """Executes one job at a time in a process of its own.

    The worker is made by the first job, not in `__init__`, so that whatever is wrong with a store or a folder reaches
    the driver as the job's own exception. After any failure the driver replaces the process, since an engine may then
    be in any state, and memory may have grown.

    Args:
        make_worker: makes the worker.
        crash_log: where heartbeats go.
        limits: what a rollout may take.
    """

    def __init__(self, make_worker: WorkerFactory, crash_log: CrashLog, limits: Limits) -> None:
        self._make_worker = make_worker
        self._guard = Watchdog(crash_log, limits)
        self._worker: JobWorker | None = None
        self._broken = False
        self._plans: dict[str, Plan] = {}
        self._loaded: set[int] = set()

    def arrive(self) -> str:
        """Return this process's name, by which its heartbeats go; which also says that it is up."""
        self._guard.stand()
        return process_name()

    def run(
        self,
        plan: "list[ray.ObjectRef[Plan]]",
        job: Job,
        policy: "list[ray.ObjectRef[Mapping[str, bytes]]]",
        quarantined: Mapping[int, str],
    ) -> JobResult:
        """Execute `job` and return its job result; arrays never cross.

        Args:
            plan: the reference to the plan that the job belongs to, within a list so that Ray hands over the reference
                and the plan, which names all objects, is pulled once.
            job: the job.
            policy: likewise to the weights of the plan's policy; empty if it uses none.
            quarantined: rollouts of the job that are not to be executed, and why.
        """
        # The job behind one that failed is here already, and would hide its heartbeat before the driver has seen it.
        if self._broken:
            raise RuntimeError("the job before this one failed, and the process is about to be replaced")
        self._broken = True
        worker, known = self._live_worker(), self._plan(job.plan_key, plan[0])
        if policy and known.policy_version not in self._loaded:
            worker.load_policy(known.policy_version, ray.get(policy[0]))
            self._loaded.add(known.policy_version)
        with self._guard.job(job) as under_way:
            job_result = worker.run(known, job, quarantined, under_way)
        self._broken = False
        return job_result

    def _plan(self, key: str, ref: "ray.ObjectRef[Plan]") -> Plan:
        """The plan of this name, pulled if it is not here."""
        if key not in self._plans:
            self._plans[key] = ray.get(ref)
        return self._plans[key]

    def _live_worker(self) -> JobWorker:
        """The worker, made if there is none."""
        if self._worker is None:
            self._worker = self._make_worker()
            self._guard.bound_memory()
        return self._worker
