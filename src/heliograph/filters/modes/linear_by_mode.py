"""Matrices of x~ = (x - c, 1), and of its products with the modes' indicators, in filters of jump systems.

The centre c = E[x] is subtracted, since a mean far from zero, which the modes' indicators multiply, would leave no
digits for the rest.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, rounding_of
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise
from heliograph.filters.gaussian.signal_moments import factor_covariance
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.linalg import outer
from heliograph.numerics.types import ArrayLike


def transition_with_constant(plant: LinearPlant, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return A~ = [[A, B u + E w], [0, 1]] and Q~ = diag(Q, 0) (n + 1, n + 1) of x~ = (x, 1).

    Then x+ = A x + B u + w is x~+ = A~ x~ + a noise of mean 0 and covariance Q~.
    """
    matrix = pad_with_zeros(plant.transition_matrix(u)).at[:-1, -1].set(plant.shift(u)).at[-1, -1].set(1.0)
    return matrix, pad_with_zeros(plant.noise_covariance(u))


def measurement_with_constant(sensor: LinearSensor) -> tuple[jax.Array, jax.Array]:
    """Return C~ = [[C, E v], [0, 1]] (p + 1, n + 1) and R~ = diag(R, 0) (p + 1, p + 1) of y~ = (y, 1).

    Then y = C x + v is y~ = C~ (x, 1) + a noise of mean 0 and covariance R~.
    """
    measure = pad_with_zeros(jnp.asarray(sensor.matrix)).at[:-1, -1].set(sensor.noise.mean).at[-1, -1].set(1.0)
    return measure, pad_with_zeros(jnp.asarray(sensor.noise.covariance))


def centred_transition(plant: LinearPlant, u: ArrayLike, centre: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return A~ and Q~ of x~ = (x - c, 1), and the centre c+ = A c + B u + E w one step later.

    x+ - c+ = A (x - c) + w - E w: the input and the mean of the noise move the centre alone, so that
    A~ = diag(A, 1) and Q~ = diag(Q, 0).
    """
    matrix, noise = transition_with_constant(plant, jnp.asarray(u))
    return matrix.at[:-1, -1].set(0.0), noise, matrix[:-1] @ jnp.append(centre, 1.0)


def centred_measurement(sensor: LinearSensor, centre: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return C~ and R~ of (y, 1) = C~ (x - c, 1) + noise for the centre c.

    y = C (x - c) + (C c + E v) + noise, so that C~ = [[C, C c + E v], [0, 1]] and R~ = diag(R, 0).
    """
    measure, noise = measurement_with_constant(sensor)
    return measure.at[:-1, -1].add(measure[:-1, :-1] @ centre), noise


def noise_in_mode(plant: LinearPlant, u: ArrayLike, initial_power: jax.Array) -> WeightedColumns:
    """Return columns of the process noise of x~ = (x, 1), and of what rounding adds to it.

    Rounding errors of each step act like noise. Without it the covariance of a precise estimate would become smaller
    than its rounding errors. `initial_power`: E[x_i^2] at the start, the squared size of numbers that are rounded.
    """
    process_noise = factor_process_noise(plant, jnp.asarray(u), initial_power)  # with the rounding of x
    rounding_of_one = rounding_of(np.ones(1))
    matrix = jax.scipy.linalg.block_diag(process_noise.matrix, rounding_of_one.matrix)
    return WeightedColumns(matrix, jnp.append(process_noise.weights, rounding_of_one.weights))


def pad_with_zeros(a: jax.Array) -> jax.Array:
    """Return [[A, 0], [0, 0]], A with one more row and column of zeros: those of the constant 1 in (x, 1)."""
    return jnp.pad(a, ((0, 1), (0, 1)))


class MotionByMode(NamedTuple):
    """Transition of x~ = (x - c, 1) in each mode, A~_j and Q~_j, and the centre c one step later.

    Shapes: `matrices` A~_j and `noises` Q~_j (M, n + 1, n + 1), centre (n,).
    """

    matrices: jax.Array
    noises: jax.Array
    centre: jax.Array


def centred_motion(
    plants: Sequence[LinearPlant], modes: Sequence[int], u: ArrayLike, centre: jax.Array, moments_before: jax.Array
) -> MotionByMode:
    """Return the transition from (x - c, 1) to (x+ - c+, 1) in each mode j, and the centre c+ = E[x+] before any data.

    Filters of systems whose law of motion depends on a mode work about the mean c, since moments about 0 lose digits.
    In mode j, x+ - c+ = A_j (x - c) + d_j + (w_j - E w_j) with d_j = A_j c + B_j u + E w_j - c+.

    Args:
        plants: the different plants.
        modes: for each mode the index of its plant in `plants`.
        u: input (inputs,).
        centre: c (n,).
        moments_before: E[(x - c, 1) 1{mode j}] (M, n + 1), with j the mode by which x moves.
    """
    # For each mode [A_j, B_j u + E w_j; 0, 1] and Cov w_j, by those of its plant.
    by_plant = [transition_with_constant(plant, jnp.asarray(u)) for plant in plants]
    matrices, noises = (jnp.stack(of_modes) for of_modes in zip(*(by_plant[mode] for mode in modes), strict=True))
    moved_centres = matrices[:, :-1] @ jnp.append(centre, 1.0)  # A_j c + B_j u + E w_j
    # One plant for all modes: all move c to c+, so that d_j = 0.
    if len(plants) == 1:
        return MotionByMode(matrices.at[:, :-1, -1].set(0.0), noises, moved_centres[0])
    # E[x+ 1{j}] = A_j E[(x - c) 1{j}] + P(j) (A_j c + B_j u + E w_j), and c+ = sum_j E[x+ 1{j}].
    law = moments_before[:, -1:]
    means = jnp.einsum("jab,jb->ja", matrices[:, :-1, :-1], moments_before[:, :-1]) + law * moved_centres
    next_centre = jnp.sum(means, axis=0) / jnp.sum(law)
    return MotionByMode(matrices.at[:, :-1, -1].set(moved_centres - next_centre), noises, next_centre)


def noise_by_mode(
    plants: Sequence[LinearPlant], modes: Sequence[int], u: ArrayLike, initial_power: jax.Array, law: jax.Array
) -> WeightedColumns:
    """Return columns of the process noise and rounding of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), x~ = (x, 1).

    The block of mode j is P(j) Cov w_j, with P(j) = law[j] and the plant number modes[j].

    `initial_power` is E[x_i^2] at the start, which gives the size of rounding.
    """
    noises = [noise_in_mode(plant, u, initial_power) for plant in plants]
    matrix = jax.scipy.linalg.block_diag(*(noises[mode].matrix for mode in modes))
    weights = jnp.concatenate([p * noises[mode].weights for p, mode in zip(law, modes, strict=True)])
    return WeightedColumns(matrix, weights)


def centred_sensing(
    sensors: Sequence[LinearSensor], modes: Sequence[int], centre: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return C~_j and R~_j of the centred state in each mode (M, p + 1, n + 1), (M, p + 1, p + 1).

    y~ = C~_j x~ + noise of covariance R~_j, with x~ = (x - centre, 1) and y~ = (y, 1). Mode j has sensor modes[j].
    """
    by_sensor = [centred_measurement(sensor, centre) for sensor in sensors]
    measures, noises = zip(*(by_sensor[mode] for mode in modes), strict=True)
    return jnp.stack(measures), jnp.stack(noises)


def multiply_by_transition(columns: jax.Array, matrices: jax.Array, transition: jax.Array) -> jax.Array:
    """Return F @ columns for the transition F of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), F_ji = Pi_ij A~_j.

    Block j of the result is A~_j (sum_i Pi_ij (block i)), which needs no matrix F.

    Args:
        columns: (N, c), in blocks by mode.
        matrices: A~_j by mode (M, s, s), or one A~ (s, s) for all.
        transition: Pi (M, M), by mode before and after; or the like for functions of modes.
    """
    blocks = transition.T @ columns.reshape(len(transition), -1)
    blocks = blocks.reshape(transition.shape[1], matrices.shape[-1], -1)
    return jnp.reshape(matrices @ blocks, columns.shape)


def mode_transition_covariance(moments: jax.Array, transition: jax.Array) -> WeightedColumns:
    """Return columns of sum_i Cov(1{next mode} | i) (x) E[x~ x~' 1{mode = i}] (N, N), Kronecker's product.

    It is the covariance of x~ times the next mode's indicators, less its mean given x~ and the mode, since the chain
    draws the next mode. `moments`: E[x~ x~' 1{mode = i}] (M, s, s); `transition`: Pi (M, M).
    """
    return factor_with_last_mode(jnp.einsum("ijl,iab->jalb", covariance_of_mode(transition)[:, :-1, :-1], moments))


def covariance_of_mode(transition: jax.Array) -> jax.Array:
    """Return Cov(1{next = j}, 1{next = l} | mode = i) = delta_jl Pi_ij - Pi_ij Pi_il as [i, j, l], for a chain Pi."""
    return transition[:, :, None] * (np.eye(transition.shape[1]) - transition[:, None, :])


def factor_with_last_mode(covariance: jax.Array) -> WeightedColumns:
    """Return columns (M s, ...) of a covariance of M blocks, one a mode, of size s, that sum to 0 over the modes.

    Such are deviations of the modes' indicators from their means, since the indicators sum to 1. `covariance` (M - 1,
    s, M - 1, s) is that of all modes but the last, whose block is minus the sum of the others: x_M = -sum_j x_j. So the
    singular covariance of all is never factored.
    """
    other_modes, size = covariance.shape[:2]
    factors = factor_covariance(covariance.reshape(other_modes * size, other_modes * size))
    minus_sum = -np.tile(np.eye(size), (1, other_modes))  # maps the blocks of all other modes to that of the last
    return factors.through(np.concatenate([np.eye(other_modes * size), minus_sum]))


def kron(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the Kronecker product of a and b, by an outer product.

    In compiled code entries that are known to be 0 then stay known, which they do not in `jnp.kron`.
    """
    a, b = jnp.asarray(a), jnp.asarray(b)
    products = outer(a.reshape(-1), b.reshape(-1)).reshape(*a.shape, *b.shape)
    # products[i, j, k, l] = a_ij b_kl goes to row (i, k), column (j, l).
    return products.swapaxes(1, 2).reshape(len(a) * len(b), -1)
