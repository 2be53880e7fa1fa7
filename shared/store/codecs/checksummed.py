"""JSON documents that carry their own checksum, so that a flipped bit anywhere in them is found."""

import hashlib
import json
from typing import Any

from shared.errors import StoreError
from shared.io.documents import parse_object

_SEAL = "sha256"


def canonical(content: Any) -> bytes:
    """The one way in which the store writes a JSON value: sorted keys, no NaN, two blanks of indentation."""
    return json.dumps(content, sort_keys=True, indent=2, allow_nan=False, ensure_ascii=True).encode() + b"\n"


def with_checksum(content: dict[str, Any]) -> bytes:
    """The document's bytes, with the checksum of its content added."""
    return canonical(content | {_SEAL: _checksum(content)})


def without_checksum(data: bytes, source: str) -> dict[str, Any]:
    """The content of a document that `with_checksum` wrote.

    Raises:
        StoreError: it is not JSON, not an object, or not what was sealed, byte for byte.
    """
    return checked_content(parse_object(data, source), data, source)


def checked_content(content: dict[str, Any], data: bytes, source: str) -> dict[str, Any]:
    """The same of a document that is parsed already.

    Raises:
        StoreError: it is not what was sealed, byte for byte.
    """
    checksum = content.pop(_SEAL, None)
    if checksum != _checksum(content) or with_checksum(content) != data:
        raise StoreError(f"{source}: its checksum does not match; the file is damaged: restore it from a copy")
    return content


def has_checksum(content: dict[str, Any]) -> bool:
    """Whether an object carries the checksum of the rest of it."""
    return content.get(_SEAL) == _checksum({name: value for name, value in content.items() if name != _SEAL})


def _checksum(content: dict[str, Any]) -> str:
    # Without indentation, since only then does Python's fast encoder run.
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
