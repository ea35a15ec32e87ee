"""How the example is shown."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.examples.smoothing.compute import LAG_STEP, LAGS, RUNS, Outcome
from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION, Curve, errors_with_bands
from heliograph.report.page import KeyFigure, KeyFigures, Page, Picture, Section, Table, Text

COLOURS = dict(zip(LAGS, (AMBER, PURPLE, GREEN, VERMILION), strict=True))
SHOWN_LAGS = (1, 5, 20)


def smoothing_figures(outcome: Outcome) -> dict[str, Figure]:
    """Deviations over time, and the errors of one run."""
    clock = np.arange(1, len(outcome.filtered) + 1)
    curves = [Curve("filter", MUTED, _deviation(outcome.filtered))]
    curves += [Curve(f"lag {lag}", COLOURS[lag], _deviation(outcome.lagged[lag])) for lag in SHOWN_LAGS]
    curves.append(Curve("all data", BLUE, _deviation(outcome.smoothed)))
    return {
        "deviations": curves_over_time(clock, [Panel("deviation of the place", curves)]),
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
                KeyFigure("filter", f"{filtered[at]:.3f}", f"deviation at step {LAG_STEP}", MUTED),
                KeyFigure("smoother", f"{smoothed[at]:.3f}", "given all 100 steps", BLUE),
            ]),
            Picture(pictures["deviations"], "Deviation of the place over time by lag", "Claimed before any data."),
            Table(["lag", "variance of the filter's"], lags, f"Variance of the place at step {LAG_STEP}."),
            Picture(pictures["errors"], "Errors of one run, filtered and smoothed, within two claimed deviations",
                    "Errors of one run, and two claimed deviations."),
            Table(["", "RMSE", "NEES per dimension"], measured, f"{RUNS} simulated runs; 1 if the claim is exact."),
        ]),
        Section("A receiver behind relays that take turns", [
            Text(["The relays filter and forward; the receiver estimates the state and what the relays do not know."]),
            Table(["lag", "even steps", "odd steps"], relays, "Trace of the error covariance once settled."),
        ]),
        Section("A filter that should not be smoothed", [
            Text([
                "An extended filter of a pendulum. Where the swing is large it loses its way and does not know; later "
                "data make it surer, not better. Its own innovations tell."
            ]),
            Table(
                ["swing", "angle error", "smoothed", "NEES", "smoothed", "warned"], swings, f"{RUNS} runs of each."
            ),
        ]),
    ]  # fmt: skip
    lead = (
        "An estimate of an earlier state improves while data still come. Behind random gains the best linear smoother "
        "is exact, and known before any data: nothing but second moments has a part in it."
    )
    return Page("Heliograph example", "What waiting is worth", lead, sections)


def _deviation(covariance: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(covariance[:, 0, 0] + covariance[:, 2, 2]))
