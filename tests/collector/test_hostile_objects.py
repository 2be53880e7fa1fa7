"""Two thousand hostile objects: each is refused with one line, or can be simulated and seen.

They are tried in processes of their own, so that a crash or a hang is caught and its object named. To try one again:
`python -m tests.support.hostile_batch SCRATCH SEED NUMBER NUMBER+1 OBJECTS...`.
"""

import dataclasses
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from collector.objects import articulation, procedural
from collector.objects.articulation import Body, Joint
from collector.objects.catalogue import scan
from shared.errors import ObjectError
from tests.support.hostile_runs import assert_harmless
from tests.support.single_door import box

MUTANTS, SAMPLE, BATCH = 2000, 40, 250


def test_a_sample_of_hostile_objects_is_refused_or_survived(tmp_path: Path) -> None:
    objects = generated(tmp_path, {"Box": 1, "Faucet": 1, "StorageFurniture": 2})
    assert_harmless(tmp_path, objects, range(SAMPLE))


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_two_thousand_hostile_objects_are_refused_or_survived(tmp_path: Path) -> None:
    objects = generated(tmp_path, dict.fromkeys(procedural.CATEGORIES, 2))
    results = Counter[str]()
    for start in range(SAMPLE, MUTANTS, BATCH):
        results += assert_harmless(tmp_path, objects, range(start, min(start + BATCH, MUTANTS)))
    # Neither a fuzzer whose objects are all refused at the door nor one that changes nothing tests much.
    assert min(results["refused"], results["survived"]) > MUTANTS / 5, results


@pytest.mark.slow
@pytest.mark.real_objects
@pytest.mark.timeout(1200)
def test_hostile_versions_of_real_objects_are_refused_or_survived(tmp_path: Path, real_objects: Path) -> None:
    objects = [entry.folder for entry in scan(real_objects).usable]
    assert_harmless(tmp_path, objects, range(MUTANTS, MUTANTS + 500))


def test_what_the_engine_cannot_take_is_refused() -> None:
    def body(reach: float = 0.1, shapes: int = 1) -> Body:
        return Body("l", "", None, (box((0, 0, 0), (reach, 0.1, 0.1)),), (box((0, 0, 0), (0.1, 0.1, 0.1)),) * shapes)

    def turning(parent: int, reach: float = 0.1, shapes: int = 1, upper: float = 1.0, offset: float = 0.0) -> Body:
        pose, base = np.eye(4), body(reach, shapes)
        pose[0, 3] = offset
        joint = Joint("j", "revolute", parent, pose, np.array([0.0, 0.0, 1.0]), 0.0, upper)
        return dataclasses.replace(base, joint=joint)

    def sliding(upper: float) -> Body:
        joint = Joint("j", "prismatic", 0, np.eye(4), np.array([0.0, 0.0, 1.0]), -0.1, upper)
        return dataclasses.replace(body(), joint=joint)

    articulation.check_bounds([body(), *(turning(k) for k in range(articulation.MAX_DEPTH))])
    articulation.check_bounds([body(19.0), turning(0, 4.0, offset=15.0), turning(1, 0.5), sliding(19.0)])
    for bodies, message in (
        ([body(), *(turning(0) for _ in range(articulation.MAX_PARTS + 1))], "movable parts"),
        ([body(), *(turning(k) for k in range(articulation.MAX_DEPTH + 1))], "moving joints"),
        ([body(), turning(0, shapes=300), turning(0, shapes=300)], "pairs of collision shapes"),
        ([body(20.1)], "from the root's origin"),
        ([body(), turning(0, 10.0, offset=5.0), turning(1, 9.0, offset=10.0)], "from the root's origin"),
        ([body(), sliding(20.0)], "from the root's origin"),
        ([body(), turning(0, upper=6.3)], "beyond one turn"),
    ):
        with pytest.raises(ObjectError, match=message):
            articulation.check_bounds(bodies)


def generated(folder: Path, counts: dict[str, int]) -> list[Path]:
    """Good objects to start from."""
    procedural.generate(folder / "objects", counts, seed=5)
    return sorted(path for path in (folder / "objects").iterdir() if path.is_dir())
