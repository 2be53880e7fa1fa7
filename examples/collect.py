"""Collect interactions on your own objects, and open the rows: `python examples/collect.py OBJECTS STORE`.

OBJECTS is a folder in PartNet-Mobility's layout, STORE a new folder. The same command again goes on where it stopped.
"""

import sys

import pyarrow.compute as pc

import adaafford

objects, where = sys.argv[1:]

# A rollout is one object with one draw of hidden dynamics (mass, friction, direction) and several interactions.
# With `workers=0` everything happens in this process; otherwise so many Ray workers share the work on this machine.
store = adaafford.collect(
    where,
    objects=objects,
    task="push-faucet",
    rollouts=8,
    workers=0,
    seed=1,
    collection={"rollout": {"interactions": 8}},
)

# One row an interaction, as an Arrow table: the action u = (p, R), the motion m, the success r, and all that a replay
# needs. A failed interaction is a row like any other.
rows = store.interactions()
print(f"{rows.num_rows} interactions with {rows.num_columns} columns: {', '.join(rows.column_names)}")
print(f"success rate: {pc.mean(pc.cast(rows['success'], 'float64')).as_py():.2f}")
for found in rows.group_by("outcome").aggregate([("success", "count")]).to_pylist():
    print(f"  {found['outcome']}: {found['success_count']}")

# One row a rollout: the object, its hidden dynamics, which no network sees, and the camera.
rollouts = store.rollouts()
print(f"{rollouts.num_rows} rollouts: {', '.join(rollouts.column_names)}")

# The cloud O of each row; `examples/look.py` shows more of a store.
last = rows.slice(rows.num_rows - 1)
point, index, cloud = last["point"][0].as_py(), last["point_index"][0].as_py(), store.clouds(last).points[0]
print(f"p = {point} is point {index} of a cloud {cloud.shape}")
