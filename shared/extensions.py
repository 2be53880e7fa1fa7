"""Things that are found by name: those of this project, and those that other packages add by entry points.

A package adds a primitive called "twist" by these lines of its pyproject.toml, and is found once it is installed:

    [project.entry-points."adaafford.primitives"]
    twist = "my_package.twist:TWIST"
"""

import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Generic, TypeVar

from shared.errors import UsageError

Item = TypeVar("Item")


class Registry(Generic[Item]):
    """All things of one kind, by name.

    Args:
        kind: its name in messages, such as "primitive".
        of: the class of all things of this kind.
        built_in: this project's own, which no package can replace. A text "module:attribute" is imported when it is
            first needed.
    """

    def __init__(self, kind: str, of: type[Item], built_in: Mapping[str, Item | str]) -> None:
        self.kind, self.group = kind, f"adaafford.{kind.replace(' ', '_')}s"
        self._of = of
        self._built_in = dict(built_in)
        self._loaded: dict[str, Item] = {}

    def names(self) -> list[str]:
        """The names of this project's things, in their order, then those of other packages; nothing is imported."""
        return [*self._built_in, *sorted(self._foreign())]

    def get(self, name: str) -> Item:
        """The thing called `name`; the package that adds it is imported.

        Raises:
            UsageError: no thing has this name, several packages add it, or its package cannot be imported.
        """
        ours = self._built_in.get(name)
        if isinstance(ours, self._of):
            return ours
        if name not in self._loaded and isinstance(ours, str):
            self._loaded[name] = self._load(EntryPoint(name, ours, self.group))
        if name not in self._loaded:
            entries = self._foreign()
            if name not in entries:
                raise UsageError(f"unknown {self.kind} '{name}'; allowed: {', '.join(self.names())}")
            self._loaded[name] = self._load(entries[name])
        return self._loaded[name]

    def __iter__(self) -> Iterator[Item]:
        """All of them; imports the packages that add any."""
        return map(self.get, self.names())

    def package_of(self, name: str) -> str | None:
        """Name and version of the package that adds it, as "my-package 1.2"; None for one of ours.

        Raises:
            UsageError: there is none.
        """
        if name in self._built_in:
            return None
        self.get(name)
        distribution = self._foreign()[name].dist
        return f"{distribution.name} {distribution.version}" if distribution is not None else "unknown package"

    def _foreign(self) -> dict[str, EntryPoint]:
        """The entry points of other packages, by name.

        Raises:
            UsageError: two packages add one of the same name.
        """
        found: dict[str, EntryPoint] = {}
        for entry in _entry_points(self.group, tuple(sys.path)):
            if entry.name in self._built_in:
                raise UsageError(f"'{entry.value}' adds the {self.kind} '{entry.name}', which is built in; rename it")
            if entry.name in found and found[entry.name].value != entry.value:
                both = f"'{found[entry.name].value}' and '{entry.value}'"
                raise UsageError(f"{both} both add the {self.kind} '{entry.name}'; uninstall one of their packages")
            found[entry.name] = entry
        return found

    def _load(self, entry: EntryPoint) -> Item:
        try:
            item = entry.load()
        except Exception as error:
            why = f"{type(error).__name__}: {error}"
            raise UsageError(f"{self.kind} '{entry.name}': '{entry.value}' cannot be imported ({why})") from error
        if not isinstance(item, self._of):
            raise UsageError(f"{self.kind} '{entry.name}': '{entry.value}' is no {self._of.__name__}")
        return item


@lru_cache(maxsize=64)
def _entry_points(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Those of a group, of what is installed along Python's path; looking through it takes 5 ms, so it is done once."""
    return tuple(entry_points(group=group))


def added_by_packages(used: Iterable[tuple[Registry[Any], str]]) -> tuple[str, ...]:
    """The used things that other packages add, such as "primitive twist: my-package 1.2".

    Args:
        used: the registry and the name of each used thing.

    Raises:
        UsageError: one of them cannot be found.
    """
    packages = [(registry.kind, name, registry.package_of(name)) for registry, name in used]
    return tuple(f"{kind} {name}: {package}" for kind, name, package in packages if package is not None)
