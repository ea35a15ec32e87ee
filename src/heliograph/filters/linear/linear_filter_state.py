"""State of a linear filter: the estimate, and the moments of the plant without any data; prediction of both."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, from_covariance, predict_affine
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.numerics.linalg import symmetric
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Float


class PlantMotion(NamedTuple):
    """Plant over one step, x+ = A x + b + w.

    Shapes: matrix A (n, n), shift b (n,), covariance Cov w (n, n), noise (n, columns) its factors with the rounding
    of x.
    """

    matrix: jax.Array
    shift: jax.Array
    covariance: jax.Array
    noise: WeightedColumns


def motion_of_plant(plant: LinearPlant, u: jax.Array, start: jax.Array) -> PlantMotion:
    """Return the plant's motion under the input u; `start` is E[x_i^2] before the first step, (n,)."""
    return PlantMotion(
        matrix=plant.transition_matrix(u),
        shift=plant.shift(u),
        covariance=plant.noise_covariance(u),
        noise=factor_process_noise(plant, u, start),
    )


class LinearBelief(NamedTuple):
    """The state given the data, and its mean and covariance before any data.

    The latter is never diminished by a measurement, and so needs no factors. Shapes: the state (n,), state_mean (n,),
    state_covariance (n, n).
    """

    gaussian: Gaussian
    state_mean: Float[jax.Array, " n"]
    state_covariance: Float[jax.Array, "n n"]


def prior_belief(start: AbstractPlant) -> LinearBelief:
    """Return the prior, both as estimate and as the state's moments before data."""
    xp = library(start.initial_mean, start.initial_covariance)
    mean, covariance = xp.asarray(start.initial_mean), xp.asarray(start.initial_covariance)
    return LinearBelief(from_covariance(start.initial_mean, start.initial_covariance), mean, covariance)


def predict_belief(belief: LinearBelief, step: PlantMotion) -> LinearBelief:
    """Predict both moments over x+ = A x + b + w: those of the estimate, and those of the state without any data."""
    gaussian = predict_affine(belief.gaussian, step.matrix, step.shift, step.noise)
    mean = step.matrix @ belief.state_mean + step.shift
    covariance = step.matrix @ belief.state_covariance @ step.matrix.T + step.covariance
    return LinearBelief(gaussian, *_limit_to_finite_squares(mean, symmetric(covariance)))


def _limit_to_finite_squares(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return moments without data, limited to numbers whose squares are finite: an unstable plant's grow for ever.

    Behind a known gain nothing depends on them.
    """
    largest = float(np.finfo(covariance.dtype).max) ** 0.5
    return _clip_to(mean, largest**0.5), _clip_to(covariance, largest)


def _clip_to(a: jax.Array, largest: float) -> jax.Array:
    """Clip the entries of a to [-largest, largest]."""
    return jnp.maximum(jnp.minimum(a, largest), -largest)
