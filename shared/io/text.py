"""Filters for text: of names from outside on their way to people, and of secrets and places in what we say and keep.

Whoever wrote a name must not be able to command the terminal, to forge a line, or to have a spreadsheet or a browser
execute something. Files for programs (Parquet, JSON) keep names as they are.

    without_secrets("http://me:word@host/")        # "http://***@host/"
    without_places("/home/me/runs/a/store", ...)   # "store", where "/home/me/runs/a" is the run

Every message goes through `without_secrets` (`cluster.cli.main`, `cluster.runs.streams`), every text that a run keeps
through both.
"""

import html
import os
import re
from pathlib import Path

_MARKS = re.compile(r"[\\`*\[\]|]")
_FORMULA = ("=", "+", "-", "@")


MAX_WORD = 80
"""Characters of what a file says that a message repeats."""


def plain(text: object, most: int | None = None) -> str:
    """One line for a terminal or a log: letters that show as themselves; all others are written as escapes.

    Control characters, line ends, overrides of the direction of writing and letters without width are such.

    Args:
        text: from outside.
        most: characters of the result; None: all.
    """
    shown = str(text)[:most]
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in shown)[:most]


def short(text: object) -> str:
    """`text` for a one-line message: quoted, without control characters, shortened."""
    quoted = repr(str(text)[: MAX_WORD + 1])
    return quoted if len(quoted) <= MAX_WORD + 2 else quoted[:MAX_WORD] + "...'"


def markdown(text: object) -> str:
    """The same within Markdown, where it is neither a mark, nor HTML, nor the end of a table's cell."""
    return html.escape(_MARKS.sub(r"\\\g<0>", plain(text)), quote=False)


def csv_cell(value: object) -> object:
    """A cell of a CSV file: a text that a spreadsheet would take for a formula is quoted with an apostrophe."""
    if not isinstance(value, str):
        return value
    text = plain(value)
    return f"'{text}" if text.lstrip().startswith(_FORMULA) else text


_USER_INFO = re.compile(
    r"(?<=://)[^/\s'\"]*@"  # user and password of a URL,
    r"|(?<![^\s'\"=(])[^\s/:@'\"=(]+:[^\s/@'\"]+@(?=[\w\[])"  # or of an address without a scheme.
)
_SIGNATURE = re.compile(r"(?i)\b(x-amz-(?:signature|credential|security-token))=[^&\s'\"]+")
_SECRETS = (
    "AWS_SECRET_ACCESS_KEY",
    "AWS_SESSION_TOKEN",
    "AWS_CONTAINER_AUTHORIZATION_TOKEN",
    "RAY_AUTH_TOKEN",
    "HF_TOKEN",
)
"""Variables whose values never belong in a message, in whatever way they came into it."""
_SHORTEST = 8
"""A secret that is shorter is as well part of a word."""
HIDDEN = "***"


def without_secrets(text: str) -> str:
    """The text with user and password of each URL, and the values of secret variables, replaced by "***"."""
    text = _SIGNATURE.sub(rf"\1={HIDDEN}", _USER_INFO.sub(f"{HIDDEN}@", text))
    for name in _SECRETS:
        secret = os.environ.get(name, "")
        if len(secret) >= _SHORTEST:
            text = text.replace(secret, HIDDEN)
    return text


def without_places(text: str, *folders: Path) -> str:
    """The text with paths below some folders made relative to these, and the home folder called "~".

    Args:
        text: of any length.
        folders: such as a run's; the folder itself becomes ".".
    """
    known = {str(name): replacement for folder in folders for name, replacement in _names(folder)}
    home = os.environ.get("HOME", "")
    if len(home) > 1:
        known.setdefault(home, "~")
    # Longer ones first: the run may be below the home folder.
    for name in sorted(known, key=len, reverse=True):
        shown = known[name]
        text = re.sub(rf"(?<![\w./-]){re.escape(name)}/", "" if shown == "." else f"{shown}/", text)
        text = re.sub(rf"(?<![\w./-]){re.escape(name)}(?![\w.-])", shown, text)
    return text


def _names(folder: Path) -> list[tuple[str, str]]:
    """A folder as it was named and as it is, each if it is no part of every other path."""
    return [(str(each), ".") for each in {folder, folder.absolute(), folder.resolve()} if len(str(each)) > 1]
