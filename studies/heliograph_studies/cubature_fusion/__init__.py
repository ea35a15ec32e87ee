"""Cubature Kalman fusion filtering under amplify-and-forward relays, reproduced and repaired; see README.md."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, STYLE, VERMILION, WIDTH
from heliograph_studies import Statement, Study, stated
from heliograph_studies.cubature_fusion import compute, one_step
from heliograph_studies.cubature_fusion.compute import Outcome, Runs
from heliograph_studies.cubature_fusion.setting import (
    B4,
    B6,
    K1,
    NODES,
    STATES,
    H,
    Scenario,
    plant,
)
from heliograph_studies.cubature_fusion.setting import FIXED_ZERO_MEAN_SCALAR as FIXED_ZERO_MEAN_SCALAR
from heliograph_studies.cubature_fusion.setting import Setting as Setting
from heliograph_studies.curves import Curve, Panel, curves_over_time, label_right

NEEDS = ("xarray", "h5netcdf")
METHOD, TWIN = "cubature_printed_fixed", "extended_printed_fixed"  # the paper's filter, and what it compares with
BETTER = ("cubature_polytope", "cubature_zero_mean", "ci_equal")  # than the paper's bound
TRIALS = 150  # random cases of Theorem 1
DRAWS = 100_000  # of the uniform Delta: their spread is known to a third of a percent
LONG = 100  # steps of the strong scenario
COLOURS = {
    "open_loop": MUTED, "mean_gain": AMBER, "cubature_printed_fixed": VERMILION, "cubature_printed": PURPLE,
    "cubature_tight": INK, "cubature_polytope": BLUE, "cubature_zero_mean": GREEN, "ci_equal": BLUE,
    "ci_optimal": PURPLE, "central": INK,
}  # fmt: skip
LABELS = {"cubature_printed_fixed": "printed, fixed β", "ci_equal": "equal weights", "ci_optimal": "optimal weights"}
NAMES = {
    "open_loop": "no measurements", "ci_optimal": "fused, optimal weights", "ci_equal": "fused, equal weights",
    "ci_printed": "fused, the paper's filters", "ci_open_loop": "fused, no measurements",
}  # fmt: skip
LITERAL = ("step_four_gain", "mixed_cross", "central_moment", "raw_moment")
NODE_COLOURS = (BLUE, AMBER, GREEN, PURPLE)


def figures(outcome: Outcome) -> dict[str, Figure]:
    """All figures by file name."""
    printed, drawn = outcome.printed, {}
    for i, state in enumerate(STATES):
        drawn[f"fig{i + 1:02d}_{state}"] = _states(printed, i)
    drawn["fig06_trace"] = _traces(printed)
    drawn["fig07_rmse_and_bound"] = _below_bound(printed)
    for i, node in enumerate(NODES):
        drawn[f"fig{i + 8:02d}_node{node}"] = _against_extended(printed, i)
    drawn["fig12_fusion"] = _fusion(printed)
    drawn["strong_filters"] = _strong_filters(outcome.strong)
    drawn["strong_fusion"] = _strong_fusion(outcome.strong)
    return drawn


def label(name: str) -> str:
    """A filter's name for reading."""
    return LABELS.get(name, name.removeprefix("cubature_").replace("_", " "))


def _states(o: Runs, i: int) -> Figure:
    assert o.shown.truth is not None
    truth = o.shown.truth[0, :, i]
    local = [np.asarray(o.shown.estimates[n][METHOD].mean)[0, :, i] for n in NODES]
    fused = np.asarray(o.shown.estimates["fused"]["ci_printed"].mean)[0, :, i]
    estimates = [*(Curve("nodes", MUTED, v) for v in local), Curve("fused", VERMILION, fused)]
    errors = [Curve(c.name, c.colour, c.values - truth) for c in estimates]
    panels = [Panel(STATES[i], [*estimates, Curve("true", INK, truth)]), Panel("error", errors)]
    return curves_over_time(o.shown.time, panels)


def _trace(o: Runs, name: str) -> np.ndarray:
    return np.asarray(np.trace(o.pooled(name).claimed(), axis1=-2, axis2=-1))


def _traces(o: Runs) -> Figure:
    local, fused = o.claimed_trace(METHOD), _trace(o, "ci_printed")
    nodes = [Curve("nodes", MUTED, v) for v in local]
    gain = Curve("fused", VERMILION, 100 * (1 - fused / local.min(axis=0)))
    traces = Panel("trace of the bound", [*nodes, Curve("fused", VERMILION, fused)])
    return curves_over_time(o.shown.time, [traces, Panel("below best node (%)", [gain])])


def _below_bound(o: Runs) -> Figure:
    bound = Curve("√trace, fused", BLUE, np.sqrt(_trace(o, "ci_printed")))
    error = Curve("RMSE, fused", VERMILION, o.pooled("ci_printed").rmse_over_time())
    local = [Curve("√trace, nodes", MUTED, np.sqrt(v)) for v in o.claimed_trace(METHOD)]
    errors = [Curve("RMSE, nodes", AMBER, v) for v in o.rmse(METHOD)]
    return curves_over_time(o.shown.time, [Panel("root of squared error", [*local, *errors, bound, error])])


def _against_extended(o: Runs, i: int) -> Figure:
    pairs = ((TWIN, "extended", BLUE), (METHOD, "cubature", VERMILION))
    curves = [Curve(text, colour, o.rmse(name)[i]) for name, text, colour in pairs]
    return curves_over_time(o.shown.time, [Panel(f"RMSE, node {NODES[i]}", curves)])


def _fusion(o: Runs) -> Figure:
    panels = []
    for name, fused, text in ((METHOD, "ci_printed", "RMSE"), ("open_loop", "ci_open_loop", "RMSE, no measurements")):
        curves = [Curve(f"node {n}", c, v) for n, c, v in zip(NODES, NODE_COLOURS, o.rmse(name), strict=True)]
        panels.append(Panel(text, [*curves, Curve("fused", VERMILION, o.pooled(fused).rmse_over_time())]))
    return curves_over_time(o.shown.time, panels)


def _over_nodes(o: Runs, name: str) -> np.ndarray:
    """Root of the mean squared error over the nodes, (time,)."""
    return np.asarray(np.sqrt(np.mean(o.rmse(name) ** 2, axis=0)))


def _strong_filters(o: Runs) -> Figure:
    names = ("mean_gain", "open_loop", "cubature_printed_fixed", "cubature_printed", "cubature_tight",
             "cubature_polytope", "cubature_zero_mean")  # fmt: skip
    curves = [Curve(label(n), COLOURS[n], _over_nodes(o, n)) for n in names]
    return _from_zero(o, "RMSE over the nodes", curves)


def _strong_fusion(o: Runs) -> Figure:
    single = Curve("one node", GREEN, _over_nodes(o, "cubature_zero_mean"))
    curves = [Curve(label(n), COLOURS[n], o.pooled(n).rmse_over_time()) for n in ("ci_optimal", "ci_equal", "central")]
    return _from_zero(o, "RMSE", [single, *curves])


@matplotlib.rc_context(STYLE)
def _from_zero(o: Runs, text: str, curves: list[Curve]) -> Figure:
    """Curves on an axis that starts at zero, so that what is low has room for its name."""
    figure = Figure(figsize=(WIDTH, 3.4), layout="constrained")
    axes = figure.subplots()
    for curve in curves:
        axes.plot(o.shown.time, curve.values, color=curve.colour, linewidth=1.4)
    axes.set(xlim=(o.shown.time[0], o.shown.time[-1]), ylim=(0.0, None), xlabel="step", ylabel=text)
    label_right(axes, {c.name: (float(c.values[-1]), c.colour) for c in curves}, 0.055)
    return figure


def words(outcome: Outcome) -> dict[str, object]:
    """Labels and colours, and the numbers of the tables: of a filter RMSE, its error, trace, and worst direction."""
    strong = outcome.strong
    return {
        "label": label,
        "named": {name: NAMES.get(name, name.replace("_", " ")) for o in outcome.both for name in _names(o)},
        "rmse": {name: strong.pooled(name).rmse() for name in (*BETTER, METHOD, "mean_gain")},
        "tables": {"strong scenario": _table(strong), "printed example": _table(outcome.printed)},
    }


def _names(o: Runs) -> list[str]:
    return [*(n for n in o.statistics[NODES[0]] if n not in LITERAL), *o.statistics["fused"]]


def _table(o: Runs) -> dict[str, object]:
    rows = {name: (*s.rmse(), s.mean_trace(), s.worst_direction()) for name, s in ((n, o.pooled(n)) for n in _names(o))}
    return {"runs": o.runs, "steps": o.steps, "rows": rows}


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """The paper's theorems and figures, what else was found, and its errata: each that a formula is right."""
    numbers = {"method": METHOD, "twin": TWIN, "better": BETTER, "trials": TRIALS}
    return stated(__file__, {**vars(outcome), **numbers, **_theorems(outcome), **_errata(outcome)})


def _theorems(outcome: Outcome) -> dict[str, object]:
    """Numbers on Theorems 1 to 3 and Fig. 6, of the printed example."""
    o, s, rule = outcome.printed, outcome.printed.scenario, hg.filters.Cubature()
    assert o.shown.truth is not None
    violations, margin = one_step.enumerate_theorem_1(TRIALS, outcome.seed, 1)
    # The trace is least where d tr(Xi) / dK = 0.
    terms = one_step.box_terms(one_step.channel_of(s), 1)
    gradient = one_step.trace_gradient(one_step.innovation(s, rule), s.beta, terms, one_step.channel_of(s))
    # Theorem 3 along one run, and what happens in its place.
    visited = [o.shown.truth[0], *(np.asarray(o.shown.estimates[node][METHOD].mean)[0] for node in NODES)]
    covariances = {
        "claimed": [o.statistics[node][METHOD].claimed() for node in NODES],
        "actual": [o.statistics[node][METHOD].actual() for node in NODES],
    }
    return {
        "violations": violations,
        "margin": margin,
        "gradient": gradient,
        "growth": one_step.growth_condition(plant(s), np.concatenate(visited), s.beta[0]),
        "largest": {name: np.linalg.eigvalsh(np.array(p)).max() for name, p in covariances.items()},
        "gain": 100 * (1 - _trace(o, "ci_printed") / o.claimed_trace(METHOD).min(axis=0)),
    }


def _errata(outcome: Outcome) -> dict[str, object]:
    """Numbers on the printed formulas."""
    s, shown, scenarios = outcome.printed.scenario, outcome.printed.shown, [o.scenario for o in outcome.both]
    cubature, exact, line = hg.filters.Cubature(), hg.filters.PolynomialMoments(2), hg.filters.Linearization()
    first, law = one_step.innovation(s, cubature), hg.Discrete([0.0, 1.0], [1.0, 0.0], 0.9)
    mixed = np.abs(one_step.mixed_cross(s) - first.Pxy).max() / np.abs(first.Pxy).max()
    local = [shown.estimates[node][METHOD] for node in NODES]
    parts = (np.stack([np.asarray(getattr(e, a))[0] for e in local], axis=1) for a in ("mean", "covariance"))
    # Predictions at the claimed covariances of node 1: f(xhat) + 1/2 tr(H Xi) by two rules, and f(xhat).
    claimed = outcome.printed.statistics["1"][METHOD].claimed()
    moved, right, straight = (
        np.array([one_step.predicted(s, rule, c)[0] for c in claimed]) for rule in (cubature, exact, line)
    )
    # Probabilities with three independent Delta do not sum to one.
    delta = np.random.default_rng(outcome.seed).uniform(-0.01, 0.01, (DRAWS, 3))
    misses = np.abs(delta.sum(axis=1))
    least = one_step.predicted(s, cubature)[1] - one_step.predicted(s, exact)[1]
    return {
        "terms": [[one_step.box_terms(one_step.channel_of(x), sign).V for sign in (1, -1)] for x in scenarios],
        "excess": [one_step.perfect_channel_excess(x) for x in scenarios],
        "minus": {
            "raw": one_step.variance_bound(law, 0), "right": one_step.variance_bound(law, -1),
            "possible": max(p * (1 - p) for p in np.linspace(0, 0.9, 901)),
        },
        "mixed": mixed,
        "moments_apart": np.linalg.norm(first.Y - first.Pyy) / np.linalg.norm(first.Y),
        "fusion_error": one_step.printed_fusion_error(*parts),
        "doubled": np.trace(one_step.predicted(s, line, claimed[9])[1]),
        "offset": np.linalg.norm(moved - straight, axis=1),
        "same": np.abs((moved - straight) - (right - straight)).max(),
        "missed": np.linalg.eigvalsh(least)[0],
        "sums_off": (misses.mean(), misses.std() / np.sqrt(DRAWS)),
        "marginal": np.abs(delta.mean(axis=0)).max(),
        "correlation": one_step.correlation_term(),
        "rotor": _rotor(s),
    }  # fmt: skip


def _rotor(s: Scenario) -> dict[str, float]:
    """Where x5, which integrates the torque, makes the rotor's Euler step unstable: |1 + h b4 + i h (k1 - x5)| > 1."""
    drift, reach = H * B6 * s.torque, np.sqrt(1 - (1 + H * B4) ** 2) / H
    late = np.hypot(1 + H * B4, H * (K1 - (0.15 + drift * LONG)))
    return {"drift": drift, "reach": reach, "step": (reach + K1 - 0.15) / drift, "late": late}


publication = Study(
    name="cubature-fusion",
    setting=Setting,
    compute=compute.compute,
    stages=5,
    figures=figures,
    words=words,
    publication="Cubature Kalman fusion filtering under amplify-and-forward relays with randomly varying channel "
    "parameters",
    statements=statements,
    data=compute.write_record,
    needs=NEEDS,
)
run = publication.run
