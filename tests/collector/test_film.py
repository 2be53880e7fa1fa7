"""Films of trials: the right moments of the very trial that the collector would run."""

from pathlib import Path

import numpy as np
import pytest

from collector.objects.articulation import ArticulatedObject
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from collector.viz import film
from collector.viz.film import FIDELITY, FilmedTrial
from shared.errors import UsageError
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, START_DISTANCE
from shared.types import Action, HiddenDynamics
from tests.support.single_door import door, drawer

EASY = HiddenDynamics(part_mass=0.2, joint_friction=0.05, surface_friction=1.0)
INTO = gripper_rotation(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))


def scene_of(target: ArticulatedObject) -> Scene:
    scene = Scene(target, EASY, FIDELITY, PRIMITIVES.get("pull"))
    scene.put(np.zeros(1))
    return scene


def test_a_film_shows_the_hand_come_touch_and_stop() -> None:
    action = Action(0, np.zeros(3), INTO)
    take = FilmedTrial(scene_of(drawer()), action, 1, "push").take()
    assert take.outcome.success
    assert take.contact is not None
    palms = [pose.hand[0, :3, 3] for pose in (take.start, take.contact, take.end)]
    assert palms[0] == pytest.approx([-START_DISTANCE, 0.0, 0.0], abs=1e-3)
    assert palms[0][0] < palms[1][0] < palms[2][0]
    assert take.contact.joint_positions == pytest.approx([0.0], abs=2e-3)
    assert take.end.joint_positions == pytest.approx([take.outcome.end_joint_position])
    # At first contact the fingertips, 0.112 ahead of the hand, are at the face.
    assert palms[1][0] + 0.112 == pytest.approx(0.0, abs=5e-3)


def test_filming_changes_nothing() -> None:
    action = Action(0, np.array([-0.32, -0.295, 0.0]), INTO)
    filmed = FilmedTrial(scene_of(door()), action, 1, "pull").take().outcome
    plain = Trial(scene_of(door()), action, 1, PRIMITIVES.get("pull"), FIDELITY).run()
    assert (filmed.kind, filmed.motion, filmed.steps) == (plain.kind, plain.motion, plain.steps)


def test_a_trial_that_a_contact_ends_is_filmed_to_that_contact() -> None:
    action = Action(0, np.array([-0.2, 0.0, 0.0]), INTO)  # The hand starts within the door.
    take = FilmedTrial(scene_of(door()), action, 1, "push").take()
    assert take.contact is take.start
    assert take.caption == "push: start-collision, failure, m = 0.000"


def test_a_film_is_written_with_a_caption_a_primitive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(film, "ENOUGH", 1)
    out = tmp_path / "made/film.png"
    (caption,) = film.film(door(), ["push-left"], 1, out)
    assert caption.startswith("push-left: ok, success, m = ")
    assert out.read_bytes().startswith(b"\x89PNG")
    with pytest.raises(UsageError, match="unknown primitive 'Shove!'; allowed: push, push-left"):
        film.film(door(), ["push", "Shove!"], 1, out)
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(UsageError, match="cannot be written"):
        film.film(door(), ["push-left"], 1, tmp_path / "file/film.png")
