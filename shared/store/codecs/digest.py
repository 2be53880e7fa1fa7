"""The content digest: over the data without times, hosts, versions or shards.

Same plan, same seed, same policy: same digest, whether one worker made the rollouts or a thousand.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from shared.records import RolloutRecord, RolloutStatus
from shared.store.codecs.columns import INTERACTION_COLUMNS, Column, InteractionRow, RolloutRow, rollout_columns
from shared.store.codecs.observations import Packed, pack

Row = TypeVar("Row")


def rollout_digest(rollout: RolloutRecord, clouds: Sequence[Packed] | None = None) -> str:
    """SHA-256 of one rollout, over the canonical little-endian bytes of its columns and clouds.

    Args:
        rollout: the rollout.
        clouds: its observations as `observations.pack` makes them, where somebody has them.
    """
    digest = hashlib.sha256()
    if rollout.status is RolloutStatus.NEVER_AT_REST:
        # Earlier software did not tell the two apart; the same plan shall have the digest that it had.
        rollout = replace(rollout, status=RolloutStatus.NOTHING_TO_ACT_ON)
    _add_columns(digest, rollout_columns(rollout.dynamics.added), [RolloutRow(rollout, 0)])
    if rollout.arm_base:
        # Not every store has it, and those without keep their digests.
        _add(digest, "arm_base", [len(rollout.arm_base)], np.array(rollout.arm_base, "<f8").tobytes())
    rows = [InteractionRow(rollout, interaction, 0) for interaction in rollout.interactions]
    _add_columns(digest, INTERACTION_COLUMNS, rows)
    for cloud in map(pack, rollout.observations) if clouds is None else clouds:
        for name, packed in cloud.items():
            _add(digest, name, packed.shape, packed.tobytes())
    return digest.hexdigest()


def combined_digest(digests: Iterable[tuple[str, int, str]]) -> str:
    """SHA-256 of many rollouts, given as plan key, number within the plan and digest, in this order."""
    digest = hashlib.sha256()
    for plan_key, index, one in digests:
        digest.update(f"{plan_key} {index} {one}\n".encode())
    return digest.hexdigest()


def _add_columns(digest: Any, columns: Sequence[Column[Row]], rows: Sequence[Row]) -> None:
    for column in columns:
        if column.content:
            cells = column.gather(rows)
            # Lengths and texts are framed as JSON, so that no two columns of cells give the same bytes.
            frame = (len(rows), cells.lengths, cells.texts)
            _add(digest, column.name, frame, np.ascontiguousarray(cells.numbers).tobytes())


def _add(digest: Any, name: str, frame: Sequence[Any], data: bytes) -> None:
    digest.update(json.dumps([name, frame, len(data)], separators=(",", ":")).encode())
    digest.update(data)
