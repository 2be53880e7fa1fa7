"""A process that tries hostile objects one after another, so that a crash or a hang costs its batch alone.

    python -m tests.support.hostile_batch SCRATCH SEED START STOP OBJECTS...

For each mutant it prints a line when it begins, and one when it ends: "refused", "survived", or what went wrong.
"""

import shutil
import sys
import time
import traceback
from pathlib import Path

import numpy as np

from collector.objects.readers import read_object
from collector.sim.camera import EmbreeCamera
from collector.sim.scene import Scene
from shared.config import FIDELITIES, CameraConfig
from shared.errors import ObjectError
from shared.geometry import camera_pose
from shared.primitives import PRIMITIVES
from shared.types import HiddenDynamics
from tests.support.mutations import mutate

DYNAMICS = HiddenDynamics(part_mass=0.05, joint_friction=0.05, surface_friction=1.0)
CAMERA = CameraConfig(image_size=64)
STEPS = 20
LONGEST_MESSAGE = 500


def main() -> None:
    """Try the mutants that the command line names."""
    scratch, seed, start, stop, *objects = sys.argv[1:]
    for number in range(int(start), int(stop)):
        rng = np.random.default_rng([int(seed), number])
        original = Path(objects[int(rng.integers(len(objects)))])
        folder = Path(scratch) / original.name
        shutil.copytree(original, folder)
        print(f"begin {number} {mutate(folder, rng)} of {original.name}", flush=True)
        begun = time.perf_counter()
        result = verdict(folder)
        print(f"end {number} {time.perf_counter() - begun:.2f} {result}", flush=True)
        shutil.rmtree(folder)


def verdict(folder: Path) -> str:
    """What came of one object: "refused: ...", "survived", or "failed: ..."."""
    try:
        described = read_object(folder)
    except ObjectError as error:
        message = str(error)
        sound = "\n" not in message and message.isprintable() and len(message) <= LONGEST_MESSAGE
        return f"refused: {message}" if sound else f"failed: {message[:600]!r} is no line for a user"
    except Exception as error:  # noqa: BLE001 - whatever else is raised is what we look for.
        return f"failed: {type(error).__name__} at {traceback.extract_tb(error.__traceback__)[-1]}: {error}"
    try:
        scene = Scene(described, DYNAMICS, FIDELITIES["fast"], PRIMITIVES.get("push"))
        limits = described.limits()
        for share in (0.0, 0.5):
            scene.put(limits[:, 0] + share * (limits[:, 1] - limits[:, 0]))
            for _ in range(STEPS):
                scene.system.step()
            if not np.isfinite(scene.coordinates()).all():
                return "failed: a joint's position is not finite"
        contact = scene.contact()
        if contact.palm or contact.finger_on:
            return "failed: touches the parked hand"
        positions = scene.joint_positions()
        camera = EmbreeCamera(described, camera_pose(200.0, 30.0, CAMERA.distance), CAMERA)
        image = camera.capture(positions)
        if not all(np.isfinite(values).all() for values in (image.depths, image.points, image.normals)):
            return "failed: the image is not finite"
    except Exception as error:  # noqa: BLE001
        return f"failed: {type(error).__name__} at {traceback.extract_tb(error.__traceback__)[-1]}: {error}"
    return "survived"


if __name__ == "__main__":
    main()
