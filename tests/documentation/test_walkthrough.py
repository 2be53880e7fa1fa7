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


def test_the_page_counts_the_files_that_it_names() -> None:
    page = (ROOT / "docs/walkthrough.md").read_text()
    steps, dispatch = page.partition("## Dispatch")[::2]
    named = set(MODULE.findall(steps))
    added = set(MODULE.findall(dispatch.partition("## How a new policy")[0])) - named
    skipped = set(MODULE.findall(page.partition("## How many files")[2]))
    assert skipped < named
    assert f"Steps 1 to 6 name {len(named)} files." in page
    assert f"takes {len(named - skipped)} of them" in page
    assert f"Dispatch adds {len(added)}." in page
