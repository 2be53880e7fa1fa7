"""Figures and tables, as people and programs read them."""

import io
import json
import math

from rich.console import Console

from shared.formatting import counted, csv_table, finite, markdown_table, number, percent, terminal_table


def test_what_is_no_figure_is_a_dash() -> None:
    assert [percent(None), percent(math.nan), number(None), number(math.nan)] == ["-"] * 4
    assert [number(3), number(0.25), percent(0.7654)] == ["3", "0.250", "76.5"]
    assert percent(0.5, (0.25, 0.75), decimals=0) == "50.0 [25, 75]"
    assert percent(0.5, (0.25, math.nan)) == "50.0"


def test_one_thing_is_counted_in_the_singular() -> None:
    assert [counted(n, "shard") for n in (0, 1, 2)] == ["0 shards", "1 shard", "2 shards"]
    assert [counted(n, "category", "categories") for n in (1, 2)] == ["1 category", "2 categories"]


def test_finite_reaches_every_number_of_nested_values() -> None:
    value = {"a": math.nan, "b": [1.5, -math.inf, {"c": (math.inf, 2)}], "d": "nan", "e": None}
    found = finite(value)
    assert found == {"a": None, "b": [1.5, None, {"c": [None, 2]}], "d": "nan", "e": None}
    json.dumps(found, allow_nan=False)


def test_markdown_aligns_first_columns_to_the_left() -> None:
    assert markdown_table(("a", "b"), [("x", "1")]) == ["| a | b |", "| --- | ---: |", "| x | 1 |"]
    assert markdown_table(("a", "b"), [], left=0)[1] == "| ---: | ---: |"


def test_csv_has_full_precision_and_leaves_out_what_only_programs_read() -> None:
    rows = [{"name": "=x", "share": 1 / 3, "counts": [1], "none": None}]
    assert csv_table(rows, ["counts"]) == "name,share,none\n'=x,0.3333333333333333,\n"
    assert csv_table([]) == "\n"


def test_a_terminal_table_shows_names_as_they_are() -> None:
    console = Console(file=io.StringIO(), record=True, width=60)
    console.print(terminal_table("[b]t\x1b", ("name", "f"), [("[red]x[/]\x07", 0.5), ("y", None)]))
    text = console.export_text()
    assert "[red]x[/]" in text and "[b]t" in text and "0.500" in text
    assert "\x1b" not in text and "\x07" not in text
