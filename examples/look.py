"""Look at a store: tables, a cloud, a picture: `python examples/look.py STORE PICTURE.png`.

STORE is what `examples/collect.py` or `adaafford collect` left. docs/reading.md has all that can be asked.
"""

import sys

import matplotlib.pyplot as plt
import pyarrow.compute as pc

import adaafford

where, picture = sys.argv[1:]
store = adaafford.open_store(where)
print(f"task {store.setting.task}, {len(store.setting.objects)} objects")

# Tables are Arrow tables: `rollouts` and `interactions`. Only the columns that are named here are read.
rollouts = store.rollouts(["object_id", "joint_friction", "status"])
print(f"{len(rollouts)} rollouts, joint friction {pc.min_max(rollouts['joint_friction']).as_py()}")
rows = store.interactions(["object_id", "outcome", "motion", "success"])
for found in rows.group_by("object_id").aggregate([("success", "count"), ("motion", "max")]).to_pylist():
    print(f"  {found['object_id']}: {found['success_count']} interactions, largest motion {found['motion_max']:.2f}")

# Conditions choose rows while the store is read, so that a large store does not have to fit into memory.
moved = store.interactions(["point", "rotation", "motion"], where=[("outcome", "=", "ok"), ("motion", ">", 0.0)])
print(f"{len(moved)} of {len(rows)} interactions moved something")

# Each row has the partial cloud that its action was decided on; here of the one that moved its part the farthest.
best = moved.sort_by([("motion", "descending")]).slice(0, 1)
cloud = next(store.observations(best))
print(f"a cloud of {len(cloud.points)} points, {cloud.movable.sum()} of them movable")

# The picture: the points in the world frame (metres of the scaled object, z up), p as a star, and the approach as a
# line. The columns of R are the hand's forward, left and approach.
p, approach = best["point"][0].as_py(), best["rotation"][0].as_py()[2::3]
axes = plt.figure(figsize=(6, 6)).add_subplot(projection="3d")
axes.scatter(*cloud.points.T, s=2, c=cloud.movable, cmap="coolwarm")
axes.plot(*zip(p, [a - 0.3 * b for a, b in zip(p, approach, strict=True)], strict=True), c="black")
axes.scatter(*p, marker="*", s=150, c="gold", edgecolors="black")
axes.set_title(f"moved by {best['motion'][0].as_py():.2f}")
axes.set_aspect("equal")
plt.savefig(picture, dpi=100)
