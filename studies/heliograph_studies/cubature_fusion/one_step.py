"""One-step computations in NumPy, in the paper's letters: what its formulas give, and what they should give."""

from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import heliograph as hg
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.numerics.check import array, scalar
from heliograph.numerics.float64 import compile_in_float64, to_numpy
from heliograph_studies.cubature_fusion.setting import OUTPUTS, Scenario, Transition, transition

Array = np.ndarray


class Channel(NamedTuple):
    """c, noises and the laws of xi and gamma: values, nominal probabilities, radii."""

    c: float
    relay: float  # alpha^2 E^r, times E xi^2 Q^m
    Qm: Array
    Qn: Array
    xi: hg.Discrete
    gamma: hg.Discrete


class Innovation(NamedTuple):
    """P^-, Y = E[y y'], Pyy = E[e_y e_y'], Pxy = E[e e_y']."""

    P: Array
    Y: Array
    Pyy: Array
    Pxy: Array


class Terms(NamedTuple):
    """mu, a_V, lambda and xi_2 + kappa_2 of a bound."""

    mu: float
    V: float
    d: float
    X2: float


def channel_of(s: Scenario) -> Channel:
    """The channel of a scenario."""
    relay, eye = s.amplification**2 * s.relay_power, np.eye(2)
    return Channel(s.amplitude, relay, s.relay_noise * eye, s.receiver_noise * eye, s.relay_gain, s.sensor_gain)


def moments(law: hg.Discrete) -> tuple[float, float, float, float]:
    """First and second nominal moments with their radii, (11) and (18)."""
    v, r = law.values, law.radius
    return float(law.moment(1)), float(law.moment(2)), float(np.abs(v) @ r), float(v**2 @ r)


def variance_bound(law: hg.Discrete, sign: int) -> float:
    """Bound of the variance: (19) as printed (sign 1), corrected (-1), or with a minus but without the positive "
    "part (0)."""
    m, s, r, q = moments(law)
    if sign > 0:
        return s + q + (m - r) ** 2
    return s + q - (m - r) ** 2 if sign == 0 else s + q - max(abs(m) - r, 0.0) ** 2


def box_terms(ch: Channel, sign: int) -> Terms:
    """(11) with the sign of its last term."""
    (x1, x2, k1, k2), (g1, g2, r1, r2) = moments(ch.xi), moments(ch.gamma)
    aV = variance_bound(ch.xi, sign) * (g2 + r2) + (abs(x1) + k1) ** 2 * variance_bound(ch.gamma, sign)
    return Terms(x1 * g1, aV, abs(x1) * r1 + k1 * abs(g1) + k1 * r1, x2 + k2)


def omega(v: Innovation, b: tuple[float, float], t: Terms, ch: Channel) -> Array:
    """(30) with Y in the terms of the law and Pyy in the (1 + beta_2) term."""
    cross = (1 + 1 / b[0] + 1 / b[1]) * t.d**2 if t.d else 0.0
    signal = (t.V + cross) * v.Y + (1 + b[1]) * t.mu**2 * v.Pyy
    return np.asarray(ch.c**2 * signal + ch.relay * t.X2 * ch.Qm + ch.Qn)


def theorem_1(K: Array, v: Innovation, b: tuple[float, float], t: Terms, ch: Channel) -> Array:
    """(10) at any gain."""
    A = ch.c * t.mu * v.Pxy @ K.T
    return np.asarray((1 + b[0]) * v.P + K @ omega(v, b, t, ch) @ K.T - A - A.T)


def theorem_2(v: Innovation, b: tuple[float, float], t: Terms, ch: Channel) -> Array:
    """Gain (29)."""
    return np.asarray(ch.c * t.mu * v.Pxy @ np.linalg.inv(omega(v, b, t, ch)))


def predicted(s: Scenario, rule: AbstractTransform, covariance: Array | None = None) -> tuple[Array, Array]:
    """Node 1's first prediction by a rule, from Xi_0 or another covariance: mean (5,) and covariance (5, 5)."""
    spread = s.claimed_initial_variance * np.eye(5) if covariance is None else covariance
    mean, moved = _moved(transition(s), rule, np.array(s.guesses[0]), spread)
    return mean, moved + s.process_noise * np.eye(5)


@compile_in_float64
def _moved(f: Transition, rule: AbstractTransform, mean: Array, covariance: Array) -> tuple[Any, Any]:
    """Mean and covariance of f(x); compiled once for f and rule."""
    result = rule.apply(lambda x: f(x, ()), jnp.asarray(mean), jnp.asarray(covariance))
    return result.mean, result.covariance


def output(node: int) -> Array:
    """C_i."""
    p, q = OUTPUTS[node]
    return np.array([[p, 0, q, 0, 0], [0, p, 0, q, 0]])


def innovation(s: Scenario, rule: AbstractTransform) -> Innovation:
    """Node 1's first innovation."""
    m, P = predicted(s, rule)
    C = output(0)
    y, Pyy = C @ m, C @ P @ C.T + s.sensor_noise * np.eye(2)
    return Innovation(P, Pyy + np.outer(y, y), Pyy, P @ C.T)


def cubature_points(x: Array, P: Array) -> Array:
    """x +- sqrt(n) S e_j, (2 n, n)."""
    S = np.sqrt(len(x)) * np.linalg.cholesky(P).T
    return np.concatenate([x + S, x - S])


def mixed_cross(s: Scenario) -> Array:
    """Step 3's Pxy as printed: propagated points with outputs of redrawn ones, for node 1's first step."""
    f, m, P = transition(s), *predicted(s, hg.filters.Cubature())
    with jax.enable_x64(True):
        points = jnp.asarray(cubature_points(np.array(s.guesses[0]), s.claimed_initial_variance * np.eye(5)))
        propagated = to_numpy(jax.vmap(lambda x: f(x, ()))(points))
    y = cubature_points(m, P) @ output(0).T
    return np.asarray((propagated - m).T @ (y - y.mean(0)) / len(y))


def enumerate_theorem_1(trials: int, seed: int, sign: int) -> tuple[int, float]:
    """Violations of (10) over random laws of (e, y), channel laws in the box and gains; the least relative margin.

    The covariance of the error is summed over all atoms of e, y, xi and gamma, so nothing is sampled but the cases.
    """
    rng, worst, violations = np.random.default_rng(seed), np.inf, 0
    for _ in range(trials):
        ch, truth = _random_channel(rng)
        e, y, w, yhat = rng.normal(size=(6, 3)), rng.normal(size=(6, 2)), rng.dirichlet(np.ones(6)), rng.normal(size=2)
        ey = y - yhat
        v = Innovation(*(np.einsum("a,ai,aj->ij", w, p, q) for p, q in ((e, e), (y, y), (ey, ey), (e, ey))))
        t, b = box_terms(ch, sign), (float(10 ** rng.uniform(-4, 0)), float(10 ** rng.uniform(-4, 0)))
        K = theorem_2(v, b, t, ch) + rng.choice([0.0, 1.0]) * rng.normal(size=(3, 2))
        P = K @ (ch.relay * float(truth[0] @ ch.xi.values**2) * ch.Qm + ch.Qn) @ K.T
        for (x, p), (g, q) in product(
            zip(ch.xi.values, truth[0], strict=True), zip(ch.gamma.values, truth[1], strict=True)
        ):
            after = e - (ch.c * (x * g * y - t.mu * yhat)) @ K.T
            P = P + p * q * np.einsum("a,ai,aj->ij", w, after, after)
        Xi = theorem_1(K, v, b, t, ch)
        margin = float(np.linalg.eigvalsh(Xi - P)[0] / np.linalg.norm(Xi, 2))
        worst, violations = min(worst, margin), violations + (margin < -1e-12)  # rounding of an eigenvalue
    return violations, worst


def _random_channel(rng: np.random.Generator) -> tuple[Channel, tuple[Array, Array]]:
    """A channel with gains in [0, 1], and true probabilities at an extreme point of each law's polytope."""
    laws, truth = [], []
    reach = rng.choice([0.0, 0.01, 0.3])  # certain laws test the variance, uncertain ones the cross terms
    for _ in range(2):
        p = rng.dirichlet(np.ones(3))
        radius = reach * rng.uniform(0, 1, 3) * np.maximum(p, 1 - p)
        law = hg.Discrete(rng.uniform(0, 1, 3), p, radius)
        corners = np.asarray(law.corners())
        laws.append(law)
        truth.append(corners[rng.integers(len(corners))])
    return Channel(float(rng.uniform(0.1, 2)), 1.0, 1e-4 * np.eye(2), 1e-4 * np.eye(2), laws[0], laws[1]), (
        truth[0],
        truth[1],
    )


def trace_gradient(v: Innovation, b: tuple[float, float], t: Terms, ch: Channel) -> float:
    """Largest relative derivative of tr Xi at the gain of Theorem 2, and so how far that is from a minimum."""
    K = theorem_2(v, b, t, ch)
    left, right = 2 * K @ omega(v, b, t, ch), 2 * ch.c * t.mu * v.Pxy
    return float(np.max(np.abs(left - right)) / np.max(np.abs(right)))


def perfect_channel_excess(s: Scenario) -> float:
    """Relative excess of the printed bound's one-step trace over the right one through a perfect channel."""
    item = hg.Discrete([1.0], [1.0])
    ch = Channel(1.0, 1.0, s.relay_noise * np.eye(2), s.receiver_noise * np.eye(2), item, item)
    v = innovation(s, hg.filters.Cubature())
    traces = []
    for sign in (1, -1):
        t = box_terms(ch, sign)
        traces.append(float(np.trace(theorem_1(theorem_2(v, (0.0, 0.0), t, ch), v, (0.0, 0.0), t, ch))))
    return traces[0] / traces[1] - 1


def printed_fusion_error(means: Array, covariances: Array) -> float:
    """Largest error of Step 6's Xi^-1 sum w Xi_i^-1 x_i, equal weights; means (time, node, n), covariances alike."""
    information = np.linalg.inv(covariances) / means.shape[1]
    total = information.sum(axis=1)
    weighted = np.einsum("tkij,tkj->ti", information, means)
    right = np.linalg.solve(total, weighted[..., None])[..., 0]
    return float(np.max(np.abs(np.einsum("tij,tj->ti", total, weighted) - right)))


def correlation_term(gain: float = 0.5) -> float:
    """S_4 / (K E x^2) of one scalar example with one xi for both steps: x+ = x = y, prior mean 0, xi = .5 or 1.5.

    After a first update with `gain`, e = (1 - gain xi) x, so -E[(xi - 1) e y] = gain Var(xi) E x^2, not 0.
    """
    return -sum(0.5 * (xi - 1) * (1 - gain * xi) for xi in (0.5, 1.5))


@dataclass(frozen=True)
class GrowthCondition:
    """Theorem 3's condition for one plant over the states that it visits.

    The theorem wants theta = (1 + b) ((1 + eps) a v + (1 + 1/eps) n_x n v m + chi) <= v for some v, eps > 0, where
    a >= sigma_max(J)^2 at every state, J = df/dx, and all other terms are positive. So it can be met only if
    factor = (1 + b) a < 1, the limit eps -> 0.

    factor: (1 + b) max sigma_max(J)^2. gains (state,): sigma_max(J)^2 at each state. worst_state: where it is largest.
    """

    factor: float
    gains: np.ndarray
    worst_state: np.ndarray

    @property
    def satisfiable(self) -> bool:
        """Whether the condition can be met at all."""
        return self.factor < 1

    @property
    def excess(self) -> float:
        """By how much it fails: factor - 1; negative where it can be met."""
        return self.factor - 1


def growth_condition(plant: hg.Plant | hg.LinearPlant, states: ArrayLike, first_scalar: float) -> GrowthCondition:
    """Evaluate the condition at visited states (count, n) of a plant without inputs.

    It uses the plant and beta_1 alone (`first_scalar`): its proof drops whatever measurements achieve, so neither
    sensor nor channel can help to meet it.

    Raises:
        ValueError: states of the wrong shape, a negative scalar.
    Source: cubature fusion under amplify-and-forward relays, Theorem 3.
    """
    visited = array("states", states, (None, len(plant.states)))
    beta = scalar("first scalar of the bound", first_scalar, 0.0)
    with jax.enable_x64(True):
        jacobians = to_numpy(jax.vmap(jax.jacfwd(lambda x: plant.transition(x, jnp.zeros(0))))(jnp.asarray(visited)))
    gains = np.linalg.norm(jacobians, 2, axis=(-2, -1)) ** 2
    worst = int(np.argmax(gains))
    return GrowthCondition(float((1 + beta) * gains[worst]), gains, visited[worst])
