"""JSON from files that nobody vouches for: bounded in size, depth and number of values before any of it is believed."""

import codecs
import json
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import from_json

from shared.errors import StoreError
from shared.io.files import read_bounded
from shared.io.text import MAX_WORD, plain

MAX_VALUES = 1 << 20
"""Of a document: a hostile one has a value in every three bytes, and each takes a hundred bytes of memory and more."""
MAX_PROBLEMS = 1000
"""A document with more is only said to have so many: their list alone could take gigabytes."""

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
            json.loads(data, object_pairs_hook=_refuse_twins)
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


def problem_of(error: ValidationError) -> str:
    """The first thing that is wrong with a document, in a line of bounded length."""
    if error.error_count() > MAX_PROBLEMS:
        return f"{error.error_count()} values are not allowed"
    problem = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = ".".join(map(str, problem["loc"])) or "content"
    return f"{plain(place, MAX_WORD)}: {plain(problem['msg'], 100)}"


def named_twice(pairs: list[tuple[str, Any]]) -> str | None:
    """The first name of an object's pairs that stands there again; None if there is none."""
    seen: set[str] = set()
    for name, _ in pairs:
        if name in seen:
            return name
        seen.add(name)
    return None


def _refuse_twins(pairs: list[tuple[str, Any]]) -> None:
    if (name := named_twice(pairs)) is not None:
        raise ValueError(f"'{plain(name, MAX_WORD)}' occurs twice")
