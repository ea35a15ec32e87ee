"""Figures in one style, without global state: draw one, then export it as `png` or `svg`."""

from collections.abc import Mapping, Sequence
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


@matplotlib.rc_context(STYLE)
def paths(truth: np.ndarray, curves: Sequence[Curve], beacons: np.ndarray) -> Figure:
    """Plot paths on a map in metres, one panel for each, over the true path."""
    # A metre is as long across as along: a panel is as high as the paths are for their width, at most a square.
    extent = np.ptp(np.concatenate([truth, beacons, *(c.values[np.isfinite(c.values).all(1)] for c in curves)]), axis=0)
    height = WIDTH / len(curves) * min(1.0, max(0.25, extent[1] / extent[0])) if extent[0] > 0 else WIDTH / len(curves)
    figure = Figure(figsize=(WIDTH, height + 0.9), layout="constrained")
    row = figure.subplots(1, len(curves), squeeze=False, sharex=True, sharey=True)[0]
    for axes, curve in zip(row, curves, strict=True):
        (true,) = axes.plot(*truth.T, color=PALE, linewidth=3.5)
        axes.plot(*curve.values.T, color=curve.colour, linewidth=0.9)
        (marks,) = axes.plot(*beacons.T, "^", color=AMBER, markeredgecolor=INK, markersize=8, zorder=5)
        axes.set(aspect="equal", xlabel="x (m)")
        axes.set_title(curve.name, color=curve.colour)
    row[0].margins(0.08)
    row[0].set_ylabel("y (m)")
    figure.legend([true, marks], ["true path", "beacon"], loc="outside lower right", ncols=2, frameon=False)
    return figure


@matplotlib.rc_context(STYLE)
def errors_with_bands(
    time: np.ndarray, curves: Sequence[Curve], components: Sequence[str], sigmas: float = 2.0, unit: str = "m"
) -> Figure:
    """Plot the signed error of each curve (row) and component (column) in its claimed band of +-`sigmas` deviations.

    Shapes: time (time,) s from the start; values and deviation of each curve (time, component).
    """
    figure = Figure(figsize=(WIDTH, 0.6 + 1.4 * len(curves)), layout="constrained")
    grid = figure.subplots(len(curves), len(components), squeeze=False, sharex=True, sharey=True)
    # One panel for each curve and component: error e and the band +- sigmas sqrt(P_ii).
    for row, curve in zip(grid, curves, strict=True):
        for i, (axes, component) in enumerate(zip(row, components, strict=True)):
            if curve.deviation is not None:
                band = sigmas * curve.deviation[:, i]
                axes.fill_between(time, -band, band, color=curve.colour, alpha=0.25, linewidth=0)
            axes.plot(time, curve.values[:, i], color=curve.colour, linewidth=0.8)
            axes.axhline(0.0, color=MUTED, linewidth=0.6)
            axes.set_title(f"{curve.name}: {component}", color=curve.colour)
        row[0].set_ylabel(f"error ({unit})")
    for axes in grid[-1]:
        axes.set_xlabel("time (s)")
    # Axes are symmetric around zero and common to all panels.
    largest = max(abs(limit) for limit in axes.get_ylim())
    axes.set(xlim=(0.0, time[-1]), ylim=(-largest, largest))
    return figure


@matplotlib.rc_context(STYLE)
def consistency_over_time(time: np.ndarray, curves: Sequence[Curve], window: int) -> Figure:
    """Plot each curve's NEES per dimension (time,), averaged over `window` rows, on a logarithmic axis; ideal is 1."""
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    axes.axhline(1.0, color=INK, linewidth=1.0, linestyle=(0, (4, 1.6)))
    middle = time[window // 2 : window // 2 + len(time) - window + 1]
    lines = [np.convolve(curve.values, np.full(window, 1 / window), mode="valid") for curve in curves]
    for curve, line in zip(curves, lines, strict=True):
        axes.plot(middle, line, color=curve.colour, linewidth=1.4)
    axes.set(yscale="log", xlabel="time (s)", ylabel="NEES per dimension", xlim=(0.0, time[-1]))
    ends = {curve.name: (float(line[-1]), curve.colour) for curve, line in zip(curves, lines, strict=True)}
    label_right(axes, ends | {"1: right": (1.0, INK)})
    return figure


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
