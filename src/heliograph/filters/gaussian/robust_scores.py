"""Arithmetic of robust updates: the score of a mixture, component after component, and weights before one update.

x is the state, t what would arrive without the noise that may hold outliers, z = t + v; V = Cov(t).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns, join_columns
from heliograph.factors.factored_gaussian import (
    Gaussian,
    append_rows,
    condition_on_observation,
    from_columns,
    impose_moments_of_combination,
    take_leading,
)
from heliograph.factors.repeated_measurements import triangularise_noise
from heliograph.filters.received_outlier_noise import NoiseBranches
from heliograph.numerics.module import Module, readable, unwritten

LARGEST = 1e150  # deviations of the widest branch: beyond, squares overflow
SMALLEST = 1e-200  # weight: below, a component counts as missing


class PredictedMeasurement(NamedTuple):
    """Prediction of the measurement without its noise, t = E t + slopes xi + noise, of a state x = m + L xi.

    Shapes: prior of n states, signal (m,), slopes (m, n), noise (m, columns).
    """

    prior: Gaussian
    signal: jax.Array
    slopes: jax.Array
    noise: WeightedColumns

    @property
    def columns(self) -> WeightedColumns:
        """Columns whose weighted products are Cov t."""
        return join_columns(WeightedColumns(self.slopes, self.prior.variances), self.noise)


class ScoreUpdate(NamedTuple):
    """State after the update, weight of each component (0: left out, 1: in full), log density of what arrived."""

    state: Gaussian
    weight: jax.Array
    log_density: jax.Array


def update_by_score(before: PredictedMeasurement, z: jax.Array, law: NoiseBranches) -> ScoreUpdate:
    """Return exact posterior moments, component after component, for a Gaussian prior and noise of Gaussian branches.

    With s_j = V_ii + r_j (at least `least`), u_j = (e - m_j) / s_j and q_j in proportion to p_j N(e; m_j, s_j), the
    score g = sum q_j u_j: t_i moves by V_ii g, its variance becomes V_ii (sum q_j r_j / s_j + V_ii Var_q u), a sum of
    positive terms, and x given t_i stays. The variance grows where the branch is not clear. The weight is
    sum_j q_j / s_j over its value at e = 0.

    Shapes: the law's (m, branches).
    Source: Masreliez, Approximate non-Gaussian filtering with linear state and observation relations (1975).
    """
    n, m, present = len(before.prior.mean), len(before.signal), ~jnp.isnan(z)
    both = append_rows(before.prior, before.signal, before.slopes, triangularise_noise(before.noise))
    weights, density = [], jnp.zeros_like(z[0])
    for i in range(m):
        row = both.root[n + i]
        v = row**2 @ both.variances
        e = jnp.where(present[i], z[i] - both.mean[n + i], 0.0)
        branches = law.log_share[i], law.mean[i], jnp.maximum(law.variance[i], law.least[i] - v)
        score = _compute_score(e, v, *branches)
        weights.append(
            jnp.where(present[i], score.weight / _compute_score(jnp.zeros_like(e), v, *branches).weight, jnp.nan)
        )
        density = density + jnp.where(present[i], score.log_density, 0.0)
        both = impose_moments_of_combination(both, jnp.where(present[i], row, 0.0), v * score.slope, score.left)
    return ScoreUpdate(take_leading(both, n), _stack_entries(weights), density)


class _Score(NamedTuple):
    """Score of one component: slope g, share of t's variance that is left, weight sum q_j / s_j, and log density."""

    slope: jax.Array
    left: jax.Array
    weight: jax.Array
    log_density: jax.Array


def _compute_score(e: jax.Array, v: jax.Array, log_share: jax.Array, mean: jax.Array, noise: jax.Array) -> _Score:
    """Return the score of an innovation e about a t of variance v, with branches (branches,) of the noise.

    `log_share`, `mean`, `noise`: log probability, mean and variance of each branch; symbols as of `update_by_score`.
    """
    s = v + noise
    reach = LARGEST * jnp.sqrt(jnp.max(s))
    difference = jnp.clip(e, -reach, reach) - mean
    u = difference / s
    # q_j in proportion to p_j N(e; m_j, s_j), relative to the largest.
    logs = log_share - (difference * u + jnp.log(2 * jnp.pi * s)) / 2
    top = jnp.max(logs)
    q = jnp.exp(logs - top)
    total = jnp.sum(q)
    q = q / total
    g = q @ u
    left = q @ (jnp.maximum(noise, 0.0) / s) + v * (q @ (u - g) ** 2)
    return _Score(slope=g, left=left, weight=q @ (1 / s), log_density=top + jnp.log(total))


@readable
class AbstractWeightingRule(Module):
    """Rule that weighs each component of a measurement: its noise r becomes r / w in one joint update."""

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return w (m,) from innovations e, e^2 over the innovation variance, and the noise's variance `scale`."""
        raise unwritten(self, "weights")

    def iterate(
        self, before: PredictedMeasurement, noise: WeightedColumns, e: jax.Array, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the weights of the update, and the weights to report, which are equal for a rule of one step.

        They are functions of the innovations e, of e^2 over its variance (with noise), and of the noise's variance.
        """
        scale = noise.diagonal
        squared = e**2 / (before.columns.diagonal + scale)
        weights = self.weights(e, squared, scale)
        return weights, weights


def update_with_weights(
    before: PredictedMeasurement, z: jax.Array, center: jax.Array, noise: WeightedColumns, rule: AbstractWeightingRule
) -> ScoreUpdate:
    """Return one joint update by all of z (m,), with the noise covariance r_ij / sqrt(w_i w_j) for a rule's weights w.

    Args:
        before: prediction of z without its noise.
        z: what was received, NaN where a component did not arrive.
        center: mean of the noise (m,).
        noise: columns of the noise's covariance r.
        rule: weighs the components. Those with a weight up to SMALLEST, 1e-200, count as missing.
    """
    arrived = ~jnp.isnan(z)
    innovation = jnp.where(arrived, z - before.signal - center, 0.0)
    # A rule that iterates returns the weights of its last update, and newer ones that follow from it, to be reported.
    weights, reported_weights = rule.iterate(before, noise, innovation, arrived)
    after = joint_update(before, innovation, arrived & (weights > SMALLEST), divide_noise_by_weights(noise, weights))
    return ScoreUpdate(
        state=after,
        weight=jnp.where(arrived, reported_weights, jnp.nan),
        log_density=jnp.zeros_like(z[0]),  # a rule is no law of the noise: there is no density of z
    )


def divide_noise_by_weights(noise: WeightedColumns, w: jax.Array) -> WeightedColumns:
    """Return r_ij / sqrt(w_i w_j): each row over the root of its weight."""
    return noise.through(jnp.diag(1 / jnp.sqrt(jnp.maximum(w, SMALLEST))))


def joint_update(before: PredictedMeasurement, e: jax.Array, present: jax.Array, noise: WeightedColumns) -> Gaussian:
    """Return the state after the components that are present, with noise of this covariance besides that of t."""
    return condition_on_observation(before.prior, before.slopes, e, join_columns(before.noise, noise), present)[0]


def expected_squared_residuals(
    before: PredictedMeasurement, noise: WeightedColumns, e: jax.Array, present: jax.Array
) -> jax.Array:
    """Return E[(e_i - t_i)^2 | e] = (e_i - t_i+)^2 + V_ii+ after a joint update with this noise, (m,).

    e (m,) are the innovations, and `present` says which arrived. e = t + noise, where t comes from the state's error.
    t+ and V+ are the mean and covariance of t given e.
    """
    t = from_columns(jnp.zeros_like(e), before.columns)
    after, _ = condition_on_observation(t, t.root, e, noise, present)
    return (e - after.mean) ** 2 + after.columns.diagonal


def expected_branch_precision(
    before: PredictedMeasurement, e: jax.Array, scale: jax.Array, law: NoiseBranches
) -> tuple[jax.Array, jax.Array]:
    """Return each noise's expected precision sum_j q_j r / r_j (m,) and its mean weighted by precision (m,).

    The noise's law is a mixture of Gaussian branches j, with means m_j, variances r_j and logarithms of shares. q_j is
    the probability of branch j given the component alone, and r is a unit (`scale`). The mean is
    (sum_j q_j m_j / r_j) / (sum_j q_j / r_j). `before` is the prediction without noise.
    """
    log_share, mean, variance, branch_variance = law
    total = jnp.maximum(before.columns.diagonal[:, None] + variance, branch_variance)
    difference = e[:, None] - mean
    log_weight = log_share - (difference**2 / total + jnp.log(total)) / 2
    weight = jnp.exp(log_weight - jnp.max(log_weight, axis=1, keepdims=True))  # relative to the largest
    precision = weight * scale[:, None] / branch_variance
    sum_of_precisions = jnp.sum(precision, axis=1)
    return sum_of_precisions / jnp.sum(weight, axis=1), jnp.sum(precision * mean, axis=1) / sum_of_precisions


def _stack_entries(entries: list[jax.Array]) -> jax.Array:
    """Return scalars as an array (m,), of length 0 where there are none."""
    return jnp.stack(entries) if entries else jnp.zeros(0)
