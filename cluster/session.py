"""The Ray session: a private one on this machine's loopback, or a connection to a cluster that runs already."""

import logging
import os
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

from cluster.fleet import Fleet, SerialFleet, WorkerFactory
from collector.guard import Limits
from shared.errors import UsageError, WorkerError
from shared.extras import require_packages
from shared.underway import Underway

OBJECT_STORE_BYTES = 128 << 20
"""Only weights and receipts travel, so the smallest object store that Ray likes is ample."""

_ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # The new behaviour; unset, Ray warns that it will come.
    "RAY_DISABLE_IMPORT_WARNING": "1",
    # Actors inherit these: one CPU each, and no library may think that it has more.
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}

FleetMaker = Callable[[WorkerFactory, Underway], Fleet]
"""Makes a fleet whose workers leave their breadcrumbs there."""

logger = logging.getLogger(__name__)


@contextmanager
def fleets(workers: int, limits: Limits, address: str | None = None) -> Iterator[FleetMaker]:
    """A maker of fleets that live at most as long as the context: serial if `workers` is 0, else on Ray.

    Ray starts with the first fleet, so that what needs none does not wait for it.

    Args:
        workers: how many actors a fleet has; 0 does without Ray.
        limits: what a rollout may take.
        address: of a running Ray cluster; None starts a session of our own on this machine.

    Raises:
        UsageError: as soon as a fleet is wanted, where Ray or SAPIEN is not installed.
    """
    with ExitStack() as stack:
        begun = False

        def make(make_worker: WorkerFactory, underway: Underway) -> Fleet:
            nonlocal begun
            if workers == 0:
                require_packages("collecting", "sapien")
                return SerialFleet(make_worker)
            # On a cluster, it is the workers that need SAPIEN.
            require_packages("collecting", "ray", *(["sapien"] if address is None else []))
            if not begun:
                stack.enter_context(ray_session(workers, address))
                begun = True
            from cluster.ray_fleet import RayFleet

            fleet = RayFleet(make_worker, underway, workers, limits)
            stack.callback(fleet.close)
            return fleet

        yield make


@contextmanager
def ray_session(workers: int, address: str | None = None) -> Iterator[None]:
    """Hold a Ray session: no dashboard, quiet, and shut down in the end whatever happens.

    Raises:
        UsageError: there is no cluster at `address`.
        WorkerError: a session of our own does not come up; Ray allows it 30 s, too few for a machine under heavy load.
    """
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    on_terminate = signal.getsignal(signal.SIGTERM)
    os.environ.update(_ENVIRONMENT)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own deprecations; a user can do nothing about them.
        import ray

        _quieten()
        try:
            if address is None:
                _start_on_loopback(workers)
            else:
                ray.init(address=address, logging_level=logging.ERROR, log_to_driver=False)
        except ConnectionError:
            raise UsageError(f"no Ray cluster answers at '{address}'; start one, or leave the address out") from None
        finally:
            for name, value in before.items():
                os.environ.pop(name, None) if value is None else os.environ.update({name: value})
    try:
        # Ray has put a handler of its own in place of ours.
        signal.signal(signal.SIGTERM, on_terminate)
        yield
    finally:
        ray.shutdown()


def _start_on_loopback(workers: int) -> None:
    """Start Ray so that nothing listens beyond this machine: it executes code for whoever reaches its ports.

    Ray replaces 127.0.0.1 by the address that others would reach, except where it believes that clusters are not
    supported (as on macOS and Windows); so that belief is installed while the session starts.
    """
    import ray
    from ray._private import ray_constants

    clusters = ray_constants.ENABLE_RAY_CLUSTER
    ray_constants.ENABLE_RAY_CLUSTER = False
    try:
        ray.init(
            num_cpus=workers,
            num_gpus=0,
            include_dashboard=False,
            object_store_memory=OBJECT_STORE_BYTES,
            logging_level=logging.ERROR,
            log_to_driver=False,
            _node_ip_address="127.0.0.1",
        )
    except Exception as error:
        # Ray has no class of its own for a session that does not come up in its 30 s.
        said = str(error).partition("\n")[0]
        raise WorkerError(f"Ray did not start ({said}); run the same command again, or with --workers 0") from error
    finally:
        ray_constants.ENABLE_RAY_CLUSTER = clusters


def _quieten() -> None:
    """Send what raylets would print on our terminal to the log: the end of an actor, say, which we report ourselves."""
    from ray._private import worker

    def to_log(data: dict[str, Any], ignore_prefix: bool = False) -> None:
        logger.debug("%s", " ".join(data.get("lines", ())))

    worker.print_to_stdstream = to_log
