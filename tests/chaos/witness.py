"""Holds a store to its promises after every kill: sound, nothing committed lost or changed, nothing there twice."""

import hashlib
from collections import Counter

from shared.store import Store, verify
from shared.store.backends.base import backend_of
from shared.store.layout import MANIFEST_FILE, MAX_DOCUMENT_BYTES, SHARDS_FOLDER, STORE_FILE


class Witness:
    """Remembers what it has seen committed in one store, and wants to see it again.

    Args:
        where: folder or URL of the store, which need not be there yet.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._manifests: dict[str, str] = {}
        self._policies: dict[int, dict[str, bytes]] = {}

    def look(self) -> int:
        """Look at the store now, whoever writes it at this moment; returns how many rollouts it holds.

        Raises:
            AssertionError: a promise is broken.
        """
        place = backend_of(self._where)
        if not (place.is_there() and place.exists(STORE_FILE)):
            assert not self._manifests, "the store itself is gone"
            return 0
        store = Store.open(self._where)
        manifests = {shard.shard_id: _digest(store, shard.shard_id) for shard in store.committed()}
        lost = self._manifests.keys() - manifests.keys()
        assert not lost, f"committed, and gone: {sorted(lost)}"
        changed = [name for name, digest in self._manifests.items() if manifests[name] != digest]
        assert not changed, f"committed, and changed: {sorted(changed)}"
        self._manifests = manifests
        policies = {version: store.read_policy(version) for version in store.policy_versions()}
        assert policies.items() >= self._policies.items(), "a policy is gone, or another one"
        self._policies = policies
        problems = verify(store)
        assert problems == [], problems
        return _rollouts(store)

    def holds(self) -> set[str]:
        """Ids of the shards that were there at the last look."""
        return set(self._manifests)


def _digest(store: Store, shard_id: str) -> str:
    manifest = store.backend.read(f"{SHARDS_FOLDER}/{shard_id}/{MANIFEST_FILE}", MAX_DOCUMENT_BYTES)
    return hashlib.sha256(manifest).hexdigest()


def _rollouts(store: Store) -> int:
    """How many rollouts there are, each number of a proposer once, whichever version of its policy made it."""
    times: Counter[tuple[str, int]] = Counter()
    proposers = {plan.key: plan.proposer for plan in store.plans()}
    for shard in store.committed():
        times.update((proposers[shard.plan_key], number) for number in range(shard.start, shard.stop))
    twice = [each for each, count in times.items() if count > 1]
    assert not twice, f"there twice: {sorted(twice)}"
    return len(times)
