"""Transition, output and noise matrices of x~ = (x, 1) about a centre c, mode by mode, of filters of jump systems.

All moments are those of (x - c, 1): a mean far from zero, which the modes' indicators multiply, would leave no digits
for the rest.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, rounding_of
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.types import ArrayLike


def transition_with_constant(plant: LinearPlant, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return A~ = [[A, B u + E w], [0, 1]] and Q~ = diag(Q, 0) of x~ = (x, 1)."""
    move = pad_with_zeros(plant.transition_matrix(u)).at[:-1, -1].set(plant.shift(u)).at[-1, -1].set(1.0)
    return move, pad_with_zeros(plant.noise_covariance(u))


def measurement_with_constant(sensor: LinearSensor) -> tuple[jax.Array, jax.Array]:
    """Return C~ = [[C, E v], [0, 1]] and R~ = diag(R, 0) of y~ = (y, 1)."""
    measure = pad_with_zeros(jnp.asarray(sensor.matrix)).at[:-1, -1].set(sensor.noise.mean).at[-1, -1].set(1.0)
    return measure, pad_with_zeros(jnp.asarray(sensor.noise.covariance))


def centred_transition(plant: LinearPlant, u: ArrayLike, centre: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return A~ and Q~ of x - c, which no known input moves, and c one step later."""
    move, noise = transition_with_constant(plant, jnp.asarray(u))
    return move.at[:-1, -1].set(0.0), noise, move[:-1] @ jnp.append(centre, 1.0)


def centred_measurement(sensor: LinearSensor, centre: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return C~ and R~ of the centred state: y = C (x - c) + C c + E v."""
    measure, noise = measurement_with_constant(sensor)
    return measure.at[:-1, -1].add(measure[:-1, :-1] @ centre), noise


def noise_in_mode(plant: LinearPlant, u: ArrayLike, initial_power: jax.Array) -> WeightedColumns:
    """Return factors of the process noise of x~ = (x, 1), with the rounding of the state and of the indicator.

    `initial_power` is E[x_i^2] at the start, the size of the numbers that are rounded.
    """
    process_noise = factor_process_noise(plant, jnp.asarray(u), initial_power)
    of_indicator = rounding_of(np.ones(1))
    matrix = jax.scipy.linalg.block_diag(process_noise.matrix, of_indicator.matrix)
    return WeightedColumns(matrix, jnp.append(process_noise.weights, of_indicator.weights))


def pad_with_zeros(a: jax.Array) -> jax.Array:
    """Pad A by a row and a column of zeros: [[A, 0], [0, 0]]."""
    return jnp.pad(a, ((0, 1), (0, 1)))


class MotionByMode(NamedTuple):
    """Transition of x~ about a centre in each mode, A~_j and Q~_j, and the centre one step later.

    Shapes: moves and noises (M, n + 1, n + 1), centre (n,).
    """

    moves: jax.Array
    noises: jax.Array
    centre: jax.Array


def centred_motion(
    plants: Sequence[LinearPlant], modes: Sequence[int], u: ArrayLike, centre: jax.Array, moments_before: jax.Array
) -> MotionByMode:
    """Return how x - c moves in each mode j, and the next centre c+ = E[x+] before any data.

    x+ - c+ = A_j (x - c) + d_j + w_j with d_j = A_j c + B_j u + E w_j - c+. If all modes have one law of motion, d_j is
    0 for all j.

    Args:
        plants: the laws of motion.
        modes: for each mode the index of its law in `plants`.
        u: input (inputs,).
        centre: c (n,).
        moments_before: E[(x - c, 1) 1{mode j}] (M, n + 1), with j the mode by which x moves.
    """
    by_plant = [transition_with_constant(plant, jnp.asarray(u)) for plant in plants]
    moves, noises = (jnp.stack(matrices) for matrices in zip(*(by_plant[mode] for mode in modes), strict=True))
    at_centre = moves[:, :-1] @ jnp.append(centre, 1.0)
    if len(plants) == 1:
        return MotionByMode(moves.at[:, :-1, -1].set(0.0), noises, at_centre[0])
    # E[x+ 1{j}] = A_j E[(x - c) 1{j}] + P(j) (A_j c + B_j u + E w_j).
    law = moments_before[:, -1:]
    means = jnp.einsum("jab,jb->ja", moves[:, :-1, :-1], moments_before[:, :-1]) + law * at_centre
    centre_after = jnp.sum(means, axis=0) / jnp.sum(law)
    return MotionByMode(moves.at[:, :-1, -1].set(at_centre - centre_after), noises, centre_after)


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
