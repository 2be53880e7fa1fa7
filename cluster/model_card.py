"""Model cards: what a policy was trained on, how well it does, and what it is not for; Markdown beside its weights."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from cluster.configuration import CampaignConfig
from cluster.evaluation_tables import MARKDOWN_FILE
from cluster.run_folder import RunFolder
from shared.errors import UsageError
from shared.files import read_bounded
from shared.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.store import Store
from shared.store.provenance import software_versions

CARD_FILE = "README.md"
MAX_TABLE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Exported:
    """A policy to take elsewhere.

    Attributes:
        policy: its prior, AAP and AIP.
        version: in the run's store.
        files: weights.safetensors in half precision, policy.json and README.md.
    """

    policy: Policy
    version: int
    files: dict[str, bytes]


def export(run: RunFolder, config: CampaignConfig, version: int | None, licence: str) -> Exported:
    """A run's policy in half precision, with its card.

    The networks of the baselines stay behind: nobody but an evaluation asks for them.

    Raises:
        UsageError: the run has published no policy.
        StoreError: it has none of this version.
    """
    store = Store.open(run.store)
    known = store.policy_versions()
    if not known:
        raise UsageError(f"{run.path}: has published no policy yet; finish it with `adaafford resume {run.path}`")
    chosen = known[-1] if version is None else version
    policy = Policy.from_files(store.read_policy(chosen)).without_baselines()
    files = policy.to_files(half=True)
    card = "\n\n".join((_head(policy, files, licence), _data(run, store), _results(run), _limits(config), _use(policy)))
    return Exported(policy, chosen, {**files, CARD_FILE: f"{card}\n".encode()})


def _head(policy: Policy, files: dict[str, bytes], licence: str) -> str:
    parameters = sum(tensor.numel() for tensor in policy.modules().parameters())
    return f"""# AdaAfford policy: {policy.task}

Where and how a gripper can move one articulated object, from a point cloud, adapted by a few tries: Where2Act prior,
Adaptive Affordance Prediction and Adaptive Interaction Proposal (Wang et al., ECCV 2022).

| | |
| --- | --- |
| task | `{policy.task}` |
| trained modules | {", ".join(sorted(policy.trained))} |
| parameters | {parameters:,} |
| weights | `{WEIGHTS_FILE}`, half precision, {len(files[WEIGHTS_FILE]) / 1e6:.1f} MB; sizes in `{POLICY_FILE}` |
| licence | {licence} |"""


def _data(run: RunFolder, store: Store) -> str:
    used, setting = run.objects_used(), store.setting
    generated = Path(used.folder) == run.generated_objects.resolve()
    origin = (
        "procedural objects only, made by `adaafford objects generate`" if generated else "objects of a user's folder"
    )
    categories = Counter(ref.category for ref in used.train)
    rows = store.interactions(["success"]).to_pydict()["success"] if store.committed() else []
    rate = f"{100 * sum(rows) / len(rows):.1f}% successful" if rows else "none"
    return f"""## Data

{len(rows):,} interactions ({rate}) in simulation, seed {setting.seed}, fidelity `{setting.collection.fidelity.name}`,
clouds of {setting.collection.camera.points} points; {origin}: {len(used.train)} to learn from
({", ".join(f"{count} {name}" for name, count in sorted(categories.items()))}), {len(used.validation)} to validate,
{len(used.test)} to test. Digest of the interactions: `{store.digest()[:16]}`."""


def _results(run: RunFolder) -> str:
    table = run.training("evaluate") / MARKDOWN_FILE
    if not table.is_file():
        return "## Results\n\nThis policy was not evaluated."
    lines = read_bounded(table, MAX_TABLE_BYTES).decode().splitlines()
    return "\n".join(["## Results", *lines[1:]])


def _limits(config: CampaignConfig) -> str:
    camera = config.collection.camera
    return f"""## Limits

- Trained in simulation alone: rigid parts, one hinge or slide at a time, a flying Panda hand, noise-free depth.
- The object stands upright and alone in the cloud, in metres, of about the size that the training objects have (they
  fit into a ball of radius 1), seen from {camera.elevation_deg.low:g} to {camera.elevation_deg.high:g} deg above.
- What is called a probability is one on objects like those of training, and on no others.
- It knows neither reach nor safety: check poses, speeds and forces before an arm moves.
- Half precision: scores differ from those of the trained weights by less than 0.001."""


def _use(policy: Policy) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in sorted(software_versions().items()))
    return f"""## Use

`adaafford adapt --policy FOLDER --cloud scan.ply --history history.json`, or in Python
`Adapter(load_policy("FOLDER"))`; FOLDER is where this file lies, or `{policy.task}` if the package brings it.
Exported with {versions}."""
