"""Collect interactions on an object of your own: `python examples/own_object.py OBJECTS STORE`.

The script writes a turnstile, a bar that turns on a post, as URDF and OBJ files into OBJECTS, in the layout that
docs/objects.md describes, and then collects on it. Replace the first part by your own files.
"""

import json
import sys
from pathlib import Path

import adaafford

objects, where = Path(sys.argv[1]), sys.argv[2]


def box(size: tuple[float, float, float]) -> str:
    """A box around the origin as an OBJ file: eight corners, and six sides with the normals outwards."""
    x, y, z = (length / 2 for length in size)
    corners = [(a * x, b * y, c * z) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)]
    sides = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]
    return "".join(f"v {a} {b} {c}\n" for a, b, c in corners) + "".join(f"f {side}\n" for side in sides)


# The front is towards -x, z is up, and all of it fits into a sphere of radius 1. The bar turns about the z axis.
URDF = """<robot name="turnstile">
  <link name="post">
    <visual><geometry><mesh filename="textured_objs/post.obj"/></geometry></visual>
    <collision><geometry><mesh filename="textured_objs/post.obj"/></geometry></collision>
  </link>
  <link name="bar">
    <visual><geometry><mesh filename="textured_objs/bar.obj"/></geometry></visual>
    <collision><geometry><mesh filename="textured_objs/bar.obj"/></geometry></collision>
  </link>
  <joint name="hinge" type="revolute">
    <parent link="post"/><child link="bar"/>
    <origin xyz="0 0 0.36"/><axis xyz="0 0 1"/><limit lower="-1.5" upper="1.5"/>
  </joint>
</robot>
"""
folder = objects / "my-turnstile"
(folder / "textured_objs").mkdir(parents=True, exist_ok=True)
(folder / "textured_objs" / "post.obj").write_text(box((0.3, 0.3, 0.5)))
(folder / "textured_objs" / "bar.obj").write_text(box((0.15, 1.4, 0.2)))
(folder / "mobility.urdf").write_text(URDF)
(folder / "meta.json").write_text(json.dumps({"model_cat": "Switch"}))
# The names of parts decide which tasks apply; `push` takes every part that can move.
(folder / "semantics.txt").write_text("post static post\nbar hinge rotation_bar\n")

# `adaafford objects check OBJECTS --settle` says whether an object can be used, and why not.
store = adaafford.collect(
    where,
    objects=objects,
    task="push",
    rollouts=2,
    workers=0,
    seed=1,
    collection={"rollout": {"interactions": 8}},
)
for row in store.interactions(["object_id", "target_link", "outcome", "motion"]).to_pylist():
    print(f"{row['object_id']}, {row['target_link']}: {row['outcome']}, moved by {row['motion']:.2f} rad")
