"""Arithmetic of robust updates: the score of a mixture, component after component, and weights before one update.

x is the state and z = t + v the measurement, with t the measurement without the noise v that may hold outliers, and
V = Cov(t).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

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
from heliograph.numerics.trace_settings import precision_in_use

LARGEST = {np.float64: 1e150, np.float32: 1e12}  # deviations of the widest branch: beyond, squares overflow
SMALLEST = 1e-200  # weight: below, a component counts as missing


class PredictedMeasurement(NamedTuple):
    """Prediction of t, the measurement without the noise that may hold outliers.

    With the state x = m + L xi, t = E t + slopes xi + n, where n is all other noise. Shapes: `prior` of n states,
    `signal` E t (m,), slopes (m, n), `noise` columns of Cov n (m, columns).
    """

    prior: Gaussian
    signal: jax.Array
    slopes: jax.Array
    noise: WeightedColumns

    @property
    def columns(self) -> WeightedColumns:
        """Columns W and weights w of the covariance Cov t = W diag(w) W' = slopes diag(d) slopes' + Cov n (m, m)."""
        return join_columns(WeightedColumns(self.slopes, self.prior.variances), self.noise)


class ScoreUpdate(NamedTuple):
    """State after the update, weight of each component (0: not used, 1: used in full), log density of z."""

    state: Gaussian
    weight: jax.Array
    log_density: jax.Array


def update_by_score(before: PredictedMeasurement, z: jax.Array, law: NoiseBranches) -> ScoreUpdate:
    """Return exact posterior moments, component after component, for a Gaussian prior and noise of Gaussian branches.

    The noise is a mixture of Gaussians (branches), such as usual errors and outliers. `before` has the prior of x and
    the signal t, linear in x. Component i is z_i = t_i + noise, with the innovation e = z_i - E t_i and V = Var t_i.
    Its noise has branches j of probability p_j, mean m_j and variance r_j. With s_j = V + r_j, u_j = (e - m_j) / s_j
    and q_j, the posterior probability of branch j, in proportion to p_j N(e; m_j, s_j):

        score g = sum_j q_j u_j,  E[t_i | z_i] = E t_i + V g,
        Var[t_i | z_i] = V (sum_j q_j r_j / s_j + V Var_q u),

    a sum of positive terms, which grows with Var_q u if z_i does not decide between the branches. The law of x given
    t_i stays. The weight is sum_j q_j / s_j over its value at e = 0.

    A random gain may lower r_j; it is kept at least at `law.least` - V, so that s_j >= `law.least`. The law's arrays
    are (m, branches).

    Source: Masreliez, Approximate non-Gaussian filtering with linear state and observation relations (1975).
    """
    n, m, present = len(before.prior.mean), len(before.signal), ~jnp.isnan(z)
    # The joint Gaussian of (x, t): row n + i of its factor is that of t_i.
    joint = append_rows(before.prior, before.signal, before.slopes, triangularise_noise(before.noise))
    weights, density = [], jnp.zeros_like(z[0])
    for i in range(m):
        row = joint.root[n + i]
        v = row**2 @ joint.variances  # V
        e = jnp.where(present[i], z[i] - joint.mean[n + i], 0.0)
        branches = law.log_share[i], law.mean[i], jnp.maximum(law.variance[i], law.least[i] - v)
        # g, the posterior variance over V, sum_j q_j / s_j and the log density of e; then the weight at e = 0.
        score = _compute_score(e, v, *branches)
        weight_at_zero = _compute_score(jnp.zeros_like(e), v, *branches).weight
        weights.append(jnp.where(present[i], score.weight / weight_at_zero, jnp.nan))
        density = density + jnp.where(present[i], score.log_density, 0.0)
        # Give t_i its posterior mean and variance; x follows by its regression on t_i.
        joint = impose_moments_of_combination(
            joint, jnp.where(present[i], row, 0.0), shift=v * score.slope, ratio=score.variance_ratio
        )
    return ScoreUpdate(take_leading(joint, n), _stack_entries(weights), density)


class _Score(NamedTuple):
    """Score of one component z = t + noise, all ().

    `slope` is the score g, by which E[t | z] = E t + V g. `variance_ratio` is Var[t | z] / V, `weight` is
    sum_j q_j / s_j, and `log_density` that of z.
    """

    slope: jax.Array
    variance_ratio: jax.Array
    weight: jax.Array
    log_density: jax.Array


def _compute_score(e: jax.Array, v: jax.Array, log_share: jax.Array, mean: jax.Array, noise: jax.Array) -> _Score:
    """Return the score of an innovation e = z - E t, for z = t + noise, Var t = v and a noise of Gaussian branches j.

    `log_share`, `mean` and `noise` (branches,) are log p_j, m_j and r_j: log probability, mean and variance of each.
    With s_j = v + r_j and u_j = (e - m_j) / s_j, the posterior probability of branch j is q_j, in proportion to
    p_j N(e; m_j, s_j). Then g = sum_j q_j u_j, and Var[t | z] / v = sum_j q_j r_j / s_j + v Var_q u.
    """
    s = v + noise
    largest = LARGEST[precision_in_use()] * jnp.sqrt(jnp.max(s))  # so that squares stay finite
    difference = jnp.clip(e, -largest, largest) - mean
    u = difference / s
    # log p_j N(e; m_j, s_j); q_j relative to the largest, so that none overflows.
    logs = log_share - (difference * u + jnp.log(2 * jnp.pi * s)) / 2
    top = jnp.max(logs)
    q = jnp.exp(logs - top)
    total = jnp.sum(q)
    q = q / total
    g = q @ u
    variance_ratio = q @ (jnp.maximum(noise, 0.0) / s) + v * (q @ (u - g) ** 2)
    return _Score(slope=g, variance_ratio=variance_ratio, weight=q @ (1 / s), log_density=top + jnp.log(total))


@readable
class AbstractWeightingRule(Module):
    """Rule that weighs each component of a measurement: its noise r becomes r / w in one joint update."""

    def weights(self, e: jax.Array, squared: jax.Array, scale: jax.Array) -> jax.Array:
        """Return w (m,), by which each component's noise variance is divided: from 1 (used in full) down to 0.

        Args:
            e: innovations (m,).
            squared: e_i^2 over the variance of the innovation, with the noise (m,).
            scale: variance of the noise (m,).
        """
        raise unwritten(self, "weights")

    def iterate(
        self, before: PredictedMeasurement, noise: WeightedColumns, e: jax.Array, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Return the weights (m,) with which the update divides the noise, and the weights (m,) to report.

        They are the same here: one evaluation of `weights`. A rule that iterates overrides this; it reports the weights
        that follow from its last update. `before` is the prediction without the noise, whose covariance is `noise`, and
        e (m,) are the innovations, of which `present` arrived.
        """
        noise_variance = noise.diagonal
        squared = e**2 / (before.columns.diagonal + noise_variance)  # e_i^2 over the innovation's variance
        weights = self.weights(e, squared, noise_variance)
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
    """Return the columns of the covariance r_ij / sqrt(w_i w_j), for columns of r and weights w (m,)."""
    return noise.through(jnp.diag(1 / jnp.sqrt(jnp.maximum(w, SMALLEST))))


def joint_update(before: PredictedMeasurement, e: jax.Array, present: jax.Array, noise: WeightedColumns) -> Gaussian:
    """Return the state conditioned on e = t - E t + noise, of which the components `present` (m,) arrived.

    `noise` has the columns of the noise's covariance, besides the noise that the prediction of t itself has.
    """
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
    """Return each noise's expected precision sum_j q_j r / r_j (m,), and its mean weighted by precision (m,).

    The noise's law is a mixture of Gaussian branches j of probability p_j, mean m_j and variance r_j. Given the
    innovation e = t - E t + noise of its component alone, branch j has the probability q_j, in proportion to
    p_j N(e; m_j, s_j) with s_j = Var t + r_j. r is the unit `scale` (m,). The mean is
    (sum_j q_j m_j / r_j) / (sum_j q_j / r_j). `before` is the prediction of t, the measurement without that noise.
    """
    # `law.least` is r_j. `law.variance` also has the covariance of a random gain, which acts on t too, and may be
    # lower.
    log_share, mean, variance, least = law
    s = jnp.maximum(before.columns.diagonal[:, None] + variance, least)
    difference = e[:, None] - mean
    log_q = log_share - (difference**2 / s + jnp.log(s)) / 2
    q = jnp.exp(log_q - jnp.max(log_q, axis=1, keepdims=True))  # relative to the largest, so they do not sum to 1
    precision = q * scale[:, None] / least
    sum_of_precisions = jnp.sum(precision, axis=1)
    return sum_of_precisions / jnp.sum(q, axis=1), jnp.sum(precision * mean, axis=1) / sum_of_precisions


def _stack_entries(entries: list[jax.Array]) -> jax.Array:
    """Stack m scalars to an array (m,); `jnp.stack` refuses an empty list, of which an empty array is returned."""
    return jnp.stack(entries) if entries else jnp.zeros(0)
