"""Figures in one style, without global state: draw one, then export it as `png` or `svg`."""

from collections.abc import Mapping
from dataclasses import dataclass
from io import BytesIO
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, MUTED, PALE, GRID = "#1f2933", "#66727f", "#bcc4cd", "#e4e7eb"
# Okabe and Ito's palette, which people with colour blindness can tell apart.
BLUE, VERMILION, GREEN, PURPLE, AMBER = "#0072b2", "#d55e00", "#009e73", "#b05c92", "#e69f00"
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


@dataclass(frozen=True)
class Curve:
    """A named curve in one colour: values (time,), or (time, 2) for a path; `deviation` alike, if claimed."""

    name: str
    colour: str
    values: np.ndarray
    deviation: np.ndarray | None = None


def label_right(axes: Axes, ends: Mapping[str, tuple[float, str]], gap: float = 0.065) -> None:
    """Name curves at the right edge, at (value, colour), at least `gap` of the axis apart."""
    to_axes = axes.transData + axes.transAxes.inverted()
    names = sorted(ends, key=lambda name: ends[name][0])
    heights = np.array([to_axes.transform((0.0, ends[name][0]))[1] for name in names])
    for _ in range(100):  # each pass shares what is missing between the two neighbours
        missing = np.maximum(gap - np.diff(heights), 0.0) / 2
        heights += np.append(0.0, missing) - np.append(missing, 0.0)
    for name, height in zip(names, heights, strict=True):
        axes.text(1.015, height, name, transform=axes.transAxes, va="center", color=ends[name][1], fontsize=9)


def legend_above(figure: Figure, axes: Axes, columns: int = 4) -> None:
    """Place the legend of `axes` above all panels."""
    handles, names = axes.get_legend_handles_labels()
    local = axes.get_legend()
    if local is not None:
        local.remove()
    if names:
        figure.legend(handles, names, loc="outside upper center", ncols=min(len(names), columns), frameon=False)


@matplotlib.rc_context(STYLE)
def png(figure: Figure, dots_per_inch: int = 150) -> bytes:
    """Export the figure as PNG."""
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=dots_per_inch, facecolor="white")
    return buffer.getvalue()


@matplotlib.rc_context(STYLE)
def svg(figure: Figure) -> bytes:
    """Export the figure as SVG with its text as outlines, the same bytes for the same figure."""
    buffer = BytesIO()
    figure.savefig(buffer, format="svg", facecolor="white", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()
