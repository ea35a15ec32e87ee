"""Figures of the example, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over_time, errors_with_bands
from heliograph_studies.smoothing.compute import LAG_STEP, LAGS, Outcome, places

COLOURS = dict(zip(LAGS, (AMBER, PURPLE, GREEN, VERMILION), strict=True))
SHOWN_LAGS = (1, 5, 20)


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Deviations over time, and the errors of one run."""
    curves = [Curve("filter", MUTED, _deviation(outcome.filtered))]
    curves += [Curve(f"{lag} later", COLOURS[lag], _deviation(outcome.lagged[lag])) for lag in SHOWN_LAGS]
    curves.append(Curve("all data", BLUE, _deviation(outcome.smoothed)))
    steps = np.arange(1, len(outcome.filtered) + 1)
    return {
        "deviations": curves_over_time(steps, [Panel("standard deviation", curves)]),
        "errors": _errors(outcome.shown),
    }


def _errors(run: hg.Record) -> Figure:
    """Errors of one run within what filter and smoother claim."""
    curves = []
    for name, part, colour in (("filter", run, MUTED), ("smoother", run.smoothed or run, BLUE)):
        deviation = np.sqrt(np.diagonal(part.estimates["node"]["linear"].covariance, axis1=1, axis2=2))
        curves.append(Curve(name, colour, part.errors("node", "linear")[:, [0, 2]], deviation[:, [0, 2]]))
    return errors_with_bands(run.time, curves, ["x", "y"])


def _deviation(covariance: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(places(covariance)))


def words(outcome: Outcome) -> dict[str, object]:
    """Colours, and the step at which deviations are compared."""
    return {"muted": MUTED, "blue": BLUE, "step": LAG_STEP, "count": len(outcome.filtered)}
