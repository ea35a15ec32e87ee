"""Figures of the example, and how rules are called."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import BLUE, GREEN, INK, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over_time, graph_map
from heliograph_studies.without_centre.compute import Outcome

RULES = {"best": ("best weights", GREEN), "intersection": ("intersection", BLUE), "diffusion": ("diffusion", VERMILION)}

BEGUN = 4  # steps that are left out: before them every node is as ignorant as the plant's prior


def figures(outcome: Outcome) -> dict[str, Figure]:
    """A map of the graph by error over claim, and errors over time."""
    curves = [Curve(label, colour, outcome.rules[name].over_time[BEGUN:]) for name, (label, colour) in RULES.items()]
    steps = np.arange(1.0, len(curves[0].values) + 1) + BEGUN
    earlier = np.full(len(steps) - len(outcome.bound), np.nan)
    bound = Curve("least possible", INK, np.concatenate([earlier, outcome.bound]))
    values = outcome.rules["intersection"].nees_by_node
    return {
        "map": graph_map(outcome.positions, outcome.edges, values, "error over claim (NEES)", outcome.sensors),
        "errors": curves_over_time(steps, [Panel("error in units of a centre's", [*curves, bound])]),
    }


def words(outcome: Outcome) -> dict[str, object]:
    """How rules are called."""
    return {"names": RULES}
