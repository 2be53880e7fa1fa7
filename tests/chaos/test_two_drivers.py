"""Two drivers on one store at once: one clear refusal, or both useful; never damage."""

from pathlib import Path

import pytest

from shared.errors import UsageError
from shared.store import Store, verify
from tests.chaos.campaigns import COLLECT, learner_file, policies_in
from tests.chaos.processes import Marked
from tests.chaos.witness import Witness

pytestmark = pytest.mark.chaos

ROLLOUTS = 12
PATIENCE_S = 900.0
TIMES = 2


def both(folder: Path, commands: list[list[str]]) -> list[tuple[int, str]]:
    """Exit code and output of each of several commands that are given at the same moment."""
    folder.mkdir(exist_ok=True)
    logs = [folder / f"{k}.txt" for k in range(len(commands))]
    started = [Marked().start(command, log) for command, log in zip(commands, logs, strict=True)]
    return [(one.wait(PATIENCE_S), log.read_text()) for one, log in zip(started, logs, strict=True)]


def collecting(store: str, objects: Path, per_shard: int) -> list[str]:
    flags = ["--workers", "0", "--rollouts", str(ROLLOUTS), "--per-shard", str(per_shard), "--objects", str(objects)]
    return [*COLLECT, *flags, "--store", store]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, objects: Path) -> str:
    """The digest of one driver alone."""
    folder = tmp_path_factory.mktemp("undisturbed")
    ((code, words),) = both(folder, [collecting(str(folder / "store"), objects, 1)])
    assert code == 0, words
    return Store.open(folder / "store").digest()


def test_on_a_disk_the_second_is_refused(tmp_path: Path, objects: Path, undisturbed: str) -> None:
    for time in range(TIMES):
        store = str(tmp_path / f"store-{time}")
        ended = sorted(both(tmp_path / f"log-{time}", [collecting(store, objects, size) for size in (1, 3)]))
        assert [code for code, _ in ended] == [0, UsageError.exit_code], ended
        refusal = ended[1][1]
        assert "is in use by process" in refusal
        assert refusal.count("\n") == 1
        assert verify(Store.open(store)) == []
        assert Store.open(store).digest() == undisturbed


@pytest.mark.parametrize("sizes", [(1, 1), (1, 3)])
def test_in_a_bucket_both_end_or_one_is_refused_and_nothing_is_doubled(
    sizes: tuple[int, int], tmp_path: Path, s3_url: str, objects: Path, undisturbed: str
) -> None:
    """With shards of the same size both are useful; with others, whoever meets the other's shard is refused."""
    for time in range(TIMES):
        store = f"{s3_url}/{time}"
        ended = sorted(both(tmp_path / f"log-{time}", [collecting(store, objects, size) for size in sizes]))
        assert ended[0][0] == 0, ended
        if ended[1][0] != 0:
            assert len(set(sizes)) > 1, ended
            assert ended[1][0] == UsageError.exit_code, ended
            assert "overlaps the committed shard" in ended[1][1].splitlines()[-1]
        held = Store.open(store)
        assert held.digest() == undisturbed
        assert len(held.rollouts()) == ROLLOUTS
        assert verify(held) == []


def test_in_a_bucket_one_goes_on_where_the_other_is_killed(
    tmp_path: Path, s3_url: str, objects: Path, undisturbed: str
) -> None:
    command = collecting(s3_url, objects, 1)
    witness, log = Witness(s3_url), tmp_path / "log.txt"
    one, other = (Marked().start(command, log) for _ in range(2))
    while witness.look() < ROLLOUTS // 3:
        assert one.poll() is None, log.read_text()
    one.kill()
    one.wait()
    witness.look()
    assert other.wait(PATIENCE_S) == 0, log.read_text()
    witness.look()
    assert Store.open(s3_url).digest() == undisturbed


@pytest.mark.parametrize("command", ["learn", "train alternate"])
def test_of_two_learners_in_one_folder_the_second_is_refused(command: str, tmp_path: Path, objects: Path) -> None:
    store = str(tmp_path / "store")
    assert both(tmp_path / "fill", [collecting(store, objects, 4)])[0][0] == 0
    told = ["--store", store, "--config", str(learner_file(tmp_path))]
    ended = sorted(
        both(tmp_path / "log", [[*command.split(), *told, "--out", str(tmp_path / "out")] for _ in range(2)])
    )
    assert [code for code, _ in ended] == [0, UsageError.exit_code], ended
    assert "is in use by process" in ended[1][1]
    alone = both(tmp_path / "alone", [["train", "alternate", *told, "--out", str(tmp_path / "alone" / "out")]])
    assert alone[0][0] == 0, alone
    assert policies_in(tmp_path / "out") == policies_in(tmp_path / "alone" / "out")
