"""Model cards: what a policy was trained on, how well it does, and what it is not for; Markdown beside its weights."""

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from cluster.evaluation.tables import MARKDOWN_FILE
from cluster.runs.run_folder import RunFolder
from cluster.runs.warm_start import seen_by
from learner.alternation import trained_in
from learner.stages.jobs import DONE_FILE, objects_seen, read_policy_folder
from shared.config import PANDA, CollectionConfig
from shared.errors import UsageError
from shared.io.files import TEMPORARY_PREFIX, make_folder, read_bounded, write_atomically, writing
from shared.io.text import markdown
from shared.plan import ObjectRef
from shared.policies.policy import POLICY_FILE, WEIGHTS_FILE, Policy
from shared.software import software_versions
from shared.store import Store

CARD_FILE = "README.md"
MAX_TABLE_BYTES = 1 << 20
PROCEDURAL = "procedural objects only, made by `adaafford objects generate`"


@dataclass(frozen=True, slots=True)
class Source:
    """Where a policy comes from, for its card.

    Attributes:
        policy: the policy.
        name: what it is called there.
        store: what it was trained on.
        objects: how many of the store's objects it saw, and for what.
        seen: those that it learned from, as far as they are the store's.
        known: content hashes of all that it learned from or was judged by, also before it was fine-tuned.
        origin: what kind of objects.
        results: Markdown; a table, and what it is a table of.
    """

    policy: Policy
    name: str
    store: Store
    objects: str
    seen: tuple[ObjectRef, ...]
    known: frozenset[str]
    origin: str
    results: str


def source_of_run(run: RunFolder, version: int | None) -> Source:
    """A campaign's policy.

    Raises:
        UsageError: the run has published no policy.
        StoreError: it has none of this version.
    """
    store = Store.open(run.store)
    known = store.policy_versions()
    if not known:
        raise UsageError(f"{run.path}: has published no policy yet; finish it with `adaafford resume {run.path}`")
    chosen = known[-1] if version is None else version
    used = run.objects_used()
    table = run.training("evaluate") / MARKDOWN_FILE
    return Source(
        policy=Policy.from_files(store.read_policy(chosen)),
        name=f"policy {chosen}",
        store=store,
        objects=f"{len(used.train)} to learn from, {len(used.validation)} to validate, {len(used.test)} to test",
        seen=used.train,
        known=seen_by(str(run.path)),
        origin=PROCEDURAL if run.generates_objects() else "objects of a user's folder",
        results=_without_title(table) if table.is_file() else "This policy was not evaluated.",
    )


def source_of_training(training: Path, store: Store, results: Path | None, origin: str) -> Source:
    """The policy of a training from a store (`adaafford train`).

    Args:
        training: its --out.
        store: what it was trained on.
        results: a table of `adaafford curve` or `evaluate`; None: there is none.
        origin: what the store's objects are.

    Raises:
        UsageError: the training is not finished, or was of another task.
        StoreError: what it left is damaged.
    """
    folder = trained_in(training)
    policy, seen = read_policy_folder(folder), objects_seen(folder)
    policy.require_task(store.setting.task, str(training))
    refs = tuple(ref for ref in store.setting.objects if ref.content_hash in seen)
    return Source(
        policy=policy,
        name=folder.name,
        store=store,
        objects=f"{len(refs)} to learn from and to validate by",
        seen=refs,
        known=seen,
        origin=origin,
        results="This policy was not evaluated." if results is None else _without_title(results),
    )


def export(source: Source, licence: str) -> dict[str, bytes]:
    """weights.safetensors in half precision, policy.json, README.md, the card, and done.json, by name.

    The last has the objects that the policy has seen, so that fine-tuning does not test on them.

    The networks of the baselines are left out, because only an evaluation uses them.
    """
    policy = source.policy.without_baselines()
    files = policy.to_files(half=True)
    card = (
        head(policy, files, licence),
        _data(source),
        f"## Results\n\n{source.results}",
        _limits(source.store.setting.collection),
        _use(policy),
    )
    seen = {"stage": "exported", "objects": sorted(source.known)}
    return {**files, CARD_FILE: ("\n\n".join(card) + "\n").encode(), DONE_FILE: json.dumps(seen).encode()}


def _without_title(table: Path) -> str:
    """Markdown without its first line, the title."""
    return "\n".join(read_bounded(table, MAX_TABLE_BYTES).decode(errors="replace").splitlines()[1:]).strip()


def check_export_folder(out: Path) -> None:
    """Refuse a folder that holds anything but an exported policy.

    Raises:
        UsageError: it does, or is no folder.
    """
    known = {WEIGHTS_FILE, POLICY_FILE, CARD_FILE, DONE_FILE}

    def foreign(name: str) -> bool:
        # A kill leaves the temporary file of the file that was being written.
        return name not in known and not name.startswith(TEMPORARY_PREFIX)

    if out.exists() and (not out.is_dir() or any(foreign(path.name) for path in out.iterdir())):
        raise UsageError(f"{out}: holds something that is not an exported policy; name a new or an empty folder")


def write_export(out: Path, files: Mapping[str, bytes]) -> None:
    """Write the files of an exported policy; raises as `check_export_folder` does, or UsageError where it cannot."""
    check_export_folder(out)
    make_folder(out)
    with writing(out, "correct this, or name another folder"):
        for name, data in files.items():
            write_atomically(out / name, data)


def head(policy: Policy, files: Mapping[str, bytes], licence: str, precision: str = "half") -> str:
    """The title of a card and what the policy's files are."""
    parameters = sum(tensor.numel() for tensor in policy.modules().parameters())
    return f"""# AdaAfford policy: {policy.task}

Where and how a gripper can move one articulated object, from a point cloud, adapted by a few interactions: the
Where2Act prior, Adaptive Affordance Prediction and Adaptive Interaction Proposal (Wang et al., ECCV 2022).

| | |
| --- | --- |
| task | `{policy.task}` |
| trained modules | {", ".join(sorted(policy.trained))} |
| parameters | {parameters:,} |
| weights | `{WEIGHTS_FILE}`, {precision} precision, {len(files[WEIGHTS_FILE]) / 1e6:.1f} MB; sizes in `{POLICY_FILE}` |
| licence | {licence} |"""


def _data(source: Source) -> str:
    setting = source.store.setting
    categories = Counter(ref.category for ref in source.seen)
    rows = source.store.interactions(["success"]).to_pydict()["success"] if source.store.jobs() else []
    rate = f"{100 * sum(rows) / len(rows):.1f}% successful" if rows else "none"
    return f"""## Data

{len(rows):,} interactions ({rate}) in simulation, seed {setting.seed}, fidelity `{setting.collection.fidelity.name}`,
clouds of {setting.collection.camera.points} points; {source.origin}: {source.objects}
({", ".join(f"{count} {markdown(name)}" for name, count in sorted(categories.items()))}). Digest of the interactions:
`{source.store.digest()[:16]}`."""


def _limits(collection: CollectionConfig) -> str:
    camera = collection.camera
    hand = "Panda hand" if collection.gripper == PANDA else f"hand `{collection.gripper}`"
    depth = f"depth with {camera.noise:g} times the errors of a camera" if camera.noise else "noise-free depth"
    return f"""## Limits

- Trained in simulation alone: rigid parts, one hinge or slide at a time, a flying {hand}, {depth}.
- The object stands upright and alone in the cloud, in metres, of about the size that the training objects have (they
  fit into a ball of radius 1), seen from {camera.elevation_deg.low:g} to {camera.elevation_deg.high:g} deg above.
- Predicted probabilities are valid only for objects like those of training.
- It knows neither reach nor safety: check poses, speeds and forces before an arm moves.
- Half precision: scores differ from those of the trained weights by less than 0.001."""


def _use(policy: Policy) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in sorted(software_versions().items()))
    return f"""## Use

`adaafford adapt --policy FOLDER --cloud scan.ply --history history.json`, or in Python
`Adapter(load_policy("FOLDER"))`; FOLDER is the folder of this file.
Exported with {versions}."""
