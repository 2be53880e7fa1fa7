"""Things found by name: ours, those of other packages, and what is said where there is none or one is broken."""

import sys
from pathlib import Path

import pytest

from shared.errors import UsageError
from shared.extensions import Registry


@pytest.fixture
def registry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> "Registry[int]":
    """Of numbers: 'one' is built in, and installed packages add 'two', a word, and one that cannot be imported."""
    (tmp_path / "numbers_of_others.py").write_text("TWO = 2\nWORD = 'word'\n")
    distribution = tmp_path / "others-1.5.dist-info"
    distribution.mkdir()
    (distribution / "METADATA").write_text("Metadata-Version: 2.1\nName: others\nVersion: 1.5\n")
    (distribution / "entry_points.txt").write_text(
        "[adaafford.odd_numbers]\ntwo = numbers_of_others:TWO\nword = numbers_of_others:WORD\nbroken = no_such_one:X\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "numbers_of_others", raising=False)
    return Registry("odd number", int, {"one": 1})


def test_what_packages_add_is_found_beside_ours(registry: "Registry[int]") -> None:
    assert registry.names() == ["one", "broken", "two", "word"]
    assert "numbers_of_others" not in sys.modules
    assert (registry.get("one"), registry.get("two")) == (1, 2)
    assert (registry.package_of("one"), registry.package_of("two")) == (None, "others 1.5")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("three", "unknown odd number 'three'; allowed: one, broken, two, word"),
        ("word", "odd number 'word': 'numbers_of_others:WORD' is no int"),
        ("broken", "odd number 'broken': 'no_such_one:X' cannot be imported (ModuleNotFoundError: No module"),
    ],
)
def test_what_cannot_be_had_is_said_in_one_line(registry: "Registry[int]", name: str, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        registry.get(name)
    assert str(refused.value).startswith(said)


def test_nobody_replaces_what_is_built_in(registry: "Registry[int]", tmp_path: Path) -> None:
    entries = tmp_path / "others-1.5.dist-info" / "entry_points.txt"
    entries.write_text(entries.read_text() + "one = numbers_of_others:TWO\n")
    with pytest.raises(UsageError, match="adds the odd number 'one', which is built in; rename it"):
        registry.names()
