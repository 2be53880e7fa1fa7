"""A policy that a campaign goes on from, instead of training one from nothing: fine-tuning on other objects.

training/adopted/ of such a run is what the stages prior, aap-1 and aip-1 leave in others: a policy, the oracle that
taught it, where there was one, and done.json, which says what objects it has seen.
"""

import json
from pathlib import Path

from adaafford.pretrained import load_policy
from cluster.run_folder import RunFolder
from learner.recipes import ORACLE_FILE
from learner.stages import DONE_FILE, objects_seen
from shared.errors import UsageError
from shared.files import read_bounded, write_atomically
from shared.policy import MAX_WEIGHTS_BYTES, Policy


def adopt(source: str, task: str, out: Path) -> None:
    """Copy a policy for `task` into the folder of a stage.

    Raises:
        UsageError: there is none, it is of another task, or one of its networks is not trained.
        StoreError: its files are damaged or foreign.
    """
    policy = fit_to_start_from(source, task)
    out.mkdir(parents=True, exist_ok=True)
    oracle = RunFolder(Path(source)).oracle / ORACLE_FILE
    if oracle.is_file():
        write_atomically(out / ORACLE_FILE, read_bounded(oracle, MAX_WEIGHTS_BYTES))
    for name, data in policy.to_files().items():
        write_atomically(out / name, data)
    write_atomically(out / DONE_FILE, json.dumps({"stage": "adopted", "objects": sorted(seen_by(source))}).encode())


def fit_to_start_from(source: str, task: str) -> Policy:
    """The policy at `source`; raises as `adopt` does."""
    policy = load_policy(source)
    if policy.task != task:
        raise UsageError(f"start_from '{source}': a policy for '{policy.task}', but the run is of '{task}'")
    policy.require("prior", "aap", "aip")
    return policy


def seen_by(source: str) -> frozenset[str]:
    """Content hashes of the objects that a policy learned from or was judged by, as far as its place says."""
    run = RunFolder(Path(source))
    if not run.objects_file.is_file():
        return objects_seen(run.path)
    used = run.objects_used()
    return frozenset(ref.content_hash for ref in (*used.train, *used.validation)) | objects_seen(run.adopted)
