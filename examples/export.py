"""Take data and a policy elsewhere: `python examples/export.py STORE TRAINED OUT`.

STORE is what `examples/collect.py` left, TRAINED the folder of a trained stage, such as the `aip` of
`examples/retrain.py`. Everything in OUT can be read without this package.
"""

import subprocess
import sys
from pathlib import Path

import pyarrow.parquet as pq
import zarr
from safetensors.numpy import load_file

store, trained, out = sys.argv[1], sys.argv[2], Path(sys.argv[3])
adaafford = [sys.executable, "-m", "adaafford.console"]

# The store as Parquet, Zarr and a data card. `--test-share` splits by object, so that none is in both splits.
subprocess.run([*adaafford, "store", "export", store, "--out", out / "data"], check=True)
rows = pq.read_table(out / "data" / "train" / "interactions.parquet")
clouds = zarr.open_group(out / "data" / "train" / "observations.zarr", mode="r")["points"]
count, points = clouds.shape[:2]
print(f"{len(rows)} interactions; the column `observation` counts the {count} clouds of {points} points")

# The policy in half precision, with its model card; `adaafford.load_policy` and `adaafford adapt` take the folder.
subprocess.run([*adaafford, "export-policy", trained, "--store", store, "--out", out / "policy"], check=True)
weights = load_file(out / "policy" / "weights.safetensors")
print(f"{sum(array.size for array in weights.values()):,} weights in {len(weights)} arrays")
