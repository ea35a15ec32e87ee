"""Map of a graph of nodes, coloured by a number of each."""

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from heliograph.report.figures import INK, PALE, STYLE, WIDTH


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
