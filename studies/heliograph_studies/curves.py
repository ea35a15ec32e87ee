"""Figures of studies: curves over time or another quantity, paths, errors in their bands, and graphs of nodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, INK, MUTED, PALE, STYLE, WIDTH, make_stacked_panels


@dataclass(frozen=True)
class Curve:
    """A named curve in one colour: values (time,), or (time, 2) for a path; `deviation` alike, if claimed."""

    name: str
    colour: str
    values: np.ndarray
    deviation: np.ndarray | None = None


@dataclass(frozen=True)
class Panel:
    """One set of axes: the label of its values, and its curves (time,)."""

    label: str
    curves: Sequence[Curve]


@matplotlib.rc_context(STYLE)
def curves_over_time(time: np.ndarray, panels: Sequence[Panel], label: str = "step") -> Figure:
    """Plot panels one above the other over the same time; curves are named at the mean of their last tenth."""
    figure, grid = make_stacked_panels(len(panels), 2.4, 0.4)
    for axes, panel in zip(grid, panels, strict=True):
        for curve in panel.curves:
            axes.plot(time, curve.values, color=curve.colour, linewidth=1.4)
        axes.set(ylabel=panel.label, xlim=(time[0], time[-1]))
        tail = max(len(time) // 10, 1)
        ends = {c.name: c.values[~np.isnan(c.values)][-tail:] for c in panel.curves}  # some end before the others
        label_right(axes, {c.name: (float(ends[c.name].mean()), c.colour) for c in panel.curves})
    grid[-1].set_xlabel(label)
    return figure


@matplotlib.rc_context(STYLE)
def curves_over(
    where: np.ndarray, panel: Panel, label: str, marks: Mapping[str, float] | None = None, logarithmic: bool = True
) -> Figure:
    """Plot curves in one panel over the values `where`, with axis label `label` and named places `marks` on it."""
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes = figure.subplots()
    for curve in panel.curves:
        axes.plot(where, curve.values, color=curve.colour, linewidth=1.6)
    axes.set(xlabel=label, ylabel=panel.label, xlim=(where[0], where[-1]), yscale="log" if logarithmic else "linear")
    for name, place in (marks or {}).items():
        axes.axvline(place, color=INK, linewidth=1.0, linestyle=(0, (4, 1.6)))
        axes.text(place, 1.01, name, transform=axes.get_xaxis_transform(), ha="center", va="bottom", fontsize=9)
    ends = {c.name: (float(c.values[np.isfinite(c.values)][-1]), c.colour) for c in panel.curves}
    label_right(axes, ends)
    return figure


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


@matplotlib.rc_context(STYLE)
def graph_map(
    positions: Mapping[str, np.ndarray],
    neighbours: Mapping[str, Sequence[str]],
    values: Mapping[str, float],
    label: str,
    sensors: Sequence[str],
) -> Figure:
    """Plot nodes at their positions, coloured by value; circles for those among `sensors`, squares for the others."""
    figure = Figure(figsize=(WIDTH, 0.95 * WIDTH), layout="constrained")
    axes = figure.subplots()
    lines = [(positions[a], positions[b]) for a, mine in neighbours.items() for b in mine]
    axes.add_collection(LineCollection(lines, colors=PALE, linewidths=0.7, zorder=1))
    # One scale of colours; 1, an error as large as the claim, is its middle.
    reach = max(abs(value - 1) for value in values.values()) or 1.0
    for marker, names in (("o", [n for n in values if n in sensors]), ("s", [n for n in values if n not in sensors])):
        if names:
            x, y = np.array([positions[n] for n in names]).T
            limits = {"cmap": "RdBu_r", "vmin": 1 - reach, "vmax": 1 + reach}
            shown: Any = {"marker": marker, "edgecolors": INK, "linewidths": 0.8, "zorder": 2, **limits}
            dots = axes.scatter(x, y, s=70, c=[values[n] for n in names], **shown)
    figure.colorbar(dots, ax=axes, label=label, shrink=0.8)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)
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
