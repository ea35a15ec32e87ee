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
    """Text in paragraphs.

    Args:
        paragraphs: one text each; `**strong**` and backquoted code are marked up, all other text is literal.
    """

    paragraphs: Sequence[str]
    kind = "text"  # of block, for the template


@dataclass(frozen=True)
class Points:
    """A list of points.

    Args:
        points: one text each, with the markup of paragraphs.
    """

    points: Sequence[str]
    kind = "points"  # of block, for the template


@dataclass(frozen=True)
class KeyFigure:
    """A number to remember.

    Args:
        label: its name.
        value: the number with its unit.
        note: what is said below it.
        colour: its colour in the figures.
    """

    label: str
    value: str
    note: str
    colour: str


@dataclass(frozen=True)
class KeyFigures:
    """Numbers to remember, side by side.

    Args:
        figures: the numbers, from left to right.
    """

    figures: Sequence[KeyFigure]
    kind = "key_figures"  # of block, for the template


@dataclass(frozen=True)
class Table:
    """Rows of cells under headers. On a phone a table that is too wide is moved sideways under its first column.

    Args:
        headers: one for each column.
        rows: cells of each row; the first names it.
        caption: what is said below ("" for nothing).
        colours: of a dot before the name of each row; None for no dots.
        wordy: whether cells are words, set to the left and broken into lines, not numbers, set to the right.
        links: addresses of what the rows are about; None for none.
    """

    headers: Sequence[str]
    rows: Sequence[Sequence[str]]
    caption: str = ""
    colours: Sequence[str] | None = None
    wordy: bool = False
    links: Sequence[str] | None = None
    kind = "table"  # of block, for the template


@dataclass(frozen=True)
class Judged:
    """A statement of a publication, judged.

    Args:
        text: the statement.
        source: its place in the publication.
        printed: the printed value.
        result: the value found.
        verdict: one of VERDICTS.
    """

    text: str
    source: str
    printed: str
    result: str
    verdict: str

    @property
    def word(self) -> str:
        """Return the verdict in words, such as "does not apply"."""
        return VERDICTS[self.verdict]


@dataclass(frozen=True)
class Statements:
    """Statements with their verdicts, readable at any width.

    Args:
        statements: in the order of the publication.
    """

    statements: Sequence[Judged]
    kind = "statements"  # of block, for the template


@dataclass(frozen=True)
class Picture:
    """A figure.

    Args:
        svg: the figure as SVG.
        description: for those who do not see it.
        caption: what is said below ("" for nothing).
    """

    svg: bytes
    description: str
    caption: str = ""
    kind = "picture"  # of block, for the template

    @property
    def address(self) -> str:
        """Return the picture as a data URL, so that the page needs no other file."""
        return "data:image/svg+xml;base64," + b64encode(self.svg).decode()


@dataclass(frozen=True)
class PictureChoice:
    """Pictures of which one is shown, chosen from a list; all of them in print and where no script runs.

    Args:
        label: what is chosen.
        names: one for each picture.
        pictures: the pictures.
    """

    label: str
    names: Sequence[str]
    pictures: Sequence[Picture]
    kind = "choice"  # of block, for the template


@dataclass(frozen=True)
class Code:
    """Lines to type or to read.

    Args:
        text: the lines.
    """

    text: str
    kind = "code"  # of block, for the template


Block = TypeAliasType("Block", Text | Points | KeyFigures | Table | Statements | Picture | PictureChoice | Code)


@dataclass(frozen=True)
class Section:
    """A titled part of the page.

    Args:
        title: its title.
        blocks: what stands in it, from above.
        kind: its CSS class ("" for none).
    """

    title: str
    blocks: Sequence[Block]
    kind: str = ""


@dataclass(frozen=True)
class Page:
    """A page of sections.

    Args:
        kicker: what stands above the title.
        title: the title.
        lead: what stands below it.
        sections: the parts of the page.
        footer: what stands at its end ("" for nothing).
    """

    kicker: str
    title: str
    lead: str
    sections: Sequence[Section]
    footer: str = ""

    @property
    def has_choice(self) -> bool:
        """Return whether a picture is chosen from a list, for which the page needs a script."""
        return any(block.kind == "choice" for section in self.sections for block in section.blocks)

    def html(self) -> str:
        """Return the page as HTML that loads nothing else."""
        return make_template_environment().get_template("page.html.j2").render(page=self)


def make_template_environment() -> Environment:
    """Return the environment of Jinja for this package's templates, in which all values are escaped for HTML.

    The filter `rich` marks up **strong** words and code; a name that a template does not get is an error.
    """
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
    """Return a text as HTML: escaped, then with `**strong**` and backquoted code marked up."""
    html = str(escape(text))
    # A number stays on one line with the unit, per cent or ± that belongs to it.
    html = re.sub(r"(?<=\d) (?=%|± |m\b|s\b)", "\u00a0", html)
    html = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", html)
    html = re.sub(r"`(.+?)`", r"<code>\1</code>", html)
    return Markup(html)
