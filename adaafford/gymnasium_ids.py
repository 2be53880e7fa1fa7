"""The ids of our Gymnasium environments: one for each task, such as "adaafford/PullClosedDoor-v0".

Gymnasium finds the environments of other packages only after these were imported and registered them. Most users of
this package have no use for Gymnasium, so it is not imported here; the ids are registered once it is.
"""

import sys
from collections.abc import Sequence
from contextlib import suppress
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType

GYMNASIUM = "gymnasium"
ANY_TASK = "adaafford/Task-v0"
"""Its argument `task` is the name of a task, or a TOML file."""
ENTRY_POINT = "collector.gym.environment:ObjectEnv"


def register_when_imported() -> None:
    """Register the ids: at once if Gymnasium is imported already, otherwise after its import."""
    if GYMNASIUM in sys.modules:
        register()
    else:
        sys.meta_path.insert(0, _Finder())


def register() -> None:
    """Register one id for each task, ours and those of other packages, and the one for any task."""
    from gymnasium import register as add
    from gymnasium import registry

    from shared.config import RolloutConfig
    from shared.errors import UsageError
    from shared.tasks import TASKS

    ids = dict[str, dict[str, str]]({ANY_TASK: {}})
    with suppress(UsageError):  # Of packages that contradict each other; whoever names a task is told.
        ids |= {env_id(name): {"task": name} for name in TASKS.names()}
    for name, arguments in ids.items():
        if name not in registry:
            add(name, ENTRY_POINT, max_episode_steps=RolloutConfig().context, kwargs=arguments)


def env_id(task: str) -> str:
    """The id of a task, such as "adaafford/PullClosedDoor-v0" of "pull-closed-door"."""
    return f"adaafford/{''.join(word.capitalize() for word in task.split('-'))}-v0"


class _Finder(MetaPathFinder):
    """Finds Gymnasium as the other finders do, and has `register` called after its import."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname != GYMNASIUM:
            return None
        others = (finder for finder in sys.meta_path if finder is not self)
        found = (finder.find_spec(fullname, path, target) for finder in others)
        spec = next((one for one in found if one is not None), None)
        if spec is not None and spec.loader is not None:
            spec.loader = _Registering(spec.loader)
        return spec


class _Registering(Loader):
    """Imports a module by its own loader, and then calls `register`."""

    def __init__(self, loader: Loader) -> None:
        self._loader = loader

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        assert module.__spec__ is not None
        module.__spec__.loader = module.__loader__ = self._loader
        self._loader.exec_module(module)
        register()
