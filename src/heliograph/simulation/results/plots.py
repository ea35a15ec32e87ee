"""Parts of plots on axes of matplotlib, given or new, one for each state: what is drawn, colours, units, legend."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.disk.colours_of_figures import COLOURS
from heliograph.disk.quoted_text import label_with_unit, quote_for_figure
from heliograph.model.estimate import Estimate
from heliograph.numerics.angles.angle import find_wraps, insert_gaps
from heliograph.numerics.check import check_count, fail

FAR = 10.0  # times the best filter's error: from there an axis is logarithmic

if TYPE_CHECKING:  # an extra
    from matplotlib.axes import Axes


def choose_filters(
    filters_by_node: Mapping[str, Mapping[str, object]], node: str | None, filters: Sequence[str] | None
) -> tuple[str, list[str]]:
    """Return the node to draw and its filters; raise ValueError if a given one does not exist.

    The default is the first node with filters, and all of its filters.
    """
    nodes = [name for name, by_filter in filters_by_node.items() if by_filter]  # those with filters
    if not nodes or node not in (None, *nodes):
        raise fail("node", f"one with filters: {', '.join(nodes) or 'there is none'}", repr(node))
    chosen_node = nodes[0] if node is None else node
    available = filters_by_node[chosen_node]
    names = list(available) if filters is None else list(filters)
    unknown = [name for name in names if name not in available]
    if unknown or not names:
        expected = f"some of {', '.join(available)}"
        raise fail(f"filters of {chosen_node}", expected, repr(unknown[0]) if unknown else "none")
    return chosen_node, names


def find_state_indices(states: Sequence[str] | None, known: Sequence[str]) -> list[int]:
    """Return the indices of the chosen `states` in `known`, or of all if None; an unknown one is a ValueError.

    `states`: one name, or several.
    """
    one_or_all = [states] if isinstance(states, str) else states
    chosen = list(known if one_or_all is None else one_or_all)
    for name in chosen:
        if name not in known:
            raise fail("states", f"some of {', '.join(known)}", repr(name))
    return [list(known).index(name) for name in chosen]


def make_panels(axes: object, count: int, time: np.ndarray, units: Mapping[str, str]) -> "list[Axes]":
    """Return the given axes as a list, or those of a new figure with `count` panels one below the other.

    `time`: times to be drawn; dates need no unit. `units`: by name, also of "time".

    Raises:
        ValueError: another number of axes than `count`.
    """
    if axes is None:
        import matplotlib.pyplot as plt

        size = 6.4, 1 + 1.8 * count  # inches
        _, grid = plt.subplots(count, 1, squeeze=False, sharex=True, layout="constrained", figsize=size)
        grid[-1, 0].set_xlabel("time" if time.dtype.kind == "M" else label_with_unit("time", units))
        return list(grid[:, 0])
    panels = list(np.ravel(np.asarray(axes, dtype=object)))
    if len(panels) != count:
        raise fail("axes", f"{count}, one for each state", len(panels))
    return panels


def check_run(run: int, runs: int | None) -> None:
    """Raise ValueError unless there is such a run; of a recording, which has none, any number will do."""
    if runs is not None and check_count("run", run, least=0) >= runs:
        raise fail("run", f"one of {runs}, counted from 0", run)


def draw_state(
    panel: "Axes",
    time: np.ndarray,
    estimates: Mapping[str, Estimate],
    run_and_state: tuple[Any, int],
    sigmas: float,
    truth: np.ndarray | None = None,
) -> None:
    """Draw one state of several estimates, of a run, with bands of +-`sigmas` claimed deviations, and the true state.

    Args:
        panel: the axes to draw on.
        time: times of the rows.
        estimates: estimates by name, with means (..., time, n) and covariances (..., time, n, n); those whose claim is
            "none" have no covariance, and get no band.
        run_and_state: index of the run (... without an axis of runs), and number of the state.
        sigmas: half-width of the bands.
        truth: the true state (time,), of which estimated angles are within half a turn; None where it is unknown.
    """
    run, i = run_and_state
    # Estimates of an angle between -pi and pi are then between -2 pi and 2 pi.
    turns = truth is not None and find_wraps(truth[~np.isnan(truth)], np.pi).size
    most = 2 * np.pi if turns else np.pi
    for number, (name, estimate) in enumerate(estimates.items()):
        mean = np.asarray(estimate.mean)[run][..., i]
        variance = np.asarray(estimate.covariance)[run][..., i, i]
        deviation = np.sqrt(np.where(variance >= 0, variance, np.nan))
        # The line is interrupted where an angle jumps by a full turn.
        drawn_time, mean, band = insert_gaps(time, find_wraps(mean, most), mean, sigmas * deviation)
        panel.plot(drawn_time, mean, color=choose_colour(number), label=quote_for_figure(name))
        if estimate.claim != "none":
            low, high = mean - band, mean + band
            panel.fill_between(drawn_time, low, high, color=choose_colour(number), alpha=0.2, linewidth=0)
    if truth is not None:
        wraps = find_wraps(truth, np.pi)
        panel.plot(*insert_gaps(time, wraps, truth), color="0.25", linestyle=":", label="truth")


def draw_modes(
    estimates: Mapping[str, Mapping[str, Estimate]],
    node: str | None,
    filters: Sequence[str] | None,
    axes: object,
    run: int | None,
    clock: tuple[np.ndarray, Mapping[str, str]],
) -> "Axes":
    """Draw the probabilities of the modes of a node's filters: a colour for each filter, a style for each mode.

    Args:
        estimates: by node and filter; if a filter weighs modes, they have probabilities `modes` (..., time, mode).
        node: name of the node; None: the first with a filter that weighs modes.
        filters: names of its filters; None: all that weigh modes.
        axes: to draw on; None: new ones.
        run: number of the run; None without an axis of runs.
        clock: times of the rows, and units by name.

    Returns:
        The axes.
    """
    # Filters that weigh modes.
    weighing = {
        name: {label: estimate for label, estimate in by_filter.items() if estimate.modes is not None}
        for name, by_filter in estimates.items()
    }
    node, chosen = choose_filters(weighing, node, filters)
    # A panel over time, and in it a line for each mode of each filter.
    time, units = clock
    (panel,) = make_panels(None if axes is None else [axes], 1, time, units)
    line_styles = "-", "--", ":", "-."
    for number, name in enumerate(chosen):
        modes = np.asarray(weighing[node][name].modes)[... if run is None else run]
        for j in range(modes.shape[-1]):
            panel.plot(time, modes[:, j], line_styles[j % len(line_styles)], color=choose_colour(number),
                       label=quote_for_figure(f"{name}, mode {j}"))  # fmt: skip
    panel.set_ylim(-0.02, 1.02)
    panel.set_ylabel("probability")
    legend_outside(panel)
    return panel


def legend_outside(axes: "Axes", title: str | None = None) -> None:
    """Place the legend to the right of the axes, where it hides no data."""
    axes.legend(frameon=False, title=title, loc="upper left", bbox_to_anchor=(1.0, 1.0))


def choose_colour(number: int) -> str:
    """Return the colour of the pages for the filter of this number; colours repeat."""
    return COLOURS[number % len(COLOURS)]
