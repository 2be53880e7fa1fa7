"""Names from outside on their way to people: no command for a terminal, no forged line, no HTML, no formula."""

import csv
import io
import logging

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cluster.cli.main import run as adaafford
from cluster.runs.streams import JsonLines, Lines
from shared.formatting import csv_table
from shared.io.text import csv_cell, markdown, plain

HOSTILE = "a\x1b]0;x\x07\r\nforged\u202etxt\u200b|<img src=x onerror=y>[red]`=1+1"


@given(st.text())
def test_plain_text_is_one_line_of_letters_that_show(text: str) -> None:
    assert plain(text).isprintable()
    assert text.isprintable() <= (plain(text) == text)


@given(st.text())
def test_markdown_has_neither_html_nor_the_end_of_a_cell(text: str) -> None:
    shown = markdown(text)
    assert not {"<", ">", "\n"} & set(shown)
    assert all(shown[k - 1] == "\\" for k, letter in enumerate(shown) if letter in "|`*[]")


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@sum", " =1", "\t=1", "\r=1"])
def test_a_spreadsheet_takes_no_text_for_a_formula(text: str) -> None:
    ((cell,),) = list(csv.reader(io.StringIO(csv_table([{"name": text}]))))[1:]
    assert cell[0] not in "=+-@\t\r " or cell.startswith("\\")
    assert csv_cell(-1.5) == -1.5
    assert csv_cell("ours-final") == "ours-final"


def test_logs_and_errors_show_no_control_characters(capsys: pytest.CaptureFixture[str]) -> None:
    record = logging.LogRecord("cluster", logging.WARNING, "x", 1, "object %s", (HOSTILE,), None)
    assert Lines("adaafford: %(message)s").format(record) == f"adaafford: object {plain(HOSTILE)}"
    assert JsonLines().format(record).isprintable()
    adaafford([HOSTILE])
    assert capsys.readouterr().err.rstrip("\n").isprintable()
