"""docs/walkthrough.md and docs/glossary.md name files and functions that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MODULE = re.compile(r"`([a-z]+/[a-z0-9_/]+\.py)`")
NAME = re.compile(r"`(?:[A-Za-z_]+\.)?([A-Za-z_]\w*)`")


@pytest.mark.parametrize("page", ["walkthrough.md", "glossary.md"])
def test_every_module_that_a_page_names_is_there(page: str) -> None:
    named = MODULE.findall((ROOT / "docs" / page).read_text())
    assert named
    assert [path for path in named if not (ROOT / path).is_file()] == []


def test_every_step_names_functions_of_its_file() -> None:
    page = (ROOT / "docs/walkthrough.md").read_text()
    rows = re.findall(r"^\| (`[a-z/_0-9`., ]+?) \| (`[^|]+) \| [^|]+ \|$", page, re.MULTILINE)
    assert len(rows) > 30
    for files, names in rows:
        text = "".join((ROOT / path).read_text() for path in MODULE.findall(files))
        missing = [name for name in NAME.findall(names) if not re.search(rf"\b{name}\b *[(:=\[]|class {name}\b", text)]
        assert not missing, f"{files}: {missing}"
