"""Page for exploring a table: axes, panels, colours and values to choose, drawn by Bokeh, which the page contains."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from importlib.resources import files

from markupsafe import Markup

from heliograph.report.pages.page import Page, make_template_environment

LIBRARY = ("bokeh.min.js", "bokeh-api.min.js")  # 1.4 MB without its widgets; Plotly's one file has 4.8 MB
STATIC = "static"  # sections of this kind are seen in print, and where no script runs

Value = float | str | bool | None


@dataclass(frozen=True)
class PlotColumn:
    """A column that can be plotted.

    Args:
        name: name of the column.
        label: what the axis is called.
        error: name of the column of its standard error; "" for none.
        level: where a reference line is drawn; None for none.
    """

    name: str
    label: str
    error: str = ""
    level: float | None = None


@dataclass(frozen=True)
class ExploredTable:
    """A table by columns, and the first view of it.

    Args:
        name: distinguishes it from the others on the page.
        columns: values of each column by its name.
        dimensions: columns that identify a row, in the order in which they are offered.
        quantities: columns that can be plotted.
        x: dimension along the x axis in the first view.
        panel: dimension with a panel for each value.
        colour: dimension with a colour for each value.
        whole: dimensions of which the first view shows all values; of the others it shows the first.
        unordered: a dimension without an order, so that points along it are not connected.
    """

    name: str
    columns: Mapping[str, Sequence[Value]]
    dimensions: Sequence[str]
    quantities: Sequence[PlotColumn]
    x: str
    panel: str
    colour: str
    whole: Sequence[str]
    unordered: str


def make_explorable_page_html(page: Page, tables: Sequence[ExploredTable]) -> str:
    """Return the HTML of a page with tables to explore before its sections.

    It contains the tables as JSON, the program that draws them and the plotting library, so that it loads nothing else.
    `tables`: columns by name, and which of them the first view shows; `page`: the page's title, text and sections.
    """
    data = json.dumps([asdict(table) for table in tables], ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return (
        make_template_environment()
        .get_template("explore.html.j2")
        .render(
            page=page,
            data=Markup(data.replace("<", "\\u003c")),  # no text can end the script
            library=Markup("\n".join(_read_bokeh_script(name) for name in LIBRARY)),
            program=Markup(files("heliograph.report.pages").joinpath("explore.js").read_text(encoding="utf-8")),
        )
    )


def _read_bokeh_script(name: str) -> str:
    """Return a script of the installed Bokeh, to be written into the page."""
    return files("bokeh").joinpath("server", "static", "js", name).read_text(encoding="utf-8")
