"""`adaafford calibrate`: a policy's probabilities, fitted to few interactions with the user's own objects."""

import json
from dataclasses import dataclass
from typing import Literal

import tyro

from cluster.config.flags import OutFolder, parse_flags
from shared.errors import UsageError


@dataclass(frozen=True, slots=True)
class CalibrateCommand:
    """Fit the probabilities of a policy to a few interactions with your own objects, and write the policy anew.

    What is printed is cross-validated over objects: "after" is of objects that the fit has not seen; "constant" is the
    entropy of the base rate of these interactions.
    """

    policy: str
    """A name of those that the package brings, a folder with weights.safetensors and policy.json, or a finished run."""
    store: tuple[str, ...]
    """Folders or s3:// URLs of stores with interactions on your objects; they are only read."""
    out: OutFolder
    """Folder to write the policy to; files of an earlier export are replaced, and nothing else may lie there."""
    fit: Literal["scale", "last-layer"] = "scale"
    """What is fitted of each critic. "scale": a temperature and a bias; "last-layer": all weights of its last layer."""
    seed: int = 0
    """Of what is drawn."""
    licence: str = "MIT"
    """What the card says; weights that were fitted to others' objects may be bound by those objects' terms."""
    json: bool = False
    """Print one JSON object as the last line."""


def main(args: list[str]) -> int:
    """Calibrate."""
    command = parse_flags(
        CalibrateCommand, args, "calibrate", CalibrateCommand(tyro.MISSING, tyro.MISSING, tyro.MISSING)
    )
    if command.seed < 0:
        raise UsageError(f"--seed {command.seed}: give a number of 0 or more")
    from adaafford.pretrained import load_policy
    from cluster.reporting.calibration_card import as_json, as_markdown, calibrated, calibrated_files
    from cluster.reporting.model_card import check_export_folder, write_export
    from cluster.runs.warm_start import folder_of, seen_by, unknown
    from shared.store import Store

    check_export_folder(command.out)
    if command.out.resolve() == folder_of(command.policy):
        raise UsageError(f"{command.out}: holds the policy that is calibrated; name another folder, so that it is kept")
    policy = load_policy(command.policy)
    policy.require("prior", "aap")
    stores = [Store.open(place) for place in command.store]
    if not (seen := seen_by(command.policy)):
        print(unknown(command.policy))
    done = calibrated(command.policy, policy, stores, seen, command.fit, command.seed)
    if done.left_out:
        print(f"left out {done.left_out} rollouts, whose objects the policy has seen")
    print("\n".join(as_markdown(done)))
    write_export(command.out, calibrated_files(done, command.licence))
    print(f"{command.out}: policy of task {policy.task}, calibrated on {len(done.objects)} objects")
    if command.json:
        print(json.dumps(as_json(done), allow_nan=False))
    return 0
