"""JSON documents that carry their own checksum, so that a flipped bit anywhere in them is found."""

import hashlib
import json
from typing import Any

from shared.errors import StoreError

_SEAL = "sha256"


def canonical(content: Any) -> bytes:
    """The one way in which the store writes a JSON value: sorted keys, no NaN, two blanks of indentation."""
    return json.dumps(content, sort_keys=True, indent=2, allow_nan=False, ensure_ascii=True).encode() + b"\n"


def seal(content: dict[str, Any]) -> bytes:
    """The document's bytes, with the checksum of its content added."""
    return canonical(content | {_SEAL: _checksum(content)})


def unseal(data: bytes, source: str) -> dict[str, Any]:
    """The content of a document that `seal` wrote.

    Raises:
        StoreError: it is not JSON, not an object, or not what was sealed, byte for byte.
    """
    content = parse_object(data, source)
    checksum = content.pop(_SEAL, None)
    if checksum != _checksum(content) or seal(content) != data:
        raise StoreError(f"{source}: its checksum does not match; the file is damaged: restore it from a copy")
    return content


def is_sealed(content: dict[str, Any]) -> bool:
    """Whether an object carries the checksum of the rest of it."""
    return content.get(_SEAL) == _checksum({name: value for name, value in content.items() if name != _SEAL})


def parse_object(data: bytes, source: str) -> dict[str, Any]:
    """A JSON object from hostile bytes.

    Raises:
        StoreError: the bytes are something else.
    """
    try:
        content = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{source}: not valid JSON ({str(error)[:80]}); the file is damaged or foreign") from None
    if not isinstance(content, dict):
        raise StoreError(f"{source}: holds no JSON object; the file is damaged or foreign")
    return content


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not JSON")


def _checksum(content: dict[str, Any]) -> str:
    # Without indentation, since only then does Python's fast encoder run.
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
