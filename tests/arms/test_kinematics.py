"""Kinematics of arms: held to another implementation, in both directions, and safe against files from outside."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from shared.arms.arm import ARMS, Arm, ArmJoint, Capsule, arm_of
from shared.arms.kinematics import MAX_JOINT_STEP, ArmReach, Chain, chain_of, waypoints
from shared.errors import UsageError
from shared.geometry import gripper_rotation
from shared.primitives import PRIMITIVES, Leg, PrimitiveSpec
from shared.types import Action, Float
from tests.support.arms import urdf_of

CAMERA = (
    '<link name="camera"/><joint name="c" type="fixed"><parent link="link1"/><child link="camera"/></joint></robot>'
)
FAR = np.full((1, 3), 9.0)
"""An object that is nowhere near."""
BENT = Arm(
    joints=(
        ArmJoint(name="rail", kind="prismatic", xyz=(0.1, 0, 0.3), axis=(0, 1, 0), lower=-0.4, upper=0.5),
        ArmJoint(name="a", rpy=(0.3, -0.2, 1.0), axis=(1, 2, 0.5), lower=-3, upper=3),
        ArmJoint(name="b", xyz=(0.3, 0.1, 0), rpy=(-1.5, 0.4, 0), axis=(0, -1, 0), lower=-2, upper=2),
        ArmJoint(name="c", xyz=(0, 0.2, 0.2), axis=(1, 0, 0), lower=-2.5, upper=2.5),
        ArmJoint(name="d", xyz=(0, 0, 0.2), axis=(0, 0, -1), lower=-3, upper=3),
        ArmJoint(name="e", xyz=(0, 0, 0.1), rpy=(1.2, 0, 0), axis=(0, 1, 0), lower=-2, upper=2),
        ArmJoint(name="f", xyz=(0, 0.05, 0.1), axis=(0, 0, 1), lower=-3, upper=3),
    ),
    hand_xyz=(0.01, 0.02, 0.1),
    hand_rpy=(0.5, 0.1, -0.7),
    capsules=(Capsule(link=1, start=(0, 0, 0), end=(0, 0, 0), radius=0.05),),
)
"""Axes in all directions, and a slide."""
ARMS_TO_TRY = {**{name: ARMS.get(name) for name in ARMS.names()}, "bent": BENT}


def positions(chain: Chain, count: int, seed: int = 1) -> Float:
    rng = np.random.default_rng(seed)
    return rng.uniform(np.maximum(chain.lower, -3.1), np.minimum(chain.upper, 3.1), (count, len(chain.lower)))


def agree(hands: Float, wanted: Float, metres: float, degrees: float) -> bool:
    away = np.linalg.norm(hands[:, :3, 3] - wanted[:, :3, 3], axis=1)
    chord = np.linalg.norm(hands[:, :3, :3] - wanted[:, :3, :3], axis=(1, 2))
    turned = np.rad2deg(2 * np.arcsin(np.clip(chord / np.sqrt(8), 0, 1)))
    return bool(away.max() < metres and turned.max() < degrees)


@pytest.mark.parametrize("name", ARMS_TO_TRY)
def test_forward_kinematics_are_those_of_another_library(name: str) -> None:
    arm = ARMS_TO_TRY[name]
    chain = chain_of(arm)
    model = mujoco.MjModel.from_xml_string(urdf_of(arm))
    data, hand = mujoco.MjData(model), model.body("hand").id
    at = positions(chain, 50)
    wanted = np.tile(np.eye(4), (50, 1, 1))
    for k, one in enumerate(at):
        data.qpos[:] = one
        mujoco.mj_kinematics(model, data)
        wanted[k, :3, 3], wanted[k, :3, :3] = data.xpos[hand], data.xmat[hand].reshape(3, 3)
    assert np.allclose(chain.hands(at), wanted, atol=1e-9)
    assert all(np.linalg.norm(pose[:3, 3] - chain.first) <= chain.length for pose in wanted)


@pytest.mark.parametrize("name", ARMS_TO_TRY)
def test_inverse_kinematics_find_what_forward_kinematics_give(name: str) -> None:
    chain = chain_of(ARMS_TO_TRY[name])
    hands = chain.hands(positions(chain, 100, seed=2))
    for hand in hands:
        paths = (chain.follow(hand[None], seed) for seed in chain.seeds(hand))
        path = next((path for path in paths if path is not None), None)
        assert path is not None
        assert agree(chain.hands(path), hand[None], 1e-3, 0.5)
        assert (path >= chain.lower).all() and (path <= chain.upper).all()


@pytest.mark.parametrize("name", ARMS_TO_TRY)
def test_a_urdf_gives_the_same_arm(name: str, tmp_path: Path) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(urdf_of(ARMS_TO_TRY[name]))
    chain, read = chain_of(ARMS_TO_TRY[name]), Chain(arm_of(str(file)))
    at = positions(chain, 20)
    assert np.allclose(chain.hands(at), read.hands(at), atol=1e-9)
    assert np.allclose([chain.lower, chain.upper], [read.lower, read.upper])
    assert arm_of(f"{file}#hand") == read.arm
    assert len(arm_of(f"{file}#link3").joints) == 3


@pytest.mark.parametrize("primitive", ["push", "push-left", "pull", "pull-up", "turning"])
@pytest.mark.parametrize("name", ["panda", "ur5e"])
def test_each_waypoint_of_a_trajectory_is_that_of_the_primitive(name: str, primitive: str) -> None:
    turning = PrimitiveSpec(Leg((0, 0, -0.1)), Leg((0, 0, -0.1), turn_rad=1.0))
    spec = turning if primitive == "turning" else PRIMITIVES.get(primitive)
    chain = chain_of(ARMS.get(name))
    reach = ArmReach(ARMS.get(name), (0.3, -0.2, 0.1, 2.0), spec, FAR)
    legs, rng = waypoints(spec), np.random.default_rng(3)
    assert np.allclose(legs[-1, :3, 3], (spec.then or spec.approach).end)
    found = []
    for _ in range(60):
        point = np.array([0.3, -0.2, 0.1]) + rng.uniform([-0.6, -0.6, 0.1], [0.6, 0.6, 0.8])
        action = Action(0, point, gripper_rotation(_unit(rng), _unit(rng)))
        path = reach.trajectory(action)
        if path is None:
            continue
        found.append(path)
        assert agree(chain.hands(path), reach.hands(action), 1e-3, 0.5)
        assert (path >= chain.lower).all() and (path <= chain.upper).all()
        assert np.abs(np.diff(path, axis=0)).max() <= MAX_JOINT_STEP
    assert len(found) > 5


def _unit(rng: np.random.Generator) -> Float:
    vector = rng.normal(size=3)
    return np.asarray(vector / np.linalg.norm(vector))


def test_links_stay_clear_of_object_and_floor() -> None:
    push = PRIMITIVES.get("push")
    action = Action(0, np.array([0.65, 0.0, 0.5]), gripper_rotation(np.array([1.0, 0, 0]), np.array([0, 0, 1.0])))
    chain = chain_of(ARMS.get("panda"))
    path = ArmReach(ARMS.get("panda"), (0, 0, 0, 0), push, FAR).trajectory(action)
    assert path is not None
    # Something stands where the arm would be; it goes another way or does not go at all.
    for link in (3, 5):
        inside = chain.spheres(path)[-1, chain.links == link][0]
        other = ArmReach(ARMS.get("panda"), (0, 0, 0, 0), push, inside[None]).trajectory(action)
        assert other is None or np.abs(other - path).max() > 0.01
        if other is not None:
            assert (np.linalg.norm(chain.spheres(other) - inside, axis=-1) >= chain.radii).all()
    around = np.array(
        [[0.3 * np.cos(a), 0.3 * np.sin(a), z] for a in np.linspace(0, 6, 60) for z in np.arange(0, 2, 0.1)]
    )
    assert ArmReach(ARMS.get("panda"), (0, 0, 0, 0), push, around).trajectory(action) is None
    low = Action(0, np.array([0.5, 0.0, 0.03]), action.rotation)
    path = ArmReach(ARMS.get("panda"), (0, 0, 0, 0), push, FAR).trajectory(low)
    assert path is None or (chain.spheres(path)[..., 2] - chain.radii)[:, chain.links > 0].min() >= 0
    below = np.array([[9.0, 9.0, -1.0]])  # The floor is as low as the object.
    deep = Action(0, np.array([0.5, 0.0, -0.2]), gripper_rotation(np.array([0, 0, -1.0]), np.array([1.0, 0, 0])))
    assert ArmReach(ARMS.get("panda"), (0, 0, 0, 0), push, below).trajectory(deep) is not None


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda text: "<!DOCTYPE x [<!ENTITY e SYSTEM 'file:///etc/passwd'>]>" + text, "document types"),
        (lambda text: text.replace("revolute", "floating"), "floating"),
        (lambda text: text[:300], "malformed"),
        (lambda text: text + " " * (3 << 20), "larger than"),
        (lambda text: text.replace('type="revolute"', 'type="fixed"'), "no joint moves"),
        (lambda text: text.replace("</robot>", CAMERA), "#LINK"),
        (lambda text: text.replace("<axis", '<mimic joint="panda_joint1"/><axis'), "mimic"),
    ],
)  # fmt: skip
def test_a_file_that_cannot_be_used_is_refused_in_one_line(change, said: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    file = tmp_path / "arm.urdf"
    file.write_text(change(urdf_of(ARMS.get("panda"))))
    with pytest.raises(UsageError, match=said) as refused:
        arm_of(str(file))
    assert str(file) in str(refused.value) and "\n" not in str(refused.value)


def test_without_its_extra_only_built_in_arms_are_known(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(urdf_of(BENT))
    monkeypatch.setattr("shared.extras.find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"a URDF needs defusedxml.*pip install 'adaafford\[arm\]'"):
        arm_of(str(file))
    assert arm_of("panda") == ARMS.get("panda")


def test_an_unknown_arm_is_refused_with_the_known_ones(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="allowed: panda, ur5e"):
        arm_of("pumas")
    with pytest.raises(UsageError, match=r"cannot be read.*panda"):
        arm_of(str(tmp_path / "none.urdf"))
