"""Curves over time in stacked panels, or over another quantity with marks on it, each named at its right edge."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import INK, STYLE, WIDTH, Curve, label_right


@dataclass(frozen=True)
class Panel:
    """One set of axes: the label of its values, and its curves (time,)."""

    label: str
    curves: Sequence[Curve]


@matplotlib.rc_context(STYLE)
def curves_over_time(time: np.ndarray, panels: Sequence[Panel], label: str = "step") -> Figure:
    """Plot panels one above the other over the same time; curves are named at the mean of their last tenth."""
    figure = Figure(figsize=(WIDTH, 0.4 + 2.4 * len(panels)), layout="constrained")
    grid = figure.subplots(len(panels), 1, squeeze=False, sharex=True)[:, 0]
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
