"""State of a linear filter: the estimate, and the moments of the plant without any data; prediction of both."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, from_covariance, predict_affine
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.linalg import diagonal, outer, symmetric
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.trace_settings import precision_in_use
from heliograph.numerics.types import Float


class PlantMotion(NamedTuple):
    """Plant over one step, x+ = A x + b + w.

    Shapes: matrix A (n, n), offset b (n,), covariance Cov w (n, n). `noise` has columns of Cov w plus the rounding of x
    (n, columns).
    """

    matrix: jax.Array
    offset: jax.Array
    covariance: jax.Array
    noise: WeightedColumns


def motion_of_plant(plant: LinearPlant, u: jax.Array, initial_power: jax.Array) -> PlantMotion:
    """Return the plant's motion x+ = A x + b + w under the input u.

    `initial_power` (n,) is E[x_i^2] before the first step, which decides the rounding.
    """
    return PlantMotion(
        matrix=plant.transition_matrix(u),
        offset=plant.shift(u),
        covariance=plant.noise_covariance(u),
        noise=factor_process_noise(plant, u, initial_power),
    )


class LinearBelief(NamedTuple):
    """Law of the state given the data (`gaussian`), and its mean and covariance before any data.

    No measurement diminishes the covariance before data, so that it needs no factors. Shapes: state_mean (n,),
    state_covariance (n, n).
    """

    gaussian: Gaussian
    state_mean: Float[jax.Array, " n"]
    state_covariance: Float[jax.Array, "n n"]


class SignalMoments(NamedTuple):
    """Moments of a sensor's signal y = C x + v before any data: E y (p,), E[y y'] (p, p), and columns of Cov v.

    A random gain multiplies all of y, so the noise that it makes depends on E[y y'].
    """

    mean: jax.Array
    second: jax.Array
    noise: WeightedColumns


def prior_belief(start: AbstractPlant) -> LinearBelief:
    """Return the state of a linear filter before the first step, from the plant's law of x_0.

    Mean and covariance of x_0 are in it twice: factored, as the estimate, and as moments before any data, which
    measurements never change.
    """
    xp = library(start.initial_mean, start.initial_covariance)
    mean, covariance = xp.asarray(start.initial_mean), xp.asarray(start.initial_covariance)
    estimate = from_covariance(start.initial_mean, start.initial_covariance)
    return LinearBelief(estimate, mean, covariance)


def predict_belief(belief: LinearBelief, step: PlantMotion) -> LinearBelief:
    """Predict over x+ = A x + b + w the Gaussian of the estimate, and the state's moments before any data.

    Both follow m+ = A m + b and P+ = A P A' + Cov w: the first by factors of P, the second by matrices. `step` has A, b
    and Cov w.
    """
    gaussian = predict_affine(belief.gaussian, step.matrix, step.offset, step.noise)
    before_data = MomentsBeforeData(belief.state_mean, belief.state_covariance)
    mean, covariance = before_data.predict(step.matrix, step.offset, step.covariance)
    return LinearBelief(gaussian, mean, covariance)


class MomentsBeforeData(NamedTuple):
    """Mean (n,) and covariance (n, n) of the plant's state before any data."""

    mean: Float[jax.Array, " n"]
    covariance: Float[jax.Array, "n n"]

    def predict(self, matrix: jax.Array, offset: jax.Array, noise: jax.Array) -> "MomentsBeforeData":
        """Return mean and covariance before any data after a step x+ = A x + b + w: A m + b and A P A' + Q.

        A is `matrix`, b the `offset` and Q = Cov w the `noise` (n, n). For an unstable plant these moments grow without
        limit, and are kept so small that their squares, which later formulas take, are finite.
        """
        covariance = matrix @ self.covariance @ matrix.T + noise
        return MomentsBeforeData(*_limit_to_finite_squares(matrix @ self.mean + offset, symmetric(covariance)))

    def measure(self, sensor: LinearSensor) -> SignalMoments:
        """Return the moments of the signal y = C x + v: its mean, E[y y'] and the columns of Cov v.

        The law of v may depend on the mean and variances of C x, as rounding noise does.
        """
        matrix, law = jnp.asarray(sensor.matrix), sensor.noise
        mean = matrix @ self.mean + law.mean
        state_covariance = matrix @ self.covariance @ matrix.T  # C Cov(x) C'
        noise = law.given_signal(mean, diagonal(state_covariance))
        second = symmetric(state_covariance + noise.covariance + outer(mean, mean))
        return SignalMoments(mean=mean, second=second, noise=noise.columns)


def _limit_to_finite_squares(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return moments before any data, limited to numbers whose squares are finite: an unstable plant's grow for ever.

    Covariances are limited to `largest`, the root of the largest number, and means to the root of `largest`. Behind a
    known gain nothing depends on these moments.
    """
    largest = min(float(np.finfo(one).max) for one in (covariance.dtype, precision_in_use())) ** 0.5
    # The mean of a damped plant decays to subnormal numbers, with which processors are ten times slower. Adding and
    # subtracting c rounds numbers to multiples of eps c (8e-140), and does not change those above c / eps (2e-108).
    c = float(np.finfo(covariance.dtype).tiny) ** 0.4
    return _clip_to((mean + c) - c, largest**0.5), _clip_to(covariance, largest)


def _clip_to(a: jax.Array, largest: float) -> jax.Array:
    """Clip the entries of an array to [-largest, largest]."""
    return lax.max(lax.min(a, lax.full_like(a, largest)), lax.full_like(a, -largest))
