"""The report of the reproduction."""

from collections.abc import Mapping, Sequence

import numpy as np

from heliograph.report.figures import BLUE, GREEN, VERMILION
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.h_infinity_fusion import setting, structured
from heliograph_studies.h_infinity_fusion.compute import Reproduction
from heliograph_studies.h_infinity_fusion.discriminating import NODE
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Outcome
from heliograph_studies.h_infinity_fusion.pictures import COLOURS, LABELS, LINKS
from heliograph_studies.statement import Statement
from heliograph_studies.verdicts import verdict_blocks


def page(result: Reproduction, statements: Sequence[Statement], pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    second, node = result.discriminating, result.nodes[0]
    times = setting.LEVELS[0] / node.without_measurements
    kalman = second.worst["ekf_statistics"].level
    return Page(
        kicker="Reproduction: quantized H∞ fusion over amplify-and-forward relays",
        title=f"A guarantee {times:.0f} times weaker than that of hearing nothing",
        lead=(
            f"The paper's inequalities are right. But its example guarantees node 1 an H∞ level of "
            f"{setting.LEVELS[0]:g} where, by its own growth constant, {node.without_measurements:.3f} holds without "
            "any measurement; that constant is false; and its quantizer saturates in "
            f"{100 * result.saturated('dynamic'):.0f} % of the samples. In an example that tells filters apart, H∞ "
            f"design guarantees node {NODE} a level of {second.designs['horizon'][NODE].level:.2f} where a Kalman "
            f"filter can be driven to {kalman:.2f}, at the price of larger errors under white noise."
        ),
        sections=[
            _result(result),
            _statements(statements),
            _levels(result, pictures),
            _growth(result, pictures),
            _errors(result, pictures),
            _second(result, pictures),
            _notes(result),
            *_figures(pictures),
            Section("Run it again", [Code(
                f"heliograph reproduce h-infinity-fusion --out out --runs {result.outcome.runs} --seed {result.seed}"
            )]),
        ],
        footer="Every number is in summary.json, certificates included; the runs' means and one run are in record.nc.",
    )  # fmt: skip


def _result(result: Reproduction) -> Section:
    own = result.outcome.mean_error(RECURSIVE, "none")[0]
    dynamic, static = (result.outcome.mean_error(RECURSIVE, q)[0] for q in ("dynamic", "static"))
    keys = [
        KeyFigure("smallest level", f"{min(n.horizon.level for n in result.nodes):.4f}",
                  "if a = 0.7 were true; the paper: 1.7 to 1.9", BLUE),
        KeyFigure("saturated samples", f"{100 * result.saturated('dynamic'):.0f} %", "of the dynamic quantizer",
                  VERMILION),
        KeyFigure("mean fused error", f"{own:.4f}", f"dynamic {dynamic:.4f}, static {static:.4f}", GREEN),
    ]  # fmt: skip
    words = (
        "A **level** γ is a promise: the energy of the error stays below γ² times that of all disturbances and of the "
        "initial error, whatever these are. Smaller is better. A sample is **saturated** if it is larger than the "
        "quantizer can send; then nothing is guaranteed."
    )
    return Section("The result", [KeyFigures(keys), Text([words])])


def _levels(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    rows = []
    for name, node, level in zip(setting.NODES, result.nodes, setting.LEVELS, strict=True):
        found = [*node.smallest.values(), node.horizon.level, node.separate.level, node.without_measurements]
        rows.append([f"node {name}", f"{level:g}", *(f"{v:.5f}" for v in found)])
    headers = ["", "paper", "trace", "log det", "eigenvalue", "horizon", "separate", "no measurement"]
    caption = (
        "Smallest levels that Theorem 1 proves with a = 0.7. **Trace, log det, eigenvalue**: step by step, by what "
        "picks one of the feasible solutions. **Horizon**: all steps as one convex problem; **separate**: with one "
        "multiplier for each growth condition."
    )
    return Section("Levels", [
        Table(headers, rows, caption),
        Picture(pictures["levels"], "Levels of four nodes on a logarithmic axis, the paper's far above all others.",
                "The paper's levels and the smallest ones, by node."),
    ])  # fmt: skip


def _growth(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    true = result.true_growth
    rows = [
        [name + text, *(f"{v:.4f}" for v in values[:, i])]
        for name, values in (("one constant", true.one), ("0.7 for f, one for f~", true.differences),
                             ("0.7 for f, one per step for f~", true.each_step))
        for i, text in enumerate(("", "; separate"))
    ]  # fmt: skip
    headers = ["growth", *(f"node {n}" for n in setting.NODES)]
    caption = (
        "Levels with slopes that no pair broke in the boxes where the runs went, 10 % wider: what may be called "
        "certified there, and not for states elsewhere."
    )
    text = (
        f"The printed a = 0.7 bounds |f(x)| / |x|, not |f(x) − f(x̂)| / |x − x̂|. Over |x| ≤ 2 the ratio reaches "
        f"{result.growth.whole.ratio:.1f} at s = 15, and the guarantee fails: a = 0.7 "
        f"proves the level {result.nodes[0].horizon.level:.5f} of node 1, and a disturbance with "
        f"{result.broken.level:.5f} exists."
    )
    return Section("The growth constant", [
        Text([text]),
        Picture(pictures["growth"], "Slopes over the steps lie above 0.7 at all steps but the first.",
                "Largest slope of f in the box visited at each step, and the largest ratio among state and estimates."),
        Table(headers, rows, caption),
    ])  # fmt: skip


def _row(outcome: Outcome, name: str) -> list[str]:
    found = [outcome.mean_error(name, q) for q in ("none", "dynamic", "static")]
    return [LABELS[name], *(_pair(*each) for each in found)]


def _pair(mean: float, error: float) -> str:
    """Without an error where nothing is random."""
    return f"{mean:.5f} ± {error:.5f}" if error > 1e-9 else f"{mean:.5f}"


def _errors(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    outcome = result.outcome
    rows = [_row(outcome, name) for name in outcome.filters] + [_row(result.told, "ekf_told")]
    more = [[LABELS[RECURSIVE] + ", " + text, _pair(mean, error)] for text, (mean, error) in (
        ("p = 41, static", outcome.mean_error(RECURSIVE, "static_p41")),
        ("decodable, with escapes", outcome.mean_error(RECURSIVE, "dynamic_decodable")))]  # fmt: skip
    caption = (
        f"Mean over {outcome.runs:,} runs and s = 0 ... 15 of the norm of the fused error, ± one standard error, by "
        "quantizer; all estimates are one-step predictions, fused with c ∝ 1/γ². The filter told of losses runs in a "
        "second network, on other draws. Where nothing is random, neither is the error."
    )
    return Section("Errors, and what the quantizer does", [
        Table(["filter", "none", "dynamic", "static"], rows, caption),
        Table(["quantizer", "mean fused error"], more),
        Picture(pictures["fig10_dynamic"], "Norm of the fused error over 16 steps, one run and the mean.",
                "Fig. 10: fused error, dynamic quantizer."),
        Picture(pictures["fig11_static"], "The same behind the static quantizer, which levels off higher.",
                "Fig. 11: fused error, static quantizer: p = 40 has no level at zero."),
        Picture(pictures["quantizer"], "The amplitude d falls below the estimates, and the quantizer saturates.",
                "Above: mean amplitude d and mean size of the estimates. Below: share of saturated samples."),
    ])  # fmt: skip


def _figures(pictures: Mapping[str, bytes]) -> list[Section]:
    states = [
        Picture(
            pictures[f"fig{2 + i:02d}_node{n}"], f"State and estimate of node {n}.", f"Fig. {2 + i}: node {n}, one run."
        )
        for i, n in enumerate(setting.NODES)
    ]
    states.append(Picture(pictures["fig06_fusion"], "State and fused estimate.", "Fig. 6: fused, dynamic quantizer."))
    losses = [
        Picture(
            pictures[f"fig{7 + i:02d}_losses"], f"Which packets arrived, {link}.", f"Fig. {7 + i}: {link}, one run."
        )
        for i, link in enumerate(LINKS)
    ]
    text = "Read off what was received; the first hop cannot be seen where the second lost the packet."
    return [Section("States and estimates (Figs 2 to 6)", states),
            Section("Losses (Figs 7 to 9)", [Text([text]), *losses])]  # fmt: skip


def _second(result: Reproduction, pictures: Mapping[str, bytes]) -> Section:
    second, rows = result.discriminating, []
    for name in ("horizon", "recursive", "zero_gain", "open_loop", "ekf_ignoring", "ekf_statistics", "ekf_told"):
        errors = [each[s][name] for s in structured.SCENARIOS for each in (second.errors, second.local_errors)]
        level = f"{second.designs[name][NODE].level:.2f}" if name in second.designs else "none"
        worst = f"{second.worst[name].level:.2f}" if name in second.worst else "–"
        rows.append([LABELS[name], level, worst, *(f"{m:.2f}" for m, _ in errors)])
    caption = (
        f"**Proven** and **found**: level of node {NODE}, proven and by search (a lower bound on the true one). "
        f"Then the mean norm of the fused error of three nodes, and of node {NODE} alone, over {second.runs:,} runs, "
        "under three disturbances v of mean square one; channel noises are white. A Kalman filter minimises its own "
        "error under white noise, not that of the fusion."
    )
    text = (
        "The printed example cannot tell filters apart. Here the state turns, lightly damped, and measurements are "
        "noisy: Kalman filters, tuned to the very white noise of the first column, trust the model and are driven at "
        "its resonance. H∞ design pays for its guarantee with larger errors under white noise and under a bias, at a "
        "single node even larger than without measurements. Without knowing A, by growth alone, the level is "
        f"{second.without_structure[NODE]:.1f}."
    )
    headers = ["filter", "proven", "found", *(h for s in structured.SCENARIOS for h in (s, f"node {NODE}"))]
    colours = [COLOURS[n] for n in ("horizon", "recursive", "zero_gain", "open_loop", "ekf_ignoring",
                                    "ekf_statistics", "ekf_told")]  # fmt: skip
    return Section("An example that tells filters apart", [
        Text([text]),
        Table(headers, rows, caption, colours),
        Picture(pictures["second_levels"], "Levels found by search, and those guaranteed, by filter.",
                f"Node {NODE}: each dot is a disturbance that exists; each bar is proven."),
        Picture(pictures["second_errors"], "Mean fused error over 40 steps under three disturbances.",
                "Mean fused error over the runs: white noise, a constant, a sinusoid at the resonance."),
    ])  # fmt: skip


def _statements(statements: Sequence[Statement]) -> Section:
    return Section("What the paper states", verdict_blocks(statements))


def _notes(result: Reproduction) -> Section:
    power = float(np.mean(setting.DISTURBANCES**2))
    return Section("What the paper leaves open", [Points([
        "v_s divides by zero at s = 0 as printed; the root of s + 1 is used, as in the other noises.",
        "Gains are not unique: many attain the same level, with different errors. The paper's objective is not given; "
        "the smallest trace of L is used.",
        f"Kalman filters need covariances, and the paper has none. They take v as white of variance {power:.4f}, its "
        "mean square over the horizon, channel noises likewise, and an initial covariance of "
        f"{setting.INITIAL_VARIANCE:.3f} I, the mean square of the first errors.",
        "Q in (12) is read as a scalar for each component.",
        "A growth constant that is not refuted was searched for, not proven.",
    ])])  # fmt: skip
