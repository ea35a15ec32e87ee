"""What the paper states and what its printed formulas give, beside what is found here."""

from collections.abc import Callable

import numpy as np
from scipy import stats

import heliograph as hg
from heliograph_studies.statement import Evidence, Statement, Verdict, holds, vacuous
from heliograph_studies.successive_relays.certificate import Bound, RelayCertificate
from heliograph_studies.successive_relays.compute import FILTERS, Outcome
from heliograph_studies.successive_relays.misprints import circuit, misprints, proofs

FALSE_ALARM = 1e-3  # that some step of a right design is said to disagree with the simulation
BATCHES = 50
ROUNDING = 1e-9  # relative, of moments followed over many steps
LITTLE = 0.05  # a relative difference that does not matter
HALF = 0.25  # of a mean squared error: half the error


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """All of them: results first, then bounds, then misprints."""
    return {
        "filters": [*_designs(outcome), *_estimates(outcome)],
        "bounds": [*_bounds(outcome), *_scalar_bounds(outcome), *proofs()],
        "formulas": [*misprints(outcome), *circuit(outcome)],
    }


def worst_z(outcome: Outcome, name: str = "receiver") -> tuple[float, int]:
    """Largest |designed - simulated| in standard errors over k = 0 .. horizon, and where."""
    simulated = outcome.simulated
    z = np.abs(simulated.mean[name] - outcome.designs.paper.trace(name)) / simulated.error[name]
    return float(z.max()), int(z.argmax())


def z_limit(steps: int) -> float:
    """What the largest of `steps` values of |z| exceeds with probability FALSE_ALARM at most (Bonferroni)."""
    return float(stats.t.isf(FALSE_ALARM / 2 / steps, BATCHES - 1))


def _totals(outcome: Outcome) -> dict[str, float]:
    """The steady sums of two steps, by design."""
    return {name: value.even + value.odd for name, value in outcome.states.items()}


def _designs(result: Outcome) -> list[Statement]:
    paper, total = result.designs.paper, _totals(result)
    trace, outcome = paper.trace("receiver"), result.certificates["paper"].recomputed
    bias = max(float(np.max(np.linalg.norm(outcome.mean[f], axis=1) / np.sqrt(paper.trace(f)))) for f in FILTERS)
    correlation = max(float(np.max(c)) for c in outcome.correlation.values())
    gaps = [np.abs(outcome.covariance[f] - paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    sizes = [np.abs(paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    local = float(np.max(np.array(gaps) / np.array(sizes)))
    ratio, quiet = result.tuned_mean_ratio, result.designs.mean_ratio(result.designs.bounded)
    limit = z_limit(len(trace))
    z, where = worst_z(result)
    worst = max(worst_z(result, name)[0] for name in FILTERS)
    right = result.misprints["none"]
    mean = len(paper.moments)
    return [
        Statement("the lemmas, with the corrections below, give the exact error covariances", "Lemmas 1 to 7",
            "recursions for each covariance",
            f"traces within {np.max(np.abs(right.claimed - 1)):.1g} of the second moments of the whole network over "
            f"{len(right.claimed) - 1} steps; a recursion in absolute coordinates within {local:.1g}",
            {"gap_of_traces": float(np.max(np.abs(right.claimed - 1))), "gap_of_recursions": local},
            lambda gap_of_traces, gap_of_recursions: holds(gap_of_traces < 1e-8 and gap_of_recursions < 1e-10)),
        Statement("the gains minimise the next trace of each error covariance", "Theorems 1 and 2, (12)", "optimal",
            f"error and innovation are uncorrelated to {correlation:.1g} at each of the {mean - 1} steps",
            {"largest_correlation": correlation}, lambda largest_correlation: holds(largest_correlation < 1e-8)),
        Statement("the filters of relays and receiver are designed together and are optimal", "abstract, Remark 3",
            "concurrently designed optimal recursive filters",
            "each relay's gain is the best for its own next estimate, not for the receiver's: with gains chosen for "
            f"the receiver the mean over k = 1 .. {mean - 1} of tr Pₖ / tr Pₖ(paper) is {ratio:.4f}, and {quiet:.4f} "
            f"at no step with more power than the paper's; the steady sum falls from {total['paper']:.5g} to "
            f"{total['joint']:.6g}, and to {total['lmmse_tuned']:.5g} with the best linear receiver",
            {"mean_ratio_when_tuned": ratio, "steady_ratio_when_tuned": total["joint"] / total["paper"]},
            lambda mean_ratio_when_tuned, steady_ratio_when_tuned: holds(
                min(mean_ratio_when_tuned, steady_ratio_when_tuned) >= 1 - ROUNDING)),
        Statement("the designed covariances are those of the simulated filters", "Figs. 2 to 5", "one run shown",
            f"remote filter: largest |z| {z:.2f} at k = {where} over {len(trace)} steps and {result.setting.runs} runs "
            f"(limit {limit:.1f}: false alarm {FALSE_ALARM:g} over all steps, t with {BATCHES - 1} degrees of "
            f"freedom); relays included: {worst:.2f}", {"largest_z": worst, "limit": limit},
            lambda largest_z, limit: holds(largest_z < limit)),
        Statement("inter-relay interference is eliminated in the mean", "Remark 2", "E (γ₃ − mean) ŷⱼ = 0",
            "the estimates are unbiased; but the relay subtracts its own signal for the other's, and fading is what "
            f"costs: the remote error is {trace[10]:.4g} at k = 10, of which the gains' variances make all but 0.3 %"
            if _without_fading(result) / trace[10] < 0.004 else "unbiased",
            {"largest_bias": bias}, lambda largest_bias: holds(largest_bias <= ROUNDING)),
    ]  # fmt: skip


def _estimates(outcome: Outcome) -> list[Statement]:
    paper, best = outcome.designs.paper, outcome.designs.best_behind
    trace, state = paper.trace("receiver"), np.trace(paper.moments[:, :3, :3], axis1=1, axis2=2)
    track, total = {f"relative_error_at_{k}": _relative(outcome, k) for k in (10, 50, 100)}, _totals(outcome)
    first = float(np.max(np.abs(paper.gains["receiver"][0])))
    return [
        Statement("the estimates track the state", "Section IV, Figs. 2 to 4", "competent",
            f"rms error / rms state {_relative(outcome, 10):.3f} at k = 10, {_relative(outcome, 50):.3f} at 50, "
            f"{_relative(outcome, 100):.3f} at 100; tr P / tr(nothing received) {trace[2] / state[2]:.2f} at k = 2, "
            f"{trace[10] / state[10]:.3f} at 10, {total['paper'] / 2 / outcome.limits['nothing_received']:.3f} steady",
            {**track, "steady_over_nothing_received": total["paper"] / 2 / outcome.limits["nothing_received"]},
            lambda relative_error_at_10, relative_error_at_50, relative_error_at_100, steady_over_nothing_received:
            holds(
                max(relative_error_at_10, relative_error_at_50, relative_error_at_100) < 1 / 2
                and steady_over_nothing_received < HALF)),
        Statement("the state is estimated accurately", "Section IV, Fig. 5", "a desired performance",
            f"steady tr P is {total['paper'] / 2:.4g}, {total['paper'] / total['no_relay']:.2f} times what one hop "
            f"without relays gives as late ({total['no_relay'] / 2:.4g}; {outcome.limits['no_relay_filtered']:.4g} "
            f"without delay), and {total['paper'] / total['sensor_itself']:.2f} times the floor for every receiver "
            f"behind the relays, {total['sensor_itself'] / 2:.4g}",
            {"over_the_floor": total["paper"] / total["sensor_itself"]},
            lambda over_the_floor: holds(over_the_floor < 2)),
        Statement("behind the paper's relays the remote filter (9) is good", "Theorem 2", "optimal",
            f"the best linear filter gains {100 * (1 - total['lmmse'] / total['paper']):.1f} % in the steady sum and "
            f"at most {100 * (1 - np.min(best / trace[1:])):.1f} % for k ≤ {len(state) - 1}",
            {"steady_gain": 1 - total["lmmse"] / total["paper"],
             "largest_gain": float(1 - np.min(best / trace[1:]))},
            lambda steady_gain, largest_gain: holds(max(steady_gain, largest_gain) < LITTLE)),
        Statement("L₁ carries nothing", "(31)", "not said",
            f"largest entry of L₁ {first:.1g}",
            {"largest_entry": first}, lambda largest_entry: holds(largest_entry <= ROUNDING)),
    ]  # fmt: skip


def _relative(outcome: Outcome, k: int) -> float:
    """Root of tr P_k over the root of E |x_k|^2."""
    paper, setting = outcome.designs.paper, outcome.setting
    mean = np.linalg.matrix_power(setting.transition, k) @ setting.initial_mean
    state = np.trace(paper.moments[k, :3, :3]) + float(np.sum(mean**2))
    return float(np.sqrt(paper.trace("receiver")[k] / state))


def _without_fading(outcome: Outcome) -> float:
    """tr P_10 with every gain at its mean."""
    network = outcome.setting.network()
    slots = [
        {listener: {s: hg.model.mean_gain(link) for s, link in links.items()} for listener, links in slot.items()}
        for slot in network.slots
    ]
    certain = hg.model.RelayNetwork(network.plant, network.sensor, ("relay_1", "relay_2"), slots)
    return float(hg.relays.local_error_design(certain, 10).trace("receiver")[10])


def _bounds(outcome: Outcome) -> list[Statement]:
    certificate, tuned = outcome.certificates["paper"], outcome.certificates["tuned"]
    bounds = certificate.bounds
    truth = float(outcome.trace["remote"][-1])
    upper, lower, alpha = bounds["Theorem 3, upper"], bounds["Theorem 3, lower"], bounds["Theorem 4, lower"]
    state = bounds["state covariance"]
    least = {name: min(_below_state(outcome.certificates[name], f) for f in FILTERS) for name in ("paper", "tuned")}
    assert upper.values is not None and alpha.values is not None and state.values is not None
    return [
        Statement("Ξᵢ ≤ m̄ₖ I and Pₖ ≤ m̄ₖ I", "Theorems 3 and 4, upper", "bounded",
            f"obeyed, but m̄₁₀₀ = {upper.values[-1]:.3g} where tr P₁₀₀ = {truth:.3g}: it grows without limit, since "
            f"the largest eigenvalue of Γ Γ′ is {certificate.constants['tau_upper']:.4f}",
            {"growth": certificate.constants["tau_upper"],
             "obeyed": int(bool(upper.holds and bounds["Theorem 4, upper"].holds))},
            lambda growth, obeyed: vacuous(obeyed, growth >= 1)),
        Statement("Ξᵢ ≥ mₖ I", "Theorem 3, lower", "if a condition holds",
            "does not apply: " + "; ".join(lower.failing), *_conditional(lower)),
        Statement("Pₖ ≥ pₖ I", "Theorem 4, lower", "a positive bound",
            f"pₖ falls to {alpha.values[1]:.1g} at k = 1 and {alpha.values[-1]:.1g} at k = 100; assumption missed: "
            + "; ".join(alpha.failing), *_conditional(alpha)),
        Statement("uniform bounds m I ≤ Ξᵢ ≤ m̄ I, p I ≤ Pₖ ≤ m̄ I", "Lemmas 8 and 9",
            "boundedness is guaranteed",
            "do not apply to the paper's own example: " + bounds["Lemma 8, upper"].failing[0],
            {"assumptions_missed": len(bounds["Lemma 8, upper"].failing)},
            lambda assumptions_missed: holds(assumptions_missed == 0)),
        Statement("errors are bounded for all time", "abstract", "from Lemmas 8 and 9",
            "true for another reason: Ξᵢ, Pₖ ≤ cov xₖ for gains that are optimal for one step, and the spectral "
            f"radius of Γ is {state.assumptions[1].result}; largest eigenvalue of cov xₖ {np.max(state.values):.3g}",
            {"assumptions_missed": len(state.failing), "least_slack": least["paper"]},
            lambda assumptions_missed, least_slack: holds(assumptions_missed == 0 and least_slack >= -ROUNDING)),
        Statement("Pₖ ≤ cov xₖ also for jointly tuned gains", "not in the paper", "not said",
            f"smallest eigenvalue of cov xₖ - Pₖ over its trace {_below_state(tuned, 'receiver'):.2g} (relay 2: "
            f"{_below_state(tuned, 'relay_2'):.2g}), against {_below_state(certificate, 'receiver'):.2g} for the "
            "paper's gains: the proof needs the gain that is best for one step",
            {"least_slack": least["tuned"]}, lambda least_slack: holds(least_slack >= -ROUNDING)),
    ]  # fmt: skip


def _scalar_bounds(outcome: Outcome) -> list[Statement]:
    scalar, printed = outcome.certificates["scalar"].bounds, _printed_scalar()
    remote, relay = (_scalar_limit(outcome, name) for name in ("receiver", "relay_1"))
    highest = [scalar[name].values for name in ("Lemma 8, upper", "Lemma 9, upper")]
    tops = max(values[0] for values in highest if values is not None)
    return [
        Statement("m̄ = τ p₀ + w / (1 - τ) bounds the errors", "Lemma 8, upper",
            f"{printed['upper']:.4g} on a scalar system",
            f"10 at k = 0: fails there; max(p₀, w / (1 - τ)) = {tops:.4g} is obeyed",
            {"bound": printed["upper"], "error": 10.0}, lambda bound, error: holds(bound >= error)),
        Statement("p = α p₀ + w / (1 - α) ≤ Pₖ", "Lemma 9, lower, and (51)", f"{printed['receiver']:.4g}",
            f"P₆₀ = {remote:.4g} on the same system; min(p₀, w / (1 - α)) is {_holds(scalar['Lemma 9, lower'])}",
            {"bound": printed["receiver"], "error": remote}, lambda bound, error: holds(bound <= error)),
        Statement("m = ρ p₀ + w̃ / (1 - ρ) ≤ Ξᵢ", "Lemma 8, lower", f"{printed['relay']:.4g}",
            f"Ξ₁ = {relay:.4g} at k = 60 on the same system; the corrected bound is {_holds(scalar['Lemma 8, lower'])}",
            {"bound": printed["relay"], "error": relay}, lambda bound, error: holds(bound <= error)),
    ]  # fmt: skip


def _holds(bound: Bound) -> str:
    return "obeyed" if bound.holds else "broken"


def _conditional(bound: Bound) -> tuple[Evidence, Callable[..., Verdict]]:
    """A bound that is obeyed says nothing if it need not be."""
    return (
        {"assumptions_missed": len(bound.failing), "obeyed": int(bound.holds is not False)},
        lambda assumptions_missed, obeyed: vacuous(obeyed or assumptions_missed, assumptions_missed > 0),
    )


def _scalar_limit(outcome: Outcome, name: str) -> float:
    return float(outcome.certificates["scalar"].recomputed.covariance[name][-1, 0, 0])


def _printed_scalar() -> dict[str, float]:
    """Lemmas 8 and 9 as printed on x+ = 0.5 x + w, W = V = Psi = 1, P_0 = 10, G = O = 1e6, means 0.5, var 0.1."""
    tau, w, p0, noise, mu, phi = 0.25, 1.0, 10.0, 1e6, 0.5, 0.1
    upper = tau * p0 + w / (1 - tau)
    n, weight = (mu**2 + phi) * (1 + 1) + noise, 2 * mu**2 * (2 * tau + 3) * upper
    rho = tau * (n - weight * mu**2 / phi) / (n + weight)
    alpha = tau * noise / (noise + 4 * mu**2 * upper)
    # varrho below 1: the largest that (45) allows with s -> 0 is phi / (phi + mu^2)
    left = phi / (phi + mu**2)
    return {
        "upper": upper,
        "receiver": alpha * p0 + w / (1 - alpha),
        "relay": rho * p0 + left * w / (1 - rho),
    }


def _below_state(certificate: RelayCertificate, name: str) -> float:
    """Smallest eigenvalue of cov x_k - E e e' over its trace, over all k."""
    result = certificate.recomputed
    gap = np.linalg.eigvalsh(result.state - result.covariance[name])[:, 0]
    return float(np.min(gap / np.trace(result.state, axis1=1, axis2=2)))
