"""Kalman filtering with intermittent observations and its successors, reproduced and judged; see README.md."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, VERMILION
from heliograph_studies import Statement, Study, stated
from heliograph_studies.curves import Curve, Panel, curves_over, curves_over_time
from heliograph_studies.intermittent_observations import compute
from heliograph_studies.intermittent_observations.compute import Outcome
from heliograph_studies.intermittent_observations.setting import Setting as Setting
from heliograph_studies.intermittent_observations.setting import threshold

BURST_COLOURS = (GREEN, BLUE, AMBER)


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "scalar": _over_arrival(outcome, "scalar"),
        "coupled": _over_arrival(outcome, "coupled"),
        "bursts": _bursts(outcome),
        "patterns": _patterns(outcome),
        "rounding": _rounding(outcome),
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


def _bursts(outcome: Outcome) -> Figure:
    curves = [
        Curve(f"begin: {fail:g}", colour, curve.mean)
        for (fail, curve), colour in zip(outcome.burst_curves.items(), BURST_COLOURS, strict=True)
    ]
    threshold = max(outcome.recovery.values())
    recover = next(iter(outcome.burst_curves.values())).recover
    return curves_over(
        recover, Panel("mean of P", curves), "probability that losses end", {f"{threshold:.3f}": threshold}
    )


def _patterns(outcome: Outcome) -> Figure:
    low, between = outcome.critical["scalar"].lower - 0.06, outcome.setting.between
    curves = []
    for arrival, colour, values in ((between, BLUE, outcome.between), (low, VERMILION, outcome.below)):
        increments = np.diff(values)
        curves.append(Curve(f"arrival {arrival:.2f}", colour, increments[1:] / increments[:-1]))
    steps = np.arange(2, len(outcome.between))
    curves.append(Curve(f"bound at {between:.2f}", MUTED, np.full(len(steps), outcome.between_bound)))
    return curves_over_time(steps, [Panel("increment over the last one", curves)])


def _rounding(outcome: Outcome) -> Figure:
    it = outcome.iterated
    curves = [
        Curve("as printed, skew part", VERMILION, np.where(it.skew > 0, it.skew, np.nan)),
        Curve("as squares, tr V", BLUE, it.joseph),
    ]
    steps = np.arange(1, len(it.joseph) + 1)
    return curves_over(steps, Panel("skew part of V, and tr V", curves), "step")


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """Theorems, special cases, successors, and what is often taken for granted, with the numbers that decide."""
    setting = outcome.setting
    eigenvalues = np.abs(np.linalg.eigvals(setting.coupled.transition))
    increments = [np.diff(values) for values in (outcome.between, outcome.below, outcome.turning[::2])]
    shrinking, growing, turned = (float(steps[-1] / steps[-2]) for steps in increments)
    numbers = {
        "predicted": threshold(setting.scalar.transition[0, 0]),
        "product": 1 - float(np.prod(eigenvalues[eigenvalues > 1])) ** -2,
        "between_patterns": outcome.between,
        "shrinking": shrinking,
        "growing": growing,
        "turned": turned,
        "expected": [threshold(factor) for factor in np.diag(setting.components.transition)],
    }
    return stated(__file__, {**vars(outcome), **numbers})


publication = Study(
    name="intermittent-observations",
    setting=Setting,
    compute=compute.compute,
    stages=3,
    figures=figures,
    publication="Kalman filtering with intermittent observations",
    statements=statements,
    data=compute.write_record,
)
run = publication.run
