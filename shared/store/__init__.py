"""The store: immutable shards, each complete if and only if its manifest is there."""

from shared.store.backends.conformance import check_place
from shared.store.codecs.observations import ObservationArrays
from shared.store.layout import SCHEMA_VERSION, FileEntry, Quarantined, ShardManifest
from shared.store.maintenance.compaction import Compaction, compact, reopen_quarantined
from shared.store.maintenance.export import Export, export
from shared.store.maintenance.info import StoreInfo, SuccessCount, info
from shared.store.maintenance.merging import Merged, merge
from shared.store.maintenance.repair import Repair, repair
from shared.store.maintenance.verify import Problem, verify
from shared.store.store import Store

__all__ = [
    "SCHEMA_VERSION",
    "Compaction",
    "Export",
    "FileEntry",
    "Merged",
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
    "reopen_quarantined",
    "repair",
    "verify",
]
