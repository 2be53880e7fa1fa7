"""A store under a prefix of a bucket, by the protocol of S3.

There is neither rename nor lock, and none is needed: objects appear whole, and every write is conditional ("only if
nothing is there"), so that of several writers of one key the first wins and nothing is ever overwritten. A folder is
written straight under its name and counts once its mark is there. Where a file of it is there already, from a writer
that is dead or at work at this moment, that file is taken over, if its content is the same.
"""

import os
import re
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

from obstore.exceptions import AlreadyExistsError, BaseError, GenericError, PreconditionError
from obstore.store import S3Store

from shared.errors import MissingError, StoreError, UnreadableError, UsageError
from shared.io.text import without_secrets
from shared.store.backends.base import URL_SCHEME, StorageBackend, Transaction
from shared.store.presence import present

AT_ONCE = 16
"""Requests under way at the same time; each waits for the network most of its time."""
WINDOW = 8 * AT_ONCE
"""Answers that may wait to be used."""
MAX_RETRIES = 10
RETRY_TIMEOUT_S = 120
REQUEST_TIMEOUT_S = 60
PAGE = 1000
"""Keys that one listing request returns at most, by the protocol."""
_URL = re.compile(r"s3://(?P<bucket>[a-z0-9][a-z0-9.-]{1,61}[a-z0-9])(?:/(?P<prefix>[A-Za-z0-9._/-]*))?")
_CREDENTIALS = (
    "AWS_ACCESS_KEY_ID",
    "AWS_CONTAINER_CREDENTIALS_RELATIVE_URI",
    "AWS_CONTAINER_CREDENTIALS_FULL_URI",
    "AWS_WEB_IDENTITY_TOKEN_FILE",
    "AWS_SKIP_SIGNATURE",
)
"""One of these must be set: otherwise the client would ask the network for credentials, and wait for minutes."""

Answer = TypeVar("Answer")


class S3Backend(StorageBackend):
    """A prefix of a bucket."""

    writes_in_place = True

    def __init__(self, where: str, client: Any) -> None:
        self.where = where
        self._client = client
        self._pool: ThreadPoolExecutor | None = None

    @classmethod
    def of(cls, url: str) -> "S3Backend":
        """The storage backend of a URL; credentials and endpoint are the environment's AWS_* variables.

        Raises:
            UsageError: the URL is not allowed, or there are no credentials.
        """
        bucket, prefix = _parsed(url)
        if not any(os.environ.get(name) for name in _CREDENTIALS):
            raise UsageError(f"{url}: no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")
        endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL") or ""
        try:
            client = S3Store(
                bucket,
                prefix=prefix or None,
                client_options={
                    "allow_http": endpoint.startswith("http://"),
                    "timeout": timedelta(seconds=REQUEST_TIMEOUT_S),
                },
                retry_config={"max_retries": MAX_RETRIES, "retry_timeout": timedelta(seconds=RETRY_TIMEOUT_S)},
            )
        except (BaseError, ValueError) as error:
            raise UsageError(f"{url}: {_line(error)}; check the AWS_* variables") from None
        return cls(f"{URL_SCHEME}{bucket}/{prefix}".rstrip("/"), client)

    def is_there(self) -> bool:
        """See `StorageBackend.is_there`: prefixes always are, and that the bucket is not is an error of its own."""
        self.names("")
        return True

    def read(self, key: str, limit: int) -> bytes:
        def get() -> bytes:
            answer = self._client.get(key)
            if answer.meta["size"] > limit:
                raise StoreError(
                    f"{self._at(key)}: larger than the {limit} bytes that it may have; it is foreign or damaged"
                )
            return bytes(answer.bytes())

        return self._ask(get, key)

    def read_all(self, wanted: Sequence[tuple[str, int]]) -> Iterator[bytes]:
        if len(wanted) < 2:
            return (self.read(key, limit) for key, limit in wanted)
        return self._map(lambda pair: self.read(*pair), wanted)

    def exists(self, key: str) -> bool:
        try:
            self._ask(lambda: self._client.head(key), key, missing_is_error=False)
        except FileNotFoundError:
            return False
        return True

    def exist(self, keys: Sequence[str]) -> Iterator[bool]:
        return self._map(self.exists, keys)

    def names(self, folder: str) -> list[str]:
        found = self._ask(lambda: self._client.list_with_delimiter(folder or None), folder)
        keys = [*found["common_prefixes"], *(entry["path"] for entry in found["objects"])]
        return sorted({key.rstrip("/").rpartition("/")[2] for key in keys})

    def names_from(self, folder: str, first: str) -> Iterator[str]:
        """See `StorageBackend.names_from`; some pages of keys, however many there are before and after."""
        pages = self._client.list(f"{folder}/", offset=f"{folder}/{first}", chunk_size=PAGE)
        last = ""
        while page := self._ask(lambda: next(pages, None), folder):
            for entry in page:
                name = entry["path"].removeprefix(f"{folder}/").partition("/")[0]
                if name != last:
                    yield name
                last = name

    def leaves(self, folder: str) -> list[str]:
        pages = self._ask(lambda: list(self._client.list(folder or None, chunk_size=PAGE)), folder)
        return sorted(entry["path"] for page in pages for entry in page)

    def create(self, key: str, data: bytes) -> bool:
        try:
            # One request each: a multipart upload could not be conditional with every server.
            self._ask(lambda: self._client.put(key, data, mode="create", use_multipart=False), key)
        except (AlreadyExistsError, PreconditionError):
            return False
        return True

    def replace(self, key: str, data: bytes) -> None:
        self._ask(lambda: self._client.put(key, data, use_multipart=False), key)

    def upload(self, key: str, path: Path) -> None:
        """Write a file of this machine, in parts if it is large, so that it is never in memory; also over another."""
        self._ask(lambda: self._client.put(key, path), key)

    def remove(self, key: str) -> None:
        try:
            self._ask(lambda: self._client.delete(key), key, missing_is_error=False)
        except FileNotFoundError:
            return

    def publish(self, transaction: Transaction) -> bool:
        folder, mark = transaction.folder, f"{transaction.folder}/{transaction.mark}"
        transaction.check()

        def put(file: tuple[str, bytes]) -> bytes:
            key = f"{folder}/{file[0]}"
            # A file of that name may be larger than ours: its rows hold wall times, which compress differently.
            return file[1] if self.create(key, file[1]) else self.read(key, 2 * len(file[1]) + (1 << 16))

        held = dict(zip(transaction.files, self._map(put, list(transaction.files.items())), strict=True))
        return self.create(mark, transaction.describe(held))

    def move(self, key: str, new: str) -> None:
        """See `StorageBackend.move`: everything is copied before anything goes."""
        leaves = self.leaves(key) or ([key] if self.exists(key) else [])
        for leaf in leaves:
            target = new + leaf[len(key) :]
            self._ask(lambda leaf=leaf, target=target: self._client.copy(leaf, target), leaf)  # type: ignore[misc]
        # The mark, a document directly in the folder, goes first: from then on the folder does not count.
        for leaf in sorted(leaves, key=lambda leaf: (leaf.count("/"), not leaf.endswith(".json"), leaf)):
            self._ask(lambda leaf=leaf: self._client.delete(leaf), leaf)  # type: ignore[misc]

    def sweep(self, folders: Sequence[str]) -> int:
        """See `StorageBackend.sweep`; here unfinished folders stay, for whoever finishes them."""
        return 0

    def only_one(self, name: str, *, alone: bool = False) -> AbstractContextManager[Any]:
        """See `StorageBackend.only_one`; several drivers do no harm here, they only do the same work twice."""
        return present(self, name, alone=alone)

    def _map(self, act: Callable[[Any], Answer], items: Sequence[Any]) -> Iterator[Answer]:
        if self._pool is None:
            self._pool = ThreadPoolExecutor(AT_ONCE, thread_name_prefix="bucket")
        # In windows, since a pool would otherwise fetch all of a large store before the first answer is used.
        for start in range(0, len(items), WINDOW):
            yield from self._pool.map(act, items[start : start + WINDOW])

    def _ask(self, request: Callable[[], Answer], key: str, *, missing_is_error: bool = True) -> Answer:
        """Do a request, with one line for whatever may go wrong after all retries."""
        try:
            return request()
        except (FileNotFoundError, GenericError) as error:
            if "NoSuchBucket" in str(error):
                raise UnreadableError(f"{self.where}: there is no such bucket; create it, or name another") from None
            if not isinstance(error, FileNotFoundError):
                raise self._out_of_reach(key, error) from None
            if not missing_is_error:
                raise
            raise MissingError(f"{self._at(key)}: there is no such object; restore it from a copy") from None
        except (AlreadyExistsError, PreconditionError):
            raise
        except (BaseError, OSError) as error:
            raise self._out_of_reach(key, error) from None

    def _out_of_reach(self, key: str, error: Exception) -> UnreadableError:
        return UnreadableError(f"{self._at(key)}: {_line(error)}; check the network and the AWS_* variables")

    def _at(self, key: str) -> str:
        return f"{self.where}/{key}" if key else self.where


def _parsed(url: str) -> tuple[str, str]:
    """Bucket and prefix of a URL."""
    scheme, _, rest = url.partition("://")
    if "@" in rest:
        # Never repeated in a message, since it would end in a log.
        raise UsageError(f"{scheme}://: a URL may hold no credentials; set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY")
    match = _URL.fullmatch(url)
    if match is None or {"", ".", ".."} & set((match["prefix"] or "x").rstrip("/").split("/")):
        raise UsageError(f"{url[:100]}: no place for a store; allowed: a folder, or s3://BUCKET/PREFIX")
    return match["bucket"], (match["prefix"] or "").rstrip("/")


def _line(error: Exception) -> str:
    """An error of the client in one line of bounded length."""
    return without_secrets(" ".join(str(error).split("\n\nDebug source")[0].split()))[:200]
