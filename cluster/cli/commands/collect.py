"""`adaafford collect`: a collection into one store."""

import logging
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro
from pydantic import Field

from cluster.config.campaign_config import ObjectSelection, WorkerSettings
from cluster.config.flags import early_flags, layered, parse_flags
from shared.config import CollectionConfig
from shared.errors import UsageError
from shared.plan import ROLLOUTS_PER_SHARD
from shared.policies.methods import RANDOM, needs_policy

if TYPE_CHECKING:
    from shared.plan import ObjectRef, Setting

logger = logging.getLogger(__name__)


class CollectSettings(WorkerSettings, ObjectSelection):
    """Settings of `adaafford collect` that a file may contain as well."""

    task: str = "push"
    """Which manipulation task: push, pull, pull-closed-door, push-faucet, one that a package adds, or a TOML file."""
    rollouts: int = Field(100, ge=1)
    """How many rollouts of this plan the store has in the end, including earlier attempts; with --policy latest, of
    this proposer with any policy."""
    per_version: int | None = Field(None, ge=1)
    """With --policy latest: the most rollouts of one version; then the collection waits for the next version (rounds).
    Without it, a version is used until there is a newer one (continuous collection)."""
    per_shard: int = Field(ROLLOUTS_PER_SHARD, ge=1, le=4096)
    """Rollouts in each shard."""
    seed: int = Field(1, ge=0, lt=2**63)
    """All randomness is derived from it."""
    procedural_per_category: int = Field(8, ge=1, le=10_000)
    """Built-in objects: how many of each category that the task applies to."""
    collection: CollectionConfig = CollectionConfig()


@dataclass(frozen=True, slots=True)
class CollectCommand:
    """Collect interactions into a store. Give the same command again to continue."""

    settings: Annotated[CollectSettings, tyro.conf.arg(name="")]
    store: str
    """Folder or s3:// URL of the store: new, or of the same setting."""
    proposer: str = RANDOM
    """The proposer: random, aip, another of this package, or one of an installed package."""
    policy: int | Literal["latest"] = 0
    """Version of the policy in the store that the proposer uses; "random" needs none, "aip" needs one. "latest": always
    the newest published one, also by a learner at the same time (`adaafford learn --follow`)."""
    retry_quarantined: tyro.conf.FlagCreatePairsOff[bool] = False
    """Execute the quarantined rollouts again, after their cause was corrected."""
    config: Path | None = None
    """A TOML file of settings; flags replace them."""


def main(args: list[str]) -> int:
    """Collect."""
    early = early_flags(args, "config")
    config = Path(early["config"]) if early["config"] else None
    defaults = CollectCommand(layered(CollectSettings, None, config), tyro.MISSING, config=config)
    command = parse_flags(CollectCommand, args, "collect", defaults)
    _ = command.settings.task_record
    learnt = needs_policy(command.proposer)
    if learnt != (command.policy == "latest" or command.policy > 0):
        wanted = "needs --policy VERSION (1 or more, or latest)" if learnt else "takes no --policy"
        raise UsageError(f"the proposer '{command.proposer}' {wanted}")
    if command.settings.per_version is not None and command.policy != "latest":
        raise UsageError("--per-version is about the versions of --policy latest; without that, give --rollouts alone")
    run_collection(command)
    return 0


def _begun_with(where: str, begun: "Setting | None", found: "tuple[ObjectRef, ...]") -> "tuple[ObjectRef, ...]":
    """The objects that a store was begun with, if all of them are found; a later release may find usable ones more."""
    if begun is None or not set(begun.objects) < set(found):
        return found
    known = begun.objects
    logger.warning(
        "%s: was begun with %d of the %d objects that can be used; it goes on with these alone",
        where,
        len(known),
        len(found),
    )
    return known


def run_collection(command: CollectCommand) -> None:
    """Collect what is left of a command that was checked."""
    from cluster.collection.driver import LatestPolicy, collect
    from cluster.config.objects import objects_for
    from cluster.workers.session import worker_groups
    from cluster.workers.worker_group import make_worker
    from collector.setting import in_fidelity_of, make_setting, packages_used
    from shared.plan import Plan
    from shared.store import Store
    from shared.store.backends.base import absolute, folder_beside
    from shared.store.provenance import changed_versions

    chosen, where = command.settings, absolute(command.store)
    task = chosen.task_record
    packages_used(task, chosen.collection)  # Refused before any object is read.
    begun = Store.begun_with(where)
    made = partial(make_setting, task, in_fidelity_of(where, begun, chosen.collection), seed=chosen.seed)
    # Refused before built-in objects are made, which takes minutes.
    Store.check_free(where, None if begun is None else made(objects=begun.objects))
    catalogue, folder = objects_for(
        task,
        chosen,
        folder_beside(where, "objects"),
        chosen.procedural_per_category,
        chosen.seed,
    )
    store = Store.create(where, made(objects=_begun_with(where, begun, tuple(entry.ref for entry in catalogue.usable))))
    if changed := changed_versions(store.document.software):
        print(
            f"{store.where}: begun with other software: {changed}; new rows may differ because of it", file=sys.stderr
        )
    plan: Plan | LatestPolicy
    if command.policy == "latest":
        plan = LatestPolicy(command.proposer, chosen.per_version)
    else:
        plan = Plan(setting=store.setting, proposer=command.proposer, policy_version=command.policy)
    with (
        store.only_driver(alone=command.policy == "latest"),
        worker_groups(chosen.workers, chosen.limits, chosen.ray_address) as make_worker_group,
    ):
        open_worker_group = partial(make_worker_group, partial(make_worker, where, folder), store.crash_log)
        collect(
            store,
            plan,
            chosen.rollouts,
            chosen.per_shard,
            open_worker_group,
            folder,
            retry_quarantined=command.retry_quarantined,
        )
