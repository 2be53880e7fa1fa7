"""Several processes that train one network, each on its share of every batch (started by torchrun).

Every process draws the whole batch from the same generator, so that they agree on it without a message, and works on
its share. The average of their gradients, which DistributedDataParallel takes, is then that of one process with the
whole batch, up to rounding. With one process everything here does nothing.
"""

import torch
from torch import Tensor, distributed

from shared.errors import UsageError


def processes() -> int:
    """How many there are."""
    return distributed.get_world_size() if _together() else 1


def rank() -> int:
    """Which one this is; the first, 0, writes files and says how things stand."""
    return distributed.get_rank() if _together() else 0


def share(count: int) -> slice:
    """This process's places in a batch of `count`.

    Raises:
        UsageError: some process would get none.
    """
    if count < processes():
        raise UsageError(f"a batch of {count} cannot be shared by {processes()} processes; start fewer")
    return slice(rank(), None, processes())


def shared_mean(total: Tensor, count: Tensor) -> Tensor:
    """This process's part in a mean over all shares; the average of the parts is the mean. 0 where nothing counts.

    Args:
        total: sum over this process's share.
        count: how many entries it has, a scalar of floats.
    """
    if processes() > 1:
        count = count.detach().clone()
        distributed.all_reduce(count)
        count = count / processes()
        return torch.where(count > 0, total / count.clamp_min(1e-9), total)
    return total / count.clamp_min(1.0)


def averaged(values: Tensor) -> Tensor:
    """The mean of what each process has."""
    values = values.detach()
    if processes() > 1:
        values = values.clone()
        distributed.all_reduce(values)
        values = values / processes()
    return values


def wait_for_all() -> None:
    """Go on when every process has come this far."""
    if _together():
        distributed.barrier()


def _together() -> bool:
    return distributed.is_available() and distributed.is_initialized()
