"""Collection in one process, killed at random moments until it is done, on a disk and in a bucket."""

import itertools
import time
from pathlib import Path

import numpy as np
import pytest

from shared.store import Store
from tests.chaos.conftest import Draw
from tests.chaos.counts import Counts
from tests.chaos.killer import Campaign, Killer
from tests.chaos.processes import Marked, Role
from tests.chaos.witness import Witness

pytestmark = pytest.mark.chaos

KILLS = 6
ROLLOUTS = 16
COLLECT = (
    *("collect", "--task", "push-faucet", "--procedural-per-category", "2", "--workers", "0"),
    *("--rollouts", str(ROLLOUTS), "--per-shard", "1"),
    *("--collection.camera.points", "64", "--collection.rollout.interactions", "4"),
)


@pytest.mark.parametrize("place", ["disk", "bucket"])
def test_a_driver_killed_at_any_moment(
    place: str, tmp_path: Path, request: pytest.FixtureRequest, draw: Draw, counts: Counts
) -> None:
    base = str(tmp_path) if place == "disk" else request.getfixturevalue("s3_url")
    objects = tmp_path / "objects"
    arguments = [*COLLECT] if place == "disk" else [*COLLECT, "--objects", str(objects)]
    name = f"collect, one process, {place}"
    rng = draw(name)

    def campaign(number: int, within_s: float, kills: int, rng: np.random.Generator) -> tuple[str, int]:
        store = f"{base}/{number}"
        folder = tmp_path / f"log-{number}"
        folder.mkdir()
        this = Campaign(name, [*arguments, "--store", store], store, within_s, {Role.DRIVER: 1.0})
        killer = Killer(this, Marked(), Witness(store), rng, counts, folder)
        killer.harass(kills)
        return Store.open(store).digest(), killer.kills

    if place == "bucket":
        made = Marked().start([*COLLECT, "--rollouts", "1", "--store", str(tmp_path / "made")], tmp_path / "made.txt")
        assert made.wait(100) == 0
        (tmp_path / "made-objects").rename(objects)
    began = time.monotonic()
    digest, _ = campaign(0, 0.0, 0, rng)
    within_s = time.monotonic() - began
    done = 0
    for number in itertools.count(1):
        if done >= KILLS:
            break
        one, kills = campaign(number, within_s, KILLS - done, rng)
        assert one == digest
        counts.ended(name)
        done += kills
