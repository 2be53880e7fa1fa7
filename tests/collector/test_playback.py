"""Playbacks and pictures of trials: the very trial that the collector would run, frame by frame."""

from pathlib import Path

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from collector.viz import film
from collector.viz.playback import RecordedTrial, caption
from shared.config import Fidelity
from shared.errors import UsageError
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, START_DISTANCE
from shared.types import Action, HiddenDynamics
from tests.support.single_door import door, drawer

EASY = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=1.0)
INTO = gripper_rotation(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
FIDELITY = Fidelity()


def scene_of(target: ArticulatedObject) -> Scene:
    scene = Scene(target, EASY, FIDELITY, PRIMITIVES.get("pull"))
    scene.put(np.zeros(1))
    return scene


def test_a_playback_shows_the_hand_come_touch_and_stop() -> None:
    take = RecordedTrial(scene_of(drawer()), Action(0, np.zeros(3), INTO), 1, "push", FIDELITY).record()
    assert take.outcome.success
    assert take.contact is not None
    assert take.joint_positions.shape == (len(take.times), 1)
    assert take.hand_poses.shape == (len(take.times), len(take.hand), 4, 4)
    palms = take.hand_poses[:, 0, :3, 3]
    assert palms[0] == pytest.approx([-START_DISTANCE, 0.0, 0.0], abs=1e-6)
    assert take.joint_positions[take.contact] == pytest.approx([0.0], abs=2e-3)
    assert take.joint_positions[-1] == pytest.approx([take.outcome.end_joint_position])
    # At first contact the fingertips, 0.112 ahead of the hand, are at the face.
    assert palms[take.contact][0] + 0.112 == pytest.approx(0.0, abs=5e-3)
    # The flight to the object, which is not simulated, is shown as well: no frame is far from the next.
    assert take.outcome.steps < len(take.times) - 1
    assert np.abs(np.diff(palms[:, 0])).max() < 2e-3
    assert np.diff(take.times) == pytest.approx(1 / FIDELITY.approach.steps_per_second)


def test_a_playback_is_thinned_to_a_rate_with_contact_and_end() -> None:
    every = RecordedTrial(scene_of(drawer()), Action(0, np.zeros(3), INTO), 1, "push", FIDELITY).record()
    few = every.at_rate(30)
    assert np.diff(few.times) == pytest.approx(1 / 30)
    assert every.times[-1] <= few.times[-1] < every.times[-1] + 1 / 30
    assert (few.hand_poses[-1] == every.hand_poses[-1]).all()
    assert few.contact is not None and every.contact is not None
    assert few.times[few.contact - 1] < every.times[every.contact] <= few.times[few.contact]
    assert few.poses(0).shape == (len(few.scenery().bodies), 4, 4)


@pytest.mark.parametrize("primitive", ["pull", "push"])
def test_recording_changes_nothing(primitive: str) -> None:
    action = Action(0, np.array([-0.32, -0.295, 0.0]), INTO)
    recorded = RecordedTrial(scene_of(door()), action, 1, primitive, FIDELITY).record().outcome
    plain = Trial(scene_of(door()), action, 1, PRIMITIVES.get(primitive), FIDELITY).run()
    assert (recorded.kind, recorded.motion, recorded.steps) == (plain.kind, plain.motion, plain.steps)


def test_a_trial_that_a_contact_ends_is_recorded_to_that_contact() -> None:
    action = Action(0, np.array([-0.2, 0.0, 0.0]), INTO)  # The hand starts within the door.
    take = RecordedTrial(scene_of(door()), action, 1, "push", FIDELITY).record()
    assert (take.contact, len(take.times)) == (1, 2)
    assert caption(take.primitive, take.outcome) == "push: start-collision, failure, m = 0.000"


@pytest.mark.slow
def test_a_film_is_written_with_a_caption_a_primitive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "ENOUGH", 1)
    out = tmp_path / "made/film.png"
    (caption,) = film.film(door(), ["push-left"], 1, out)
    assert caption.startswith("push-left: ok, success, m = ")
    assert out.read_bytes().startswith(b"\x89PNG")
    (caption,) = film.film(door(), ["pull"], 1, out, "suction")
    assert caption.startswith("pull: ok")
    with pytest.raises(UsageError, match="unknown primitive 'Shove!'; allowed: push, push-left"):
        film.film(door(), ["push", "Shove!"], 1, out)
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UsageError, match="cannot be written"):
        film.film(door(), ["push-left"], 1, tmp_path / "file/film.png")
