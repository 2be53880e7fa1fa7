"""Reading the files of an object's folder, which came from outside: regular, small enough, and inside the folder."""

import stat
from pathlib import Path

from shared.errors import ObjectError


def short(text: object, length: int = 80) -> str:
    """`text` as it may stand in a one-line message: quoted, without control characters, not too long."""
    quoted = repr(str(text)[: length + 1])
    return quoted if len(quoted) <= length + 2 else quoted[:length] + "...'"


class ObjectFiles:
    """The files below one object's folder.

    Example:
        >>> files = ObjectFiles(Path("objects/149"))
        >>> urdf = files.read("mobility.urdf", 2 << 20)
    """

    def __init__(self, folder: Path) -> None:
        if not folder.is_dir():
            raise ObjectError(f"{folder}: no such folder; name an object's folder that holds mobility.urdf")
        self.folder = folder
        self._root = folder.resolve()

    def exists(self, name: str) -> bool:
        """Whether there is a file (or a link to one, wherever that may lead) called `name`."""
        return self._path(name).is_file()

    def read(self, name: str, most_bytes: int) -> bytes:
        """The bytes of the file called `name`, a path relative to the folder.

        Raises:
            ObjectError: it is missing, no regular file, outside the folder, unreadable or over `most_bytes`.
        """
        path = self._path(name)
        try:
            resolved = path.resolve(strict=True)
            if not resolved.is_relative_to(self._root):
                raise ObjectError(f"{self.folder}: {short(name)} is a link that leads out of the object's folder")
            status = resolved.stat()
            if not stat.S_ISREG(status.st_mode):
                raise ObjectError(f"{self.folder}: {short(name)} is not a regular file")
            if status.st_size > most_bytes:
                raise ObjectError(f"{self.folder}: {short(name)} has {status.st_size} bytes; at most {most_bytes}")
            return resolved.read_bytes()
        except FileNotFoundError:
            raise ObjectError(f"{self.folder}: {short(name)} is missing") from None
        except (OSError, RuntimeError) as error:
            raise ObjectError(f"{self.folder}: {short(name)} cannot be read ({type(error).__name__})") from None

    def _path(self, name: str) -> Path:
        relative = Path(name)
        if not name or "\0" in name or "\\" in name or relative.is_absolute() or ".." in relative.parts:
            raise ObjectError(f"{self.folder}: {short(name)} is not a plain path below the object's folder")
        return self.folder / relative
