"""Adapt to a scanned object: `python examples/adapt.py SCAN [HEATMAP]`.

SCAN is a cloud (.ply, .pcd or .npz) of one object in metres, z up, as the camera of a robot gives it; docs/robot.md has
the details. HEATMAP (.ply, .npz or .html) is written. `adaafford adapt` does the same as a command.
"""

import sys
from pathlib import Path

import numpy as np

from adaafford import (
    Adapter,
    Interaction,
    Outcome,
    OutcomeKind,
    ScanFrame,
    SpreadAipProposer,
    load_policy,
    observation_of,
    read_scan,
    write_heatmap,
)

scan = read_scan(Path(sys.argv[1]))
heatmap = Path(sys.argv[2]) if len(sys.argv) > 2 else Path("heatmap.ply")

# A policy that comes with the package; a folder of your own, or a run, is named in the same way.
adapter = Adapter(load_policy("push-faucet"))
frame = ScanFrame.around(scan)  # Ties the frame of the scans to the frame of the networks.
observation = observation_of(scan, frame)  # O: 2,048 points of the scan, and their normals.

# AIP proposes the interaction u = (p, R) from which the most is learnt, far from the earlier ones.
proposer = SpreadAipProposer(adapter, np.random.default_rng(1), budget=4)
history: list[Interaction] = []
action = proposer.propose(observation, history)
assert action is not None, "the first interaction is always proposed"
print(f"push at {frame.point_to_scan(action.point)} along {frame.direction_to_scan(action.approach)}")

# Both are in the frame of the scan. Here your robot executes the action and measures the motion m of the part, in rad
# or metres; we assume that nothing moved. Then a new scan is taken, and the next interaction is proposed, until AIP
# stops.
outcome = Outcome(OutcomeKind.OK, motion=0.0, success=False)
history.append(Interaction(observation, action, outcome))

# AAP: the affordance posterior A_I, for each point, after the interactions I.
before, after = adapter.affordance(observation, []), adapter.affordance(observation, history)
print(f"affordance at p: {before[action.point_index]:.2f} before, {after[action.point_index]:.2f} after")
write_heatmap(heatmap, frame.point_to_scan(observation.points.astype(float)), after, observation.pixels)
print(f"{heatmap}: the adapted affordance of {len(after)} points")
