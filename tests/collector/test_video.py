"""Videos of stored interactions: they decode again, show what happened, and bad choices are refused in one line."""

import dataclasses
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence

from cluster.cli.main import run
from collector.objects.catalogue import load_ref, scan
from collector.objects.procedural import generate
from collector.viz import video
from collector.viz.playback import Playback, record
from collector.viz.rendering import Renderer, View, fitted
from collector.worker import Worker
from shared.config import CameraConfig, CollectionConfig, RolloutConfig
from shared.errors import UsageError
from shared.plan import Job, Plan, Setting
from shared.store import Store

CONFIG = CollectionConfig(
    camera=CameraConfig(image_size=128, points=256, candidates=1000), rollout=RolloutConfig(interactions=3)
)
WIDTH, HEIGHT = 160, 96


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("objects")
    generate(folder, {"StorageFurniture": 1}, seed=8)
    return folder


@pytest.fixture(scope="module", params=["push", "pull-closed-door"])
def collected(request: pytest.FixtureRequest, objects: Path, tmp_path_factory: pytest.TempPathFactory) -> Store:
    refs = tuple(entry.ref for entry in scan(objects).usable)
    setting = Setting(task=request.param, seed=3, objects=refs, collection=CONFIG)
    store, plan = Store.create(tmp_path_factory.mktemp("collected") / "store", setting), Plan(setting=setting)
    Worker(store.where, objects).run(plan, Job(plan.key, 0, 2))
    return store


@pytest.fixture
def short_and_small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every tenth frame in small pictures, since drawing is what takes time."""
    thin = Playback.at_rate
    monkeypatch.setattr(Playback, "at_rate", lambda self, rate: thin(self, rate / 10))
    for name, value in {"WIDTH": WIDTH, "HEIGHT": HEIGHT, "CLOSE_UP": 64, "PAUSE_S": 0.04}.items():
        monkeypatch.setattr(video, name, value)


@pytest.fixture
def replay(objects: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def execute(store: Store, *flags: object) -> tuple[int, str, str]:
        code = run(["store", "replay", store.where, "--objects", str(objects), *map(str, flags)])
        return code, *capsys.readouterr()

    return execute


def rows_of(store: Store) -> list[tuple[int, int, bool]]:
    records = store.read_rollouts(store.committed()[0].shard_id)
    return [(record.index, row.step, row.outcome.success) for record in records for row in record.interactions]


def frames_of(store: Store, objects: Path, rollout: int, step: int | None) -> int:
    """How many frames a video has: those of each interaction, and one more for the pause."""
    collection = store.setting.collection
    records = store.read_rollouts(store.committed()[0].shard_id)
    chosen = next(each for each in records if each.index == rollout)
    target = load_ref(objects, chosen.object, collection.collision)
    rows = [row for row in chosen.interactions if step in (None, row.step)]
    return sum(len(record(target, collection, chosen, row, video.FRAMES_A_SECOND).times) + 1 for row in rows)


def test_playbacks_have_the_stored_outcomes(collected: Store, objects: Path) -> None:
    collection = collected.setting.collection
    for rollout in collected.read_rollouts(collected.committed()[0].shard_id):
        target = load_ref(objects, rollout.object, collection.collision)
        for row in rollout.interactions:
            again = record(target, collection, rollout, row).outcome
            assert (again.kind, again.success) == (row.outcome.kind, row.outcome.success)
            assert again.motion == pytest.approx(row.outcome.motion, abs=5e-3)


@pytest.mark.usefixtures("short_and_small")
def test_a_gif_of_an_interaction_has_all_its_frames(
    collected: Store, objects: Path, replay: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    rollout, step, success = rows_of(collected)[1]
    out = tmp_path / "made/one.gif"
    code, said, _ = replay(collected, "--rollout", rollout, "--step", step, "--video", out)
    assert code == 0
    assert f"{'success' if success else 'failure'} (" in said
    assert f"rollout {rollout}, step {step}" in said
    with Image.open(out) as image:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(image)]
        shown_ms = sum(frame.info["duration"] for frame in ImageSequence.Iterator(image))
    # Frames that are equal, as in the pause, are one that is shown for longer.
    assert shown_ms == 1000 // video.FRAMES_A_SECOND * frames_of(collected, objects, rollout, step)
    assert {frame.shape for frame in frames} == {(HEIGHT, WIDTH, 3)}
    assert (frames[0] != frames[-1]).any()
    assert [path.name for path in out.parent.iterdir()] == ["one.gif"]


@pytest.mark.usefixtures("short_and_small")
@pytest.mark.skipif(
    find_spec("av") is None, reason="PyAV (the package av) is not installed: pip install adaafford[video]"
)
def test_an_mp4_of_a_rollout_has_all_frames_of_its_interactions(
    collected: Store, objects: Path, replay: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    import av

    rollout = rows_of(collected)[0][0]
    out = tmp_path / "all.mp4"
    assert replay(collected, "--rollout", rollout, "--video", out)[0] == 0
    with av.open(out) as container:
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == frames_of(collected, objects, rollout, None)
    assert {frame.shape for frame in frames} == {(HEIGHT, WIDTH, 3)}


@pytest.mark.usefixtures("short_and_small")
def test_the_first_interaction_with_a_label_is_shown(
    collected: Store, replay: Callable[..., tuple[int, str, str]], tmp_path: Path
) -> None:
    rows, out = rows_of(collected), tmp_path / "moments.png"
    rollout, step = next((rollout, step) for rollout, step, success in rows if not success)
    code, said, _ = replay(collected, collected.committed()[0].shard_id, "--failure", "--video", out)
    assert code == 0
    assert f"rollout {rollout}, step {step}" in said
    with Image.open(out) as image:
        assert image.width == WIDTH
        assert image.height in (2 * HEIGHT, 3 * HEIGHT)


@pytest.mark.usefixtures("short_and_small")
def test_a_video_that_is_interrupted_leaves_nothing(collected: Store, objects: Path, tmp_path: Path) -> None:
    collection = collected.setting.collection
    rollout = collected.read_rollouts(collected.committed()[0].shard_id)[0]
    target, row = load_ref(objects, rollout.object, collection.collision), rollout.interactions[0]
    clip = video.Clip.of(record(target, collection, rollout, row, 25), rollout, row)

    def interrupt() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        video.write_video([clip], tmp_path / "made/one.gif", interrupt)
    assert not list(tmp_path.iterdir())


def test_a_caption_has_the_stored_outcome_and_says_where_it_was_another(collected: Store, objects: Path) -> None:
    collection = collected.setting.collection
    rollout = collected.read_rollouts(collected.committed()[0].shard_id)[0]
    target, row = load_ref(objects, rollout.object, collection.collision), rollout.interactions[0]
    playback = record(target, collection, rollout, row)
    other = dataclasses.replace(row, outcome=dataclasses.replace(row.outcome, success=not row.outcome.success))
    same, differs = (video.Clip.of(playback, rollout, each) for each in (row, other))
    assert same.lines[1].startswith("success" if row.outcome.success else "failure")
    assert differs.lines[1].startswith("failure" if row.outcome.success else "success")
    assert not any("executed again" in line for line in same.lines)
    assert differs.lines[-1].startswith("executed again: " + ("success" if row.outcome.success else "failure"))


@pytest.mark.parametrize(
    ("flags", "line"),
    [
        (["--video", "film.avi"], "film.avi: no video; its name must end in .mp4, .gif, .png"),
        (["--video", "."], "its name must end in .mp4"),
        (["--rollout", 77, "--video", "a.gif"], "has no interaction of rollout 77; choose another"),
        (["--rollout", 0, "--step", 77, "--video", "a.gif"], "has no interaction of rollout 0, step 77; choose"),
        (["--step", 1, "--video", "a.gif"], "--step 1 needs --rollout"),
        (["--success", "--failure", "--video", "a.gif"], "--success and --failure exclude each other; give one"),
        (["--success"], "--step, --success and --failure choose what is shown; give --video FILE, too"),
        ([], "name the shard whose job is executed again, or a file with --video"),
        (["shard", "--video", "a.gif"], "'shard' names no shard"),
        (["--objects", "missing", "--video", "a.gif"], "missing"),
    ],
)
def test_what_cannot_be_shown_is_refused_in_one_line(
    collected: Store, replay: Callable[..., tuple[int, str, str]], flags: list[object], line: str
) -> None:
    code, _, said = replay(collected, *flags)
    assert code != 0
    assert line in said
    assert said.strip().count("\n") == 0
    assert not Path("a.gif").exists()


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "folder.gif").mkdir()
    with pytest.raises(UsageError, match=r"folder\.gif: is a folder; name a file"):
        video.check_video(tmp_path / "folder.gif")


def test_pictures_are_the_same_again_and_only_the_hand_and_its_part_move(collected: Store, objects: Path) -> None:
    collection = collected.setting.collection
    rollout = collected.read_rollouts(collected.committed()[0].shard_id)[0]
    target = load_ref(objects, rollout.object, collection.collision)
    playback = record(target, collection, rollout, rollout.interactions[0], 5)
    view = fitted(playback, View(playback.seen_from(50.0, 25.0, 1.0), 96, 64, 30.0))
    first, again = (Renderer(playback, view) for _ in range(2))
    start = first.picture(0)
    end = first.picture(len(playback.times) - 1)
    assert (start == again.picture(0)).all()
    assert (end == again.picture(len(playback.times) - 1)).all()
    assert (start == first.picture(0)).all()
    assert 0 < (start != end).any(axis=-1).mean() < 0.8
    # Everything is in the picture: its edge is white but for shadows on the ground.
    edge = np.concatenate([start[0], start[-1], start[:, 0], start[:, -1]])
    assert edge.min() >= 200
    assert np.ptp(edge.astype(int), axis=-1).max() == 0
