"""The store: immutable shards, each complete if and only if its manifest is there."""

from shared.store.info import StoreInfo, Tally, info
from shared.store.layout import SCHEMA_VERSION, FileEntry, Quarantined, ShardManifest
from shared.store.observations import ObservationArrays
from shared.store.repair import Repair, repair
from shared.store.store import Store
from shared.store.verify import Problem, verify

__all__ = [
    "SCHEMA_VERSION",
    "FileEntry",
    "ObservationArrays",
    "Problem",
    "Quarantined",
    "Repair",
    "ShardManifest",
    "Store",
    "StoreInfo",
    "Tally",
    "info",
    "repair",
    "verify",
]
