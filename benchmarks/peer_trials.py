"""Trials of one hand and one part in other simulators, timed; run by the interpreters that have them.

    python benchmarks/peer_trials.py maniskill|robosuite|mujoco SECONDS TRIALS [SCENE]

It imports nothing of this project. A trial is a reset and SECONDS of simulated time in which the hand is driven. One
JSON object is printed: simulation steps and trials a second of processor time, of one thread. Nothing is rendered, and
no observation but the simulator's own state is computed.
"""

import json
import sys
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np


def maniskill(seconds: float, trials: int) -> dict[str, Any]:
    """ManiSkill 3, PushCube-v1 on its CPU backend: an arm with a hand pushes a cube."""
    import sapien.render
    from sapien.wrapper import actor_builder, articulation_builder

    class Nothing:
        """In place of what the renderer has, since a machine without Vulkan cannot even make a material."""

        def __init__(self, *_: object, **__: object) -> None: ...

        def __getattr__(self, name: str) -> Any:
            return lambda *_, **__: Nothing()

    for name in ("RenderMaterial", "RenderTexture2D"):
        setattr(sapien.render, name, Nothing)
    kinds = [kind for module in (actor_builder, articulation_builder) for kind in vars(module).values()]
    for kind in (kind for kind in kinds if isinstance(kind, type)):
        for name in list(vars(kind)):
            if name.startswith("add_") and "visual" in name:
                setattr(kind, name, lambda self, *_, **__: self)
            elif name == "build_render_component":
                setattr(kind, name, lambda self, *_, **__: None)
    import gymnasium
    import mani_skill
    import mani_skill.envs
    import torch

    torch.set_num_threads(1)
    env = gymnasium.make(
        "PushCube-v1", obs_mode="state", sim_backend="physx_cpu", render_backend="none", control_mode="pd_ee_delta_pose"
    )
    inner: Any = env.unwrapped
    action = np.array([0.5, 0, -0.2, 0, 0, 0, 0.5], dtype=np.float32)
    controls: int = round(seconds * inner.control_freq)

    def trial(number: int) -> int:
        env.reset(seed=number)
        for _ in range(controls):
            inner.step(action)
        return int(controls * inner.sim_freq // inner.control_freq)

    return timed(trial, trials) | {"version": f"ManiSkill {mani_skill.__version__}", "step_s": 1 / inner.sim_freq}


def robosuite(seconds: float, trials: int) -> dict[str, Any]:
    """Robosuite, Door: an arm with a hand before a door, by its default controller."""
    import mujoco
    import robosuite as suite

    env = suite.make(
        "Door", robots="Panda", has_renderer=False, has_offscreen_renderer=False, use_camera_obs=False, control_freq=20,
        horizon=10**6, hard_reset=False,
    )  # fmt: skip
    action = np.zeros(env.action_dim)
    action[0] = 0.5
    controls = round(seconds * 20)
    step_s = float(env.sim.model.opt.timestep)

    def trial(number: int) -> int:
        env.reset()
        for _ in range(controls):
            env.step(action)
        return controls * round(0.05 / step_s)

    version = f"robosuite {suite.__version__}, MuJoCo {mujoco.__version__}"
    return timed(trial, trials) | {"version": version, "step_s": step_s}


def mujoco(seconds: float, trials: int, scene: Path) -> dict[str, Any]:
    """MuJoCo alone: our cabinet and our hand, which is driven as ours is, from the same places.

    Args:
        seconds: simulated, of a trial.
        trials: how many.
        scene: JSON with the model as MJCF, and for each trial the place and rotation of the hand at its start.
    """
    import mujoco as engine

    told = json.loads(scene.read_text())
    model = engine.MjModel.from_xml_path(told["model"])
    data = engine.MjData(model)
    steps: int = round(seconds / model.opt.timestep)
    driven = ("hand", "left", "right")
    parts = [joint for joint in range(model.njnt) if model.joint(joint).name not in driven]
    moved = list[bool]()
    opened, closed = np.array(told["opened"]), np.array(told["closed"])

    def trial(number: int) -> int:
        start = told["starts"][number % len(told["starts"])]
        place, quaternion, approach = (np.array(start[name]) for name in ("place", "quaternion", "approach"))
        engine.mj_resetData(model, data)
        data.mocap_pos[0], data.mocap_quat[0] = place, quaternion
        free = model.jnt_qposadr[engine.mj_name2id(model, engine.mjtObj.mjOBJ_JOINT, "hand")]
        data.qpos[free : free + 7] = [*place, *quaternion]
        for step in range(steps):
            share = step / steps  # A third in, a ninth to close, the rest out, as our pull.
            reach = min(share * 3, 1.0) if share < 4 / 9 else 1.0 - (share - 4 / 9) * 9 / 5
            data.mocap_pos[0] = place + 0.05 * reach * approach
            data.ctrl[:] = opened if share < 1 / 3 else closed
            engine.mj_step(model, data)
        moved.append(bool(data.qpos[model.jnt_qposadr[parts]].max() > 0.01))  # From closed, which is 0.
        return steps

    result = timed(trial, trials) | {"version": f"MuJoCo {engine.__version__}", "step_s": float(model.opt.timestep)}
    return result | {"share_that_moved_a_part": sum(moved) / len(moved)}


def timed(trial: Callable[[int], int], trials: int) -> dict[str, Any]:
    """Processor time of trials, after one that is not counted."""
    trial(0)
    begun, steps = time.process_time(), 0
    for number in range(trials):
        steps += trial(number)
    cpu_s = time.process_time() - begun
    return {"trials": trials, "steps_a_core_second": steps / cpu_s, "trials_a_core_second": trials / cpu_s}


if __name__ == "__main__":
    warnings.filterwarnings("ignore")
    peer, length, count, *rest = sys.argv[1:]
    peers: dict[str, Callable[..., dict[str, Any]]] = {"maniskill": maniskill, "robosuite": robosuite, "mujoco": mujoco}
    print(json.dumps(peers[peer](float(length), int(count), *map(Path, rest))))
