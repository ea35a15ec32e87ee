"""Figures and report of the reproduction."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.papers.successive_relays import setting
from heliograph.papers.successive_relays.compute import FILTERS, Reproduction
from heliograph.papers.successive_relays.statements import statements, tuned_mean_ratio, worst_z, z_limit
from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text

COLOURS = {"relay_1": AMBER, "relay_2": VERMILION, "receiver": BLUE}
LABELS = {"relay_1": "relay 1", "relay_2": "relay 2", "receiver": "remote"}
TITLES = {
    "paper": "paper", "joint": "relays and remote filter tuned together",
    "joint_quiet": "the same, at the paper's power",
    "lmmse": "best linear receiver, paper's relays",
    "lmmse_tuned_from_paper": "best linear receiver, relays tuned for it",
    "lmmse_tuned": "the same, from another start", "lmmse_quiet": "the same, at the paper's power",
    "no_relay": "no relay: one hop, predicted", "sensor_itself": "no relay, no channel: predicted",
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
    panels = []
    for name in FILTERS:
        mean = np.asarray(result.run.estimates[name]["own"].mean)[0, :, i]
        curves = [Curve("true", INK, result.run.truth[0, :, i]), Curve(LABELS[name], COLOURS[name], mean)]
        panels.append(Panel(f"{setting.STATES[i].replace('_', ' ')} ({UNITS[i]})", curves))
    return curves_over_time(result.run.time, panels, "k")


def _traces(result: Reproduction) -> Figure:
    time = np.arange(setting.HORIZON + 1)
    designed = [Curve(LABELS[f], COLOURS[f], np.log10(result.paper.trace(f))) for f in FILTERS]
    simulated = result.simulated
    ratio = simulated.mean["receiver"] / result.paper.trace("receiver")
    band = simulated.error["receiver"] / result.paper.trace("receiver")
    panels = [
        Panel("log10 trace of error covariance", designed),
        Panel("simulated / designed, remote", [Curve("simulated", BLUE, ratio), Curve("+2 s.e.", MUTED, 1 + 2 * band),
                                               Curve("-2 s.e.", MUTED, 1 - 2 * band)]),
    ]  # fmt: skip
    return curves_over_time(time, panels, "k")


def _tuned(result: Reproduction) -> Figure:
    time, paper = np.arange(1, setting.HORIZON + 1), result.paper
    designs = {"tuned": (GREEN, result.tuned), "at paper's power": (PURPLE, result.bounded)}
    trace, power = paper.trace("receiver")[1:], paper.total_power()
    panels = [
        Panel("tr P / tr P(paper)", [Curve(n, c, d.trace("receiver")[1:] / trace) for n, (c, d) in designs.items()]),
        Panel("power / power(paper)", [Curve(n, c, d.total_power() / power) for n, (c, d) in designs.items()]),
    ]
    return curves_over_time(time, panels, "k")


def page(result: Reproduction, pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    ratio, quiet = tuned_mean_ratio(result), tuned_mean_ratio(result, "bounded")
    return Page(
        kicker="Heliograph reproduction",
        title="Filter-and-forward successive relays: right recursion, greedy relays",
        lead=(
            "Two relays filter what they hear and forward it in turn. The published recursion is exact once its "
            f"misprints are mended, but each relay minimises its own error: relays tuned for the receiver leave "
            f"{100 * (1 - ratio):.0f} % less error on average over 100 steps, and {100 * (1 - quiet):.0f} % less while "
            "sending at no step more power."
        ),
        sections=[_result(result), _figures(pictures), _steady(result), _power(result), _statements(result),
                  _certificate(result), _notes(), _rerun(result)],
        footer=(
            "Paper: H. Tan, B. Shen, Q. Li, H. Liu, Recursive filtering for stochastic systems with filter-and-forward "
            "successive relays, IEEE/CAA Journal of Automatica Sinica 11(5), 2024."
        ),
    )  # fmt: skip


def _result(result: Reproduction) -> Section:
    total = {name: value.even + value.odd for name, value in result.steady.items()}
    z, where = worst_z(result)
    keys = [
        KeyFigure("mean tr P / paper, tuned", f"{tuned_mean_ratio(result):.3f}", "k = 1 .. 100", GREEN),
        KeyFigure("the same, paper's power", f"{tuned_mean_ratio(result, 'bounded'):.3f}", "at every step", PURPLE),
        KeyFigure("steady, best receiver", f"{total['lmmse_tuned'] / total['paper']:.3f}", "relays tuned for it", BLUE),
        KeyFigure("largest |z|", f"{z:.1f}", f"designed against simulated, k = {where}", MUTED),
    ]
    judged = (
        f"Designed and simulated trace of the remote filter agree within sampling error at every k = 0 .. "
        f"{setting.HORIZON}: largest |z| {z:.2f} over {result.runs} runs, where {z_limit(setting.HORIZON + 1):.1f} "
        "would be exceeded once in a thousand such comparisons (Bonferroni over the steps; standard errors from 50 "
        "batches of runs, so t with 49 degrees of freedom)."
    )
    return Section("Result", [KeyFigures(keys), Text([judged])])


def _figures(pictures: Mapping[str, bytes]) -> Section:
    blocks = [
        Picture(pictures[f"fig{2 + i}_{state}"], f"State {state} and three estimates over 100 steps",
                f"Fig. {2 + i}: one run. Relays in the world, log-normal gains.")
        for i, state in enumerate(setting.STATES)
    ]  # fmt: skip
    blocks.append(Picture(pictures["fig5_traces"], "Traces of the three error covariances, and simulated over designed",
                          "Fig. 5: traces of the error covariances; below, the remote filter's mean squared error over "
                          "the designed one, with two standard errors."))  # fmt: skip
    blocks.append(Picture(pictures["tuned"], "Ratio of traces and of powers to the paper's design",
                          "Relays and remote filter tuned for the mean of tr P_k / tr P_k(paper)."))  # fmt: skip
    return Section("Figures", blocks)


def _steady(result: Reproduction) -> Section:
    rows = []
    paper = result.steady["paper"]
    for name, title in TITLES.items():
        s = result.steady[name]
        ratio = (s.even + s.odd) / (paper.even + paper.odd)
        power = " / ".join(f"{p:.3f}" for p in s.power / paper.power) if np.any(s.power) else "none"
        rows.append([title, f"{1e6 * s.even:.4f}", f"{1e6 * s.odd:.4f}", f"{1e6 * (s.even + s.odd):.4f}",
                     f"{100 * (ratio - 1):+.1f} %", power])  # fmt: skip
    rows += [
        [name.replace("_", " "), f"{1e6 * v:.4f}", f"{1e6 * v:.4f}", f"{2e6 * v:.4f}", "", "none"]
        for name, v in result.limits.items()
    ]
    headers = ["design", "even", "odd", "sum", "against paper", "power odd / even"]
    caption = (
        "Two-periodic steady state, tr P in 1e-6, and the relays' power relative to the paper's in odd and even steps. "
        "Tuned designs are local minima, so upper bounds on the best."
    )
    return Section("Steady state", [Table(headers, rows, caption)])


def _power(result: Reproduction) -> Section:
    base = result.paper.total_power()
    rows = []
    for name, design in (("paper", result.paper), ("tuned", result.tuned), ("tuned, limited", result.bounded)):
        ratio = design.total_power() / base
        trace = design.trace("receiver") / result.paper.trace("receiver")
        at = [f"{trace[k]:.3f}" for k in (10, 50, 100)]
        rows.append([name, *at, f"{np.mean(trace[1:]):.4f}", f"{ratio.mean():.3f}", f"{ratio.max():.3f}",
                     f"{design.trace('relay_2')[-1]:.2g}"])  # fmt: skip
    headers = ["design", "k = 10", "k = 50", "k = 100", "mean", "mean power", "largest power", "tr Xi_2 at 100"]
    caption = "tr P_k and power relative to the paper's design. A tuned relay is no good estimator of its own."
    return Section("Over the horizon", [Table(headers, rows, caption)])


def _statements(result: Reproduction) -> Section:
    rows = [[c.text, c.source, c.paper, c.ours, c.verdict.replace("_", " ")] for c in statements(result)]
    headers = ["statement", "where", "paper", "here", "verdict"]
    return Section("Statements", [Table(headers, rows, "Misprints are statements that fail.", wordy=True)])


def _certificate(result: Reproduction) -> Section:
    rows = []
    for bound in result.certificates["paper"].bounds.values():
        value = "none" if bound.values is None else f"{bound.values[0]:.3g} to {bound.values[-1]:.3g}"
        obeyed = {True: "yes", False: "no", None: "no value"}[bound.holds]
        rows.append([bound.name, "yes" if bound.applies else "no: " + "; ".join(bound.failing), value, obeyed])
    caption = "Bounds on the paper's design, in corrected form; errors recomputed by code that made no gains."
    return Section("Certificate", [Table(["bound", "applies", "k = 0 to 100", "obeyed"], rows, caption, wordy=True)])


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
