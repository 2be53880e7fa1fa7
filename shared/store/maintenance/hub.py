"""The Hugging Face Hub: an export as a data set there, by the package huggingface_hub, which nothing else needs.

The token is taken from HF_TOKEN alone, and the server from HF_ENDPOINT, if that is set.
"""

import importlib
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from shared.errors import UsageError
from shared.extras import require_packages
from shared.io.text import plain

TOKEN = "HF_TOKEN"  # noqa: S105 - the variable's name.
_REPO = r"[A-Za-z0-9][A-Za-z0-9._-]{0,95}/[A-Za-z0-9][A-Za-z0-9._-]{0,95}"
_LONGEST = 200
_REASONS = {401: f"the token in {TOKEN} is not accepted", 403: f"the token in {TOKEN} may not write there"}
"""By the status of an answer."""
_LATER = "try again later"


def pusher(repo: str, leave: str) -> Callable[[Path], None]:
    """What puts a folder on the Hub; whatever can be known before the work starts is checked here.

    Args:
        repo: "USER/NAME" of the data set, which is made where it is not there.
        leave: name of a folder within that is not put there.

    Raises:
        UsageError: it is no such name, the package is not installed, or there is no token. What is returned
            raises it, too, where the server refuses or cannot be reached.
    """
    if not re.fullmatch(_REPO, repo):
        raise UsageError(f"--push '{plain(repo, _LONGEST)}': is no name of a data set; give USER/NAME")
    require_packages("--push", "huggingface_hub")
    if not os.environ.get(TOKEN):
        raise UsageError(f"--push needs a token that may write; put it into the environment as {TOKEN}")

    def push(folder: Path) -> None:
        hub: Any = importlib.import_module("huggingface_hub")
        api = hub.HfApi(endpoint=os.environ.get("HF_ENDPOINT") or None, token=os.environ[TOKEN])
        try:
            api.create_repo(repo, repo_type="dataset", exist_ok=True)
            api.upload_folder(repo_id=repo, folder_path=folder, repo_type="dataset", ignore_patterns=[f"{leave}/*"])
        except Exception as error:
            status = getattr(getattr(error, "response", None), "status_code", None)
            lines = str(error).strip().splitlines() or [type(error).__name__]
            why = _LATER if status and status >= 500 else _REASONS.get(status or 0, plain(lines[0], _LONGEST))
            answer = "the Hub cannot be reached" if status is None else f"the Hub answered {status}"
            raise UsageError(f"--push {repo}: {answer} ({why}); the same command goes on") from error

    return push
