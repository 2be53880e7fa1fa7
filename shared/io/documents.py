"""JSON from files that nobody vouches for: bounded in size, depth and number of values before any of it is believed.

Documents of a store carry their own checksum, so that a flipped bit anywhere in them is found.
"""

import codecs
import hashlib
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails, from_json

from shared.errors import StoreError
from shared.io.files import read_bounded
from shared.io.text import MAX_WORD, plain

MAX_VALUES = 1 << 20
"""Of a document: a hostile one has a value in every three bytes, and each takes a hundred bytes of memory and more."""
MAX_PROBLEMS = 1000
"""A document with more is only said to have so many: their list alone could take gigabytes."""
VALUE_ERROR = "Value error, "
"""What pydantic puts before the message of a check."""

Model = TypeVar("Model", bound=BaseModel)


def parse_object(data: bytes, source: str, values: int = MAX_VALUES, *, unique: bool = False) -> dict[str, Any]:
    """A JSON object from hostile bytes, of bounded depth and without NaN.

    Args:
        data: UTF-8.
        source: what messages call it.
        values: the most that it may hold.
        unique: refuse a key that stands twice in an object; otherwise the last one counts.

    Raises:
        StoreError: the bytes are something else.
    """
    if data.count(b",") + data.count(b"[") + data.count(b"{") > values:
        raise StoreError(f"{source}: holds more than {values} values; the file is damaged or foreign")
    data = data.removeprefix(codecs.BOM_UTF8)
    try:
        # Unlike the standard library's parser, this one has a limit of depth that does not depend on the caller's
        # stack.
        content = from_json(data, allow_inf_nan=False)
        if unique:
            json.loads(data, object_pairs_hook=refuse_twins)
    except (ValueError, RecursionError) as error:
        raise StoreError(f"{source}: not valid JSON ({str(error)[:100]}); the file is damaged or foreign") from None
    if not isinstance(content, dict):
        raise StoreError(f"{source}: holds no JSON object; the file is damaged or foreign")
    return content


def parse_document(model: type[Model], data: bytes, source: str, remedy: str) -> Model:
    """A model from hostile JSON.

    Args:
        model: what the document must be.
        data: UTF-8.
        source: what messages call it.
        remedy: what a message tells the user to do.

    Raises:
        StoreError: the bytes are something else.
    """
    try:
        return model.model_validate(parse_object(data, source, unique=True))
    except ValidationError as error:
        raise StoreError(f"{source}: {problem_of(error)}; {remedy}") from None


def read_document(model: type[Model], path: Path, limit: int, remedy: str) -> Model:
    """A model from a file of at most `limit` bytes; raises as `parse_document` and `read_bounded` do."""
    return parse_document(model, read_bounded(path, limit), str(path), remedy)


def json_lines(lines: Iterable[str | bytes]) -> Iterator[dict[str, Any]]:
    """The JSON objects among some lines; one that a kill tore, or that is something else, is left out."""
    for line in lines:
        try:
            found = json.loads(line)
        except (ValueError, RecursionError):
            continue
        if isinstance(found, dict):
            yield found


def reason_of(problem: ErrorDetails) -> str:
    """What is wrong with a value, in the words of the check that refused it."""
    return problem["msg"].removeprefix(VALUE_ERROR)


def problem_of(error: ValidationError) -> str:
    """The first thing that is wrong with a document, in a line of bounded length."""
    if error.error_count() > MAX_PROBLEMS:
        return f"{error.error_count()} values are not allowed"
    problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(map(str, problem["loc"])) or "content"
    return f"{plain(place, MAX_WORD)}: {plain(reason_of(problem), 100)}"


def refuse_twins(pairs: list[tuple[str, Any]]) -> None:
    """Refuse an object of JSON in which a name stands twice: an `object_pairs_hook` that raises ValueError."""
    seen: set[str] = set()
    for name, _ in pairs:
        if name in seen:
            raise ValueError(f"the name '{plain(name, MAX_WORD)}' occurs twice")
        seen.add(name)


_MAX_VALUE = 60


def difference_of(stored: dict[str, Any], given: dict[str, Any]) -> str:
    """The first setting that differs, with both values, and how many more do."""
    found = [f"{name}: the store has {ours}, given {theirs}" for name, ours, theirs in differences(stored, given)]
    more = f" (and {len(found) - 1} more)" if len(found) > 1 else ""
    return (found[0] if found else "they are equal") + more


def differences(before: Any, after: Any, name: str = "") -> Iterator[tuple[str, str, str]]:
    """Every setting that differs between two documents of `name`: its name, and both values, shortened."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in dict.fromkeys([*before, *after]):
            yield from differences(before.get(key), after.get(key), f"{name}.{key}" if name else key)
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for k, (old, new) in enumerate(zip(before, after, strict=True)):
            yield from differences(old, new, f"{name}[{k}]")
    elif isinstance(before, list) and isinstance(after, list):
        yield name, f"{len(before)} entries", str(len(after))
    elif before != after:
        yield name, _brief(before), _brief(after)


def _brief(value: Any) -> str:
    text = "nothing" if value is None else str(value)
    return text if len(text) <= _MAX_VALUE else f"{text[:_MAX_VALUE]}..."


_SEAL = "sha256"


def canonical(content: Any) -> bytes:
    """The one way in which the store writes a JSON value: sorted keys, no NaN, two blanks of indentation."""
    return json.dumps(content, sort_keys=True, indent=2, allow_nan=False, ensure_ascii=True).encode() + b"\n"


def with_checksum(content: dict[str, Any]) -> bytes:
    """The document's bytes, with the checksum of its content added."""
    return canonical(content | {_SEAL: _checksum(content)})


def checked_content(content: dict[str, Any], data: bytes, source: str) -> dict[str, Any]:
    """The content of a document that `with_checksum` wrote, and that is parsed already.

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
