"""Figures of the example, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over, curves_over_time
from heliograph_studies.links_with_memory.compute import Outcome

ROWS = {  # filter: how it is called, and its colour
    "memoryless": ("linear, no memory", VERMILION),
    "exact": ("linear, with the modes", BLUE),
    "gpb1": ("one Gaussian (GPB1)", AMBER),
    "imm": ("a Gaussian per mode (IMM)", PURPLE),
    "gpb2": ("a Gaussian per mode (GPB2)", GREEN),
    "particle": ("particles", MUTED),
    "mode_late": ("knows the mode one step late", INK),
    "mode_known": ("knows the mode", INK),
}
CLAIMING = {"memoryless": "no memory", "exact": "linear, modes", "gpb2": "GPB2"}
INFORMED = {"exact": ("nothing known", BLUE), "mode_late": ("one step late", PURPLE), "mode_known": ("mode known", INK)}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Errors over time beside claims, what telling is worth, and how wrong no memory is, by file name."""
    first = outcome.e1
    claims = [Curve(label, ROWS[name][1], first[name].claimed_over_time) for name, label in CLAIMING.items()]
    truths = [Curve(label, ROWS[name][1], first[name].true_over_time) for name, label in CLAIMING.items()]
    known = [Curve(*look, first[name].true_over_time) for name, look in INFORMED.items()]
    time = np.arange(1.0, len(first["exact"].true_over_time) + 1)
    correlations, ratios = (np.array(part) for part in outcome.curve.values())
    ratio = Panel("true over claimed variance", [Curve("no memory", VERMILION, ratios)])
    return {
        "claims": curves_over_time(time, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "telling": curves_over_time(time, [Panel("mean square error", known)]),
        "correlation": curves_over(correlations, ratio, "correlation of the gain from step to step", logarithmic=False),
    }


def words(outcome: Outcome) -> dict[str, object]:
    """How the filters are called, and those that are shown first."""
    return {"rows": ROWS, "first": CLAIMING}
