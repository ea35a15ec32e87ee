"""Figures of the reproduction, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over, curves_over_time
from heliograph_studies.intermittent_observations.compute import Outcome

BURST_COLOURS = (GREEN, BLUE, AMBER)


def figures(result: Outcome) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "scalar": _over_arrival(result, "scalar"),
        "coupled": _over_arrival(result, "coupled"),
        "bursts": _bursts(result),
        "patterns": _patterns(result),
        "rounding": _rounding(result),
    }


def _over_arrival(result: Outcome, name: str) -> Figure:
    outcome, critical = result.curves[name], result.critical[name]
    curves = [Curve("upper bound", VERMILION, outcome.upper), Curve("lower bound", MUTED, outcome.lower)]
    if np.isfinite(outcome.mean).any():
        curves.insert(1, Curve("mean", BLUE, outcome.mean))
    marks = {f"{critical.lower:.3f}": critical.lower}
    if critical.upper - critical.lower > 0.01:
        marks[f"{critical.upper:.3f}"] = critical.upper
    label = "mean of tr P" if name != "scalar" else "mean of P"
    return curves_over(outcome.arrival, Panel(label, curves), "arrival probability", marks)


def _bursts(result: Outcome) -> Figure:
    curves = [
        Curve(f"begin: {fail:g}", colour, curve.mean)
        for (fail, curve), colour in zip(result.burst_curves.items(), BURST_COLOURS, strict=True)
    ]
    threshold = max(result.recovery.values())
    recover = next(iter(result.burst_curves.values())).recover
    return curves_over(
        recover, Panel("mean of P", curves), "probability that losses end", {f"{threshold:.3f}": threshold}
    )


def _patterns(result: Outcome) -> Figure:
    low, between = result.critical["scalar"].lower - 0.06, result.setting.between
    curves = []
    for arrival, colour, values in ((between, BLUE, result.between), (low, VERMILION, result.below)):
        increments = np.diff(values)
        curves.append(Curve(f"arrival {arrival:.2f}", colour, increments[1:] / increments[:-1]))
    steps = np.arange(2, len(result.between))
    curves.append(Curve(f"bound at {between:.2f}", MUTED, np.full(len(steps), result.between_bound)))
    return curves_over_time(steps, [Panel("increment over the last one", curves)])


def _rounding(result: Outcome) -> Figure:
    it = result.iterated
    curves = [
        Curve("as printed, skew part", VERMILION, np.where(it.skew > 0, it.skew, np.nan)),
        Curve("as squares, tr V", BLUE, it.joseph),
    ]
    steps = np.arange(1, len(it.joseph) + 1)
    return curves_over(steps, Panel("skew part of V, and tr V", curves), "step")


def words(result: Outcome) -> dict[str, object]:
    """The rows of the table: each plant and link."""
    rows = {"scalar": result.scalar, "two states": result.coupled, "three states, one unstable": result.one_unstable}
    rows |= {f"scalar, fail {link.fail:g}, recover {link.recover:g}": link for link in result.bursts}
    return {"rows": rows, "blue": BLUE, "vermilion": VERMILION, "green": GREEN}
