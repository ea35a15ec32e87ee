"""Figures in one style, without global state: draw one, then export it as `png` or `svg`."""

from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from heliograph.disk.colours_of_figures import COLOURS as COLOURS
from heliograph.numerics.check import check_count, instance

INK, PALE, GRID = "#1f2933", "#bcc4cd", "#e4e7eb"
BLUE, VERMILION, GREEN, PURPLE, AMBER, MUTED = COLOURS
DENSE = 1000  # points from which a line or a band is drawn as pixels in an SVG file
RASTER = 200  # pixels per inch of those
WIDTH = 5.4  # inches: 10 points are still 9 pixels high in a window of 420
STYLE: Any = {  # of matplotlib's rcParams
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "text.color": INK,
    "axes.edgecolor": MUTED,
    "axes.labelcolor": INK,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelsize": 9,
    "ytick.labelsize": 9,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "heliograph",  # the same drawing gives the same file
}


def make_stacked_panels(count: int, height: float, margin: float, sharex: bool = True) -> tuple[Figure, list[Axes]]:
    """Return a figure and its `count` panels, one below the other.

    Args:
        count: how many panels.
        height: height of a panel in inches.
        margin: height in inches for labels and the legend.
        sharex: whether all panels have the same x axis.
    """
    figure = Figure(figsize=(WIDTH, margin + height * count), layout="constrained")
    return figure, list(figure.subplots(count, 1, squeeze=False, sharex=sharex)[:, 0])


def place_legend_above(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Place the legend of the curves in `axes` above all panels, in at most `columns` columns."""
    handles, names = axes.get_legend_handles_labels()
    legend = axes.get_legend()
    if legend is not None:
        legend.remove()
    if names:
        figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), columns), frameon=False)


@matplotlib.rc_context(STYLE)
def png(figure: Figure, dots_per_inch: int = 150) -> bytes:
    """Return the bytes of a figure as a PNG file.

    Args:
        figure: a figure of matplotlib.
        dots_per_inch: how fine it is (default 150).

    Raises:
        ValueError: `figure` is no figure, or `dots_per_inch` no positive integer.
    """
    instance("figure", figure, Figure, "a figure of matplotlib")
    dots_per_inch = check_count("dots per inch", dots_per_inch, 1)
    buffer, old_dpi = BytesIO(), figure.dpi
    figure.set_facecolor("white")
    figure.dpi = dots_per_inch
    canvas: Any = FigureCanvasAgg(figure)  # it draws once, where savefig lays out and draws twice
    canvas.print_png(buffer)
    figure.dpi = old_dpi
    return buffer.getvalue()


@matplotlib.rc_context(STYLE)
def svg(figure: Figure) -> bytes:
    """Return the bytes of a figure as an SVG file; the same figure gives the same bytes.

    Text is drawn as outlines, and dense lines as pixels.

    Args:
        figure: a figure of matplotlib.

    Raises:
        ValueError: `figure` is no figure.
    """
    instance("figure", figure, Figure, "a figure of matplotlib")
    buffer, old_dpi = BytesIO(), figure.dpi
    figure.set_facecolor("white")
    _rasterise_dense(figure)
    figure.dpi = RASTER  # resolution of lines and bands that are pixels
    canvas: Any = FigureCanvasSVG(figure)
    canvas.print_svg(buffer, metadata={"Date": None, "Creator": None})
    figure.dpi = old_dpi
    return buffer.getvalue()


def _rasterise_dense(figure: Figure) -> None:
    """Let lines and bands of more than DENSE points be drawn as pixels, so that long data do not make a file long."""
    for line in figure.findobj(Line2D):
        assert isinstance(line, Line2D)
        line.set_rasterized(len(np.atleast_1d(line.get_xdata())) > DENSE)
    for band in figure.findobj(PolyCollection):
        assert isinstance(band, PolyCollection)
        band.set_rasterized(sum(np.shape(path.vertices)[0] for path in band.get_paths()) > DENSE)
