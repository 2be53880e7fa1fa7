"""Loading of policies: bundled ones by name, a folder of a policy's files, or a finished run.

A policy of the package lies in adaafford/pretrained/<name>/: weights.safetensors in half precision, policy.json, and
README.md, its model card (`adaafford export-policy` makes all three).
"""

from pathlib import Path

from shared.errors import UsageError
from shared.io.files import read_bounded
from shared.policies.policy import MAX_POLICY_JSON_BYTES, MAX_WEIGHTS_BYTES, POLICY_FILE, WEIGHTS_FILE, Policy
from shared.store import Store

PRETRAINED_FOLDER = Path(__file__).parent / "pretrained"
CARD_FILE = "README.md"


def pretrained_names() -> list[str]:
    """The names of the bundled policies."""
    return sorted(path.parent.name for path in PRETRAINED_FOLDER.glob(f"*/{POLICY_FILE}"))


def only_pretrained() -> str:
    """The name of the only bundled policy.

    Raises:
        UsageError: there is none, or there are several.
    """
    names = pretrained_names()
    if len(names) != 1:
        raise UsageError(f"say which policy: {', '.join(names) or 'a folder with policy.json, or a finished run'}")
    return names[0]


def load_policy(source: str | Path) -> Policy:
    """Load a policy by a name, such as "pull-closed-door", or from a path.

    Args:
        source: a name of `pretrained_names`, a folder that holds a policy's two files, one of these files, or a run
            (its last policy).

    Raises:
        UsageError: there is no policy of this name or in this place.
        StoreError: its files are damaged or foreign.
    """
    if str(source) in pretrained_names():
        return _read(PRETRAINED_FOLDER / str(source))
    path = Path(source)
    if path.name in (WEIGHTS_FILE, POLICY_FILE) and path.is_file():
        path = path.parent
    if (path / POLICY_FILE).is_file():
        return _read(path)
    if (path / "store").is_dir():
        store = Store.open(path / "store")
        if versions := store.policy_versions():
            return Policy.from_files(store.read_policy(versions[-1]))
    names = ", ".join(pretrained_names()) or "none in this build"
    raise UsageError(f"no policy '{source}': give a name ({names}), a folder with {POLICY_FILE}, or a finished run")


def _read(folder: Path) -> Policy:
    limits = {WEIGHTS_FILE: MAX_WEIGHTS_BYTES, POLICY_FILE: MAX_POLICY_JSON_BYTES}
    return Policy.from_files({name: read_bounded(folder / name, limit) for name, limit in limits.items()})
