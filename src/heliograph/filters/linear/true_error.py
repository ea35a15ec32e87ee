"""True error covariance of a filter whose gains do not depend on data, in a world that may differ from its model."""

from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.precomputed_filter import LinearStep, PlannedFilter
from heliograph.filters.modes.channel_by_mode import ChannelByMode, channels_by_mode
from heliograph.linear.jump_system import mix_moments_of_modes, propagate_by_mode
from heliograph.model.augmented.past_outputs import with_past
from heliograph.model.channel import Channel, check_link
from heliograph.model.over_time import at, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.check import array, check_horizon, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float


@readable
@dataclass(frozen=True)
class TrueError:
    """Claimed and true error covariance of a filter after each correction.

    Args:
        states: names of the states.
        claimed: covariance that the filter claims (time, n, n).
        true: E[(x - xhat)(x - xhat)'] (time, n, n).
    """

    states: tuple[str, ...]
    claimed: Float[np.ndarray, "time n n"]
    true: Float[np.ndarray, "time n n"]

    @property
    def ratio(self) -> Float[np.ndarray, "time n"]:
        """True over claimed variance of each state after each correction: 1 where the claim is right."""
        return np.asarray(np.diagonal(self.true, axis1=1, axis2=2) / np.diagonal(self.claimed, axis1=1, axis2=2))


@in_float64
def true_error(
    filter: AbstractFilter,
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    horizon: int,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> TrueError:
    """Return E[(x - xhat)(x - xhat)'] of a linear filter in a world that may differ from its model, exactly.

    With r = (x, 1, s), where s is the filter's state, N_j = E[r r' 1{mode j}] is propagated through plant, channel and
    gains for each mode j of the channel. The gains may be any, not only optimal ones.

    Args:
        filter: a filter whose gains do not depend on data.
        plant: the true plant, linear.
        sensor: the true sensor, linear.
        channel: the true channel, with or without memory or delays, without losses.
        horizon: number of steps.
        inputs: inputs of the plant (horizon, inputs); zero inputs of width 0 by default.

    Raises:
        ValueError: a filter whose gains depend on data, a plant or sensor that is not linear, parts that do not fit, a
            channel that loses data.

    Source: the moments of jump linear systems, as in Costa, Fragoso and Marques (2005), for the filter's state too.
    """
    _check_fits(filter, plant, sensor, channel)
    states = first(plant).states
    n = len(states)
    # Gains of the filter for these inputs.
    u = array("inputs", np.zeros((check_horizon(horizon), 0)) if inputs is None else inputs, (horizon, None))
    planned = filter.planned(u)
    if not isinstance(planned, PlannedFilter):
        raise fail("filter", "one whose gains depend on no data", type(filter).__name__)
    # A late channel: past signals are states too.
    if first(channel).past:
        plant, sensor, channel = with_past(plant, sensor, channel)
    enlarged = first(plant)
    total = len(enlarged.states)  # n, and the past signals
    # P(j) at the start, and for each step the moments of the true channel in each mode j.
    initial, channel_by_mode = channels_by_mode(channel)
    projection = np.eye(n) if planned.projection is None else np.asarray(planned.projection)
    # N_j at the start, with r = (x, 1, s): P(j) E[r r'], where only x has a covariance; s is the planned start.
    mean = np.concatenate([enlarged.initial_mean, [1.0], planned.start])
    square = np.outer(mean, mean)
    square[:total, :total] += enlarged.initial_covariance
    moments, true = np.asarray(initial)[:, None, None] * square, []
    # Error x - xhat = D r; one prediction and one correction per step. The modes move from the second step on.
    difference = np.concatenate([np.eye(n, total + 1), -projection], axis=1)
    for k in range(horizon):
        transition = np.eye(len(moments)) if k == 0 else np.asarray(at(channel_by_mode, k).transition)
        moments = _predict_joint_moments(moments, at(plant, k), at(planned.steps, k), u[k], transition)
        moments = _correct_moments(moments, at(sensor, k), at(channel_by_mode, k), at(planned.steps, k))
        true.append(difference @ moments.sum(axis=0) @ difference.T)
    # Claimed covariances lie as start, then before and after correction of each step: every second one from the third.
    claimed = np.asarray(planned.covariances)[2 : 2 * horizon + 1 : 2]
    return TrueError(states, claimed, np.array(true))


def _check_fits(filter: AbstractFilter, plant: AnyPlant, sensor: AnySensor, channel: Channel) -> None:
    """Raise ValueError unless plant and sensor are linear and the filter has their sizes; its own model may differ."""
    check_linear("true error", plant, sensor)
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    n = len(first(plant).states)
    check_link(first(sensor), first(channel), n, late=True)
    received = first(channel).outputs
    if filter.received != received or len(filter.states) != n:
        got = f"one of {len(filter.states)} that receives {filter.received}"
        raise fail("filter", f"one of {n} states that receives {received} numbers", got)


def _predict_joint_moments(
    moments: np.ndarray, plant: LinearPlant, step: LinearStep, u: np.ndarray, transition: np.ndarray
) -> np.ndarray:
    """Return E[r r' 1{mode}] (M, size, size), r = (x, 1, s), after the prediction of a step.

    They follow plant and filter together, to find the true error of a filter that was designed for another model.
    x+ = A x + b + w (Cov w = Q) is the true state, s- = F s + f the filter's predicted mean s, and the modes of the
    channel move by their Markov chain. 1{mode} is 1 in a mode of the channel, else 0.

    Args:
        moments: E[r r' 1{mode}] before the step (M, size, size), one for each of M modes.
        plant: the true plant.
        step: the filter's step: `transition` F and `drift` f.
        u: input of the step.
        transition: transition matrix of the modes (M, M).
    """
    n, size = len(plant.states), moments.shape[-1]
    x, one, s = slice(0, n), n, slice(n + 1, None)  # where r = (x, 1, s) has its three parts
    inputs = jnp.asarray(u)
    # r+ = T r + (w, 0, 0) with T = [A b 0; 0 1 0; 0 f F], and N = diag(Q, 0, 0).
    T, N = np.zeros((2, size, size))
    T[x, x], T[x, one] = plant.transition_matrix(inputs), plant.shift(inputs)
    T[one, one] = 1.0
    T[s, s], T[s, one] = step.transition, step.drift
    N[x, x] = plant.noise_covariance(inputs)
    # Modes move first: moments after the move of the chain.
    before = mix_moments_of_modes(transition, moments)
    # T E[r r' 1{mode}] T' + P(mode) N, with P(mode) = E[1 1 1{mode}].
    probability = before[:, one, one, None, None]
    return np.asarray(propagate_by_mode(T, before, probability * N))


def _correct_moments(moments: np.ndarray, sensor: LinearSensor, channel: ChannelByMode, step: LinearStep) -> np.ndarray:
    """Return E[r r' 1{mode}] (M, size, size) after a correction, for r = (x, 1, s) and each of M modes of the channel.

    This follows a filter of a wrong model under the true one: r joins the true state x and the filter's state s, which
    becomes s + K (z - C s - c). The true sensor sends y = C_x x + v, and z = G y + n arrives, with a random G and n
    whose law depends on the mode. With (y, 1) = D (x, 1) + (v - E v, 0), D = [C_x, E v; 0, 1],

        s+ = (I - K C) s - K c + K E[(G, n)] D (x, 1)                  mean given x, s and the mode
             + K [(G, n) - E(G, n)] (y, 1) + K E[G] (v - E v)          zero-mean terms, uncorrelated with x and s

    Args:
        moments: E[r r' 1{mode}] after the prediction.
        sensor: the true sensor.
        channel: E[(G, n)] (M, m, p + 1) and the covariances of its rows, `covariance` (M, m, m, p + 1, p + 1), by mode.
        step: the filter's K, C and c.
    """
    # K, E[(G, n)] by mode, D, and the covariance of (v, 0).
    p, n = sensor.matrix.shape
    x_and_one, one, s = slice(0, n + 1), n, slice(n + 1, None)  # where r = (x, 1, s) has its parts
    gain, mean = np.asarray(step.gain), np.asarray(channel.mean)
    probability = moments[:, one, one, None, None]  # P(mode) = E[1 1 1{mode}]
    D, noise = np.zeros((p + 1, n + 1)), np.zeros((p + 1, p + 1))
    D[:p, :n], D[:p, n], D[p, n] = sensor.matrix, sensor.noise.mean, 1.0
    noise[:p, :p] = sensor.noise.covariance
    # r+ = A_j r + zero-mean terms in s, with x and 1 unchanged: rows of s get K E[(G, n)] D - (0, K c) and I - K C.
    A = np.zeros_like(moments) + np.eye(moments.shape[-1])
    A[:, s, x_and_one] += gain @ mean @ D
    A[:, s, s] -= gain @ step.output
    A[:, s, one] -= gain @ step.offset
    # Second moment of the zero-mean terms without K, an m x m matrix for each mode j: entry (i, l) of the first is
    # sum_ab Cov[(G, n)_ia, (G, n)_lb] E[(y, 1)_a (y, 1)_b 1{mode j}].
    signal_moments = propagate_by_mode(D, moments[:, x_and_one, x_and_one], probability * noise)
    by_channel = np.einsum("jilab,jab->jil", np.asarray(channel.covariance), signal_moments)
    by_sensor = probability * propagate_by_mode(mean, noise, 0.0)
    # A_j E[r r' 1{mode j}] A_j', and K (...) K' in the block of s.
    after: np.ndarray = propagate_by_mode(A, moments, 0.0)
    after[:, s, s] += propagate_by_mode(gain, by_channel + by_sensor, 0.0)
    return after
