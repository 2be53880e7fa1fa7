"""Settings of workers, which several commands share."""

from typing import TYPE_CHECKING, Annotated

from pydantic import AfterValidator, Field

from shared.config import StrictModel

if TYPE_CHECKING:
    from collector.watchdog import Limits


def _without_credentials(address: str) -> str:
    if "@" in address:
        raise ValueError("an address may hold no user and password; Ray takes its token from RAY_AUTH_TOKEN")
    return address


RayAddress = Annotated[str, AfterValidator(_without_credentials)]
"""Of a Ray cluster; it is kept and shown, so that it may hold no secret."""


class WorkerSettings(StrictModel):
    """How many workers there are, where, and what a rollout may take of them."""

    workers: int = Field(2, ge=0, le=4096)
    """Ray actors, one CPU each; 0 does everything in one process without Ray."""
    ray_address: RayAddress | None = None
    """HOST:PORT of a running Ray cluster, or auto; default: a private session on this machine."""
    rollout_limit_s: float = Field(300.0, gt=0)
    """A worker that takes longer for one rollout is taken for hung, and replaced; after three times the rollout is
    quarantined."""
    memory_limit_mb: float = Field(2000.0, gt=0)
    """What a worker may take beyond what it had after its start; at half of that it is replaced after its job."""

    @property
    def limits(self) -> "Limits":
        """Of a worker's process."""
        from collector.watchdog import Limits

        return Limits(self.rollout_limit_s, self.memory_limit_mb)
