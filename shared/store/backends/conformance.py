"""Whether a place does what commits rely on: of several writers of one key exactly one wins, and its file is there."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from threading import Barrier

from shared.errors import StoreError
from shared.io.files import temporary_name
from shared.store.backends.base import StorageBackend

WRITERS = 8
ROUNDS = 3
_BYTES = 4096
"""Size of the test files."""


def check_place(backend: StorageBackend, writers: int = WRITERS, rounds: int = ROUNDS) -> None:
    """Let several writers create one key at the same time, again and again; nothing is left behind.

    Args:
        backend: one that exists; only new keys are used, named like unfinished files.
        writers: of each key.
        rounds: of a new key each.

    Raises:
        StoreError: the place breaks a promise of `StorageBackend`, or is out of reach.
    """
    with ThreadPoolExecutor(writers) as pool:
        for _ in range(rounds):
            key = temporary_name("check")
            try:
                _check_key(backend, key, pool, writers)
            except StoreError:
                # Where writing is not allowed, removing is not, either; the first reason is the one to tell.
                with suppress(StoreError):
                    backend.remove(key)
                raise
            backend.remove(key)
            if backend.exists(key):
                raise _broken(backend, "a file is still there after it was removed")


def _check_key(backend: StorageBackend, key: str, pool: ThreadPoolExecutor, writers: int) -> None:
    contents = [bytes([writer]) * _BYTES for writer in range(writers)]
    ready = Barrier(writers)

    def create(content: bytes) -> bool:
        ready.wait()
        return backend.create(key, content)

    won = [content for content, made in zip(contents, pool.map(create, contents), strict=True) if made]
    if len(won) != 1:
        raise _broken(
            backend, f"{len(won)} of {writers} concurrent writers of one new file were told that they made it"
        )
    if backend.create(key, b"late"):
        raise _broken(backend, "a writer was told that it made a file that was there already")
    if backend.read(key, _BYTES) != won[0]:
        raise _broken(backend, "a file does not hold what its one successful writer wrote")
    if key not in backend.names(""):
        raise _broken(backend, "a file is not listed directly after it was written")


def _broken(backend: StorageBackend, what: str) -> StoreError:
    return StoreError(
        f"{backend.where}: {what}, so a store here could lose data; a bucket needs a server that obeys "
        '"If-None-Match: *" also for concurrent puts, a folder a file system with hard links'
    )
