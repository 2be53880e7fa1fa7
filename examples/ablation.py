"""Train AAP with and without one thing, and compare: `python examples/ablation.py STORE OUT`.

The ablation leaves out the augmentation, which is not in the paper. Everything else stays the same: the prior, the
seed, x
"""

import json
import sys
from pathlib import Path

import adaafford

store, out = sys.argv[1], Path(sys.argv[2])
AFFORDANCE = {"steps": 1, "questions": 64, "proposals": 10}
PRIOR = {"steps": 2, "batch_clouds": 2, "proposals": 10, "affordance": AFFORDANCE}
AAP = {"steps": 2, "oracle_steps": 1, "batch_rollouts": 2, "oracle_batch_rollouts": 2, "affordance": AFFORDANCE}
VARIANTS = {
    "with augmentation": {},
    "without augmentation": {"augmentation": {"mirror": False, "turn_deg": 0.0}},
}

# Both start from one prior.
adaafford.train("prior", store, out / "prior", prior=PRIOR)
for name, change in VARIANTS.items():
    folder = out / name.replace(" ", "-")
    # `adaafford train aap --help` lists the settings, and `adaafford curve` compares such runs with intervals.
    adaafford.train("aap", store, folder, out / "prior", aap=AAP | change, seed=1)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    best = min(line["score"] for line in lines if line["stage"] == "aap")
    print(f"{name}: best validation loss {best:.3f}")
