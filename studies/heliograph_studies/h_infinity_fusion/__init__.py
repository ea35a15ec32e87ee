"""Quantized H-infinity fusion over amplify-and-forward relays, reproduced and judged; see README.md."""

from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PALE, PURPLE, STYLE, VERMILION, WIDTH
from heliograph_studies import Statement, Study, stated
from heliograph_studies.curves import Curve, Panel, curves_over_time
from heliograph_studies.h_infinity_fusion import compute, discriminating
from heliograph_studies.h_infinity_fusion.compute import Outcome, Parts
from heliograph_studies.h_infinity_fusion.discriminating import NODE
from heliograph_studies.h_infinity_fusion.example import (
    MORE_QUANTIZERS,
    QUANTIZERS,
    RECURSIVE,
    Runs,
    arrivals,
    fused_name,
)
from heliograph_studies.h_infinity_fusion.setting import NODES, STATES
from heliograph_studies.h_infinity_fusion.setting import Setting as Setting

NEEDS = ("clarabel", "cvxpy", "xarray", "h5netcdf")
NODE_COLOURS = (BLUE, VERMILION, GREEN, PURPLE)
LINKS = ("sensor to relay", "relay to filter", "sensor to filter")
COLOURS = {
    "horizon": BLUE, "recursive": GREEN, "ekf_statistics": VERMILION, "ekf_ignoring": AMBER, "ekf_known": PURPLE,
    "zero_gain": MUTED, "open_loop": MUTED,
}  # fmt: skip
LABELS = {
    RECURSIVE: "the paper's, recursive", "horizon": "H∞, horizon", "recursive": "H∞, recursive",
    "ekf_statistics": "EKF, statistics", "ekf_ignoring": "EKF, ignoring", "ekf_known": "EKF, informed",
    "zero_gain": "zero gain", "open_loop": "open loop",
}  # fmt: skip


def figures(answer: Outcome) -> dict[str, Figure]:
    """All figures by file name."""
    result, outcome = answer.parts, answer.parts.runs
    drawn = {f"fig{2 + i:02d}_node{node}": _node(outcome, i) for i, node in enumerate(NODES)}
    drawn["fig06_fusion"] = _fusion(outcome)
    seen = arrivals(outcome)[0]
    for i in range(3):
        drawn[f"fig{7 + i:02d}_losses"] = _losses(seen[..., i], LINKS[i])
    drawn["fig10_dynamic"] = _fused_error(outcome, "dynamic", VERMILION)
    drawn["fig11_static"] = _fused_error(outcome, "static", BLUE)
    drawn["levels"] = _levels(result)
    drawn["growth"] = _growth(result)
    drawn["quantizer"] = _quantizer(result)
    drawn["second_errors"] = _second_errors(result)
    drawn["second_levels"] = _second_levels(result)
    return drawn


def _over_steps(panels: list[Panel]) -> Figure:
    return curves_over_time(np.arange(len(panels[0].curves[0].values)), panels, "s")


def _node(outcome: Runs, i: int) -> Figure:
    estimate = outcome.estimates(RECURSIVE)[0, i]
    return _against_truth(outcome, estimate, f"node {NODES[i]}", NODE_COLOURS[i])


def _fusion(outcome: Runs) -> Figure:
    fused = np.asarray(outcome.record.estimates["fused"][fused_name(RECURSIVE, "dynamic")].mean)[0]
    return _against_truth(outcome, fused, "fused", AMBER)


def _against_truth(outcome: Runs, estimate: np.ndarray, name: str, colour: str) -> Figure:
    panels = [
        Panel(state, [Curve("true", INK, outcome.truth[:, j]), Curve(name, colour, estimate[:, j])])
        for j, state in enumerate(STATES)
    ]
    return _over_steps(panels)


@matplotlib.rc_context(STYLE)
def _losses(seen: np.ndarray, title: str) -> Figure:
    """One row for each node: a full mark for what arrived, an empty one for a loss, none where nobody can tell."""
    figure = Figure(figsize=(WIDTH, 2.0), layout="constrained")
    axes = figure.subplots()
    for i, row in enumerate(seen):
        axes.plot(np.flatnonzero(row == 1), np.full(np.sum(row == 1), i), "o", color=NODE_COLOURS[i])
        axes.plot(np.flatnonzero(row == 0), np.full(np.sum(row == 0), i), "o", color=NODE_COLOURS[i], mfc="white")
    axes.set(yticks=range(4), yticklabels=[f"node {n}" for n in NODES], ylim=(3.5, -0.5), xlabel="s")
    axes.set_title(f"{title}: arrived (full), lost (empty)")
    axes.grid(False)
    return figure


def _fused_error(outcome: Runs, quantizer: str, colour: str) -> Figure:
    errors = outcome.errors(RECURSIVE, quantizer)
    curves = [Curve("one run", MUTED, errors[0]), Curve("mean", colour, errors.mean(axis=0))]
    return _over_steps([Panel(f"norm of fused error, {quantizer}", curves)])


@matplotlib.rc_context(STYLE)
def _levels(result: Parts) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.6), layout="constrained")
    axes, true = figure.subplots(), result.true_growth
    fixed = result.readings.fixed_start
    rows: list[tuple[str, Sequence[float], str, str]] = [
        ("the paper's", result.setting.levels, VERMILION, "o"),
        ("smallest with its P₀", (fixed,) * 4, AMBER, "s"),
        ("one growth constant that is not refuted", true.constant[:, 0].tolist(), PURPLE, "D"),
        ("recursive, a = 0.7", [n.smallest["trace"] for n in result.nodes], GREEN, "^"),
        ("horizon, a = 0.7", [n.horizon.level for n in result.nodes], BLUE, "v"),
        ("K = 0, a = 0.7", [n.without_measurements for n in result.nodes], INK, "_"),
    ]
    for name, values, colour, mark in rows:
        axes.plot(range(1, 5), values, mark, color=colour, label=name, markersize=8)
    axes.set(yscale="log", ylabel="level γ", xlabel="node", xticks=range(1, 5), xlim=(0.7, 4.3))
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return figure


def _growth(result: Parts) -> Figure:
    outcome = result.growth
    curves = [
        Curve("largest slope nearby", VERMILION, outcome.slopes),
        Curve("largest ratio that happened", BLUE, outcome.secant),
        Curve("a, as printed", INK, np.full(len(outcome.secant), result.setting.growth)),
    ]
    return _over_steps([Panel("growth of f", curves)])


def _quantizer(result: Parts) -> Figure:
    d = result.replayed.amplitude.mean(axis=(0, 1))
    x = np.abs(result.runs.estimates(RECURSIVE)).mean(axis=(0, 1))
    uplink = result.runs.record.uplinks[fused_name(RECURSIVE, "dynamic")]
    share = 100 * uplink.saturated.mean(axis=(0, 2))
    states = list(zip(STATES, (BLUE, VERMILION), (0, 1), strict=True))
    panels = [
        Panel("log₁₀ of size",
              [Curve(f"d, {s}", colour, np.log10(d[:, j])) for s, colour, j in states]
              + [Curve(f"|{s}|", PALE if j else MUTED, np.log10(x[:, j])) for s, colour, j in states]),
        Panel("saturated (%)", [Curve(s, colour, share[:, j]) for s, colour, j in states]),
    ]  # fmt: skip
    return _over_steps(panels)


def _second_errors(result: Parts) -> Figure:
    names, second = ("horizon", "recursive", "ekf_statistics", "ekf_known", "open_loop"), result.discriminating
    panels = [
        Panel(f"error, {scenario}", [Curve(LABELS[n], COLOURS[n], second.over_time[scenario][n]) for n in names])
        for scenario in discriminating.SCENARIOS
    ]
    return curves_over_time(np.arange(discriminating.STEPS), panels, "step")


@matplotlib.rc_context(STYLE)
def _second_levels(result: Parts) -> Figure:
    second = result.discriminating
    names = list(second.worst)
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    axes = figure.subplots()
    for i, name in enumerate(names):
        axes.plot(second.worst[name].level, i, "o", color=COLOURS[name], markersize=8)
        if name in second.designs:
            axes.plot(second.designs[name][NODE].level, i, "|", color=COLOURS[name], markersize=16, mew=2)
    axes.set(yticks=range(len(names)), yticklabels=[LABELS[n] for n in names], ylim=(len(names) - 0.5, -0.5))
    axes.set(xscale="log", xlabel="level: found by search (dot), guaranteed (bar)")
    ticks = (5, 7, 10, 15, 20, 30)
    axes.set_xticks(ticks, labels=[str(t) for t in ticks])
    axes.set_xticks([], minor=True)
    return figure


def words(outcome: Outcome) -> dict[str, object]:
    """Labels and colours, and the rows of the tables."""
    result, second = outcome.parts, outcome.parts.discriminating
    names = ("horizon", "recursive", "zero_gain", "open_loop", "ekf_ignoring", "ekf_statistics", "ekf_known")
    behind = {q: result.runs.mean_error(RECURSIVE, q) for q in (*QUANTIZERS, *MORE_QUANTIZERS)}
    runs = {name: result.runs for name in result.runs.filters} | {"ekf_known": result.known}
    return {
        "p": result,
        "second": second,
        "node": NODE,
        "nodes": NODES,
        "links": LINKS,
        "scenarios": discriminating.SCENARIOS,
        "colours": COLOURS,
        "labels": LABELS,
        "key_colours": (BLUE, VERMILION, GREEN),
        "behind": behind,
        "errors": {LABELS[name]: [r.mean_error(name, q) for q in QUANTIZERS] for name, r in runs.items()},
        "recursive": LABELS[RECURSIVE],
        "second_names": names,
        "power": float(np.mean(result.setting.disturbances**2)),
    }


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """The example, its figures, errata, and what the second example tells, with the numbers that decide."""
    result, runs, setting = outcome.parts, outcome.parts.runs, outcome.parts.setting
    gamma, c = np.array(setting.levels), hg.fusion.level_weights(setting.levels)
    # (33) at its optimum: [-level^2 / 2N, c gamma; (c gamma)', -I].
    row, corner = (c * gamma)[None], np.full((1, 1), -(result.fused_level**2) / (2 * len(c)))
    edge = np.block([[corner, row], [row.T, -np.eye(len(c))]])
    # Shares of what arrived against the stated probabilities, in binomial standard errors.
    seen, stated_shares = arrivals(runs), np.array(setting.arrival)
    shares, count = np.nanmean(seen, axis=(0, 1, 2)), np.sum(np.isfinite(seen), axis=(0, 1, 2))
    gap = (runs.errors(RECURSIVE, "dynamic") - runs.errors(RECURSIVE, "static")).mean(axis=0)
    stuck = {o: sum(n.failed[o] is not None for n in result.nodes) for o in result.nodes[0].failed}
    numbers = {
        "paper": RECURSIVE,
        "errors": {name: runs.mean_error(name, "none") for name in runs.filters},
        "ratios": [g / n.horizon.level for g, n in zip(setting.levels, result.nodes, strict=True)],
        "split": [n.horizon.level / n.separate.level for n in result.nodes],
        "largest_gains": [np.abs(n.paper.gains).max() for n in result.nodes],
        "shares": shares,
        "shares_off": np.abs(shares - stated_shares) / np.sqrt(stated_shares * (1 - stated_shares) / count),
        "worse_at": np.flatnonzero(gap > 0).tolist(),
        "broken_at": np.flatnonzero(result.growth.secant > setting.growth).tolist(),
        "terms_at": np.flatnonzero(result.replayed.broken_local > 0).tolist(),
        "stuck": {"without": stuck.pop("none"), "with": sum(stuck.values())},
        "weights": c,
        "at_optimum": np.linalg.eigvalsh(edge)[-1],
        "symbols": runs.record.uplinks[f"{RECURSIVE}.dynamic_decodable"].symbols_per_value(),
    }
    return stated(__file__, words(outcome) | numbers)


publication = Study(
    name="h-infinity-fusion",
    setting=Setting,
    compute=compute.compute,
    stages=8,
    figures=figures,
    words=words,
    publication="Distributed fusion filtering for nonlinear time-varying systems over amplify-and-forward relay "
    "networks: an H-infinity quantized framework",
    statements=statements,
    data=compute.write_record,
    needs=NEEDS,
)
run = publication.run
