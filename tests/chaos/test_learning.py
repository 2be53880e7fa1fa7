"""Learners, killed at random moments until they are done: alone, beside collection, and in a whole campaign."""

from pathlib import Path

import pytest

from cluster.runs.run_folder import RunFolder
from shared.store import Store
from tests.chaos.campaigns import (
    BESIDE,
    COLLECT,
    TRAINING,
    WHOLE,
    LearnerWitness,
    Siege,
    Trial,
    learner_file,
    policies_in,
    run_file,
)
from tests.chaos.counts import Counts
from tests.chaos.processes import Marked, Role
from tests.chaos.witness import Witness

pytestmark = pytest.mark.chaos

RANDOM, ROUND = 8, 6
TO_LEARN_FROM = (*COLLECT, "--collection.camera.points", "256", "--collection.rollout.interactions", "8")


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory, objects: Path) -> Path:
    """A store with something to learn from."""
    folder = tmp_path_factory.mktemp("collected")
    fill(folder / "store", objects, folder)
    return folder / "store"


def fill(store: Path, objects: Path, folder: Path) -> None:
    arguments = ["--workers", "0", "--rollouts", str(RANDOM), "--objects", str(objects), "--store", str(store)]
    log = folder / f"fill-{store.name}.txt"
    assert Marked().start([*TO_LEARN_FROM, *arguments], log).wait(200) == 0, log.read_text()


def test_a_learner_from_the_prior_to_the_last_round(
    collected: Path, tmp_path: Path, seed: int, counts: Counts, everybody: list[Marked]
) -> None:
    settings = learner_file(tmp_path)

    def trial(name: str) -> Trial:
        out = tmp_path / name
        command = ["train", "alternate", "--store", str(collected), "--out", str(out), "--config", str(settings)]
        return Trial([command], LearnerWitness(out).look, lambda: policies_in(out))

    Siege(TRAINING, {Role.LEARNER: 1.0}, tmp_path, seed, counts, everybody).lay(trial, at_once=2)


def test_a_learner_beside_collection(
    ray_folder: Path, tmp_path: Path, objects: Path, seed: int, counts: Counts, everybody: list[Marked]
) -> None:
    """Collectors on Ray wait for each policy, and the learner for rollouts of the last one."""
    settings = learner_file(tmp_path)
    pace = ["--follow", "--first-rollouts", str(RANDOM), "--more-rollouts", str(ROUND), "--poll-s", "0.2"]
    rounds = ["--policy", "latest", "--per-version", str(ROUND), "--rollouts", str(2 * ROUND), "--proposer", "aip"]

    def trial(name: str) -> Trial:
        store, out = tmp_path / name / "store", tmp_path / name / "out"
        store.parent.mkdir()
        fill(store, objects, store.parent)
        learn = ["learn", "--store", str(store), "--out", str(out), "--config", str(settings), *pace]
        collect = [*TO_LEARN_FROM, "--workers", "1", "--objects", str(objects), "--store", str(store), *rounds]
        witness, of_learner = Witness(str(store)), LearnerWitness(out)

        def result() -> object:
            held = Store.open(store)
            return held.digest(), held.policy_versions(), policies_in(out)

        return Trial([collect, learn], lambda: (witness.look(), of_learner.look()), result)

    victims = {Role.LEARNER: 5.0, Role.DRIVER: 4.0, Role.ACTOR: 3.0, Role.HEAD: 1.0}
    environment = {"TMPDIR": str(ray_folder)}
    siege = Siege(
        BESIDE, victims, tmp_path, seed, counts, everybody, lambda: Marked(environment), most=7, within_s=10.0
    )
    siege.lay(trial)


def test_a_whole_campaign(ray_folder: Path, tmp_path: Path, seed: int, counts: Counts, everybody: list[Marked]) -> None:
    settings = run_file(tmp_path)

    def trial(name: str) -> Trial:
        run = RunFolder(tmp_path / name)
        stores = [run.store, run.evaluation]
        witnesses = [*(Witness(str(store)) for store in stores), LearnerWitness(run.trainings)]

        def result() -> object:
            return [Store.open(store).digest() for store in stores], policies_in(run.trainings)

        command = ["run", "--out", str(run.path), "--config", str(settings), "--workers", "2"]
        return Trial([command], lambda: [witness.look() for witness in witnesses], result)

    victims = {Role.LEARNER: 3.0, Role.DRIVER: 3.0, Role.ACTOR: 3.0, Role.HEAD: 1.0, Role.ALL: 1.0}
    environment = {"TMPDIR": str(ray_folder)}
    siege = Siege(WHOLE, victims, tmp_path, seed, counts, everybody, lambda: Marked(environment), within_s=20.0)
    siege.lay(trial)
