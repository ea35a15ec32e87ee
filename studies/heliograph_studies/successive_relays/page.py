"""Figures and report of the reproduction."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.successive_relays import setting
from heliograph_studies.successive_relays.compute import FILTERS, Reproduction
from heliograph_studies.successive_relays.statements import (
    on_bounds,
    on_filters,
    on_formulas,
    tuned_mean_ratio,
    worst_z,
    z_limit,
)
from heliograph_studies.verdicts import verdict_blocks

COLOURS = {"relay_1": AMBER, "relay_2": VERMILION, "receiver": BLUE}
LABELS = {"relay_1": "relay 1", "relay_2": "relay 2", "receiver": "receiver"}
TITLES = {
    "paper": "the paper's gains", "joint": "all gains chosen for the receiver",
    "joint_quiet": "the same, at the paper's power",
    "lmmse": "the paper's relays, best linear receiver",
    "lmmse_tuned_from_paper": "best linear receiver, relays chosen for it",
    "lmmse_tuned": "the same, searched from another start", "lmmse_quiet": "the same, at the paper's power",
    "no_relay": "no relay: one hop, as late", "sensor_itself": "no relay, no channel: as late",
    "no_relay_filtered": "no relay: one hop, without delay",
    "sensor_itself_filtered": "no relay, no channel: without delay", "nothing_heard": "nothing heard",
}  # fmt: skip
UNITS = ("V", "V", "A")


def drawings(result: Reproduction) -> dict[str, Figure]:
    """Figs 2 to 5 by file name, and the tuned designs."""
    figures = {f"fig{2 + i}_{state}": _trajectory(result, i) for i, state in enumerate(setting.STATES)}
    figures["fig5_traces"] = _traces(result)
    figures["tuned"] = _tuned(result)
    return figures


def _trajectory(result: Reproduction, i: int) -> Figure:
    assert result.run.truth is not None
    curves = [Curve("true", INK, result.run.truth[0, :, i])]
    for name in FILTERS:
        curves.append(Curve(LABELS[name], COLOURS[name], np.asarray(result.run.estimates[name]["own"].mean)[0, :, i]))
    label = f"{setting.STATES[i].replace('_', ' ')} ({UNITS[i]})"
    return curves_over_time(result.run.time, [Panel(label, curves)], "step k")


def _traces(result: Reproduction) -> Figure:
    time = np.arange(setting.HORIZON + 1)
    designed = [Curve(LABELS[f], COLOURS[f], np.log10(result.paper.trace(f))) for f in FILTERS]
    simulated = result.simulated
    ratio = simulated.mean["receiver"] / result.paper.trace("receiver")
    band = simulated.error["receiver"] / result.paper.trace("receiver")
    panels = [
        Panel("log10 of error variance", designed),
        Panel("simulated / computed", [Curve("receiver", BLUE, ratio), Curve("+2 s.e.", MUTED, 1 + 2 * band),
                                       Curve("−2 s.e.", MUTED, 1 - 2 * band)]),
    ]  # fmt: skip
    return curves_over_time(time, panels, "step k")


def _tuned(result: Reproduction) -> Figure:
    time, paper = np.arange(1, setting.HORIZON + 1), result.paper
    designs = {"free power": (GREEN, result.tuned), "same power": (PURPLE, result.bounded)}
    trace, power = paper.trace("receiver")[1:], paper.total_power()
    panels = [
        Panel("error / paper's", [Curve(n, c, d.trace("receiver")[1:] / trace) for n, (c, d) in designs.items()]),
        Panel("power / paper's", [Curve(n, c, d.total_power() / power) for n, (c, d) in designs.items()]),
    ]
    return curves_over_time(time, panels, "step k")


def page(result: Reproduction, pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    free, same = (100 * (1 - tuned_mean_ratio(result, name)) for name in ("tuned", "bounded"))
    return Page(
        kicker="Reproduction: filter-and-forward successive relays",
        title=f"Relays that serve the receiver leave it {free:.0f} % less error",
        lead=(
            "Two relays take turns: each filters what it hears and forwards its estimate to a distant receiver. The "
            "paper calls the three filters jointly optimal, but each relay minimises its own error. With gains chosen "
            f"for the receiver the same relays leave it {free:.0f} % less error variance on average over "
            f"{setting.HORIZON} steps, and {same:.0f} % less without more transmit power at any step."
        ),
        sections=[_finding(result, pictures), _claims(result), _steady(result), _power(result),
                  _simulation(result, pictures), _bounds(result), _formulas(result), _run(pictures), _notes(),
                  _rerun(result)],
        footer=(
            "Paper: H. Tan, B. Shen, Q. Li, H. Liu, Recursive filtering for stochastic systems with filter-and-forward "
            "successive relays, IEEE/CAA Journal of Automatica Sinica 11(5), 2024. Every number is in summary.json."
        ),
    )  # fmt: skip


def _finding(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    total = {name: value.even + value.odd for name, value in result.steady.items()}
    worse, ratio = (float(result.tuned.trace(f)[-1] / result.paper.trace(f)[-1]) for f in ("relay_2", "receiver"))
    keys = [
        KeyFigure("Relays for the receiver", f"{tuned_mean_ratio(result):.3f}",
                  "of the paper's error variance, mean over k = 1 .. 100", GREEN),
        KeyFigure("With the paper's power", f"{tuned_mean_ratio(result, 'bounded'):.3f}",
                  "no more at any step", PURPLE),
        KeyFigure("In the long run", f"{total['lmmse_tuned'] / total['paper']:.3f}",
                  "best linear receiver, relays chosen for it", BLUE),
    ]  # fmt: skip
    text = (
        "A relay's estimate is also the signal that the receiver hears, and what is best for the one is not best for "
        f"the other: at k = {setting.HORIZON} relay 2's own error variance is {worse:.0f} times the paper's, while the "
        f"receiver's is {ratio:.2f} times."
    )
    return Section("What was found", [
        KeyFigures(keys),
        Picture(pictures["tuned"], "Receiver's error variance and the relays' power, relative to the paper's design",
                "Above: tr Pₖ of the receiver over that of the paper's design; below 1 is better. Below: the relays' "
                "transmit power, over the paper's."),
        Text([text]),
    ])  # fmt: skip


def _claims(result: Reproduction) -> Section:
    return Section("What the paper claims, and what is true", verdict_blocks(on_filters(result)))


def _simulation(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    z, where = worst_z(result)
    text = (
        f"The computed error variance of the receiver and the mean squared error of {result.runs:,} simulated runs "
        f"agree within sampling error at every k = 0 .. {setting.HORIZON}: they differ by at most {z:.2f} standard "
        f"errors (at k = {where}), where {z_limit(setting.HORIZON + 1):.1f} would be exceeded once in a thousand such "
        "comparisons (Bonferroni over the steps; standard errors from 50 batches of runs, so Student's t with 49 "
        "degrees of freedom)."
    )
    picture = Picture(
        pictures["fig5_traces"], "Error variances of the three filters, and simulated over computed",
        "Fig. 5: traces of the error covariances; below, the receiver's mean squared error in simulation over the "
        "computed one, with two standard errors.",
    )  # fmt: skip
    return Section("The recursion is right", [Text([text]), picture])


def _run(pictures: Mapping[str, bytes]) -> Section:
    blocks = [
        Picture(pictures[f"fig{2 + i}_{state}"], f"State {state} and three estimates over 100 steps",
                f"Fig. {2 + i}: one run, log-normal channel gains.")
        for i, state in enumerate(setting.STATES)
    ]  # fmt: skip
    return Section("One run (Figs 2 to 4)", blocks)


def _steady(result: Reproduction) -> Section:
    rows = []
    paper = result.steady["paper"]
    for name, s in ((name, result.steady[name]) for name in TITLES if name in result.steady):
        ratio = (s.even + s.odd) / (paper.even + paper.odd)
        power = " / ".join(f"{p:.3f}" for p in s.power / paper.power) if np.any(s.power) else "none"
        rows.append([TITLES[name], f"{1e6 * s.even:.4f}", f"{1e6 * s.odd:.4f}", f"{1e6 * (s.even + s.odd):.4f}",
                     f"{100 * (ratio - 1):+.1f} %", power])  # fmt: skip
    rows += [
        [TITLES[name], f"{1e6 * v:.4f}", f"{1e6 * v:.4f}", f"{2e6 * v:.4f}", "", "none"]
        for name, v in result.limits.items()
    ]
    headers = ["design", "even k", "odd k", "sum", "against paper", "power, odd / even"]
    caption = (
        "tr P of the receiver in the long run, in 1e-6, at the end of even and odd steps, and the relays' power over "
        "the paper's in odd and even steps. The searches find local minima: the best may be better still."
    )
    return Section("In the long run", [Table(headers, rows, caption)])


def _power(result: Reproduction) -> Section:
    base = result.paper.total_power()
    rows = []
    for name, design in (("the paper's gains", result.paper), ("chosen for the receiver", result.tuned),
                         ("the same, at the paper's power", result.bounded)):  # fmt: skip
        ratio = design.total_power() / base
        trace = design.trace("receiver") / result.paper.trace("receiver")
        at = [f"{trace[k]:.3f}" for k in (10, 50, 100)]
        rows.append([name, *at, f"{np.mean(trace[1:]):.4f}", f"{ratio.mean():.3f}", f"{ratio.max():.3f}",
                     f"{design.trace('relay_2')[-1]:.2g}"])  # fmt: skip
    headers = ["gains", "k = 10", "k = 50", "k = 100", "mean", "mean power", "largest power", "relay 2's own"]
    caption = (
        "Receiver's tr Pₖ and the relays' power, over the paper's. **Relay 2's own**: trace of its error covariance at "
        "k = 100: a relay that serves the receiver is no good estimator itself."
    )
    return Section("Over the first 100 steps", [Table(headers, rows, caption)])


def _bounds(result: Reproduction) -> Section:
    rows = []
    for bound in result.certificates["paper"].bounds.values():
        value = "none" if bound.values is None else f"{bound.values[0]:.3g} to {bound.values[-1]:.3g}"
        obeyed = {True: "yes", False: "no", None: "no value"}[bound.holds]
        rows.append([bound.name, "yes" if bound.applies else "no: " + "; ".join(bound.failing), value, obeyed])
    caption = "The paper's bounds as corrected, on its own example; errors recomputed by code that made no gains."
    return Section("Its bounds on the errors", [
        *verdict_blocks(on_bounds(result)),
        Table(["bound", "applies", "k = 0 to 100", "obeyed"], rows, caption, wordy=True),
    ])  # fmt: skip


def _formulas(result: Reproduction) -> Section:
    return Section("Printed formulas, each taken as a statement", verdict_blocks(on_formulas(result)))


def _notes() -> Section:
    return Section("What the paper leaves open", [Points([
        "The printed inductance, 0.5 H, does not give the printed matrix; 5 H does. The printed matrix is "
        "used, with its four decimals.",
        "The law of the channel coefficients is not given; only two moments matter for linear filters. "
        "Log-normal gains are simulated.",
        "Horizon and seeds are not given: 100 steps here.",
        "What was read is a scan: misprints marked as such may be its own.",
    ])])  # fmt: skip


def _rerun(result: Reproduction) -> Section:
    command = f"heliograph reproduce successive-relays --out out --runs {result.runs} --seed {result.seed}"
    return Section("Run it again", [Code(command)])
