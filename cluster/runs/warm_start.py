"""The warm start of a campaign from an existing policy, for fine-tuning on other objects.

training/adopted/ of such a run is what the stages prior, aap-1 and aip-1 leave in others: a policy, the oracle that
taught it, where there was one, and done.json, which says what objects it has seen.
"""

import json
from pathlib import Path

from adaafford.pretrained import PRETRAINED_FOLDER, load_policy, pretrained_names
from cluster.config.campaign_config import CampaignConfig
from cluster.runs.run_folder import RunFolder
from learner.stages.jobs import DONE_FILE, objects_seen
from learner.stages.trainers import ORACLE_FILE
from shared.io.files import read_bounded, write_atomically
from shared.policies.policy import MAX_WEIGHTS_BYTES, Policy

_DEPTH_IN_RUN = 3
"""How far below its run a policy lies at most: RUN/store/policies/VERSION."""


def warm_start(source: str, task: str, out: Path) -> None:
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
    """The policy at `source`; raises as `warm_start` does."""
    policy = load_policy(source)
    policy.require_task(task, f"start_from '{source}'", "the run is of")
    policy.require("prior", "aap", "aip")
    return policy


def with_needed_depth(config: CampaignConfig, out: Path | None = None) -> CampaignConfig:
    """A campaign that keeps depth images where its networks need them.

    Args:
        config: of the campaign.
        out: folder of its run. What the run has adopted is not looked for where it came from any more.

    Raises:
        UsageError: its camera cannot keep them, or there is no policy to start from.
    """
    learned = config.learner.network.pinch_profile
    if config.start_from is not None:
        adopted = None if out is None else RunFolder(out).adopted
        there = adopted is not None and (adopted / DONE_FILE).is_file()
        learned = fit_to_start_from(str(adopted) if there else config.start_from, config.task).config.pinch_profile
    return config.model_copy(update={"collection": config.collection.keeping_depth()}) if learned else config


def folder_of(source: str) -> Path:
    """The folder that a policy's source names, as `load_policy` takes it."""
    place = (PRETRAINED_FOLDER / source if source in pretrained_names() else Path(source)).resolve()
    return place.parent if place.is_file() else place


def seen_by(source: str) -> frozenset[str]:
    """Content hashes of the objects that a policy learned from or was judged by, as far as its place says.

    Args:
        source: as `load_policy` takes it. A run and all that lies in it, what a training stage left, what
            `export-policy` wrote and what comes along say so; a lone copy of two files does not.
    """
    folder = folder_of(source)
    known = objects_seen(folder)
    for run in map(RunFolder, (folder, *folder.parents[:_DEPTH_IN_RUN])):
        if run.objects_file.is_file():
            used = run.objects_used()
            known |= frozenset(ref.content_hash for ref in (*used.train, *used.validation)) | objects_seen(run.adopted)
            break
    return known


def unknown(source: str) -> str:
    """What to tell of a policy that `seen_by` knows nothing of."""
    return f"'{source}' has no record of its training objects; some of them may be used for testing"
