"""Commands in the documentation: each names options that there are, and all that are required."""

import contextlib
import io
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from cluster.cli import main

ROOT = Path(__file__).parents[2]
PAGES = [
    page
    for pattern in (
        "README.md",
        "docs/*.md",
        "docs/results/README.md",
        "adaafford/pretrained/*/README.md",
        "examples/*.md",
    )
    for page in sorted(ROOT.glob(pattern))
]
FAMILIES = ("bench", "objects", "store", "train")
"""Commands whose first argument chooses a command with options of its own."""
OPTION = re.compile(r"(?<![\w-])--[a-z0-9][a-z0-9.-]*[a-z0-9]")
REQUIRED = re.compile(r"^ *(--[a-z0-9.-]+)(?: [A-Z]\S*)* .*\(required\)", re.MULTILINE)


def commands(page: Path) -> Iterator[str]:
    """The command lines of a page's blocks of code, each without its comment."""
    text = re.sub(r"\\\n\s*", " ", page.read_text())
    for block in re.findall(r"^```[a-z]*\n(.*?)^```|((?:^    .*\n)+)", text, re.DOTALL | re.MULTILINE):
        for line in "".join(block).splitlines():
            if found := re.match(r"\s*(?:[A-Z_]+=\S+ )*adaafford (.*?)(?:\s+#.*)?$", line):
                yield found[1]


@cache
def help_of(name: str) -> str:
    """What a command says of its options."""
    said = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        patch.setenv("COLUMNS", "1000")
        main.run([*name.split(), "--help"])
    return re.sub(r"\x1b\[[0-9;]*m", "", said.getvalue())


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_name_options_that_there_are_and_all_that_are_required(page: Path) -> None:
    for command in commands(page):
        words = command.split()
        said = help_of(" ".join(words[: 2 if words[0] in FAMILIES else 1]))
        known, given = set(OPTION.findall(said)), set(OPTION.findall(command))
        assert given <= known, f"{command}: no option {sorted(given - known)}"
        if "..." not in command:
            missing = set(REQUIRED.findall(said)) - given
            assert not missing, f"{command}: leaves out {sorted(missing)}"


def test_pages_have_commands() -> None:
    assert sum(1 for page in PAGES for _ in commands(page)) > 70
