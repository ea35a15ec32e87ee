"""Figures and report of the reproduction."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.quadratic_bias.compute import (
    CLAIMED,
    NODE,
    TRUE,
    Outcome,
    Reproduction,
    gain_percent,
    settled_mean,
    simulated_mean,
    simulated_over_time,
)
from heliograph_studies.quadratic_bias.statements import statements
from heliograph_studies.verdicts import verdict_blocks

COLOURS = {
    "linear": VERMILION, "quadratic": BLUE, TRUE: AMBER, CLAIMED: MUTED, "memory": AMBER, "cubic": PURPLE,
    "quartic": MUTED, "mixture": GREEN,
}  # fmt: skip
LABELS = {TRUE: "printed, true", CLAIMED: "printed, claimed"}
TABLE_ORDER = ("linear", CLAIMED, TRUE, "quadratic", "memory", "cubic", "quartic", "mixture")


def drawings(result: Reproduction) -> dict[str, Figure]:
    """Figs 1 to 6 by file name, and our scenario."""
    figures = {}
    for i, state in enumerate(("x1", "x2")):
        figures[f"fig{1 + i}_{state}"] = _trajectory(result, i, state)
        figures[f"fig{3 + i}_covariance_{state}"] = _covariances(result.example, i, state)
        figures[f"fig{5 + i}_mse_{state}"] = _errors(result.example, i, state)
    figures["outage"] = _outage(result.outage)
    return figures


def _trajectory(result: Reproduction, i: int, state: str) -> Figure:
    run = result.example.run
    assert run.truth is not None
    panels = []
    for name in ("quadratic", "mixture"):
        mean = np.asarray(run.estimates[NODE][name].mean)[:, i]
        panels.append(Panel(state, [Curve("true", INK, run.truth[:, i]), Curve(name, COLOURS[name], mean)]))
    return curves_over_time(run.time, panels, "t")


def _covariances(outcome: Outcome, i: int, state: str) -> Figure:
    names = ("linear", "quadratic", "memory", "cubic", "quartic")
    curves = [Curve(n, COLOURS[n], outcome.designs.covariance[n][:, i, i]) for n in names]
    return curves_over_time(np.arange(outcome.model.horizon + 1), [Panel(f"error variance of {state}", curves)], "t")


def _errors(outcome: Outcome, i: int, state: str) -> Figure:
    names = ("linear", "quadratic", "cubic", "mixture")
    curves = [Curve(n, COLOURS[n], simulated_over_time(outcome, n)[:, i]) for n in names]
    panel = Panel(f"mean squared error of {state}", curves)
    return curves_over_time(np.arange(1, outcome.model.horizon + 1), [panel], "t")


def _outage(outcome: Outcome) -> Figure:
    names = ("linear", CLAIMED, TRUE, "quadratic")
    curves = [Curve(_label(n), COLOURS[n], outcome.designs.covariance[n][:, 0, 0]) for n in names]
    return curves_over_time(np.arange(outcome.model.horizon + 1), [Panel("error variance of x", curves)], "t")


def _label(name: str) -> str:
    return LABELS.get(name, name)


def page(result: Reproduction, pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    example, outage = result.example, result.outage
    gain = gain_percent(example, "quadratic")
    claimed, true = (-gain_percent(outage, name)[0] for name in (CLAIMED, TRUE))
    runs = example.statistics["linear"].runs
    return Page(
        kicker="Reproduction: quadratic filtering with dynamical bias over an amplify-and-forward relay",
        title=f"Squares of the measurement remove {gain[0]:.0f} % of the linear filter's error variance",
        lead=(
            "Skewed noise carries information that linear filters throw away. On the paper's own example a filter of z "
            f"and z² has {gain[0]:.1f} % less error variance in x1 and {gain[1]:.1f} % in x2, a cubic one "
            f"{gain_percent(example, 'cubic')[0]:.1f} % less in x1. The filter as printed is not quite that filter: "
            f"with outages it can be {true:.0f} % worse than the linear one while claiming {-claimed:.0f} % better."
        ),
        sections=[
            _result(result),
            _scenario(outage, pictures),
            _statements(result),
            _notes(),
            *_figures(result, pictures),
            _rerun(result, runs),
        ],
        footer="Every number is in summary.json; covariances, mean squared errors and the run are in record.nc.",
    )  # fmt: skip


def _result(result: Reproduction) -> Section:
    example = result.example
    gains = {n: gain_percent(example, n)[0] for n in ("quadratic", "cubic", "mixture")}
    keys = [KeyFigure(n, f"{g:.1f} %", "less error variance in x1 than linear", COLOURS[n]) for n, g in gains.items()]
    caption = (
        f"Error variances averaged over t = {example.model.settled + 1} ... {example.model.horizon}. **Designed**: "
        "known before any run. **Simulated**: mean squared error of the same filters on the same runs, ± one standard "
        "error. **Gain**: 1 − ratio of the means, against linear."
    )
    bias = "The bias, which every filter estimates too: it drives the state weakly, so that there is little to gain."
    tables = [_table(example, caption, (0, 1)), _table(example, bias, (2, 3))]
    return Section("The result", [KeyFigures(keys), *tables])


def _table(outcome: Outcome, caption: str, columns: Sequence[int]) -> Table:
    headers = ["filter"]
    for state in (outcome.model.states[i] for i in columns):
        headers += [f"{state} designed", f"{state} simulated", f"{state} gain"]
    rows = []
    for name in TABLE_ORDER:
        row = [_label(name)]
        for i in columns:
            known, ran = name in outcome.designs.covariance, name in outcome.statistics
            row.append(f"{settled_mean(outcome, name)[i]:.6f}" if known else "–")
            mean, error = simulated_mean(outcome, name) if ran else (np.zeros(0), np.zeros(0))
            row.append(f"{mean[i]:.5f} ± {error[i]:.5f}" if ran else "–")
            row.append(f"{gain_percent(outcome, name)[i]:.1f} %")
        rows.append(row)
    return Table(headers, rows, caption, [COLOURS[name] for name in TABLE_ORDER])


def _figures(result: Reproduction, pictures: Mapping[str, bytes]) -> list[Section]:
    runs = result.example.statistics["linear"].runs
    track, spread, errors = [], [], []
    for i, state in enumerate(("x1", "x2")):
        track.append(
            Picture(
                pictures[f"fig{1 + i}_{state}"],
                f"{state} and its estimates over time.",
                f"Fig. {1 + i}: {state} (black) with the estimates of two filters.",
            )
        )
        spread.append(
            Picture(
                pictures[f"fig{3 + i}_covariance_{state}"],
                f"Error variance of {state} over time: linear on top, then quadratic, then cubic.",
                f"Fig. {3 + i}: error variance of {state}, known before any run.",
            )
        )
        errors.append(Picture(pictures[f"fig{5 + i}_mse_{state}"], f"Mean squared error of {state} over time.",
                              f"Fig. {5 + i}: mean squared error of {state} over {runs:,} runs."))  # fmt: skip
    return [
        Section("States and estimates (Figs 1 and 2)", track),
        Section("Error covariances (Figs 3 and 4)", spread),
        Section("Mean squared errors (Figs 5 and 6)", errors),
    ]


def _scenario(outage: Outcome, pictures: Mapping[str, bytes]) -> Section:
    text = (
        "Not in the paper: a scalar state with a bias, a sensor that is off 70 % of the time and a relay that is "
        "off 30 %, and once in 200 steps a large shock. The printed filter takes the square of the mean gain for the "
        "mean of the square; with outages the two are far apart, and what it takes for noise is correlated with "
        "the state."
    )
    caption = "The printed filter's own covariance lies below the linear filter's, its true one above."
    table = f"Averaged over t = {outage.model.settled + 1} ... {outage.model.horizon}; columns as in the first table."
    return Section(
        "Where the printed filter fails",
        [Text([text]), Picture(pictures["outage"], "Error variances over time in the outage scenario.", caption),
         _table(outage, table, (0, 1))],
    )  # fmt: skip


def _statements(result: Reproduction) -> Section:
    return Section("What the paper states", verdict_blocks(statements(result)))


def _notes() -> Section:
    points = [
        "**linear, quadratic, cubic, quartic:** the best filter that is a polynomial of that degree in each z; the "
        "designed covariance is exact. **memory:** quadratic, with products of z and the linear estimate.",
        "**printed:** Theorems 1 and 2 with Lemma 4 corrected. **quadratic:** the same with the conditional mean of z² "
        "right, after which nothing else needs repair.",
        "**mixture:** uses the laws themselves, 72 combinations of powers and noises at each step, and one Gaussian "
        "for the state. It claims nothing exact. Since all noises have few values, exact Bayes would do better still.",
        "P at t = 0 is the covariance of the initial state, and the first measurement used is z at t = 1, as in (14).",
    ]
    return Section("What is compared", [Points(points)])


def _rerun(result: Reproduction, runs: int) -> Section:
    command = f"heliograph reproduce quadratic-bias --out out --runs {runs} --seed {result.seed}"
    return Section("Run it again", [Code(command)])
