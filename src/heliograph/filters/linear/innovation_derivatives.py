"""Derivatives of the innovations of a linear filter, by the derivatives of its covariance.

Of the factors L diag(d) L' a derivative costs two passes of their orthogonal rows, with every zero of the model filled;
of the matrix P itself it is a linear recursion that keeps these zeros and subtracts nothing large. With C = P- H',
S = H P- H' + R, K = C S^-1, w = S^-1 e and a dot for the derivative in one of the free numbers,

    m-' = F m' + F' m + b',   P-' = F P' F' + (F' P F' and its transpose) + Q',
    e'  = -(H m-' + H' m- + c'),   C' = P-' H' + P- (H')',   S' = H C' + H' C + R',
    m'  = m-' + K e' + (C' - K S') w,   P' = P-' - C' K' - K C'' + K S' K',

the last of P = P- - C S^-1 C'. A fit of four variances of thirteen states takes 84,000 operations a row by the former,
and 14,500 by the latter.

A random gain G is one more noise, (G - M) y: R holds E[(G - M) E[y y'] (G - M)'], by the state's moments before data,
whose derivatives are carried beside, a linear recursion as well.

Source: Gupta and Mehra, Computational aspects of maximum likelihood estimation (1974); behind a random gain the
recursion of De Koning, Optimal estimation of linear discrete-time systems with stochastic parameters (1984).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.gaussian.signal_moments import augmented_second_moment
from heliograph.filters.gaussians_in_states import MomentSlopes
from heliograph.filters.linear.linear_filter_state import LinearBelief, MomentsBeforeData
from heliograph.model.over_time import at
from heliograph.numerics.linalg import contract, psd_solve, symmetric
from heliograph.numerics.types import Array


class ModelMatrices(NamedTuple):
    """A step x+ = F x + b + w, z = H x + c + v with Cov w = Q and Cov v = R, the channel's gain and noise within.

    H is by the mean gain; R holds the noise of the sensor, of the channel and of a random gain.
    """

    F: jax.Array
    b: jax.Array
    Q: jax.Array
    H: jax.Array
    c: jax.Array
    R: jax.Array


class EstimateWithDerivatives(NamedTuple):
    """An estimate and its derivatives in each of the free numbers; behind a random gain also those before any data."""

    gaussian: Gaussian
    slopes: tuple[MomentSlopes, ...]
    before_data: MomentsBeforeData | None = None
    slopes_before_data: tuple[MomentsBeforeData, ...] | None = None


class DifferentiatedInnovation(NamedTuple):
    """Innovation e (m,), its covariance S (m, m), their derivatives (p, ...), and what arrived (m,).

    e is NaN where nothing arrived, with derivatives of zero. `lost`: whether the estimate is no number.
    """

    e: jax.Array
    S: jax.Array
    de: jax.Array
    ds: jax.Array
    present: jax.Array
    lost: jax.Array


def differentiate_start(make: Callable[[Array], Any], x: Array, known_gain: bool) -> EstimateWithDerivatives:
    """Return the estimate before the first step, with its derivatives in each free number.

    A filter behind a random gain also carries the moments of the state before any data, with their derivatives.

    Args:
        make: the filter by the free numbers, a `LinearFilter` with `has_score_recursion`.
        x: the free numbers (p,).
        known_gain: whether the gain is known, so that no moment before data matters.
    """

    def find_moments(x: Array) -> MomentSlopes:
        """Return the initial moments of the filter with the free numbers x."""
        return _find_initial_moments(make(x))

    slopes = tuple(jax.jvp(find_moments, (x,), (axis,))[1] for axis in np.eye(len(x)))
    start = jax.tree.map(jnp.asarray, make(x).init())
    if known_gain:
        return EstimateWithDerivatives(start.gaussian, slopes)
    return EstimateWithDerivatives(
        gaussian=start.gaussian,
        slopes=slopes,
        before_data=MomentsBeforeData(start.state_mean, start.state_covariance),
        slopes_before_data=tuple(MomentsBeforeData(*slope) for slope in slopes),
    )


def differentiate_step(
    make: Callable[[Array], Any], x: Array, before: EstimateWithDerivatives, row: tuple[Array, Array], k: Array
) -> tuple[EstimateWithDerivatives, DifferentiatedInnovation]:
    """Return estimate and innovation of a row (z, u), both with their derivatives in each free number.

    Args:
        make: the filter by the free numbers, a `LinearFilter` with `has_score_recursion`.
        x: the free numbers (p,).
        before: the estimate before the row.
        row: measurement (m,), NaN for what did not arrive, and input.
        k: the row's number.
    """
    z, u = row
    filter, present = make(x), ~jnp.isnan(z)
    # For each free number the step's matrices and the moments before data, which are the same, and their derivatives.
    pairs = [
        jax.jvp(lambda x, moments: find_model_matrices(make(x), moments, u, k), (x, before.before_data), (axis, slope))
        for axis, slope in zip(np.eye(len(x)), before.slopes_before_data or [None] * len(x), strict=True)
    ]
    (matrices, moments), _ = pairs[0]
    # Behind a known gain no moment before data matters: those at the start stand for all.
    start = filter.init() if before.before_data is None else LinearBelief(before.gaussian, *before.before_data)
    prior = filter.predict(start._replace(gaussian=before.gaussian), u, k)
    after, innovation = filter.correct(prior, z, k)
    value, covariance = jnp.asarray(innovation.value), jnp.asarray(innovation.covariance)
    step = FilterStep(
        matrices=matrices, before=before.gaussian, prior=prior.gaussian, e=value, S=covariance, present=present
    )
    slopes_after, slopes_of_e, slopes_of_S = zip(
        *(step.differentiate_in_one_number(d, one) for (_, (d, _)), one in zip(pairs, before.slopes, strict=True)),
        strict=True,
    )
    lost = jnp.any(jnp.isnan(after.gaussian.mean))
    innovation_with_slopes = DifferentiatedInnovation(
        e=value, S=covariance, de=jnp.stack(slopes_of_e), ds=jnp.stack(slopes_of_S), present=present, lost=lost
    )
    slopes_before_data = None if moments is None else tuple(slope for _, (_, slope) in pairs)
    return EstimateWithDerivatives(after.gaussian, slopes_after, moments, slopes_before_data), innovation_with_slopes


def find_model_matrices(
    filter: Any, moments: MomentsBeforeData | None, u: Array, k: Array
) -> tuple[ModelMatrices, MomentsBeforeData | None]:
    """Return F, b, Q, H, c and R of step k of a linear filter, under the input u, and the moments before data after it.

    `moments`: those before data of the state before the step; None behind a known gain, where none are returned.

    They are x+ = F x + b + w of covariance Q, and z = H x + c + v of covariance R, as received behind the channel.
    """
    plant, sensor, channel = at(filter.plant, k), at(filter.sensor, k), at(filter.channel, k)
    law, gain = sensor.noise, jnp.asarray(channel.mean_gain)
    F, b, Q = plant.transition_matrix(u), plant.shift(u), plant.noise_covariance(u)
    R = gain @ jnp.asarray(law.covariance) @ gain.T + channel.noise.covariance
    if moments is not None:
        moments = moments.predict(F, b, Q)
        # A random gain adds its spread times E[(y, 1)(y, 1)'] to the noise.
        y = moments.measure(sensor)
        R = R + contract(channel.gain_spread, augmented_second_moment(y.second, y.mean, 1.0))
    H, c = gain @ jnp.asarray(sensor.matrix), gain @ jnp.asarray(law.mean) + jnp.asarray(channel.offset)
    return ModelMatrices(F=F, b=b, Q=Q, H=H, c=c, R=R), moments


def _find_initial_moments(filter: Any) -> MomentSlopes:
    """Return the mean and covariance before the first step."""
    plant = at(filter.plant, k=0)
    return MomentSlopes(jnp.asarray(plant.initial_mean), jnp.asarray(plant.initial_covariance))


class FilterStep(NamedTuple):
    """A step of a filter: its matrices, the laws before it and after its prediction, innovation e and covariance S.

    `present`: which components of e arrived (m,).
    """

    matrices: ModelMatrices
    before: Gaussian
    prior: Gaussian
    e: jax.Array
    S: jax.Array
    present: jax.Array

    def differentiate_in_one_number(
        self, d: ModelMatrices, before: MomentSlopes
    ) -> tuple[MomentSlopes, jax.Array, jax.Array]:
        """Return the derivatives, in one free number, of the estimate after the step, and of e and S.

        A dash is the derivative; m- and P are the predicted mean and covariance, C = P H', K = C S^-1, w = S^-1 e:

            m-' = F m' + F' m + b',   P' = F (P of before)' F' + (F' (P of before) F' and its transpose) + Q',
            C' = P' H' + P (H')',   e' = -(H m-' + H' m- + c'),   S' = H C' + H' C + R',
            m' = m-' + K e' + (C' - K S') w,   and of the corrected covariance P' - C' K' - K C'' + K S' K'.

        Args:
            d: derivatives of the step's matrices.
            before: derivatives of the mean and covariance before the step.

        Returns:
            Derivatives of the corrected mean and covariance, of e (m,) and of S (m, m), zero of what did not arrive.
        """
        F, H, P = self.matrices.F, self.matrices.H, self.prior.covariance
        # Prediction.
        mean = F @ before.mean + d.F @ self.before.mean + d.b
        turned = d.F @ self.before.covariance @ F.T
        covariance = symmetric(F @ before.covariance @ F.T + (turned + turned.T) + d.Q)
        # Innovation; `cross` is C'.
        present = self.present
        both = present[:, None] & present
        cross = jnp.where(present, covariance @ H.T + P @ d.H.T, 0.0)
        e = jnp.where(present, -(H @ mean + d.H @ self.prior.mean + d.c), 0.0)
        S = jnp.where(both, symmetric(H @ cross + d.H @ P @ H.T + d.R), 0.0)
        # Correction: w = S^-1 e and K = (S^-1 H P)', zero of what did not arrive.
        H_arrived, S_arrived = jnp.where(present[:, None], H, 0.0), jnp.where(both, self.S, 0.0)
        e_arrived = jnp.where(present, self.e, 0.0)
        solved = psd_solve(S_arrived, jnp.concatenate([e_arrived[:, None], H_arrived @ P], axis=1))
        w, gain = solved[:, 0], solved[:, 1:].T
        mean = mean + gain @ e + (cross - gain @ S) @ w
        # C' K' + K C'' - K S' K' = (C' - K S' / 2) K' and its transpose.
        turned = (cross - gain @ S / 2) @ gain.T
        return MomentSlopes(mean, symmetric(covariance - (turned + turned.T))), e, S
