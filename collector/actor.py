"""The Ray actor: a thin wrapper around a worker, which pulls weights by version; only this module imports Ray."""

from collections.abc import Mapping

import ray

from collector.job_result import JobResult, JobWorker, WorkerFactory
from collector.watchdog import Limits, Watchdog
from shared.io.files import process_name
from shared.plan import Job, Plan
from shared.store.crash_log import CrashLog


class WorkerActor:
    """Executes one job at a time in a separate process.

    The worker is created in the first job, not in `__init__`, so that a problem with a store or a folder reaches the
    driver as the exception of the job. After any failure the driver replaces the process, because the engine may be in
    any state and memory may have grown.
    """

    def __init__(self, make_worker: WorkerFactory, crash_log: CrashLog, limits: Limits) -> None:
        self._make_worker = make_worker
        self._watchdog = Watchdog(crash_log, limits)
        self._worker: JobWorker | None = None
        self._broken = False
        self._plans: dict[str, Plan] = {}
        self._loaded: set[int] = set()

    def arrive(self) -> str:
        """Return the name of this process, which is also that of its heartbeats; the answer shows that it is up."""
        self._watchdog.install()
        return process_name()

    def run(
        self,
        plan: "list[ray.ObjectRef[Plan]]",
        job: Job,
        policy: "list[ray.ObjectRef[Mapping[str, bytes]]]",
        quarantined: Mapping[int, str],
    ) -> JobResult:
        """Execute `job` and return its result, which has no arrays.

        Args:
            plan: the reference to the plan of the job. It is in a list so that Ray passes the reference, and the plan,
                which has all objects, is pulled only once.
            job: the job.
            policy: the reference to the weights of the plan's policy, also in a list; empty if the plan uses none.
            quarantined: rollouts of the job that are not executed, with the reasons.
        """
        # The next job was already submitted. It would overwrite the heartbeat of the failed one, which the driver
        # reads.
        if self._broken:
            raise RuntimeError("the job before this one failed, and the process is about to be replaced")
        self._broken = True
        worker, known = self._live_worker(), self._plan(job.plan_key, plan[0])
        if policy and known.policy_version not in self._loaded:
            worker.load_policy(known.policy_version, ray.get(policy[0]))
            self._loaded.add(known.policy_version)
        with self._watchdog.job(job) as under_way:
            job_result = worker.run(known, job, quarantined, under_way)
        self._broken = False
        return job_result

    def _plan(self, key: str, ref: "ray.ObjectRef[Plan]") -> Plan:
        """The plan with this key, pulled if it is not cached."""
        if key not in self._plans:
            self._plans[key] = ray.get(ref)
        return self._plans[key]

    def _live_worker(self) -> JobWorker:
        """The worker, created if there is none."""
        if self._worker is None:
            self._worker = self._make_worker()
            self._watchdog.bound_memory()
        return self._worker
