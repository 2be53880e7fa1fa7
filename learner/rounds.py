"""Learning beside collection: the alternation, whose rounds wait for new rollouts and publish what they made.

RUN/ of a learner that follows, besides what `learner.alternation` leaves there
    data-1.json, ...      what each round learns from: the rollouts that the store held when the round began
    published.json        which version of the store each policy became; written before it is published

A round learns from a snapshot, since the store grows meanwhile: so it can be resumed, and the same store gives the
same policy. The validation objects are chosen among all that the store is about, before anything is collected, so that
no object moves from one side to the other.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, RootModel

from learner.alternation import Collect, Finished, Publish
from learner.data.sampling import kept_for_validation
from learner.settings import PUBLISHED_FILE
from learner.stages.jobs import StageJob
from learner.training import data_parallel
from shared.errors import StoreError
from shared.io.documents import read_document
from shared.io.files import make_folder, read_bounded, write_atomically
from shared.policies.policy import MAX_WEIGHTS_BYTES, POLICY_FILE, WEIGHTS_FILE
from shared.store.backends.base import backend_of
from shared.store.coverage import Snapshot
from shared.store.layout import MAX_DOCUMENT_BYTES, SHARDS_FOLDER, STORE_FILE, parse_shard_id
from shared.store.policies import MAX_VERSION, version_of
from shared.store.store import Store

LINE_S = 60.0
"""How often it is said that there is still too little."""


@dataclass(frozen=True, slots=True)
class Pace:
    """When there is enough to learn from.

    Attributes:
        first: rollouts in the store before the first round.
        more: new rollouts before each further one.
        poll_s: seconds between two looks.
    """

    first: int = 100
    more: int = 30
    poll_s: float = 5.0


class Following(Finished):
    """`Rollouts` of a store that collectors fill meanwhile; each round's policy is published for them.

    Args:
        job: the store, which need not be there yet, and the learner's folder.
        pace: when there is enough.
        sleep: waits for so many seconds.
    """

    def __init__(self, job: StageJob, pace: Pace, sleep: Callable[[float], None] = time.sleep) -> None:
        self._pace = pace
        self._sleep = sleep
        self._wait_for_store(job.store)
        super().__init__(job)
        # What a round learns from is a snapshot of all that there is.
        self.at_least = 1
        if job.train_objects is None and job.validation_objects is None:
            named = [ref.id for ref in self._store.setting.objects]
            self._job = replace(job, validation_objects=kept_for_validation(named))
        make_folder(job.out)

    def collect(self, step: Collect) -> Mapping[str, Any]:
        """Wait until collectors have made enough for the round after `step.version`, and note what there is.

        Raises:
            StoreError: the store is damaged.
        """
        path = self._snapshot(step.version + 1)
        if data_parallel.rank() == 0 and not path.exists():
            write_atomically(path, self._wait_for_rollouts(step.version + 1).model_dump_json().encode())
        while not path.exists():
            # Not a barrier, which would lose patience: collection may take hours.
            self._sleep(self._pace.poll_s)
        return {}

    def job(self, number: int) -> StageJob:
        """What the store held as the round began; the prior learns from what round 1 does.

        Raises:
            StoreError: the record of that is damaged.
        """
        return replace(self._job, snapshot=_read_snapshot(self._snapshot(max(number, 1))))

    def publish(self, step: Publish) -> Mapping[str, Any]:
        """Publish the policy of a round."""
        publish(self._store, self.out, f"round-{step.version}", self.out / step.folder)
        return {}

    def _snapshot(self, number: int) -> Path:
        return self.out / f"data-{number}.json"

    def _wait_for_store(self, where: str | Path) -> None:
        place, said = backend_of(where), False
        while not (place.is_there() and place.exists(STORE_FILE)):
            if not said and data_parallel.rank() == 0:
                print(f"waiting for a store in {where}", flush=True)
            said = True
            self._sleep(self._pace.poll_s)

    def _wait_for_rollouts(self, number: int) -> Snapshot:
        """What the store holds once that is enough for the round."""
        before = 0 if number == 1 else _read_snapshot(self._snapshot(number - 1)).rollouts
        wanted = self._pace.first if number == 1 else before + self._pace.more
        said_at = -LINE_S
        while True:
            there = self._at_most()
            if there >= wanted:
                snapshot = Snapshot.of(self._store.parts())
                there = snapshot.rollouts
                if there >= wanted and self._has_both_sides(snapshot):
                    return snapshot
            if time.monotonic() - said_at >= LINE_S:
                said_at = time.monotonic()
                what = f"{wanted} rollouts" if there < wanted else "objects to learn from and others to judge by"
                print(f"round {number} waits for {what} in {self._store.where}; {there} rollouts are there", flush=True)
            self._sleep(self._pace.poll_s)

    def _has_both_sides(self, snapshot: Snapshot) -> bool:
        """Whether something was tried on objects to learn from, and on objects to judge by."""
        rows = self._store.as_of(snapshot).interactions(["object_id"])
        objects = set(rows.column("object_id").unique().to_pylist())
        train, validation = self._job.train_objects, self._job.validation_objects
        learnt_from = objects - set(validation or ()) if train is None else objects & set(train)
        judged_by = objects - set(train or ()) if validation is None else objects & set(validation)
        return bool(learnt_from and judged_by)

    def _at_most(self) -> int:
        """The most rollouts that the store can hold, by the names of its shards alone: cheap, so it is asked first."""
        jobs = [parse_shard_id(name) for name in self._store.backend.names(SHARDS_FOLDER)]
        return sum(job.stop - job.start for job in jobs if job is not None)


class Published(RootModel[dict[str, Annotated[int, Field(ge=1, le=MAX_VERSION)]]]):
    """The versions of the policies that a learner has published, by what it calls them."""


def publish(store: Store, out: Path, name: str, policy: Path) -> int | None:
    """Put a policy into the store under the next free version, once; returns that version, in the first process.

    Args:
        store: where collectors look for it.
        out: folder of the run, which remembers the version.
        name: what the run calls the policy.
        policy: folder of the stage that made it.

    Raises:
        StoreError: the record is damaged, or a version's files are other than those that were noted.
    """
    if data_parallel.rank() > 0:
        return None
    versions, taken = _published(out), store.policy_versions()
    files = {file: read_bounded(policy / file, MAX_WEIGHTS_BYTES) for file in (WEIGHTS_FILE, POLICY_FILE)}
    noted = versions.get(name)
    if noted is None:
        # The record may be lost, or the same learner be started twice: then the policy is there already.
        noted = version_of(store.backend, files, besides=versions.values())
    elif noted in taken and store.read_policy(noted) != files:
        # Another learner took the version after it was noted and before this process was killed.
        noted = None
    while True:
        # Noted first: after a kill the same policy goes to the same version, where it may lie already.
        versions[name] = noted if noted is not None else max(store.policy_versions(), default=0) + 1
        write_atomically(out / PUBLISHED_FILE, json.dumps(versions, indent=1).encode())
        try:
            store.publish_policy(versions[name], files)
            break
        except StoreError:
            if versions[name] not in store.policy_versions():
                raise
            # Another learner took that version at this very moment: the next one, then.
            noted = None
    print(f"{store.where}: policy {versions[name]} is {policy}", flush=True)
    return versions[name]


def _published(out: Path) -> dict[str, int]:
    path = out / PUBLISHED_FILE
    if not path.exists():
        return {}
    return read_document(Published, path, MAX_DOCUMENT_BYTES, "damaged; restore it, or choose another --out").root


def _read_snapshot(path: Path) -> Snapshot:
    return read_document(
        Snapshot, path, MAX_DOCUMENT_BYTES, "damaged; remove it to learn from what the store holds now"
    )
