"""Bounds of a channel's second moments where probabilities are known up to a radius: over corner laws, by intervals."""

import jax
import numpy as np

from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.moment_tensors import (
    Matrix,
    Tensor,
    drop_constant,
    symmetric_product,
)
from heliograph.random_affine.moments.monomials import JointMoments
from heliograph.random_affine.moments.second_moment_map import QuadraticMap, stop_gradient

PROPORTIONAL_TOLERANCE = 1e-12  # of each entry's own scale: two tensors from different sums are one's multiples


def tensors_of_law(moments: JointMoments, mean: Matrix) -> tuple[Tensor, Tensor, Tensor]:
    """Return three maps from Y Y', Y = (y, 1), to second moments given y under one possible law of z = (G, n) Y.

    They are the spread E[e e'], e = ((G, n) - H0) Y, about the nominal mean H0; the shift, the same with E[(G, n)] in
    place of (G, n); and the power E[G y y' G']. A map T (m, m, p + 1, p + 1) gives sum_ab T[i, j, a, b] Y_a Y_b.

    Args:
        moments: moments of (G, n) up to the second, under the law.
        mean: H0 = E[(G, n)] under the nominal law (m, p + 1).
    """
    second_moment = moments.second
    law_mean = moments.mean[:-1]
    cross = symmetric_product(mean, law_mean)
    other_cross = symmetric_product(law_mean, mean)
    spread = second_moment - cross - other_cross + symmetric_product(mean, mean)
    shift = symmetric_product(law_mean - mean, law_mean - mean)
    return spread, shift, drop_constant(second_moment)


def bound_all_laws(tensors: Tensor, mean: Matrix) -> QuadraticMap:
    """Return one bound of the second moments of z = G y + n under all extreme laws v, such as of the spreads.

    The bound is exact if every law has the second moment s_v M y y' M' + N_v, as with one random scalar gain, and one
    noise matrix N_max is above all others. Then max_v s_v M y y' M' + N_max is above all. Else each entry of the bound
    has the range of this entry over the laws: its middle as center, and half its width as radius.

    Args:
        tensors: the second moments (law, m, m, p + 1, p + 1), each a map of (y, 1) (y, 1)'.
        mean: nominal E[(G, n)] (m, p + 1); M is its part E[G].
    """
    xp = library(tensors)
    low, high = tensors.min(axis=0), tensors.max(axis=0)
    dominating, is_above_all = _find_dominating_tensor(tensors, mean)
    center = xp.where(is_above_all, dominating, (low + high) / 2)
    radius = xp.where(is_above_all, 0.0, (high - low) / 2)
    return QuadraticMap(center, radius)


def _find_dominating_tensor(tensors: Tensor, mean: Matrix) -> tuple[Tensor, np.ndarray | jax.Array]:
    """Return the second moment max_v s_v M y y' M' + N_max of z = G y + n, and whether it is above those of all laws v.

    A channel z = G y + n may have any of several laws v of gain and noise, and a filter that is right under each needs
    one second moment above all. s_v is a number, M the nominal E[G], and N_max the noise covariance of the largest
    trace. The moment returned is above all if each law v has s_v M y y' M' + N_v, to rounding, without a correlation of
    gain and noise, and if N_max - N_v >= 0.

    Args:
        tensors: a map of (y, 1) (y, 1)' to a second moment of z for each law (law, m, m, p + 1, p + 1).
        mean: (M, mean offset) (m, p + 1).
    """
    xp = library(tensors, mean)
    shape = symmetric_product(mean[:, :-1], mean[:, :-1])  # M y y' M' (m, m, p, p)
    gains = tensors[..., :-1, :-1]
    noises = tensors[..., -1, -1]
    cross = tensors[..., :-1, -1]
    mean_size: Matrix = xp.abs(mean[:, :-1])
    # Sizes for relative tolerances: of the gains' entries (m, m, p, p), of each noise (m,), and of the product of entry
    # (i, a) of a gain and noise j, at (i, j, a).
    gain_size = xp.max(xp.abs(gains), axis=0, initial=0.0) + symmetric_product(mean_size, mean_size)
    noise_size = xp.sqrt(xp.max(xp.abs(xp.diagonal(noises, axis1=1, axis2=2)), axis=0)) + xp.abs(mean[:, -1])
    cross_size = xp.sqrt(xp.einsum("iiaa->ia", gain_size))[:, None, :] * noise_size[:, None]
    # The s_v with the errors of their fit, and N_max; then whether the three conditions hold.
    multiples, residual = _fit_multiples(gains, shape)
    largest, noise_is_largest = _find_largest_noise(noises)
    gains_are_multiples = xp.all(residual <= PROPORTIONAL_TOLERANCE * gain_size)
    is_uncorrelated = xp.all(xp.abs(cross) <= PROPORTIONAL_TOLERANCE * (cross_size + cross_size.swapaxes(0, 1)))
    # max_v s_v M y y' M' + N_max as one tensor: N_max multiplies the constant 1 of (y, 1), its last row and column.
    constant = np.zeros((mean.shape[1], mean.shape[1]))
    constant[-1, -1] = 1.0
    widened = xp.pad(xp.max(multiples) * shape, [(0, 0), (0, 0), (0, 1), (0, 1)])
    dominating = widened + largest[:, :, None, None] * constant
    return dominating, gains_are_multiples & is_uncorrelated & noise_is_largest


def _fit_multiples(gains: Array, shape: Tensor) -> tuple[Array, Array]:
    """Fit gains_v = s_v `shape` by least squares; return the s_v (law,), and the absolute error of each entry.

    `gains` (law, m, m, p, p) has a tensor for each law v.
    """
    xp = library(gains, shape)
    squared_norm = xp.sum(shape**2)
    multiples = xp.einsum("vijab,ijab->v", gains, shape) / xp.where(squared_norm > 0, squared_norm, 1.0)
    fitted = multiples[:, None, None, None, None] * shape
    return multiples, xp.abs(gains - fitted)


def _find_largest_noise(noises: Array) -> tuple[Matrix, Array]:
    """Return N_max, the covariance of the largest trace among N_v (law, m, m), and whether it is above all N_v.

    It is above if all N_max - N_v are positive semidefinite up to PROPORTIONAL_TOLERANCE. If any N_v is above all
    others, it has the largest trace.
    """
    xp = library(noises)
    largest = noises[xp.argmax(xp.trace(noises, axis1=1, axis2=2))]
    # In units in which N_max has ones on its diagonal, the tolerance is relative.
    unit = xp.sqrt(xp.diagonal(largest))
    unit = stop_gradient(xp.where(unit > 0, unit, 1.0))
    units = unit[:, None] * unit
    eigenvalues = xp.linalg.eigvalsh(stop_gradient(largest - noises) / units)
    is_above_all = xp.min(eigenvalues, initial=0.0) >= -PROPORTIONAL_TOLERANCE
    return largest, is_above_all


def bound_from_intervals(channel: AbstractRandomAffine, nominal: JointMoments, mean: Matrix) -> list[QuadraticMap]:
    """Return bounds of spread, shift and power of a channel, from the interval in which each of its moments lies.

    Channels z = G y + n are known up to intervals of their moments, and filters need bounds of second moments under
    every possible law. Let H = (G, n), H0 its nominal mean, m = E[H] and `raw` E[H_ia H_jb] under any such law. The
    spread, of H about H0, is raw - H0 m' - m H0' + H0 H0', the shift (m - H0) (m - H0)', and the power `raw` of G
    alone. A bound has a center, the value at the middle of all intervals, and a radius for each entry.

    Args:
        channel: the channel, whose `moment_interval(2)` gives both ends of each moment up to the second.
        nominal: its moments up to the second under the nominal law, for their shape.
        mean: H0 (m, p + 1).
    """
    low, high = channel.moment_interval(2)
    xp = library(low, high, mean)
    # Middle and half width of each moment.
    middle = JointMoments((low + high) / 2, nominal.outputs, nominal.inputs, 2)
    half = JointMoments((high - low) / 2, nominal.outputs, nominal.inputs, 2)
    raw_radius = xp.abs(half.second)
    mean_radius = half.mean[:-1]
    spread, _, power = tensors_of_law(middle, mean)
    reach = xp.abs(middle.mean[:-1] - mean) + mean_radius
    # Radii add up by the triangle inequality: of raw, and of m in the two products with H0.
    spread_radius = (
        raw_radius + symmetric_product(xp.abs(mean), mean_radius) + symmetric_product(mean_radius, xp.abs(mean))
    )
    return [
        QuadraticMap(spread, spread_radius),
        QuadraticMap(np.zeros(spread.shape), symmetric_product(reach, reach)),
        QuadraticMap(power, drop_constant(raw_radius)),
    ]
