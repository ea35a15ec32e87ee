"""How the example is shown."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.examples.smoothing.compute import LAG_STEP, LAGS, RUNS, Outcome
from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, PALE, PURPLE, STYLE, VERMILION, WIDTH, Curve
from heliograph.report.page import KeyFigure, KeyFigures, Page, Picture, Section, Table, Text

COLOURS = dict(zip(LAGS, (AMBER, PURPLE, GREEN, VERMILION), strict=True))
SHOWN_LAGS = (1, 5, 20)


def smoothing_figures(outcome: Outcome) -> dict[str, Figure]:
    """Deviations over time, and one run on its map."""
    clock = np.arange(1, len(outcome.filtered) + 1)
    curves = [Curve("filter", "#66727f", _deviation(outcome.filtered))]
    curves += [Curve(f"lag {lag}", COLOURS[lag], _deviation(outcome.lagged[lag])) for lag in SHOWN_LAGS]
    curves.append(Curve("all data", BLUE, _deviation(outcome.smoothed)))
    return {"deviations": curves_over_time(clock, [Panel("deviation of the place", curves)]), "path": _path(outcome)}


@matplotlib.rc_context(STYLE)
def _path(outcome: Outcome) -> Figure:
    """The first run: true path, filter and smoother side by side."""
    run = outcome.run
    assert run.smoothed is not None and run.truth is not None  # it was simulated and smoothed
    figure = Figure(figsize=(WIDTH, WIDTH / 2 + 0.6), layout="constrained")
    row = figure.subplots(1, 2, sharex=True, sharey=True)
    parts = {"filter": (run, "#66727f"), "smoother": (run.smoothed, BLUE)}
    for axes, (name, (part, colour)) in zip(row, parts.items(), strict=True):
        (true,) = axes.plot(run.truth[:, 0], run.truth[:, 2], color=PALE, linewidth=3.5)
        mean = np.asarray(part.estimates["node"]["linear"].mean)
        axes.plot(mean[:, 0], mean[:, 2], color=colour, linewidth=1.2)
        axes.set(xlabel="x", aspect="equal")
        axes.set_title(name, color=colour)
    row[0].set_ylabel("y")
    figure.legend([true], ["true path"], loc="outside lower right", frameon=False)
    return figure


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
                KeyFigure("filter", f"{filtered[at]:.3f}", f"deviation at step {LAG_STEP}", "#66727f"),
                KeyFigure("smoother", f"{smoothed[at]:.3f}", "given all 100 steps", BLUE),
            ]),
            Picture(pictures["deviations"], "Deviation of the place over time by lag", "Claimed before any data."),
            Table(["lag", "variance of the filter's"], lags, f"Variance of the place at step {LAG_STEP}."),
            Picture(pictures["path"], "One run on its map, filtered and smoothed", "One run."),
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
