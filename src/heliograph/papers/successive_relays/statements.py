"""What the paper states and what its printed formulas give, beside what is found here."""

import numpy as np
from scipy import stats

import heliograph as hg
from heliograph.papers.statement import Statement, holds
from heliograph.papers.successive_relays import setting
from heliograph.papers.successive_relays.certificate import RelayCertificate
from heliograph.papers.successive_relays.compute import FILTERS, Misprinted, Reproduction, misprinted

FALSE_ALARM = 1e-3  # that some step of a right design is told to disagree with the simulation
BATCHES = 50


def statements(result: Reproduction) -> list[Statement]:
    """All of them: results first, then bounds, then misprints."""
    return [*_results(result), *_bounds(result), *_misprints(result), *_circuit(result)]


def worst_z(result: Reproduction, name: str = "receiver") -> tuple[float, int]:
    """Largest |designed - simulated| in standard errors over k = 0 .. horizon, and where."""
    simulated = result.simulated
    z = np.abs(simulated.mean[name] - result.paper.trace(name)) / simulated.error[name]
    return float(z.max()), int(z.argmax())


def z_limit(steps: int) -> float:
    """What the largest of `steps` values of |z| exceeds with probability FALSE_ALARM at most (Bonferroni)."""
    return float(stats.t.isf(FALSE_ALARM / 2 / steps, BATCHES - 1))


def tuned_mean_ratio(result: Reproduction, name: str = "tuned") -> float:
    """Mean over k = 1 .. horizon of tr P_k / tr P_k(paper)."""
    design = result.tuned if name == "tuned" else result.bounded
    return float(np.mean(design.trace("receiver")[1:] / result.paper.trace("receiver")[1:]))


def _results(result: Reproduction) -> list[Statement]:
    trace, state = result.paper.trace("receiver"), np.trace(result.paper.moments[:, :3, :3], axis1=1, axis2=2)
    found = result.certificates["paper"].recomputed
    correlation = max(float(np.max(c)) for c in found.correlation.values())
    gaps = [np.abs(found.covariance[f] - result.paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    sizes = [np.abs(result.paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    own = float(np.max(np.array(gaps) / np.array(sizes)))
    steady, ratio, limit = result.steady, tuned_mean_ratio(result), z_limit(len(trace))
    total = {name: value.even + value.odd for name, value in steady.items()}
    z, where = worst_z(result)
    worst = max(worst_z(result, name)[0] for name in FILTERS)
    right = result.misprints["none"]
    mean = result.paper.moments[:, :3, :3].shape[0]
    return [
        Statement("the lemmas, with the corrections below, give the exact error covariances", "Lemmas 1 to 7",
            "recursions for each covariance",
            f"traces within {np.max(np.abs(right.claimed - 1)):.1g} of the second moments of the whole network over "
            f"{len(right.claimed) - 1} steps; a recursion in absolute coordinates within {own:.1g}",
            holds(np.max(np.abs(right.claimed - 1)) < 1e-8 and own < 1e-10)),
        Statement("the gains minimise the next trace of each error covariance", "Theorems 1 and 2, (12)", "optimal",
            f"error and innovation are uncorrelated to {correlation:.1g} at every step of the {mean - 1}",
            holds(correlation < 1e-8)),
        Statement("the filters of relays and system are designed together and are optimal", "abstract, Remark 3",
            "concurrently designed optimal recursive filters",
            f"optimal for one step only: tuned for the receiver, the mean over k = 1 .. {mean - 1} of "
            f"tr P_k / tr P_k(paper) is {ratio:.4f}, at no step more power than the paper's "
            f"{tuned_mean_ratio(result, 'bounded'):.4f}; the steady sum falls from {total['paper']:.5g} to "
            f"{total['joint']:.6g}, and to {total['lmmse_tuned']:.5g} with the best linear receiver", "fails"),
        Statement("the designed covariances are those of the simulated filters", "Figs. 2 to 5", "one run shown",
            f"remote filter: largest |z| {z:.2f} at k = {where} over {len(trace)} steps and {result.runs} runs "
            f"(limit {limit:.1f}: false alarm {FALSE_ALARM:g} over all steps, t with {BATCHES - 1} degrees of "
            f"freedom); relays included: {worst:.2f}", holds(worst < limit)),
        Statement("inter-relay interference is eliminated in the mean", "Remark 2", "E (g3 - mean) yh_j = 0",
            f"the estimates are unbiased; but the relay subtracts its own signal for the other's, and fading is what "
            f"costs: the remote error is {trace[10]:.4g} at k = 10, of which the gains' variances make all but 0.3 %"
            if _without_fading() / trace[10] < 0.004 else "unbiased", "holds"),
        Statement("the estimates track the state", "Section IV, Figs. 2 to 4", "competent",
            f"rms error / rms state {_relative(result, 10):.3f} at k = 10, {_relative(result, 50):.3f} at 50, "
            f"{_relative(result, 100):.3f} at 100; tr P / tr(nothing heard) {trace[2] / state[2]:.2f} at k = 2, "
            f"{trace[10] / state[10]:.3f} at 10, {total['paper'] / 2 / result.limits['nothing_heard']:.3f} steady",
            "holds"),
        Statement("the state is estimated accurately", "Section IV, Fig. 5", "a desired performance",
            f"steady tr P is {total['paper'] / 2:.4g}, {total['paper'] / total['no_relay']:.2f} times what one hop "
            f"without relays gives as late ({total['no_relay'] / 2:.4g}; {result.limits['no_relay_filtered']:.4g} "
            f"without delay), and {total['paper'] / total['sensor_itself']:.2f} times the floor for every receiver "
            f"behind the relays, {total['sensor_itself'] / 2:.4g}", "holds"),
        Statement("behind the paper's relays the remote filter (9) is good", "Theorem 2", "optimal",
            f"the best linear filter gains {100 * (1 - total['lmmse'] / total['paper']):.1f} % in the steady sum and "
            f"at most {100 * (1 - np.min(result.best_behind / trace[1:])):.1f} % for k <= {mean - 1}", "holds"),
        Statement("L_1 carries nothing", "(31)", "not said",
            f"largest entry of L_1 {np.max(np.abs(result.paper.gains['receiver'][0])):.1g}", "holds"),
    ]  # fmt: skip


def _relative(result: Reproduction, k: int) -> float:
    """Root of tr P_k over the root of E |x_k|^2."""
    state = np.trace(result.paper.moments[k, :3, :3]) + float(np.sum(_state_mean(result, k) ** 2))
    return float(np.sqrt(result.paper.trace("receiver")[k] / state))


def _state_mean(result: Reproduction, k: int) -> np.ndarray:
    moved: np.ndarray = np.linalg.matrix_power(setting.TRANSITION, k) @ setting.INITIAL_MEAN
    return moved


def _without_fading() -> float:
    """tr P_10 with every gain at its mean."""
    slots = [
        {listener: {s: hg.model.mean_gain(link) for s, link in links.items()} for listener, links in slot.items()}
        for slot in setting.network().slots
    ]
    network = hg.model.RelayNetwork(setting.plant(), setting.sensor(), ("relay_1", "relay_2"), slots)
    return float(hg.relays.own_error_design(network, 10).trace("receiver")[10])


def _bounds(result: Reproduction) -> list[Statement]:
    certificate, tuned = result.certificates["paper"], result.certificates["tuned"]
    bounds, scalar = certificate.bounds, result.counterexample.bounds
    truth = float(result.paper.trace("receiver")[-1])
    upper, lower, alpha = bounds["Theorem 3, upper"], bounds["Theorem 3, lower"], bounds["Theorem 4, lower"]
    state = bounds["state covariance"]
    assert upper.values is not None and alpha.values is not None and state.values is not None
    remote, relay = (_scalar_limit(result, name) for name in ("receiver", "relay_1"))
    tops = max(scalar[name].values[0] for name in ("Lemma 8, upper", "Lemma 9, upper"))  # type: ignore[index]
    printed = _printed_scalar()
    return [
        Statement("Xi_i <= mbar_k I and P_k <= mbar_k I", "Theorems 3 and 4, upper", "bounded",
            f"obeyed, but mbar_100 = {upper.values[-1]:.3g} where tr P_100 = {truth:.3g}: it grows without limit, "
            f"since the largest eigenvalue of Gamma Gamma' is {certificate.constants['tau_upper']:.4f}",
            "holds_vacuously"),
        Statement("Xi_i >= m_k I", "Theorem 3, lower", "if a condition holds",
            "does not apply: " + "; ".join(lower.failing),
            "holds_vacuously"),
        Statement("P_k >= p_k I", "Theorem 4, lower", "a positive bound",
            f"p_k falls to {alpha.values[1]:.1g} at k = 1 and {alpha.values[-1]:.1g} at k = 100; assumption missed: "
            + "; ".join(alpha.failing), "holds_vacuously"),
        Statement("uniform bounds m I <= Xi_i <= mbar I, p I <= P_k <= mbar I", "Lemmas 8 and 9",
            "boundedness is guaranteed",
            "do not apply to the paper's own example: " + bounds["Lemma 8, upper"].failing[0], "fails"),
        Statement("errors are bounded for all time", "abstract", "from Lemmas 8 and 9",
            f"true for another reason: Xi_i, P_k <= cov x_k for gains that are optimal for one step, and the "
            f"spectral radius of Gamma is {state.assumptions[1].found}; largest eigenvalue of cov x_k "
            f"{np.max(state.values):.3g}", holds(state.applies and state.holds)),
        Statement("P_k <= cov x_k also for jointly tuned gains", "not in the paper", "not said",
            f"smallest eigenvalue of cov x_k - P_k over its trace {_below_state(tuned, 'receiver'):.2g} (relay 2: "
            f"{_below_state(tuned, 'relay_2'):.2g}), against {_below_state(certificate, 'receiver'):.2g} for the "
            "paper's gains: the proof needs the gain that is best for one step",
            holds(tuned.bounds["state covariance"].holds)),
        Statement("mbar = tau p0 + w / (1 - tau) bounds the errors", "Lemma 8, upper",
            f"{printed['upper']:.4g} on a scalar system",
            f"10 at k = 0: fails there; max(p0, w / (1 - tau)) = {tops:.4g} is obeyed",
            holds(printed["upper"] >= 10)),
        Statement("p = alpha p0 + w / (1 - alpha) <= P_k", "Lemma 9, lower, and (51)", f"{printed['receiver']:.4g}",
            f"P_60 = {remote:.4g} on the same system; min(p0, w / (1 - alpha)) is obeyed: "
            f"{scalar['Lemma 9, lower'].holds}", holds(printed["receiver"] <= remote)),
        Statement("m = rho p0 + w~ / (1 - rho) <= Xi_i", "Lemma 8, lower", f"{printed['relay']:.4g}",
            f"Xi_1 = {relay:.4g} at k = 60 on the same system; the corrected bound is obeyed: "
            f"{scalar['Lemma 8, lower'].holds}", holds(printed["relay"] <= relay)),
        *_proofs(),
    ]  # fmt: skip


def _scalar_limit(result: Reproduction, name: str) -> float:
    return float(result.counterexample.recomputed.covariance[name][-1, 0, 0])


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


def _proofs() -> list[Statement]:
    noise, least, order, bound = _largest_noise(), *_noise_squared()
    return [
        Statement("o I <= O O'", "Assumption 1", f"p_{order} = {bound[0]:.4g} with o = O^2 on a scalar system",
            f"P_{order} = {least:.4g} there; with o = O, which the proofs use, p_{order} = {bound[1]:.4g}",
            holds(bound[0] <= least)),
        Statement("w~ = rho wbar, any rho below 1, in the lower bound", "(34)",
            "m >= 0.5 with W = diag(0.01, 1), rho = 0.5",
            f"smallest eigenvalue of Xi_1 is {noise:.4g}; the lower w is meant, with rho <= (phi - s mu^2) / "
            "(phi + mu^2)", holds(noise >= 0.5)),
        Statement("the factor mu^2 / phi in (34) and (46), -Gamma Xi Gamma' in (38)", "(34), (38), (46)", "mu^2 / phi",
            "1 / s with s < phi / mu^2, so 1 / s > mu^2 / phi: (46) and rho_k do not follow from (38)", "fails"),
        Statement("the algorithm can be run as ordered", "Algorithm 1",
            "covariances at k before gains at k; Pi from (1)",
            "gains at k use covariances at k - 1 and come first; Pi from (13)", "fails"),
        Statement("notation", "(2), (15), (17), (20), (22), (23), (25), (27), (62), (65)",
            "[w v]; w_k for w_(k-1); lost transposes and terms; x(t) for its derivative",
            "read as meant; the results stated after them are right", "fails"),
    ]  # fmt: skip


def _alternating(
    plant: hg.LinearPlant, sensor: hg.LinearSensor, law: hg.LogNormal, relay: float, remote: float
) -> hg.model.RelayNetwork:
    """Two relays in turn over one law of gains, with these noises at relay and remote filter."""
    slots = [
        {own: {"sensor": hg.hop(law, relay), other: hg.hop(law, 0.0)}, "receiver": {other: hg.hop(law, remote)}}
        for own, other in (("relay_2", "relay_1"), ("relay_1", "relay_2"))
    ]
    return hg.model.RelayNetwork(plant, sensor, ("relay_1", "relay_2"), slots)


def _largest_noise() -> float:
    """Smallest eigenvalue of Xi_1 at k = 40 where relays hear next to nothing and noise is unequal."""
    plant = hg.LinearPlant(0.1 * np.eye(2), np.diag([0.01, 1.0]), np.zeros(2), 0.01 * np.eye(2))
    sensor = hg.LinearSensor([[1.0, 1.0]], [[1.0]])
    network = _alternating(plant, sensor, setting.shadowing(0.5, 0.1), 1e6, 1e6)
    return float(np.linalg.eigvalsh(hg.relays.own_error_design(network, 40).covariance["relay_1"][-1])[0])


def _noise_squared() -> tuple[float, int, tuple[float, float]]:
    """P_4 of a scalar system with O = 100, and (52) with o = O^2 and with o = O."""
    tau, w, noise, order = 0.81, 1e-6, 100.0, 4
    plant, sensor = hg.LinearPlant([[0.9]], [[w]], [0.0], [[10.0]]), hg.LinearSensor([[1.0]], [[1e-6]])
    network = _alternating(plant, sensor, setting.shadowing(1.0, 1e-6), 1e-6, noise)
    bounds, upper = [10.0, 10.0], 10.0
    for _ in range(order):
        factors = [o / (o + 4 * upper) for o in (noise**2, noise)]
        bounds = [tau * factor * bound + w for factor, bound in zip(factors, bounds, strict=True)]
        upper = tau * upper + w
    return float(hg.relays.own_error_design(network, order).trace("receiver")[-1]), order, (bounds[0], bounds[1])


def _below_state(certificate: RelayCertificate, name: str) -> float:
    """Smallest eigenvalue of cov x_k - E e e' over its trace, over all k."""
    found = certificate.recomputed
    gap = np.linalg.eigvalsh(found.state - found.covariance[name])[:, 0]
    return float(np.min(gap / np.trace(found.state, axis1=1, axis2=2)))


def _misprints(result: Reproduction) -> list[Statement]:
    wrong = result.misprints
    more, less = misprinted("lemma_1", process=4 * setting.VARIANCE), misprinted("lemma_1", sensor=4 * setting.VARIANCE)
    gain, seventh = wrong["theorem_1"], wrong["lemma_7"]
    return [
        Statement("Pi_k from Sigma V Sigma'", "(13), Lemma 1", "V",
            f"W: nothing on the example, where V = W; with W = 4 V {_effect(more, -1)}; with V = 4 W "
            f"{_effect(less, -1)}", "fails"),
        Statement("Xi_i in the term with g3 of the gain", "(30), proof of Theorem 1; perhaps the scan", "Xi_i",
            f"Xi_ij, as in (29); with Xi_i: tr P {_percent(gain.true[10])} at k = 10, {_percent(gain.true[100])} at "
            f"100, {_percent(gain.true[-1])} steady; tr Xi_2 {_percent(gain.relay_2[3])} at k = 3", "fails"),
        Statement("variance squared before P_i + P_i'", "Lemma 7, (58), (39); perhaps the scan", "variance squared",
            f"mean squared, as (28); as printed at k = 10: {_effect(seventh, 10)}; steady: {_effect(seventh, -1)}",
            "fails"),
        Statement("first bracket of (24) with delta_i + delta_j", "(24); perhaps the scan", "delta",
            f"deltabar; as printed, steady: {_effect(wrong['lemma_6_sign'], -1)}", "fails"),
        Statement("last term of (24) with Xi_i'", "(24); perhaps the scan", "Xi_i'",
            f"Xi_ij'; as printed, steady: {_effect(wrong['lemma_6_last'], -1)}", "fails"),
    ]  # fmt: skip


def _effect(found: Misprinted, k: int) -> str:
    return f"claimed tr P is {found.claimed[k]:.2f} of the truth, and the truth {_percent(found.true[k])}"


def _percent(ratio: float) -> str:
    return f"{100 * (ratio - 1):+.1f} %"


def _circuit(result: Reproduction) -> list[Statement]:
    gap = {h: float(np.max(np.abs(setting.circuit(h) - setting.TRANSITION))) for h in (0.5, 5.0)}
    other = hg.relays.own_error_design(setting.network(setting.plant(setting.circuit(0.5))), 10).trace("receiver")[10]
    radius = float(np.max(np.abs(np.linalg.eigvals(setting.circuit(5.0, second_sign=1.0)))))
    own = float(result.paper.trace("receiver")[10])
    return [
        Statement("L = 0.5 H gives the printed Gamma", "Section IV", "0.5 H",
            f"largest difference {gap[0.5]:.3f}; 5 H gives it to {gap[5.0]:.1g} (four printed decimals). With 0.5 H "
            f"tr P_10 is {other:.3g}, not {own:.3g}", "fails"),
        Statement("second capacitor's equation with + i_L", "Section IV", "+ i_L",
            f"the matrix A has - i_L; with + the plant has spectral radius {radius:.3f}", "fails"),
    ]  # fmt: skip
