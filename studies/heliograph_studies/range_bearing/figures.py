"""Figures of the example, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, PURPLE, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over, paths
from heliograph_studies.range_bearing.compute import Outcome

LABELS = {
    "quiet_cubature": "Gaussian noise: cubature",
    "quiet_extended": "Gaussian noise: extended",
    "bursts_cubature": "noise in bursts: cubature",
    "bursts_imm": "noise in bursts: IMM",
    "bursts_gpb1": "noise in bursts: GPB1",
    "bursts_gpb2": "noise in bursts: GPB2",
    "bursts_particle": "noise in bursts: particles",
    "fused_intersection": "both, intersected",
    "fused_central": "both, central filter",
}
RULES = {
    "extended": ("slope at the mean", VERMILION),
    "cubature": ("cubature, 8 points", AMBER),
    "second_order": ("second order, 15 points", PURPLE),
    "four_points": ("4 points a direction", GREEN),
    "seven_points": ("7 points a direction", BLUE),
}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """One run across the cut, and errors behind the fading relay by how close the target passes."""
    named = {"across": ("with angles", BLUE), "on_a_line": ("plain numbers", VERMILION)}
    drawn = [Curve(*named[case], path) for case, path in outcome.paths.items()]
    curves = [Curve(*RULES[name], tails.rmse_by_closest_pass) for name, tails in outcome.fading.items()]
    tenths = np.arange(1.0, len(curves[0].values) + 1)
    return {
        "across": paths(outcome.truth, drawn, np.zeros((1, 2))),
        "closest": curves_over(tenths, Panel("error (m, RMS)", curves), "tenth of the runs, closest pass first"),
    }


def words(outcome: Outcome) -> dict[str, object]:
    """How filters and rules are called, the finest rule, and the colours of angles and of plain numbers."""
    labels = {name: label for name, label in LABELS.items() if name in outcome.across}
    finest = list(outcome.fading.values())[-1].score
    return {"labels": labels, "rules": RULES, "finest": finest, "blue": BLUE, "vermilion": VERMILION}
