"""What was forced to the disk, so that it is there after a power cut."""

import os
from pathlib import Path

import pytest


class Synced:
    """Records every `os.fsync` of this process."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._inodes: set[int] = set()
        fsync = os.fsync

        def recorded(descriptor: int) -> None:
            self._inodes.add(os.fstat(descriptor).st_ino)
            fsync(descriptor)

        monkeypatch.setattr(os, "fsync", recorded)

    def lacks(self, folder: Path) -> list[str]:
        """Files and folders, from the folder that holds this one down, that a power cut may have emptied."""
        found = [folder.parent, folder, *folder.rglob("*")]
        return [str(path) for path in found if path.stat().st_ino not in self._inodes]
