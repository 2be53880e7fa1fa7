"""What messages and files must not hold: secrets, and where things lie on somebody's machine.

    without_secrets("http://me:word@host/")        # "http://***@host/"
    without_places("/home/me/runs/a/store", ...)   # "store", where "/home/me/runs/a" is the run

Every message goes through the first one (`cluster.cli.main`, `cluster.runs.streams`), every text that a run keeps
through both.
"""

import os
import re
from pathlib import Path

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
