"""The command that executes one job, or one rollout, alone and in the foreground."""

import shlex
from pathlib import Path

STORE, OBJECTS = "STORE", "OBJECTS"
"""What stands for the store and the objects in a command that is kept, since both may move."""


def reproduction(store: Path | str, shard_id: str, objects: Path | str, rollout: int | None = None) -> str:
    """The command, as a shell takes it.

    Args:
        store: folder of the store.
        shard_id: the job's shard.
        objects: folder of the objects.
        rollout: number of the rollout within the plan; None for the whole job.
    """
    words = ["adaafford", "store", "replay", str(store), shard_id, "--objects", str(objects)]
    return shlex.join(words if rollout is None else [*words, "--rollout", str(rollout)])
