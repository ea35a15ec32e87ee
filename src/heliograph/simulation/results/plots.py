"""Plots of results on axes of matplotlib, given or new: one for each state."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.disk.quoting import in_figure
from heliograph.numerics.check import check_count, fail

# Okabe and Ito's palette, which people with colour blindness can tell apart; then grey.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#b05c92", "#e69f00", "#66727f")
FAR = 10.0  # times the best filter's error: from there an axis is logarithmic

if TYPE_CHECKING:  # an extra
    from matplotlib.axes import Axes

    from heliograph.simulation.results.record import Record
    from heliograph.simulation.results.statistics_by_name import StatisticsByName


def plot_record(
    record: "Record",
    node: str | None,
    filters: Sequence[str] | None,
    states: Sequence[str] | None,
    axes: "Axes | Sequence[Axes] | None",
    run: int,
    sigmas: float,
) -> "list[Axes]":
    """Draw estimates with their claimed bands, and the truth."""
    # What is drawn, on which axes.
    node, filters = _chosen(record.estimates, node, filters)
    places = _places(states, record.states)
    if record.runs is not None and check_count("run", run, 0) >= record.runs:
        raise fail("run", f"one of {record.runs}, counted from 0", run)
    which: Any = ... if record.runs is None else run
    drawn = _axes(axes, len(places), record.time, record.units)
    # Mean and +- sigmas claimed deviations, then the truth.
    for panel, i in zip(drawn, places, strict=True):
        for number, name in enumerate(filters):
            estimate, colour = record.estimates[node][name], _colour(number)
            mean = np.asarray(estimate.mean)[which][..., i]
            variance = np.asarray(estimate.covariance)[which][..., i, i]
            panel.plot(record.time, mean, color=colour, label=in_figure(name))
            if estimate.claim != "none":
                band = sigmas * np.sqrt(np.where(variance >= 0, variance, np.nan))
                panel.fill_between(record.time, mean - band, mean + band, color=colour, alpha=0.2, linewidth=0)
        if record.truth is not None:
            panel.plot(record.time, record.truth[which][..., i], color="0.25", linestyle=":", label="truth")
        panel.set_ylabel(_with_unit(record.states[i], record.units))
    _legend_outside(drawn[0])
    return drawn


def plot_statistics(
    statistics: "StatisticsByName",
    node: str | None,
    filters: Sequence[str] | None,
    states: Sequence[str] | None,
    axes: "Axes | Sequence[Axes] | None",
) -> "list[Axes]":
    """Draw RMSE over time, and dashed the root of the mean claimed variance."""
    # What is drawn, on which axes.
    node, filters = _chosen(statistics, node, filters)
    places = _places(states, statistics.states)
    time = np.arange(1.0, statistics[node][filters[0]].nees.shape[1] + 1)
    drawn = _axes(axes, len(places), time, statistics.units)
    for panel, i in zip(drawn, places, strict=True):
        for number, name in enumerate(filters):
            # Solid: actual; dashed: claimed.
            score, colour = statistics[node][name], _colour(number)
            claimed = score.claimed()[:, i, i]
            panel.plot(time, np.sqrt(score.actual()[:, i, i]), color=colour, label=in_figure(name))
            panel.plot(time, np.sqrt(np.where(claimed >= 0, claimed, np.nan)), color=colour, linestyle="--")
        panel.set_ylabel(f"RMSE of {_with_unit(statistics.states[i], statistics.units)}")
        # A log axis where one is far larger than another.
        ends = [float(np.sqrt(statistics[node][name].actual()[-1, i, i])) for name in filters]
        if min(ends) > 0 and np.isfinite(max(ends)) and max(ends) > FAR * min(ends):
            panel.set_yscale("log")
    _legend_outside(drawn[0], "dashed: claimed")
    return drawn


def _chosen(
    known: Mapping[str, Mapping[str, object]], node: str | None, filters: Sequence[str] | None
) -> tuple[str, list[str]]:
    """Choose the node and its filters to draw: the first with any, and all."""
    there = [name for name, mine in known.items() if mine]
    if not there or node not in (None, *there):
        raise fail("node", f"one with filters: {', '.join(there) or 'there is none'}", repr(node))
    chosen = there[0] if node is None else node
    mine = list(known[chosen]) if filters is None else list(filters)
    strange = [name for name in mine if name not in known[chosen]]
    if strange or not mine:
        raise fail(
            f"filters of {chosen}", f"some of {', '.join(known[chosen])}", repr(strange[0]) if strange else "none"
        )
    return chosen, mine


def _places(states: Sequence[str] | None, known: Sequence[str]) -> list[int]:
    chosen = list(known) if states is None else [states] if isinstance(states, str) else list(states)
    for name in chosen:
        if name not in known:
            raise fail("states", f"some of {', '.join(known)}", repr(name))
    return [list(known).index(name) for name in chosen]


def _axes(axes: object, count: int, time: np.ndarray, units: Mapping[str, str]) -> "list[Axes]":
    """Return the given axes, or those of a new figure, one below the other."""
    if axes is None:
        import matplotlib.pyplot as plt

        _, grid = plt.subplots(
            count, 1, squeeze=False, sharex=True, layout="constrained", figsize=(6.4, 1 + 1.8 * count)
        )
        grid[-1, 0].set_xlabel("time" if time.dtype.kind == "M" else _with_unit("time", units))
        return list(grid[:, 0])
    given = list(np.ravel(np.asarray(axes, dtype=object)))
    if len(given) != count:
        raise fail("axes", f"{count}, one for each state", len(given))
    return given


def _legend_outside(axes: "Axes", title: str | None = None) -> None:
    """Place the legend to the right of the axes, where it hides no data."""
    axes.legend(frameon=False, title=title, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _colour(number: int) -> str:
    """Next of the colours of all pages."""
    return COLOURS[number % len(COLOURS)]


def _with_unit(name: str, units: Mapping[str, str]) -> str:
    return in_figure(f"{name} ({units[name]})" if name in units else name)
