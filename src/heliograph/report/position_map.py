"""Map of an estimated position: one state against another, where the two are coordinates of a plane."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from heliograph.disk.quoted_text import label_with_unit, quote_for_figure
from heliograph.report.figures import COLOURS, INK, STYLE, WIDTH, place_legend_above
from heliograph.simulation.results.record import Record

# Names that two coordinates of a plane have, without what stands before them: "x" and "y", "position_x" and ...
PAIRS = (("x", "y"), ("east", "north"), ("e", "n"), ("px", "py"), ("pos_x", "pos_y"), ("position_x", "position_y"),
         ("x_position", "y_position"), ("lon", "lat"), ("longitude", "latitude"))  # fmt: skip
ELLIPSES = 12  # of the claimed covariance along the path
SIGMAS = 2.0  # semi-axes of an ellipse, in claimed deviations


def find_coordinates(states: Sequence[str]) -> tuple[int, int] | None:
    """Return the indices of two states whose names say that they are a position in a plane, or None.

    PAIRS holds such names, for example ("x", "y"). A unit in brackets after a name is ignored.
    """
    names = [state.split("(")[0].strip().lower() for state in states]
    for first, second in PAIRS:
        if first in names and second in names:
            return names.index(first), names.index(second)
    return None


@matplotlib.rc_context(STYLE)
def draw_position_map(record: Record, node: str, names: Sequence[str]) -> Figure:
    """Draw the paths that filters of a node estimate, with ellipses of two claimed deviations, and the true path.

    Args:
        record: estimates by node and filter; two of its states are a position in a plane by their names.
        node: name of the node.
        names: names of its filters that are drawn.
    """
    coordinates = find_coordinates(record.states)
    assert coordinates is not None  # only then is a map drawn
    i, j = coordinates
    figure = Figure(figsize=(WIDTH, WIDTH), layout="constrained")
    axes = figure.subplots()
    # For each filter a line, and ellipses at ELLIPSES of its rows if it says what its covariance is.
    for number, name in enumerate(names):
        estimate = record.estimates[node][name]
        colour = COLOURS[number % len(COLOURS)]
        mean = np.asarray(estimate.mean)[:, [i, j]]
        axes.plot(mean[:, 0], mean[:, 1], color=colour, linewidth=1.2, label=quote_for_figure(name))
        if estimate.claim != "none":
            covariance = np.asarray(estimate.covariance)
            for k in np.unique(np.linspace(0, len(mean) - 1, ELLIPSES).astype(int)):
                _draw_ellipse(axes, mean[k], covariance[k][np.ix_([i, j], [i, j])], colour)
    # The true path, unless it is missing in all rows.
    if record.truth is not None and not np.isnan(record.truth[:, [i, j]]).any(axis=1).all():
        axes.plot(record.truth[:, i], record.truth[:, j], color=INK, linestyle=":", label="truth")
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel(label_with_unit(record.states[i], record.units))
    axes.set_ylabel(label_with_unit(record.states[j], record.units))
    place_legend_above(figure, axes)
    return figure


def _draw_ellipse(axes: matplotlib.axes.Axes, center: np.ndarray, covariance: np.ndarray, colour: str) -> None:
    """Draw the ellipse (p - m)' P^-1 (p - m) = SIGMAS^2 with centre m and covariance P, or nothing for a wrong P."""
    if not (np.isfinite(covariance).all() and np.isfinite(center).all()):
        return
    eigenvalues, vectors = np.linalg.eigh(covariance)
    smaller, larger = eigenvalues
    if smaller < 0:
        return
    # Each axis is 2 SIGMAS sqrt(eigenvalue) long; the longer one, along the second eigenvector, is the width.
    width = 2 * SIGMAS * np.sqrt(larger)
    height = 2 * SIGMAS * np.sqrt(smaller)
    x, y = vectors[:, 1]
    angle = float(np.degrees(np.arctan2(y, x)))
    axes.add_patch(Ellipse((center[0], center[1]), width, height, angle=angle, color=colour, alpha=0.2, linewidth=0))
