"""Reads exported objects by other programs, and prints what they find as JSON: a line for each file named.

Runs in an environment of its own, which has these programs and nothing of this project.
"""

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np


def by_mujoco(file: str) -> dict[str, Any]:
    """Joints of an MJCF file, with what hangs on them, in the world's frame."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(file)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = {}
    for j in range(model.njnt):
        body = model.jnt_bodyid[j]
        hulls = []
        for g in range(model.ngeom):
            if model.geom_bodyid[g] == body and model.geom_contype[g]:
                mesh = model.geom_dataid[g]
                start = model.mesh_vertadr[mesh]
                vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
                hulls.append(vertices @ data.geom_xmat[g].reshape(3, 3).T + data.geom_xpos[g])
        slides = model.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE
        found[model.joint(j).name] = {
            "kind": "prismatic" if slides else "revolute",
            "limits": model.jnt_range[j].tolist(),
            "axis": (data.xmat[body].reshape(3, 3) @ model.jnt_axis[j]).tolist(),
            "anchor": (data.xpos[body] + data.xmat[body].reshape(3, 3) @ model.jnt_pos[j]).tolist(),
            "mass": float(model.body_mass[body]),
            "hulls": [hull.tolist() for hull in hulls],
        }
    return {"joints": found}


def by_yourdfpy(file: str) -> dict[str, Any]:
    """The same of a URDF file."""
    import yourdfpy

    robot = yourdfpy.URDF.load(file, load_collision_meshes=True, build_collision_scene_graph=True)
    if not robot.validate():
        raise SystemExit(f"{file}: not valid: {robot.errors}")
    robot.update_cfg(np.zeros(robot.num_dofs))
    found = {}
    for joint in robot.robot.joints:
        if joint.type == "fixed":
            continue
        link = robot.link_map[joint.child]
        pose = robot.get_transform(joint.child)
        hulls = []
        for shape in link.collisions:
            mesh = Path(file).parent / shape.geometry.mesh.filename
            lines = [line.split()[1:] for line in mesh.read_text().splitlines() if line.startswith("v ")]
            placed = pose @ (np.eye(4) if shape.origin is None else shape.origin)
            hulls.append(np.array(lines, dtype=float) @ placed[:3, :3].T + placed[:3, 3])
        found[joint.name] = {
            "kind": joint.type,
            "limits": [joint.limit.lower, joint.limit.upper],
            "axis": (pose[:3, :3] @ joint.axis).tolist(),
            "anchor": pose[:3, 3].tolist(),
            "mass": link.inertial.mass,
            "hulls": [hull.tolist() for hull in hulls],
        }
    return {"joints": found}


if __name__ == "__main__":
    for each in sys.argv[1:]:
        print(json.dumps(by_yourdfpy(each) if each.endswith(".urdf") else by_mujoco(each)))
