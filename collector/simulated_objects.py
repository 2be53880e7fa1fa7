"""The objects of a folder as rollouts that begin one after the other, for programs that act in them themselves."""

from pathlib import Path

from collector.objects.catalogue import ObjectCache, for_task, scan
from collector.rollout import Start, begin, object_of
from collector.setting import make_setting
from collector.sim.simulator import StageClock
from shared.config import CollectionConfig
from shared.errors import UsageError
from shared.plan import Plan
from shared.tasks import Task


class SimulatedObjects:
    """The objects of a folder that a task applies to.

    Args:
        folder: of objects, in any layout that is read.
        task: objects that it does not apply to are left out.
        collection: camera, hand, fidelity and hidden parameters.

    Raises:
        UsageError: the folder cannot be read, or the task applies to none of its objects.
    """

    def __init__(self, folder: Path, task: Task, collection: CollectionConfig) -> None:
        self._folder, self._task, self._collection = folder, task, collection
        self.refs = tuple(entry.ref for entry in for_task(scan(folder), task).usable)
        if not self.refs:
            raise UsageError(f"{folder}: no object that '{task.name}' applies to; look at `adaafford objects check`")
        self._cache = ObjectCache(folder)

    def plan(self, seed: int, object_id: str | None = None) -> Plan:
        """The numbered rollouts of a seed, which are those of `adaafford collect` on these objects.

        Args:
            seed: everything random derives from it.
            object_id: the only object, instead of each in turn; all else of a rollout stays as it is.

        Raises:
            UsageError: there is no such object.
        """
        refs = tuple(ref for ref in self.refs if object_id in (None, ref.id))
        if not refs:
            raise UsageError(
                f"{self._folder}: no object '{object_id}' that '{self._task.name}' applies to; "
                f"there are {len(self.refs)}, such as '{self.refs[0].id}'"
            )
        return Plan(setting=make_setting(self._task, self._collection, seed=seed, objects=refs))

    def start(self, plan: Plan, first: int) -> Start:
        """The first rollout from number `first` on that can begin.

        Raises:
            UsageError: in one turn over all objects, none comes to rest in view of the camera.
            ObjectError: an object has changed since the scan.
        """
        for index in range(first, first + len(plan.setting.objects)):
            target = self._cache.load(object_of(plan, index), self._collection.collision)
            start = begin(plan, index, target, StageClock())
            if isinstance(start, Start):
                return start
        raise UsageError(f"{self._folder}: no object comes to rest in view; look at `adaafford objects check --settle`")
