"""Figure of what sensors are worth: how many times the error is, of each state, in each case."""

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from heliograph.disk.quoted_text import label_with_unit, quote_for_figure
from heliograph.numerics.types import units_in
from heliograph.planning.sensor_worth import SensorWorth
from heliograph.report.figures import BLUE, GREEN, INK, STYLE, VERMILION, make_stacked_panels

BAR = 0.6  # height of a bar
NARROW = 4.0  # ratio of an axis's ends below which 1, 2, 5, 10, ... would give only one or two ticks
SPARE, ROOM = 0.05, 0.2  # share of the axis left free before all bars, and behind them for numbers


@matplotlib.rc_context(STYLE)
def draw_worth(worth: SensorWorth, title: str) -> Figure:
    """Draw a panel for each state with a bar for each case: the case's error over the error with all nodes.

    The axis is logarithmic. A bar to the right of 1 is a larger error, such as without a node. A bar to the left is a
    smaller error, such as with one more node.

    Args:
        worth: errors with all nodes and in each case, at least one.
        title: how errors were found, in words.
    """
    rows = len(worth.cases)
    figure, panels = make_stacked_panels(len(worth.states), height=0.55 + 0.26 * rows, margin=0.5)
    figure.suptitle(title, fontsize=10, x=0.01, ha="left")
    units, limits = units_in(worth.states), _find_limits(worth)
    for i, panel in enumerate(panels):
        _draw_bars_of_state(panel, worth, i, limits)
        state = label_with_unit(str(worth.states[i]), units)
        panel.set_title(f"{state}: with all nodes {worth.complete.error[i]:.3g}")
    panels[-1].set_xlabel("times the error with all nodes")
    return figure


def _draw_bars_of_state(axes: Axes, worth: SensorWorth, i: int, limits: tuple[float, float]) -> None:
    """Draw a bar for each case, the first one above: the error of state i over that with all nodes.

    Beside each bar stands its number, and if errors were drawn its standard error. `limits`: ends of the axis. A case
    is the network with a node left out, out for a while, or added. `case.increase` (states,) is its error over that
    with all nodes (`worth.complete.error`), and `case.uncertainty` the standard error of its error.
    """
    increase = np.array([case.increase[i] for case in worth.cases])
    lengths = np.where(np.isfinite(increase) & (increase > 0), increase, 1.0)  # no bar where it is not known
    heights = np.arange(len(lengths))
    axes.barh(heights, lengths - 1.0, left=1.0, height=BAR, color=[VERMILION if x > 1 else GREEN for x in lengths])
    if not worth.exact:
        errors = np.array([case.uncertainty[i] for case in worth.cases]) / worth.complete.error[i]
        axes.errorbar(lengths, heights, xerr=errors, fmt="none", ecolor=INK, elinewidth=1.0)
    for height, times in enumerate(increase):  # a column of numbers at the end of the rows
        words = f"{times:.3g}" if np.isfinite(times) else "not known"
        axes.text(limits[1], height, words, va="center", ha="right", fontsize=9, color=INK)
    axes.axvline(1.0, color=BLUE, linewidth=1.0)
    axes.set_yticks(heights, [quote_for_figure(case.name) for case in worth.cases])
    axes.set_ylim(len(lengths) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")
    _scale_axis(axes, limits)


def _scale_axis(axes: Axes, limits: tuple[float, float]) -> None:
    """Make the axis of factors logarithmic between these limits, with ticks at plain numbers.

    If the limits' ratio is below NARROW (4), ticks are evenly spaced, since few powers would lie between them.
    """
    low, high = limits
    axes.set_xscale("log")
    axes.set_xlim(low, high)
    is_narrow = high < NARROW * low
    axes.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]) if is_narrow else LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(FuncFormatter(lambda times, _: f"{times:g}"))
    axes.xaxis.set_minor_locator(NullLocator())


def _find_limits(worth: SensorWorth) -> tuple[float, float]:
    """Return the ends of all panels' axes, a little beyond the bars and with room for their numbers.

    A bar goes from 1 to the factor `increase`. SPARE and ROOM are shares of the bars' span, in logarithms.
    `worth.cases`: the network with a node left out, out for a while, or added.
    """
    increases = np.array([case.increase for case in worth.cases])
    ends_of_bars = np.append(increases[np.isfinite(increases) & (increases > 0)], 1.0)
    low, high = ends_of_bars.min(), ends_of_bars.max()
    span = max(float(np.log(high / low)), np.log(2.0))
    return float(low * np.exp(-SPARE * span)), float(high * np.exp(ROOM * span))
