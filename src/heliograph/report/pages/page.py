"""Self-contained HTML page made of sections of blocks: text, key figures, tables, pictures and code."""

import re
from base64 import b64encode
from collections.abc import Sequence
from dataclasses import dataclass

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from typing_extensions import TypeAliasType

VERDICTS = {"fails": "fails", "does_not_apply": "does not apply", "holds_vacuously": "true but empty", "holds": "holds"}


@dataclass(frozen=True)
class Text:
    """Paragraphs; `**strong**` and backquoted code are marked up, all other text is literal."""

    paragraphs: Sequence[str]
    kind: str = "text"


@dataclass(frozen=True)
class Points:
    """A list of points, with the markup of paragraphs."""

    points: Sequence[str]
    kind: str = "points"


@dataclass(frozen=True)
class KeyFigure:
    """A number to remember: its name, the number with its unit, and its colour in the figures."""

    label: str
    value: str
    note: str
    colour: str


@dataclass(frozen=True)
class KeyFigures:
    """Numbers to remember, side by side."""

    figures: Sequence[KeyFigure]
    kind: str = "key_figures"


@dataclass(frozen=True)
class Table:
    """Rows of cells under headers; the first column names the row, with a dot in its colour if `colours` are given.

    Cells are numbers, set to the right, unless `wordy`: then they are set to the left and broken into lines. On a phone
    a table that is too wide is moved sideways under its first column, which stays. `links` are addresses of what the
    rows are about.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    colours: Sequence[str] | None = None
    wordy: bool = False
    links: Sequence[str] | None = None
    kind: str = "table"


@dataclass(frozen=True)
class Judged:
    """A statement, its place in a paper, the printed value, the value found, and the verdict.

    `verdict` is one of VERDICTS.
    """

    text: str
    source: str
    printed: str
    result: str
    verdict: str

    @property
    def word(self) -> str:
        """Return the verdict in words."""
        return VERDICTS[self.verdict]


@dataclass(frozen=True)
class Statements:
    """Statements with their verdicts, in the order of the publication, readable at any width."""

    statements: Sequence[Judged]
    kind: str = "statements"


@dataclass(frozen=True)
class Picture:
    """An SVG figure with a caption, and a description for those who do not see it."""

    svg: bytes
    description: str
    caption: str = ""
    kind: str = "picture"

    @property
    def address(self) -> str:
        """Return the picture as a data URL, so that the page needs no other file."""
        return "data:image/svg+xml;base64," + b64encode(self.svg).decode()


@dataclass(frozen=True)
class Choice:
    """Pictures of which one is shown, chosen from a list by its name; all of them in print and where no script runs."""

    label: str
    names: Sequence[str]
    pictures: Sequence[Picture]
    kind: str = "choice"


@dataclass(frozen=True)
class Code:
    """Lines to type or to read."""

    text: str
    kind: str = "code"


Block = TypeAliasType("Block", Text | Points | KeyFigures | Table | Statements | Picture | Choice | Code)


@dataclass(frozen=True)
class Section:
    """A titled part of the page; `kind` is its CSS class."""

    title: str
    blocks: Sequence[Block]
    kind: str = ""


@dataclass(frozen=True)
class Page:
    """A page: a kicker above its title, a lead below, sections, and a footer."""

    kicker: str
    title: str
    lead: str
    sections: Sequence[Section]
    footer: str = ""

    @property
    def has_choice(self) -> bool:
        """Test whether something is chosen from a list, which takes a script."""
        return any(block.kind == "choice" for section in self.sections for block in section.blocks)

    def html(self) -> str:
        """Return the page as HTML that loads nothing else."""
        return make_environment().get_template("page.html.j2").render(page=self)


def make_environment() -> Environment:
    """Return the environment of this room's templates, in which all values are escaped."""
    templates = Environment(
        loader=PackageLoader("heliograph.report.pages", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    templates.filters["rich"] = rich
    return templates


def rich(text: str) -> Markup:
    """Escape a text, then mark up `**strong**` and backquoted code."""
    safe = re.sub(r"(?<=\d) (?=%|± |m\b|s\b)", "\u00a0", str(escape(text)))  # a number stays with what belongs to it
    safe = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", safe)
    return Markup(re.sub(r"`(.+?)`", r"<code>\1</code>", safe))
