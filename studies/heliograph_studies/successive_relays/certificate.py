"""Which published bounds on a relay network's errors apply to a design, and whether they hold; checked on their own."""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import at
from heliograph.model.relays import RECEIVER, SENSOR, RelayNetwork, RelaySteps
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.relays.design import GainsByFilter
from heliograph_studies.successive_relays.raw_moments import Recomputed, recompute

GREEDY = 1e-8  # correlation of error and innovation below which a gain minimises its own next error
ROUNDING = 1e-9  # relative to the trace of the larger matrix, in comparisons of covariances from raw moments


class Assumption(NamedTuple):
    """What a bound asks for, the number found, and whether it is met."""

    text: str
    result: str
    met: bool


class Bound(NamedTuple):
    """One bound: what it says, where from, what it assumes, its value at k = 0 .. steps, and whether the errors obey.

    `holds` is None where no value can be formed.
    """

    name: str
    source: str
    assumptions: tuple[Assumption, ...]
    values: Float[np.ndarray, "steps+1"] | None
    holds: bool | None

    @property
    def applies(self) -> bool:
        """Whether every assumption is met."""
        return all(a.met for a in self.assumptions)

    @property
    def failing(self) -> tuple[str, ...]:
        """The assumptions that are not met, each with what was found."""
        return tuple(f"{a.text}: {a.result}" for a in self.assumptions if not a.met)


class RelayCertificate(NamedTuple):
    """Bounds on a design's errors, by name; `recomputed` are the errors they were compared with."""

    bounds: dict[str, Bound]
    constants: dict[str, float]
    recomputed: Recomputed


def certify_relays(network: RelayNetwork, gains: GainsByFilter) -> RelayCertificate:
    """Compare the errors under any gains {filter: (steps, n, received)} with every bound that is known.

    The errors are recomputed by `recompute`, which knows nothing of how the gains were made. "state covariance" is the
    bound that holds whenever gains are greedy: no error covariance exceeds that of the state itself, which is bounded
    for all time if the plant's spectral radius is below 1. The published bounds are in corrected form: the lower bounds
    with s = phi / (2 mu^2) in place of the printed phi / mu^2 and with the lower process noise, constants as
    max(p0, w / (1 - tau)) and min(p0, w / (1 - alpha)).

    Raises:
        ValueError: a filter without gains.
    Source: filter-and-forward successive relays (IEEE/CAA JAS 11(5), 2024), Theorems 3 and 4, Lemmas 8 and 9.
    """
    result = recompute(network, gains)
    horizon = len(result.state) - 1
    steps = network.steps(horizon)
    c = _constants(network, steps)
    # Eigenvalues of the error covariances, relays and receiver.
    relays = np.array([np.linalg.eigvalsh(result.covariance[name]) for name in network.relays])
    receiver = np.linalg.eigvalsh(result.covariance[RECEIVER])
    greedy = _greedy(result)
    # mbar_k = tau mbar_(k-1) + w bounds all of them from above.
    upper = _recursion(c["p0_upper"], np.full(horizon, c["tau_upper"]), c["w_upper"])
    relay_lower, receiver_lower = _over_time(c, upper, relays, receiver, greedy)
    bounds = [
        _state_bound(steps, result, greedy),
        _bound("Theorem 3, upper", "(33)", (greedy,), upper, relays),
        relay_lower,
        _bound("Theorem 4, upper", "(54)", (greedy,), upper, receiver),
        receiver_lower,
        *_uniform(c, relays, receiver, greedy, horizon),
    ]
    return RelayCertificate({bound.name: bound for bound in bounds}, c, result)


def _greedy(recomputed: Recomputed) -> Assumption:
    largest = max(float(np.max(value)) for value in recomputed.correlation.values())
    text = "every gain minimises its filter's own next error (error and innovation uncorrelated)"
    return Assumption(text, f"correlation {largest:.2g}", largest <= GREEDY)


def _state_bound(steps: RelaySteps, recomputed: Recomputed, greedy: Assumption) -> Bound:
    """E e_f e_f' <= cov x_k; the values are the largest eigenvalues of cov x_k."""
    radius = max(float(np.max(np.abs(np.linalg.eigvals(a)))) for a in steps.transition)
    still = bool(np.all(steps.transition == steps.transition[0]))
    stable = Assumption("a constant plant with spectral radius below 1", f"{radius:.6g}", still and radius < 1)
    size = np.trace(recomputed.state, axis1=1, axis2=2)
    gap = min(
        float(np.min(np.linalg.eigvalsh(recomputed.state - error)[:, 0] / size))
        for error in recomputed.covariance.values()
    )
    values = np.linalg.eigvalsh(recomputed.state)[:, -1]
    return Bound("state covariance", "E e e' <= cov x", (greedy, stable), values, gap >= -ROUNDING)


def _constants(network: RelayNetwork, steps: RelaySteps) -> dict[str, float]:
    """The scalars of Assumption 1; NaN where the network is not of the published kind."""

    def extremes(matrices: ArrayLike) -> tuple[float, float]:
        values = np.linalg.eigvalsh(np.asarray(matrices))
        return float(values.min()), float(values.max())

    def gram(a: Float[np.ndarray, "time n m"]) -> Float[np.ndarray, "time n n"]:
        return np.asarray(a @ np.swapaxes(a, 1, 2))

    # Extreme eigenvalues of A A', C C', W, P_0 and V.
    tau, f, w = extremes(gram(steps.transition)), extremes(gram(steps.sensing)), extremes(steps.process)
    p0, v = extremes(network.initial()[1][None]), extremes(steps.sensor_noise)
    mu, phi, g, o = _link_constants(network, len(steps.receives_in_slot))
    rounding = 1e-14 * w[1]  # of an eigenvalue of a singular matrix
    return {
        "tau_lower": tau[0], "tau_upper": tau[1], "f_lower": f[0], "f_upper": f[1],
        "w_lower": w[0] if w[0] > rounding else 0.0, "w_upper": w[1], "v_lower": max(v[0], 0.0),
        "p0_lower": p0[0], "p0_upper": p0[1], "mu_lower": mu[0], "mu_upper": mu[1], "phi_lower": phi[0],
        "phi_upper": phi[1], "g_lower": g, "o_lower": o,
    }  # fmt: skip


def _link_constants(
    network: RelayNetwork, horizon: int
) -> tuple[tuple[float, float], tuple[float, float], float, float]:
    """Ranges of |mean| and variance of the scalar link gains; least noise at a relay and at the receiver."""
    nothing = (float("nan"), float("nan")), (float("nan"), float("nan")), float("nan"), float("nan")
    means: list[float] = []
    variances: list[float] = []
    noises: dict[bool, list[float]] = {True: [], False: []}
    for k in range(horizon):
        for listener, links in network.slots[k % len(network.slots)].items():
            senders, noise = set(links), np.zeros(())
            # Of the published kind: a relay receives the sensor and one relay, the receiver one relay.
            published = senders < {SENSOR, *network.relays} and len(senders - {SENSOR}) == 1 and listener not in senders
            if not published or (SENSOR in senders) != (listener != RECEIVER):
                return nothing
            for link in links.values():
                moments = second_order(at(link, k))
                gain, offset, spread = moments.mean_gain, moments.offset, moments.nominal.center
                m = len(offset)
                mean, variance = gain[0, 0], spread[0, 0, 0, 0]
                shape = np.einsum("ia,jb->ijab", np.eye(m), np.eye(m))
                # Over scalar gains: one mean and one variance, whatever the component.
                square = spread.shape == (m, m, m + 1, m + 1)
                if not square or np.any(offset) or not np.allclose(gain, mean * np.eye(m)):
                    return nothing
                if not np.allclose(spread[..., :-1, :-1], variance * (shape + shape.swapaxes(2, 3)) / 2):
                    return nothing
                means.append(float(abs(mean)))
                variances.append(float(variance))
                noise = noise + spread[..., -1, -1]
            noises[listener == RECEIVER].append(float(np.linalg.eigvalsh(np.atleast_2d(noise))[0]))
    if not noises[True] or not noises[False]:
        return nothing
    return (min(means), max(means)), (min(variances), max(variances)), min(noises[False]), min(noises[True])


def _structure(c: dict[str, float]) -> Assumption:
    text = "each relay receives the sensor and one other relay, the receiver one relay, over scalar gains"
    return Assumption(text, "otherwise" if np.isnan(c["mu_upper"]) else "so", not np.isnan(c["mu_upper"]))


def _positive(c: dict[str, float]) -> tuple[Assumption, ...]:
    """Assumption 1's lower bounds that a circuit can miss."""
    expected = {"w_lower": "process noise in every direction", "tau_lower": "an invertible plant matrix",
              "p0_lower": "an initial covariance in every direction"}  # fmt: skip
    return tuple(Assumption(text, f"smallest eigenvalue {c[name]:.3g}", c[name] > 0) for name, text in expected.items())


def _recursion(start: float, factors: Float[np.ndarray, "steps"], constant: float) -> Float[np.ndarray, "steps+1"]:
    """b_k = a_(k-1) b_(k-1) + c."""
    values = [start]
    for factor in factors:
        values.append(factor * values[-1] + constant)
    return np.array(values)


def _bound(
    name: str, source: str, assumptions: Iterable[Assumption], values: np.ndarray | None, eigenvalues: np.ndarray
) -> Bound:
    """A bound, from below if its name says so, and whether eigenvalues (..., time, n) obey it; no value, no verdict."""
    if values is None:
        return Bound(name, source, tuple(assumptions), None, None)
    if "lower" in name:
        holds = eigenvalues[..., 0] >= values - ROUNDING * eigenvalues[..., -1]
    else:
        holds = eigenvalues[..., -1] <= values * (1 + ROUNDING)
    return Bound(name, source, tuple(assumptions), values, bool(np.all(holds)))


class _Lower(NamedTuple):
    """What lower bounds are made of, over an upper bound mbar: rho and alpha, w that is left, n - c mbar / s > 0."""

    rho: np.ndarray
    alpha: np.ndarray
    left: float
    above: np.ndarray
    printed: np.ndarray


def _lower(c: dict[str, float], upper: Float[np.ndarray, "steps"]) -> _Lower:
    """rho = tau (n - c mbar / s) / (n + c mbar), alpha = tau o / (o + 4 mu^2 f mbar); printed 1 / s is mu^2 / phi."""
    mu, phi, f = c["mu_upper"], c["phi_lower"], c["f_upper"]
    s = phi / (2 * mu**2)
    # n bounds the innovation from below, c mbar its part from the other relay from above.
    n = (c["mu_lower"] ** 2 + phi) * (c["f_lower"] * c["w_lower"] + c["v_lower"]) + c["g_lower"]
    weight = 2 * mu**2 * f * (2 * c["tau_upper"] + 3) * upper
    above, left = n - weight / s if s else n - np.inf * weight, (phi - s * mu**2) / (phi + mu**2)
    alpha = c["tau_lower"] * c["o_lower"] / (c["o_lower"] + 4 * mu**2 * f * upper)
    printed = n - weight * (mu**2 / phi if phi else np.inf)
    return _Lower(c["tau_lower"] * above / (n + weight), alpha, left, above, printed)


def _over_time(
    c: dict[str, float], upper: np.ndarray, relays: np.ndarray, receiver: np.ndarray, greedy: Assumption
) -> list[Bound]:
    """Lower bounds at each step: m_k = rho_(k-1) m_(k-1) + left w of a relay, p_k = alpha_(k-1) p_(k-1) + w."""
    structure = _structure(c)
    names = ("Theorem 3, lower", "(34)", relays), ("Theorem 4, lower", "(52)", receiver)
    if not structure.met:
        return [_bound(name, source, (structure, greedy), None, errors) for name, source, errors in names]
    lower = _lower(c, upper[:-1])
    result = f"{lower.above[0]:.4g} at k = 1 (printed form {lower.printed[0]:.4g}), least {lower.above.min():.4g}"
    condition = Assumption("n - c mbar / s > 0 at every k", result, bool(np.all(lower.above > 0)))
    relay = _recursion(c["p0_lower"], lower.rho, lower.left * c["w_lower"]) if condition.met else None
    remote = _recursion(c["p0_lower"], lower.alpha, c["w_lower"])
    needs = structure, greedy, *_positive(c)
    assumed = ((*needs, condition), relay), (needs, remote)
    return [_bound(name, source, *part, errors) for (name, source, errors), part in zip(names, assumed, strict=True)]


def _uniform(
    c: dict[str, float], relays: np.ndarray, receiver: np.ndarray, greedy: Assumption, horizon: int
) -> list[Bound]:
    """Bounds for all time, which need tau < 1: max(p0, w / (1 - tau)) and min(p0, w / (1 - alpha))."""
    tau, structure = c["tau_upper"], _structure(c)
    contracting = Assumption("largest eigenvalue of A A' below 1", f"{tau:.6g}", tau < 1)
    needs, errors = (contracting, greedy, structure), {"Lemma 8": relays, "Lemma 9": receiver}
    if not contracting.met or not structure.met:
        names = [(f"{lemma}, {side}", e) for side in ("upper", "lower") for lemma, e in errors.items()]
        return [_bound(name, "(49) and (64)", needs, None, e) for name, e in names]
    top, every = max(c["p0_upper"], c["w_upper"] / (1 - tau)), np.ones(horizon + 1)
    lower = _lower(c, np.array([top]))
    condition = Assumption("n - c mbar / s > 0", f"{lower.above[0]:.4g}", bool(lower.above[0] > 0))
    lowest = lower.left * c["w_lower"] / (1 - lower.rho[0]), c["w_lower"] / (1 - lower.alpha[0])
    result = [_bound(f"{lemma}, upper", "(49)", needs, top * every, e) for lemma, e in errors.items()]
    for (lemma, e), low, extra in zip(errors.items(), lowest, ((condition,), ()), strict=True):
        assumptions = *needs, *_positive(c), *extra
        result.append(_bound(f"{lemma}, lower", "(49) and (64)", assumptions, min(c["p0_lower"], low) * every, e))
    return result
