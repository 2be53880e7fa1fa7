"""What examples/plugin adds: a twist that turns knobs and a wide hand, known to every command once it is installed."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cluster.cli.main import run
from collector.objects.articulation import ArticulatedObject, Body, Joint
from collector.sim.scene import Scene
from collector.sim.trial import Trial
from shared.config import FIDELITIES
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, PrimitiveSpec
from shared.store import Store, verify
from shared.types import Action, HiddenDynamics, Outcome
from tests.support.example_package import PACKAGE, install, install_here
from tests.support.single_door import base_with, box, drawer

ROOT = Path(__file__).parents[2]
EASY = HiddenDynamics(part_mass=0.1, joint_friction=0.05, surface_friction=2.0)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The package installed in this process, for one test."""
    install_here(tmp_path, monkeypatch)


def knob(half_width: float) -> ArticulatedObject:
    """A bar on the plane x = 0 that sticks out along -x, and turns about x."""
    bar = box((-0.05, -half_width, -0.03), (-0.002, half_width, 0.03))
    joint = Joint("shaft", "revolute", 0, np.eye(4), np.array([1.0, 0.0, 0.0]), -3.0, 3.0)
    return base_with(box((0.0, -0.2, -0.2), (0.1, 0.2, 0.2)), Body("bar", "switch", joint, (bar,), (bar,)))


def act(primitive: PrimitiveSpec, target: ArticulatedObject, x: float, gripper: str, fidelity: str = "fast") -> Outcome:
    """What comes of acting on the middle of an object's face at `x`, along +x."""
    scene = Scene(target, EASY, FIDELITIES[fidelity], primitive, gripper)
    scene.put(np.zeros(1))
    action = Action(0, np.array([x, 0.0, 0.0]), gripper_rotation(np.array([1.0, 0, 0]), np.array([0.0, 0, 1.0])))
    return Trial(scene, action, 1, primitive, FIDELITIES[fidelity]).run()


@pytest.mark.usefixtures("installed")
def test_a_twist_turns_a_knob_about_the_approach_and_nothing_else_does() -> None:
    twist = PRIMITIVES.get("twist")
    turned = act(twist, knob(0.02), -0.05, "panda")
    assert turned.success
    assert turned.end_joint_position == pytest.approx(1.0, abs=0.1)
    assert turned.grasp_opening == pytest.approx(0.04, abs=5e-3)
    assert act(twist, knob(0.02), -0.05, "panda", "reference").end_joint_position == pytest.approx(1.0, abs=0.1)
    for name in ("push", "pull"):
        assert abs(act(PRIMITIVES.get(name), knob(0.02), -0.05, "panda").end_joint_position) < 0.01


@pytest.mark.usefixtures("installed")
def test_the_wide_hand_takes_what_the_panda_cannot_span_and_pushes_alike() -> None:
    twist = PRIMITIVES.get("twist")
    held = act(twist, knob(0.055), -0.05, "wide")
    assert held.end_joint_position == pytest.approx(1.0, abs=0.1)
    assert held.grasp_opening == pytest.approx(0.11, abs=5e-3)
    assert act(twist, knob(0.055), -0.05, "panda").grasp_opening < 0.081
    pushed = [act(PRIMITIVES.get("push"), drawer(), 0.0, gripper).motion for gripper in ("panda", "wide")]
    assert pushed[1] == pytest.approx(pushed[0], abs=2e-3)


@pytest.mark.slow
def test_an_installed_package_is_collected_with_and_named_in_the_setting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    venv, store = tmp_path / "venv", tmp_path / "store"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", venv], check=True)
    (library,) = venv.glob("lib/python*/site-packages")
    ours = [str(ROOT), *(path for path in sys.path if path.endswith("-packages"))]
    (library / "ours.pth").write_text("\n".join(ours))
    install(library)
    (tmp_path / "small.toml").write_text(
        "[collection]\nprimitive = 'twist'\ngripper = 'wide'\n"
        "[collection.camera]\nimage_size = 64\npoints = 64\ncandidates = 64\n"
        "[collection.rollout]\ninteractions = 4\n"
    )
    command = ["collect", "--store", str(store), "--task", "push", "--workers", "0", "--rollouts", "2"]
    command += ["--procedural-per-category", "1", "--config", str(tmp_path / "small.toml")]
    main = "from adaafford.console import main; main()"
    subprocess.run([venv / "bin/python", "-c", main, *command], check=True, cwd=tmp_path)
    collected = Store.open(store)
    assert collected.setting.extensions == (f"primitive twist: {PACKAGE}", f"gripper wide: {PACKAGE}")
    assert set(collected.interactions(["primitive"]).column("primitive").to_pylist()) == {"twist"}
    # Here the package is not installed: what it made can be read, and nothing can be added.
    assert verify(collected) == []
    assert run(command) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "unknown primitive 'twist'; allowed: push, push-left, push-up, pull, pull-left, pull-up" in said
