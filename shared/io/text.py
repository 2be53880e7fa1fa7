"""Text from outside (object ids, categories, part names, links, files) on its way to people: one filter for each place.

Whoever wrote a name must not be able to command the terminal, to forge a line, or to have a spreadsheet or a browser
execute something. Files for programs (Parquet, JSON) keep names as they are.
"""

import html
import re

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
