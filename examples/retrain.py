"""Train the prior, AAP and AIP from a store alone: `python examples/retrain.py STORE OUT`.

STORE is what `examples/collect.py` or `adaafford collect` left. Neither a simulator nor a cluster is needed. The same
command again goes on where it was stopped.
"""

import sys
from pathlib import Path

import adaafford

store, out = sys.argv[1], Path(sys.argv[2])

# Each stage starts from the weights of the one before. The settings are those of `adaafford train STAGE --help`. The
# few steps here only check that the script works; leave these settings out to train a policy.
adaafford.train("prior", store, out / "prior", prior={"steps": 4, "affordance": {"steps": 2}})

# AAP: an oracle critic, which sees the hidden facts, is trained first and teaches AAP. With `"training": "paper"` AAP
# is trained end to end, as in the paper.
short = {"steps": 4, "oracle_steps": 4, "batch_rollouts": 4, "oracle_batch_rollouts": 4, "affordance": {"steps": 2}}
adaafford.train("aap", store, out / "aap", out / "prior", aap=short)

# AIP learns how much an interaction lowers AAP's loss on the other interactions of the rollout.
short = {"steps": 4, "batch_rollouts": 4, "affordance": {"steps": 2}}
policy = adaafford.train("aip", store, out / "aip", out / "aap", aip=short)

# The folder of the last stage is a policy; `metrics.jsonl` in each folder has the validation losses.
print(f"a policy for '{policy.task}' with {', '.join(sorted(policy.trained))} is in {out / 'aip'}")
