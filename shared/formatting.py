"""Numbers and tables: for people in Markdown and on a terminal, for programs in CSV and JSON.

None and NaN are shown as "-"; CSV leaves them empty, and JSON has null.
"""

import csv
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from shared.io.text import csv_cell, plain

if TYPE_CHECKING:
    from rich.table import Table


def percent(share: float | None, limits: Sequence[float | None] = (), decimals: int = 1) -> str:
    """A share in percent, "76.6", and its interval if it has one, "76.6 [71.2, 80.9]".

    Args:
        share: between 0 and 1, as a rule.
        limits: where the interval begins and ends.
        decimals: of the limits.
    """
    if share is None or math.isnan(share):
        return "-"
    known = [limit for limit in limits if limit is not None and not math.isnan(limit)]
    interval = f" [{', '.join(f'{100 * limit:.{decimals}f}' for limit in known)}]" if len(known) == 2 else ""
    return f"{100 * share:.1f}{interval}"


def counted(count: int, one: str, several: str = "") -> str:
    """A number of things, such as "1 shard" and "2 shards"."""
    return f"{count} {one if count == 1 else several or f'{one}s'}"


def number(value: float | None) -> str:
    """An integer unchanged, any other number with three decimals."""
    if value is None or math.isnan(value):
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def finite(value: Any) -> Any:
    """A value of nested mappings and sequences, in which every number that is not finite is None: JSON has no NaN."""
    if isinstance(value, Mapping):
        return {key: finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> list[str]:
    """The lines of a Markdown table.

    Args:
        head: names of the columns, as Markdown.
        rows: cells, as Markdown; texts from outside have gone through `shared.io.text.markdown`.
        left: how many of the first columns are aligned to the left; all others to the right.
    """
    alignment = ["---"] * left + ["---:"] * (len(head) - left)
    return [f"| {' | '.join(cells)} |" for cells in (head, alignment, *rows)]


def csv_table(rows: Sequence[Mapping[str, Any]], left_out: Iterable[str] = ()) -> str:
    """A CSV file with a line for each row, in full precision; the first row names the columns."""
    names = [name for name in (rows[0] if rows else ()) if name not in frozenset(left_out)]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(names)
    writer.writerows([csv_cell(row[name]) for name in names] for row in rows)
    return text.getvalue()


def terminal_table(title: str, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> "Table":
    """A table for a rich console, its first column aligned to the left and the others to the right.

    Args:
        title: what it shows.
        head: names of the columns.
        rows: texts as they are, and figures, which are formatted as `number` does.
    """
    from rich.table import Table
    from rich.text import Text

    # As plain text: names may hold what rich takes for markup, or a terminal for commands.
    table = Table(title=Text(plain(title)))
    for name in head:
        table.add_column(name, justify="right" if table.columns else "left")
    for row in rows:
        table.add_row(*(Text(plain(cell) if isinstance(cell, str) else number(cell)) for cell in row))
    return table
