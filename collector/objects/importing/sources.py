"""The files of an object from outside: below its folder, and below the folders that the user names beside it."""

import os
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

from collector.objects.files import ObjectFiles
from collector.objects.urdf_bodies import listed
from shared.errors import ObjectError, UsageError
from shared.io.text import short

SCHEMES = ("package", "model", "file")


class SourceFiles:
    """Finds files by the names that other files give them, and reads none from anywhere else.

    Args:
        folder: of the object's own file.
        search: further folders (`--search-path`), asked in their order.

    Raises:
        UsageError: one of the further folders is none.
    """

    def __init__(self, folder: Path, search: Sequence[Path] = ()) -> None:
        for each in search:
            if not each.is_dir():
                raise UsageError(f"--search-path {each}: no such folder; name one that holds the object's other files")
        self.folder = folder
        self._roots = tuple(ObjectFiles(Path(os.path.normpath(each.absolute()))) for each in (folder, *search))
        self._elsewhere: list[str] = []

    def find(self, name: str, most_bytes: int) -> tuple[str, bytes] | None:
        """The path below one of the folders, and the contents, of the file that is called `name`; None if it is absent.

        Args:
            name: a path relative to one of the folders, an absolute one, or a URI of `SCHEMES`.
            most_bytes: that it may have.

        Raises:
            ObjectError: it is in none of the folders, cannot be read, or is too large.
        """
        parts, exact, inside = self._places(name)
        for files, path in exact:
            if files.is_file(path):
                return path, files.read(path, most_bytes)
        for files in self._roots:
            for end in ("/".join(parts[k:]) for k in range(len(parts))):
                if files.is_file(end):
                    self._elsewhere.append(short(name))
                    return end, files.read(end, most_bytes)
        if inside:
            return None
        raise ObjectError(
            f"the file {short(name)} is in none of the folders that may be read ({self._named()}); name the folder "
            "that it is in by --search-path"
        )

    def notes(self) -> Iterator[str]:
        """What was found under another path."""
        if self._elsewhere:
            yield f"{len(self._elsewhere)} files found by the ends of their paths ({listed(self._elsewhere)})"

    def _places(self, name: str) -> tuple[tuple[str, ...], list[tuple[ObjectFiles, str]], bool]:
        """The parts of the path that may be looked for; where it may be; whether it is meant to be in the folders."""
        scheme, separator, rest = name.partition("://")
        if separator and scheme not in SCHEMES:
            raise ObjectError(f"the file {short(name)} has a scheme other than {', '.join(SCHEMES)}; copy it here")
        path = (unquote(rest) if separator else name).replace("\\", "/")
        parts = PurePosixPath(path).parts
        outside = [k for k, part in enumerate(parts) if part in ("..", "/", "//") or part.endswith(":")]
        plain = parts[max(outside, default=-1) + 1 :]
        if separator and scheme != "file":
            exact = [(files, "/".join(parts)) for files in self._roots]
            exact += [(files, "/".join(parts[1:])) for files in self._roots if parts[:1] == (files.folder.name,)]
            # The package's own folder may have another name here, so that a file in it is found by the path's end.
            return plain if outside else plain[1:], exact, False
        if outside and parts[outside[-1]].endswith(":"):
            return plain, [], False
        starts = [Path("/")] if path.startswith("/") else [files.folder for files in self._roots]
        exact = [
            (files, os.path.relpath(place, files.folder))
            for place in (os.path.normpath(start / path) for start in starts)
            for files in self._roots
            if Path(place).is_relative_to(files.folder)
        ]
        return plain, exact, bool(exact)

    def _named(self) -> str:
        return ", ".join(str(files.folder) for files in self._roots)
