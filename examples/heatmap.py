"""Draw the affordance of an object before and after one interaction: `python examples/heatmap.py OBJECTS PICTURE.png`.

OBJECTS is a folder in PartNet-Mobility's layout. The picture shows the cloud as the camera sees it; the star is the
point p of the interaction that AIP chose.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from adaafford import Adapter, AipProposer, Interaction, load_policy, simulated, write_heatmap

objects, picture = sys.argv[1], Path(sys.argv[2])

# The first object that the task applies to, at rest, with hidden dynamics that are drawn for it.
environment = next(simulated(objects, "push-faucet", seed=3))
adapter = Adapter(load_policy("push-faucet"))

observation = environment.observe()
action = AipProposer(adapter, np.random.default_rng(1), budget=1).propose(observation, [])
assert action is not None, "the first interaction is always proposed"
outcome = environment.execute(action)

# A is the prior belief of AAP with no interaction, A_I its posterior after one; [N], in [0, 1].
before = adapter.affordance(observation, [])
after = adapter.affordance(observation, [Interaction(observation, action, outcome)])

# Camera frame: x forward, y left, z up.
camera_from_world = np.linalg.inv(observation.world_from_camera)
seen = observation.points @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
figure, axes = plt.subplots(1, 2, figsize=(9, 4.5), layout="constrained")
titles = "before any interaction", f"after one: {'success' if outcome.success else 'failure'}, m = {outcome.motion:.2f}"
most = max(before.max(), after.max())
for panel, scores, title in zip(axes, (before, after), titles, strict=True):
    shown = panel.scatter(-seen[:, 1], seen[:, 2], c=scores, s=8, cmap="viridis", vmin=0, vmax=most)
    panel.set(title=title, aspect="equal")
    panel.set_axis_off()
point = camera_from_world[:3, :3] @ action.point + camera_from_world[:3, 3]
axes[1].plot(-point[1], point[2], "r*", markersize=14)
figure.colorbar(shown, ax=axes, label="affordance")
figure.savefig(picture, dpi=110)

# The same as a cloud that viewers such as MeshLab open.
write_heatmap(picture.with_suffix(".ply"), observation.points.astype(float), after, observation.pixels)
