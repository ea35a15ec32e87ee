"""Gaussians of the state and of the sender's reference: moved, with the measurement as well, and given a value."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.gaussian import given
from heliograph.filters.event.parts import Parts
from heliograph.filters.gaussian.belief import image_of
from heliograph.filters.gaussian.signal import signal_of
from heliograph.filters.gaussian.transform import AbstractTransform
from heliograph.filters.innovation import log_density
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.linalg import psd_solve, symmetrize, with_rounding


def augmented(
    plant: AbstractPlant, sensor: AbstractSensor, transform: AbstractTransform, parts: Parts, n: int
) -> Parts:
    """Each Gaussian of (x, r) with y = h(x) + v as well."""

    def single(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        x = given(mean[:n], covariance[:n, :n])
        signal = signal_of(plant, sensor, transform, x, jnp.zeros(n))
        slope = _slope(sensor, covariance[:n, :n], signal.cross)
        cross = jnp.concatenate([signal.cross, covariance[n:, :n] @ slope.T])
        wide = jnp.concatenate([covariance, cross.T])
        below = jnp.concatenate([cross, signal.covariance])
        return jnp.concatenate([mean, signal.mean]), jnp.concatenate([wide, below], axis=1)

    mean, covariance = jax.vmap(single)(parts.mean, parts.covariance)
    return parts._replace(mean=mean, covariance=covariance)


def _slope(sensor: AbstractSensor, covariance: jax.Array, cross: jax.Array) -> jax.Array:
    """The regression of y on x, (m, n): C of a linear sensor."""
    matrix = getattr(sensor, "matrix", None)
    return psd_solve(covariance, cross).T if matrix is None else jnp.asarray(matrix)


def moved(
    plant: AbstractPlant, transform: AbstractTransform, mean: jax.Array, covariance: jax.Array, u: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """(x, r) a step later."""
    n = len(plant.states)
    x = given(mean[:n], covariance[:n, :n])
    image = image_of(plant, transform, x, u)
    total = image.columns_from(x).covariance + plant.noise_covariance(u)
    both = (x.root * x.variances) @ image.slopes.T
    slope = plant.transition_matrix(u) if isinstance(plant, LinearPlant) else psd_solve(covariance[:n, :n], both).T
    cross = slope @ covariance[:n, n:]
    upper = jnp.concatenate([total, cross], axis=1)
    lower = jnp.concatenate([cross.T, covariance[n:, n:]], axis=1)
    return jnp.concatenate([image.mean + plant.noise_mean(), mean[n:]]), jnp.concatenate([upper, lower])


def updated(
    parts: Parts,
    z: jax.Array,
    there: jax.Array,
    mean: jax.Array,
    tensor: jax.Array,
    sender: slice,
    m: int,
    delivers: bool,
) -> Parts:
    """Each Gaussian of (x, r, y) given z = G y + n, weighed by its density."""
    y, rows = slice(parts.mean.shape[1] - m, parts.mean.shape[1]), _rows(sender, m)
    gain, both = mean[rows, :-1], there[:, None] & there

    # A Kalman update of each Gaussian, on the components that are there.
    def single(centre: jax.Array, covariance: jax.Array) -> tuple[jax.Array, ...]:
        expected, total = _through(centre[y], covariance[y, y], mean[rows], tensor[rows, rows])
        seen = jnp.where(both, total, jnp.diag(jnp.where(there, 0.0, 1.0)))
        cross = jnp.where(there[:, None], gain @ covariance[y], 0.0)
        solved = psd_solve(seen, cross)
        middle = centre + jnp.where(there, z - expected, 0.0) @ solved
        left = symmetrize(with_rounding(covariance, m) - cross.T @ solved)
        return middle, left, log_density(z - expected, total, jnp.abs(z))

    centre, covariance, density = jax.vmap(single)(parts.mean, parts.covariance)
    if delivers:  # y is z, to the last digit
        places = np.r_[y][sender]
        centre = centre.at[:, places].set(jnp.where(there, z, 0.0))
        covariance = covariance.at[:, places].set(0.0).at[:, :, places].set(0.0)
    return Parts(parts.log_weight + density, centre, covariance, parts.label)


def arriving(parts: Parts, mean: jax.Array, tensor: jax.Array, sender: slice, m: int) -> dict[str, jax.Array]:
    """Mean and covariance of z = G y + n for each Gaussian of (x, r, y)."""
    y, rows = slice(parts.mean.shape[1] - m, parts.mean.shape[1]), _rows(sender, m)

    def single(centre: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        return _through(centre[y], covariance[y, y], mean[rows], tensor[rows, rows])

    middle, total = jax.vmap(single)(parts.mean, parts.covariance)
    return {"mean": middle, "covariance": total}


def _rows(sender: slice, m: int) -> slice:
    """Outputs of the link that carry a sender's components: all, unless each component has its own sender."""
    return slice(None) if sender == slice(0, m) else sender


def _through(
    centre: jax.Array, covariance: jax.Array, mean: jax.Array, tensor: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """E z and Cov z = M Cov(y) M' + E[((G - M) y + n - b)(...)']."""
    signal = jnp.append(centre, 1.0)
    second = jnp.outer(signal, signal).at[:-1, :-1].add(covariance)
    gain = mean[:, :-1]
    return gain @ centre + mean[:, -1], gain @ covariance @ gain.T + jnp.einsum("ijab,ab->ij", tensor, second)
