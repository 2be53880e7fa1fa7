"""What a page is made of, and how it becomes one HTML file that needs no network.

Texts come from files that nobody has vouched for: object ids, categories, reasons, names of stages. The template
escapes all of them; texts within a figure are escaped by `plain`; and the page's own policy lets nothing run but its
two scripts, named by their hashes, so that even a text that slipped through could do nothing.
"""

import base64
import hashlib
import html
from dataclasses import dataclass, field
from importlib.resources import files

import plotly.graph_objects as go
from jinja2 import Environment, PackageLoader, StrictUndefined
from plotly.offline import get_plotlyjs

MAX_TEXT = 200
"""Characters of a text from a file that are shown."""


@dataclass(frozen=True, slots=True)
class Tile:
    """One figure that a reader should see first."""

    value: str
    label: str


@dataclass(frozen=True, slots=True)
class Cell:
    """One cell of a table.

    Attributes:
        text: what it says.
        note: in smaller letters below, such as an interval.
        kind: how it looks: "", "name", "best" or "paper".
        span: columns that it takes.
    """

    text: str
    note: str = ""
    kind: str = ""
    span: int = 1


Row = tuple[Cell, ...]


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    Attributes:
        head: rows of headings.
        body: the rest.
        caption: what it shows.
        folded: whether it is shown only when asked for; `caption` is then what one clicks on.
    """

    head: tuple[Row, ...]
    body: tuple[Row, ...]
    caption: str = ""
    folded: bool = False


@dataclass(frozen=True, slots=True)
class Picture:
    """A picture."""

    png: bytes
    caption: str

    @property
    def url(self) -> str:
        """The picture within the page."""
        return f"data:image/png;base64,{base64.b64encode(self.png).decode()}"


@dataclass(frozen=True, slots=True)
class Drawing:
    """A plotly figure.

    Attributes:
        figure: whose texts went through `plain`.
        caption: what it shows.
        tab: what the button that shows it says; drawings of a section that have one share a place.
        solid: whether it is in three dimensions: it takes graphics memory while it is in view.
    """

    figure: go.Figure
    caption: str = ""
    tab: str = ""
    solid: bool = False

    @property
    def json(self) -> str:
        """The figure for a script element: JSON without any character that HTML could mistake."""
        text = str(self.figure.to_json())
        return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")

    @property
    def height(self) -> int:
        """Of the figure, pixels."""
        return int(self.figure.layout.height)


@dataclass(frozen=True, slots=True)
class Section:
    """One part of the page, with its own heading.

    Attributes:
        key: its anchor: letters and hyphens.
        title: its heading.
        lead: paragraphs that come first.
        pictures: its pictures.
        tables: its tables; those that are folded come last.
        drawings: its figures.
    """

    key: str
    title: str
    lead: tuple[str, ...] = ()
    pictures: tuple[Picture, ...] = ()
    tables: tuple[Table, ...] = ()
    drawings: tuple[Drawing, ...] = ()

    @property
    def tabs(self) -> tuple[str, ...]:
        """What the buttons say."""
        return tuple(drawing.tab for drawing in self.drawings if drawing.tab)


@dataclass(frozen=True, slots=True)
class Page:
    """The whole report."""

    title: str
    subtitle: str
    tiles: tuple[Tile, ...]
    sections: tuple[Section, ...]
    facts: tuple[tuple[str, str], ...] = field(default=())
    """Name and value, at the foot: what made it."""


def render(page: Page) -> str:
    """The page as HTML with everything inside."""
    environment = Environment(
        loader=PackageLoader("cluster.reporting"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    own, library = _asset("report.js"), get_plotlyjs()
    assert "</script" not in library.lower(), "plotly.js does not end its own script element"
    policy = (
        "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'; "
        f"script-src {_hash(library)} {_hash(own)}"
    )
    return environment.get_template("report.html.j2").render(
        page=page, policy=policy, style=_asset("report.css"), library=library, script=own
    )


def plain(text: str) -> str:
    """A text from a file for a figure, where plotly would take tags for format and brackets for templates."""
    return html.escape(shortened(text)).replace("%", "&#37;").replace("$", "&#36;")


def shortened(text: str) -> str:
    """One line of bounded length."""
    line = " ".join(text.split())
    return line if len(line) <= MAX_TEXT else f"{line[: MAX_TEXT - 1]}…"


def _asset(name: str) -> str:
    return files("cluster.reporting").joinpath("templates", name).read_text(encoding="utf-8")


def _hash(script: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()}'"
