"""Probabilities of the modes over time, of filters that weigh modes: their figure, and its words on a page."""

from collections.abc import Sequence

import matplotlib
from matplotlib.figure import Figure

from heliograph.report.figures import make_stacked_panels, place_legend_above
from heliograph.report.innovations_section import LOOK, label_time_axis
from heliograph.simulation.results.record import Record

PREFIX = "modes_"  # of the names of figures, before that of a node's estimates


def draw_modes_of_nodes(record: Record, kind: str, nodes: Sequence[str]) -> dict[str, Figure]:
    """Return {file name: figure} of the modes' probabilities, for each node with a filter that estimates modes.

    The file name is "modes_KIND_i" with the node's index i in `nodes`; `kind` is "estimates" or "smoothed". The modes
    are the states of a Markov chain that switches the model. `record`: the estimates; `modes` are such probabilities,
    None for a filter without them.
    """
    figures = {}
    for i, node in enumerate(nodes):
        if any(estimate.modes is not None for estimate in record.estimates[node].values()):
            figures[f"{PREFIX}{kind}_{i}"] = _draw_modes(record, node)
    return figures


@matplotlib.rc_context(LOOK)
def _draw_modes(record: Record, node: str) -> Figure:
    """Draw the probabilities of the modes over time, by the filters of one node."""
    figure, grid = make_stacked_panels(1, height=2.2, margin=0.8)
    record.plot_modes(node, axes=grid[0])
    place_legend_above(figure, grid[0], columns=3)
    label_time_axis(record, grid[0])
    return figure
