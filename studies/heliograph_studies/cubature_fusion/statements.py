"""What the paper states, and what was found on the way, judged by this run's numbers."""

import numpy as np

import heliograph as hg
from heliograph_studies.cubature_fusion import one_step
from heliograph_studies.cubature_fusion.compute import Outcome, Runs
from heliograph_studies.cubature_fusion.errata import errata, ratio, rmse, worst
from heliograph_studies.cubature_fusion.one_step import growth_condition
from heliograph_studies.cubature_fusion.setting import NODES, Scenario, plant
from heliograph_studies.statement import Sampled, Statement, holds, if_met, vacuous

METHOD, TWIN = "cubature_printed_fixed", "extended_printed_fixed"  # the paper's filter, and what it compares with
THEOREM, FIGURES = "paper", "paper, Section IV"
OURS = "not in the paper"
TRIALS = 150  # random cases of Theorem 1
BETTER = ("cubature_polytope", "cubature_zero_mean", "ci_equal")  # than the paper's bound
LITTLE = 1.05  # an error that is no larger without measurements, but for this factor


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """All statements: the paper's theorems and figures, what else was found, then the errata."""
    return {
        "paper": [*theorems(outcome), *figures(outcome.printed)],
        "found": [*findings(outcome), *better(outcome.strong)],
        "errata": errata(outcome),
    }


def theorems(outcome: Outcome) -> list[Statement]:
    """Theorems 1 to 3."""
    violations, margin = one_step.enumerate_theorem_1(TRIALS, outcome.seed, 1)
    ours = (
        f"{violations} violations in {TRIALS} random joint laws, channel laws at the ends of their intervals, and "
        f"gains; least relative margin {margin:.1e}. It takes the true P⁻, P^xy and E[yy′]"
    )
    return [
        Statement("(10) is an upper bound of the error covariance", f"{THEOREM}, Theorem 1", "one step", ours,
                  {"violations": violations}, lambda violations: holds(violations == 0)),
        _whole_filter(outcome),
        _gain(outcome.printed.scenario),
        _boundedness(outcome.printed),
    ]  # fmt: skip


def _whole_filter(outcome: Outcome) -> Statement:
    exact = [ratio(o, "exact_moments_printed_fixed") for o in outcome.both]
    ours = (
        f"Actual over claimed in the worst direction: {ratio(outcome.printed, METHOD)} printed, "
        f"{ratio(outcome.strong, METHOD)} strong. It is the prediction that is too small. Exact moments repair the "
        f"printed example, {exact[0]}, and not quite the strong one, {exact[1]}: the error is not Gaussian, as they "
        "take it to be"
    )
    return Statement("The filter's Ξ is an upper bound, in every direction", f"{THEOREM}, Theorem 1 with Algorithm 1",
                     "“minimum upper bound”", ours,
                     {"printed": worst(outcome.printed, METHOD), "strong": worst(outcome.strong, METHOD)},
                     lambda printed, strong: holds(printed.at_most(1) and strong.at_most(1)))  # fmt: skip


def _gain(s: Scenario) -> Statement:
    ch, rule = one_step.channel_of(s), hg.filters.Cubature()
    gradient = one_step.trace_gradient(one_step.innovation(s, rule), s.beta, one_step.box_terms(ch, 1), ch)
    ours = f"tr Ξ is a convex quadratic of K; its gradient at (29) is {gradient:.0e} of its terms"
    return Statement("(29) minimises the trace", f"{THEOREM}, Theorem 2", "", ours,
                     {"relative_gradient": gradient},
                     lambda relative_gradient: holds(relative_gradient < 1e-12))  # fmt: skip


def _boundedness(o: Runs) -> Statement:
    assert o.shown.truth is not None
    states = np.concatenate([o.shown.truth[0], *(np.asarray(o.shown.estimates[n][METHOD].mean)[0] for n in NODES)])
    result = growth_condition(plant(o.scenario), states, o.scenario.beta[0])
    statistics = [o.statistics[node][METHOD] for node in NODES]
    claimed, actual = (
        max(float(np.linalg.eigvalsh(covariance)[:, -1].max()) for covariance in covariances)
        for covariances in ([s.claimed() for s in statistics], [s.actual() for s in statistics])
    )
    ours = (
        f"θ ≤ ϑ needs (1 + β₁)(1 + ε) σ²max(Φ) < 1. Over the states of a run it is at least {result.factor:.3f}, so it "
        f"fails by {result.excess:.3f}; σ²max(Φ) is {result.gains.min():.3f} to "
        f"{result.gains.max():.3f}, and never below "
        f"1, since Φ₅₅ = 1. In its place, empirical over 40 steps: largest eigenvalue claimed {claimed:.3f}, actual "
        f"{actual:.4f}"
    )
    return Statement("Ξ stays below ϑI for all time", f"{THEOREM}, Theorem 3", "“sufficient conditions”", ours,
                     {"factor": result.factor}, lambda factor: if_met(factor < 1))  # fmt: skip


def figures(o: Runs) -> list[Statement]:
    """Figs 1 to 12, on the printed example."""
    return [_estimates(o), _fused_trace(o), _below_bound(o), _against_extended(o), _fused_error(o), _precision(o)]


def _estimates(o: Runs) -> Statement:
    fused, blind = (o.pooled(name).rmse() for name in ("ci_printed", "ci_open_loop"))
    size = np.sqrt(np.mean(np.sum(_truth(o) ** 2, axis=1)))
    ours = (
        f"Fused RMSE {fused[0]:.4f} of a state of size {size:.2f}, and {blind[0]:.4f} without any measurement (K = 0)"
    )
    return Statement("The scheme reliably estimates the states", f"{FIGURES}, Figs 1-5", "no numbers", ours,
                     {"fused": Sampled(*fused), "without_measurements": Sampled(*blind), "state": float(size)},
                     lambda fused, without_measurements, state: vacuous(
                         fused.value < state, without_measurements.value <= fused.value * LITTLE))  # fmt: skip


def _truth(o: Runs) -> np.ndarray:
    assert o.shown.truth is not None
    result: np.ndarray = o.shown.truth[0]
    return result


def _fused_trace(o: Runs) -> Statement:
    local = o.claimed_trace(METHOD).min(axis=0)
    fused = np.trace(o.pooled("ci_printed").claimed(), axis1=-2, axis2=-1)
    gain = 100 * (1 - fused / local)
    shown = ", ".join(f"{abs(gain[s - 1]):.1f} % at s = {s}" for s in (1, 3, 15, 40) if s <= len(gain))
    ours = f"Never above (largest excess {-gain.min():.1e} %), lower by {shown}: each node alone is a choice of weights"
    text = "The fused trace stays significantly below the local ones"
    return Statement(text, f"{FIGURES}, Fig. 6", "no numbers", ours, {"least_gain_percent": float(gain.min())},
                     lambda least_gain_percent: holds(least_gain_percent >= -1e-8))  # fmt: skip


def _below_bound(o: Runs) -> Statement:
    slack = np.sqrt(o.claimed_trace(METHOD)) / o.rmse(METHOD)
    blind = np.sqrt(o.claimed_trace("open_loop")) / o.rmse("open_loop")
    ours = (
        f"√trace is {slack.min():.1f} to {slack.max():.1f} times the RMSE, without measurements {blind.min():.1f} to "
        f"{blind.max():.1f} times: the guess 1.25 I is loose, and x5 is never learnt"
    )
    return Statement("The RMSE stays below the bound", f"{FIGURES}, Fig. 7", "RMSE against trace", ours,
                     {"least_root_over_rmse": float(slack.min()), "without_measurements": float(blind.min())},
                     lambda least_root_over_rmse, without_measurements: vacuous(
                         least_root_over_rmse >= 1, without_measurements >= 1))  # fmt: skip


def _against_extended(o: Runs) -> Statement:
    cubature, extended = o.rmse(METHOD), o.rmse(TWIN)
    below = np.sum(cubature <= extended, axis=1)
    means = [", ".join(f"{v:.4f}" for v in values.mean(axis=1)) for values in (cubature, extended)]
    ours = (
        f"Below it in only {', '.join(map(str, below))} of {cubature.shape[1]} steps (nodes 1 to 4). Mean over steps "
        f"{means[0]} against {means[1]}: with Ξ = 1.25 I the cubature mean moves off by ½ tr(HₖΞ), away from the truth "
        "for these guesses"
    )
    text = "The cubature filter's RMSE always stays below the extended one's"
    return Statement(text, f"{FIGURES}, Figs 8-11", "always", ours,
                     {"steps_above": int(cubature.size - below.sum())},
                     lambda steps_above: holds(steps_above == 0))  # fmt: skip


def _fused_error(o: Runs) -> Statement:
    def steps_above(fused: str, local: str) -> int:
        return int(np.count_nonzero(o.pooled(fused).rmse_over_time() > o.rmse(local).min(axis=0)))

    above, blind = steps_above("ci_printed", METHOD), steps_above("ci_open_loop", "open_loop")
    means = [
        (o.pooled(f).rmse()[0], o.rmse(n).mean()) for f, n in (("ci_printed", METHOD), ("ci_open_loop", "open_loop"))
    ]
    ours = (
        f"RMSE {means[0][0]:.4f} against {means[0][1]:.4f} (mean of the nodes); without measurements {means[1][0]:.4f} "
        f"against {means[1][1]:.4f}: it averages four wrong guesses. Below every node at every step: "
        f"{'no' if above else 'yes'}, without measurements {'no' if blind else 'yes'}"
    )
    return Statement("The fused RMSE stays below the local ones", f"{FIGURES}, Fig. 12", "no numbers", ours,
                     {"steps_above": above, "without_measurements": blind},
                     lambda steps_above, without_measurements: vacuous(
                         steps_above == 0, without_measurements == 0))  # fmt: skip


def _precision(o: Runs) -> Statement:
    means = [", ".join(f"{v:.4f}" for v in o.rmse(name).mean(axis=1)) for name in (METHOD, "open_loop")]
    gain = o.scenario.amplitude * o.scenario.mean_gain
    gained = float(np.min(o.rmse("open_loop").mean(axis=1) - o.rmse(METHOD).mean(axis=1)))
    ours = (
        f"RMSE, mean over steps, nodes 1 to 4: {means[0]}; without measurements {means[1]}. The signal arrives with "
        f"gain {gain:.4f} in noise of standard deviation {np.sqrt(o.scenario.receiver_noise):.3f}"
    )
    return Statement("Measurements enhance the precision of the example", f"{THEOREM}, contribution 2", "", ours,
                     {"least_gain_of_a_node": gained},
                     lambda least_gain_of_a_node: holds(least_gain_of_a_node > 0))  # fmt: skip


def findings(outcome: Outcome) -> list[Statement]:
    """What was found about the bounds and the fusion."""
    strong, early = outcome.strong, outcome.early
    return [
        _is_bound(strong, "mean_gain", "A filter that takes the mean gain for the true one knows its error"),
        _is_bound(strong, "cubature_polytope", "The polytope bound is one"),
        _is_bound(strong, "cubature_zero_mean", "The zero-mean bound is one"),
        _is_bound(early, "ci_optimal", "Trace-optimal intersection of zero-mean bounds is a bound",
                  "weights chosen on data-dependent bounds prefer whoever is too sure"),
        _is_bound(early, "ci_equal", "Equal-weight intersection of zero-mean bounds is a bound"),
        _is_bound(early, "central", "The sequential central filter with the zero-mean bound has one",
                  "behind uncertain gains its first correction is no conditional mean, which the next one needs"),
        _is_bound(strong, "central_polytope", "The sequential central filter with the polytope bound has one"),
        _weights(strong),
    ]  # fmt: skip


def _is_bound(o: Runs, name: str, text: str, reason: str = "") -> Statement:
    """Whether the actual covariance stays below the claimed one but for sampling."""
    result = f"Actual over claimed in the worst direction {ratio(o, name)}, {o.steps} steps, {o.runs:,} runs, strong"
    judged = Statement(text, OURS, "", result, {"actual_over_claimed": worst(o, name)},
                       lambda actual_over_claimed: holds(actual_over_claimed.at_most(1)))  # fmt: skip
    return judged._replace(ours=f"{result}: {reason}") if reason and judged.verdict == "fails" else judged


def _weights(o: Runs) -> Statement:
    traces = [o.pooled(name).mean_trace() for name in ("ci_optimal", "ci_equal")]
    errors = [Sampled(*o.pooled(name).rmse()) for name in ("ci_optimal", "ci_equal")]
    ours = (
        f"Strong: RMSE {rmse(o, 'ci_optimal')} with optimal, {rmse(o, 'ci_equal')} with equal weights, though equal "
        f"ones claim {100 * (traces[1] / traces[0] - 1):+.1f} % of trace"
    )
    return Statement("Trace-optimal weights give the better fused estimate", OURS, "", ours,
                     {"optimal": errors[0], "equal": errors[1]},
                     lambda optimal, equal: holds(optimal.value <= equal.value))  # fmt: skip


def better(o: Runs) -> list[Statement]:
    """What a user of the repaired method may expect, in the strong scenario: the runs are the same."""
    base = f"paper's bound, fixed scalars {rmse(o, METHOD)}; mean gain {rmse(o, 'mean_gain')}"
    return [
        Statement(f"The RMSE of {name.replace('_', ' ')} is below that of the paper's bound (strong)", OURS, "",
                  f"{rmse(o, name)}; {base}",
                  {"local": Sampled(*o.pooled(name).rmse()), "papers": Sampled(*o.pooled(METHOD).rmse())},
                  lambda local, papers: holds(local.below(papers.value)))
        for name in BETTER
    ]  # fmt: skip
