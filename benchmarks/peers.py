"""How many trials a core-second does collection make, beside those of other simulators?

    python -m benchmarks.peers --task pull --objects FOLDER --maniskill PYTHON --robosuite PYTHON --mujoco PYTHON

PYTHON is an interpreter of an environment where the package is installed; peers without one are left out. Ours is what
users run: loading, settling, rendering, proposing, simulating and storing; theirs are steps of the simulator alone
(`benchmarks/peer_trials.py`). All run in turns, one thread each, and processor time counts.
"""

import json
import subprocess
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any
from xml.etree.ElementTree import Element, ElementTree, SubElement, parse

import numpy as np
from pydantic import Field

from benchmarks.script import main
from cluster.cli.benchmarks.collecting import collect
from cluster.cli.commands.bench import BenchSettings, planned
from collector.objects.catalogue import load_ref
from collector.objects.exporting import MAIN_FILES, export_object
from collector.sim.gripper import TwoFingers
from collector.sim.grippers import panda_shape
from shared.errors import UsageError, WorkerError
from shared.geometry import quaternion_from_rotation
from shared.io.interpreter import own_environment
from shared.plan import Plan, RolloutRecord
from shared.primitives import hand_start
from shared.store import Store

SCRIPT = Path(__file__).with_name("peer_trials.py")
TRIAL_S = 3.4
"""Simulated time of a trial: one second in, 0.4 to close the fingers, two to pull, as ours at 240 steps a second."""
LIMIT_S = 600.0
STARTS = 20
"""Of MuJoCo's trials: places of the hand, of stored trials with one object."""


class PeerSettings(BenchSettings):
    """Time trials of ours and of other simulators, in turns."""

    task: str = "pull"
    rollouts: int = Field(60, ge=1, le=1_000_000)
    """Of each repeat of ours."""
    trials: int = Field(20, ge=1, le=100_000)
    """Of each repeat of a peer."""
    repeats: int = Field(3, ge=1, le=1000)
    """The medians of these count."""
    maniskill: Path | None = None
    """Interpreter of an environment with ManiSkill 3."""
    robosuite: Path | None = None
    """Likewise with robosuite."""
    mujoco: Path | None = None
    """Likewise with MuJoCo, which simulates one of our objects and our hand."""


def measure(command: PeerSettings) -> dict[str, Any]:
    """Measure, turn by turn, and print a table."""
    peers = {name: getattr(command, name) for name in ("maniskill", "robosuite", "mujoco")}
    found: dict[str, list[dict[str, Any]]] = {"ours": []}
    with planned(command) as (plan, folder), TemporaryDirectory(prefix="adaafford-peers-") as scratch:
        for turn in range(command.repeats):
            store = Store.create(Path(scratch) / f"store-{turn}", plan.setting)
            run = collect(plan, folder, command.rollouts, store, lambda: None)
            steps = sum(row.outcome.steps for rollout in _rollouts(store) for row in rollout.interactions)
            found["ours"].append(
                {
                    "trials_a_core_second": run.interactions / run.cpu_s,
                    "steps_a_core_second": steps / run.cpu_s,
                    "success_rate": run.successes / run.interactions,
                }
            )
            for name, python in peers.items():
                if python is None:
                    continue
                more = [str(_mujoco_scene(plan, folder, store, Path(scratch) / "scene"))] if name == "mujoco" else []
                found.setdefault(name, []).append(_run(python, name, command.trials, more))
    result = {name: _summary(runs) for name, runs in found.items()}
    for one in result.values():
        print(
            f"{one.get('version', 'ours, all of collection'):<36} {one['trials_a_core_second']:8.2f} trials, "
            f"{one['steps_a_core_second']:8.0f} steps a core-second"
        )
    return result


def _run(python: Path, name: str, trials: int, more: list[str]) -> dict[str, Any]:
    done = subprocess.run(
        [python, SCRIPT, name, str(TRIAL_S), str(trials), *more], capture_output=True, text=True, timeout=LIMIT_S,
        env=own_environment() | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    if done.returncode != 0:
        raise WorkerError(f"{name}: {(done.stderr.strip().splitlines() or ['no reason'])[-1][:200]}")
    told: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return told


def _summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    rates = {key: median(run[key] for run in runs) for key in ("trials_a_core_second", "steps_a_core_second")}
    return {key: value for key, value in runs[0].items() if key not in rates and key != "trials"} | rates


def _rollouts(store: Store) -> Iterator[RolloutRecord]:
    for part in store.parts():
        yield from store.rollouts_of(part)


def _mujoco_scene(plan: Plan, folder: Path, store: Store, out: Path) -> Path:
    """An object of the store and our hand as MJCF, with the starts of trials; the JSON that `peer_trials` reads."""
    record = next((one for one in _rollouts(store) if one.interactions), None)
    if record is None:
        raise UsageError(f"{folder}: no object comes to rest in view of the camera; nothing was collected")
    target = load_ref(folder, record.object, plan.setting.collection.collision)
    main_file = export_object(
        target, "mjcf", out / MAIN_FILES["mjcf"].removesuffix(".xml"), record.dynamics["part_mass"]
    )
    tree = parse(main_file)  # noqa: S314 - our own file.
    for joint in tree.iter("joint"):
        joint.set("frictionloss", str(record.dynamics["joint_friction"]))
    for geom in tree.iter("geom"):
        geom.set("friction", str(record.dynamics["surface_friction"]))
    _add_hand(tree, panda_shape())
    model = main_file.with_name("scene.xml")
    tree.write(model)
    starts = [
        {
            "place": hand_start(row.action).tolist(),
            "quaternion": quaternion_from_rotation(row.action.rotation).tolist(),
            "approach": row.action.approach.tolist(),
        }
        for row in islice(record.interactions, STARTS)
    ]
    told = {"model": str(model), "starts": starts, "opened": [panda_shape().finger_open] * 2, "closed": [0.0, 0.0]}
    path = out / "told.json"
    path.write_text(json.dumps(told))
    return path


def _add_hand(tree: "ElementTree[Element]", shape: TwoFingers) -> None:
    """Our hand, pulled by a body that is moved, with two fingers on slides."""
    root = tree.getroot()
    asset, world = root.find("asset"), root.find("worldbody")
    assert asset is not None and world is not None, "an exported object has both"
    SubElement(root, "option", timestep=str(1 / 240))
    SubElement(world, "body", name="target", mocap="true")
    hand = SubElement(world, "body", name="hand", gravcomp="1")
    SubElement(hand, "freejoint", name="hand")
    for number, piece in enumerate(shape.palm):
        _add_mesh(asset, hand, f"palm-{number}", piece.vertices, shape.palm_mass / len(shape.palm))
    actuator = SubElement(root, "actuator")
    for side, turn in (("left", "1 0 0 0"), ("right", "0 0 0 1")):
        finger = SubElement(hand, "body", name=side, pos=f"0 0 {shape.finger_offset}", quat=turn, gravcomp="1")
        SubElement(finger, "joint", name=side, type="slide", axis="0 1 0", range=f"0 {shape.finger_open}", damping="60")
        for number, piece in enumerate(shape.finger):
            _add_mesh(asset, finger, f"{side}-{number}", piece.vertices, shape.finger_mass / len(shape.finger))
        SubElement(actuator, "position", joint=side, kp="200")
    equality = SubElement(root, "equality")
    SubElement(equality, "weld", body1="target", body2="hand")


def _add_mesh(asset: Element, body: Element, name: str, vertices: Any, mass: float) -> None:
    corners = " ".join(f"{value:.6g}" for value in np.asarray(vertices).ravel())
    SubElement(asset, "mesh", name=name, vertex=corners)
    SubElement(body, "geom", type="mesh", mesh=name, mass=str(mass))


if __name__ == "__main__":
    main("peers", PeerSettings, measure)
