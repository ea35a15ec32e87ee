"""How the example is shown."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION, Curve, errors_with_bands
from heliograph.report.page import KeyFigure, KeyFigures, Page, Picture, Section, Table, Text
from heliograph_studies.smoothing.compute import LAG_STEP, LAGS, RUNS, Outcome

COLOURS = dict(zip(LAGS, (AMBER, PURPLE, GREEN, VERMILION), strict=True))
SHOWN_LAGS = (1, 5, 20)


def smoothing_figures(outcome: Outcome) -> dict[str, Figure]:
    """Deviations over time, and the errors of one run."""
    clock = np.arange(1, len(outcome.filtered) + 1)
    curves = [Curve("filter", MUTED, _deviation(outcome.filtered))]
    curves += [Curve(f"{lag} later", COLOURS[lag], _deviation(outcome.lagged[lag])) for lag in SHOWN_LAGS]
    curves.append(Curve("all data", BLUE, _deviation(outcome.smoothed)))
    return {
        "deviations": curves_over_time(clock, [Panel("standard deviation", curves)]),
        "errors": _errors(outcome.run),
    }


def _errors(run: hg.Record) -> Figure:
    """Errors of one run within what filter and smoother claim."""
    parts = {"filter": (run, MUTED), "smoother": (run.smoothed or run, BLUE)}
    curves = []
    for name, (part, colour) in parts.items():
        deviation = np.sqrt(np.diagonal(part.estimates["node"]["linear"].covariance, axis1=1, axis2=2))
        curves.append(Curve(name, colour, part.errors("node", "linear")[:, [0, 2]], deviation[:, [0, 2]]))
    return errors_with_bands(run.time, curves, ["x", "y"])


def smoothing_page(outcome: Outcome, pictures: Mapping[str, bytes]) -> Page:
    """The report."""
    filtered, smoothed = _deviation(outcome.filtered), _deviation(outcome.smoothed)
    at = LAG_STEP - 1
    lags = [[str(lag), f"{(_deviation(p)[at] / filtered[at]) ** 2:.3f}"] for lag, p in outcome.lagged.items()]
    relays = [[str(lag), f"{t['even']:.4e}", f"{t['odd']:.4e}"] for lag, t in outcome.relays.items()]
    measured = [
        [name, f"{m['rmse']:.3f}", f"{m['nees']:.3f} ({m['nees_low']:.3f} to {m['nees_high']:.3f})"]
        for name, m in outcome.measured.items()
    ]
    swings = [
        [name, *(f"{s[f'{which}_{what}']:.3g}" for what in ("angle", "nees") for which in ("filter", "smoother")),
         "yes" if outcome.warned[name] else "no"]
        for name, s in outcome.pendulum.items()
    ]  # fmt: skip
    sections = [
        Section("A moving point behind two fading hops", [
            KeyFigures([
                KeyFigure("filter", f"{filtered[at]:.3f}", f"standard deviation at step {LAG_STEP}", MUTED),
                KeyFigure("smoother", f"{smoothed[at]:.3f}", "given all 100 steps", BLUE),
            ]),
            Picture(pictures["deviations"], "Standard deviation of the place over time by lag",
                    "Standard deviation of the error, computed before any data. **Lag**: steps that are waited."),
            Table(["steps waited", "variance, of the filter's"], lags, f"Variance of the place at step {LAG_STEP}."),
            Picture(pictures["errors"], "Errors of one run, filtered and smoothed, within two standard deviations",
                    "Errors of one run (line) within two computed standard deviations (band)."),
            Table(["", "RMSE", "NEES per dimension"], measured,
                  f"{RUNS} simulated runs. **NEES per dimension**: squared error in units of the computed covariance, "
                  "with its 95 % interval; 1 where the covariance is right."),
        ]),
        Section("A receiver behind relays that take turns", [
            Text(["The relays filter and forward; the receiver estimates the state and what the relays do not know."]),
            Table(["steps waited", "even steps", "odd steps"], relays,
                  "Trace of the error covariance in the long run."),
        ]),
        Section("A filter that should not be smoothed", [
            Text([
                "An extended Kalman filter of a pendulum. Where the swing is large the filter is far off and does not "
                "know it; later data make it surer, not better. A test of its innovations for whiteness warns of it."
            ]),
            Table(
                ["swing", "angle error", "smoothed", "NEES", "NEES, smoothed", "warned"], swings,
                f"{RUNS} runs of each; errors are root mean squares in radians."
            ),
        ]),
    ]  # fmt: skip
    lead = (
        f"Behind two fading hops the place of a moving point is known to {filtered[at]:.2f} at step {LAG_STEP} by the "
        f"data so far, and to {smoothed[at]:.2f} once all {len(filtered)} steps are in: data that come later tell of "
        "an earlier state too. For linear smoothers these numbers are exact, and known before any data, since nothing "
        "but second moments of the random gains has a part in them."
    )
    cut = 100 * (1 - smoothed[at] / filtered[at])
    return Page("Heliograph example", f"Waiting for later data takes {cut:.0f} % off the error", lead, sections)


def _deviation(covariance: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 2, 2]))
