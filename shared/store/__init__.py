"""The store: immutable shards, each complete if and only if its manifest is there."""

from shared.store.compaction import Compaction, compact
from shared.store.conformance import check_place
from shared.store.export import Export, export
from shared.store.info import StoreInfo, SuccessCount, info
from shared.store.layout import SCHEMA_VERSION, FileEntry, Quarantined, ShardManifest
from shared.store.merging import Merged, merge
from shared.store.migration import Migrated, migrate
from shared.store.observations import ObservationArrays
from shared.store.reopening import reopen_quarantined
from shared.store.repair import Repair, repair
from shared.store.store import Store
from shared.store.verify import Problem, verify

__all__ = [
    "SCHEMA_VERSION",
    "Compaction",
    "Export",
    "FileEntry",
    "Merged",
    "Migrated",
    "ObservationArrays",
    "Problem",
    "Quarantined",
    "Repair",
    "ShardManifest",
    "Store",
    "StoreInfo",
    "SuccessCount",
    "check_place",
    "compact",
    "export",
    "info",
    "merge",
    "migrate",
    "reopen_quarantined",
    "repair",
    "verify",
]
