"""Arithmetic of robust updates: the score of a mixture, component after component, and weights before one update.

x is the state, t what would arrive without the noise that may hold outliers, z = t + v; C = Cov(x, t), V = Cov(t).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.correction import absent, gain_and_bound, gain_and_covariance
from heliograph.numerics.linalg import add, diagonal_of, solve, summed, times, transpose, with_rounding
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.over_runs import runs_last

LARGEST = 1e150  # deviations of the widest branch: beyond, squares overflow
SMALLEST = 1e-200  # weight: below, a component counts as missing


class Expected(NamedTuple):
    """Moments of the state and of what would arrive without its noise, before the measurement.

    mean (n,), covariance (n, n), signal (m,), cross C (n, m), spread V (m, m). Of a linear sensor also the matrix H
    of t (m, n) and what of V is not H P H' (m, m), with which an update keeps its digits.
    """

    mean: jax.Array
    covariance: jax.Array
    signal: jax.Array
    cross: jax.Array
    spread: jax.Array
    matrix: jax.Array | None = None
    noise: jax.Array | None = None


class Corrected(NamedTuple):
    """State after the update, weight of each component (0: left out, 1: in full), log density of what arrived."""

    mean: jax.Array
    covariance: jax.Array
    weight: jax.Array
    log_density: jax.Array


@runs_last
def score_update(
    before: Expected, z: jax.Array, log_share: jax.Array, mean: jax.Array, variance: jax.Array, least: jax.Array
) -> Corrected:
    """Exact posterior moments of one component after another, for a Gaussian prior and a noise of Gaussian branches.

    With s_j = V_ii + r_j (at least `least`), u_j = (e - m_j) / s_j and q_j in proportion to p_j N(e; m_j, s_j): the
    score g = sum q_j u_j and G = sum q_j / s_j - Var_q u give mean + c g and covariance - c c' G, c the joint's column
    at t_i. G may be negative: the covariance grows where the branch is not clear. The weight is G's first part over its
    value at e = 0.

    Shapes: log_share, mean, variance, least (m, branches).
    Source: Masreliez, Approximate non-Gaussian filtering with linear state and observation relations (1975).
    """
    x, p, t, c, v = before.mean, before.covariance, before.signal, before.cross, before.spread
    m, present = len(t), ~jnp.isnan(z)
    prior, p = p, with_rounding(p, m)
    # Each component is one scalar update of the joint of (x, t): the score moves the mean, its slope the covariance.
    weights, density = [], jnp.zeros_like(z[0])
    for i in range(m):
        e = jnp.where(present[i], z[i] - t[i], 0.0)
        branch = (log_share[i], mean[i], jnp.maximum(v[i, i] + variance[i], least[i]))
        g, curvature, gain, log_density = _score(e, *branch)
        weights.append(jnp.where(present[i], gain / _score(jnp.zeros_like(e), *branch)[2], jnp.nan))
        density = density + jnp.where(present[i], log_density, 0.0)
        g, curvature = (jnp.where(present[i], value, 0.0) for value in (g, curvature))
        to_x, to_t = c[:, i], v[:, i]
        x, t = x + to_x * g, t + to_t * g
        p = p - to_x[:, None] * to_x[None] * curvature
        c = c - to_x[:, None] * to_t[None] * curvature
        v = v - to_t[:, None] * to_t[None] * curvature
    return Corrected(x, jnp.where(jnp.any(present, axis=0), p, prior), jnp.stack(weights), density)


def _score(
    e: jax.Array, log_share: jax.Array, mean: jax.Array, total: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """g, G, sum q_j / s_j and log density of an innovation e (...), of branches (branches, ...)."""
    reach = LARGEST * jnp.sqrt(jnp.max(total, axis=0))
    apart = jnp.clip(e, -reach, reach) - mean
    u = apart / total
    logs = log_share - (apart * u + jnp.log(2 * np.pi * total)) / 2
    top = jnp.max(logs, axis=0)
    q = jnp.exp(logs - top)
    whole = _sum(q)
    q = q / whole
    g, gain = _sum(q * u), _sum(q / total)
    return g, gain - _sum(q * (u - g) ** 2), gain, top + jnp.log(whole)


def _sum(terms: jax.Array) -> jax.Array:
    return add(list(terms))


@readable
class AbstractWeights(Module):
    """Rule that weighs each component of a measurement: its noise r becomes r / w in one joint update."""

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """w (m,) of innovations e, their squares over the innovation variance d^2, and the noise's variance r."""
        raise unwritten(self, "weights")

    def iterate(
        self, before: Expected, noise: jax.Array, e: jax.Array, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """The weights of the update, and those to report, for noise (m, m)."""
        scale = diagonal_of(noise)
        w = self.weights(e, e**2 / (diagonal_of(before.spread) + scale), scale)
        return w, w


@runs_last
def weighted_update(
    before: Expected, z: jax.Array, center: jax.Array, noise: jax.Array, rule: AbstractWeights
) -> Corrected:
    """One joint update with noise r_ij / sqrt(w_i w_j), of mean `center`; a component of weight zero is missing."""
    arrived = ~jnp.isnan(z)
    e = jnp.where(arrived, z - before.signal - center, 0.0)
    w, shown = rule.iterate(before, noise, e, arrived)
    present = arrived & (w > SMALLEST)
    x, p = joint_update(before, e, present, reweighted(noise, w))
    return Corrected(x, p, jnp.where(arrived, shown, jnp.nan), jnp.zeros_like(x[0]))


def reweighted(noise: jax.Array, w: jax.Array) -> jax.Array:
    """r_ij / sqrt(w_i w_j)."""
    root = jnp.sqrt(jnp.maximum(w, SMALLEST))
    return noise / (root[:, None] * root[None])


def joint_update(before: Expected, e: jax.Array, present: jax.Array, noise: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and covariance after the components that are present, with noise of this covariance (m, m)."""
    both = present[:, None] & present[None]
    omega = jnp.where(both, before.spread + noise, 0.0) + absent(present)
    cross = jnp.where(present[:, None], transpose(before.cross), 0.0)
    if before.matrix is None or before.noise is None:
        gain, after = gain_and_bound(before.covariance, cross, omega)
    else:
        matrix = jnp.where(present[:, None], before.matrix, 0.0)
        rest = jnp.where(both, before.noise + noise, 0.0) + absent(present)
        gain, after = gain_and_covariance(before.covariance, cross, omega, matrix, rest, jnp.zeros_like(e))
    used = jnp.any(present, axis=0)
    mean = before.mean + summed(gain * jnp.where(present, e, 0.0)[None], 1)
    return mean, jnp.where(used, after, before.covariance)


def squared_residuals(before: Expected, noise: jax.Array, e: jax.Array, present: jax.Array) -> jax.Array:
    """E_i = (z_i - t_i+)^2 + V_ii+ after a joint update with this noise: what is then known of each noise's square."""
    both = present[:, None] & present[None]
    omega = jnp.where(both, before.spread + noise, 0.0) + absent(present)
    rows = jnp.where(present[:, None], before.spread, 0.0)
    solved = solve(omega, jnp.concatenate([rows, jnp.where(present, e, 0.0)[:, None]], axis=1))
    moved = times(transpose(rows), solved)
    left = diagonal_of(before.spread) - diagonal_of(moved[:, :-1])
    return (e - moved[:, -1]) ** 2 + jnp.maximum(left, 0.0)


def branch_precision(
    before: Expected, e: jax.Array, scale: jax.Array, law: tuple[jax.Array, jax.Array, jax.Array, jax.Array]
) -> tuple[jax.Array, jax.Array]:
    """Expected precision sum q_j r / r_j (m,) of each component's noise, in units of r, and the mean that it is about.

    q_j is the probability of branch j given the component alone.
    """
    log_share, mean, variance, least = law
    total = jnp.maximum(diagonal_of(before.spread)[:, None] + variance, least)
    apart = e[:, None] - mean
    logs = log_share - (apart**2 / total + jnp.log(total)) / 2
    q = jnp.exp(logs - jnp.max(logs, axis=1, keepdims=True))
    precision = q * scale[:, None] / least
    whole = summed(precision, 1)
    return whole / summed(q, 1), summed(precision * mean, 1) / whole
