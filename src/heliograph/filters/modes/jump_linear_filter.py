"""Best linear filter of jump systems: it estimates the state jointly with the mode of links, plant and sensor.

With x~ = (x, 1) and modes theta, zeta^j = x~ 1{theta = j}. Its transition and its measurement are linear and their
noises white, E[zeta+ | past] = F zeta with F[j, i] = Pi[i, j] A~_j, and E[z | zeta, past] = sum_j Hbar_j C~_j zeta^j,
so that a Kalman filter of zeta is the best linear filter of x = sum_j zeta^j. All moments are those of x~ = (x - c, 1),
c = E[x] before data: a mean far from zero, which the modes' indicators multiply, would leave no digits for the rest.

The covariance of zeta is carried by factors; the moments before any data, which no measurement diminishes, are plain
matrices.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    below_diagonal,
    join_columns,
    rounding_of,
    side_by_side,
    triangularise,
)
from heliograph.factors.factored_gaussian import Gaussian, from_columns, from_covariance
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.signal_moments import condition_on_measurement, factor_spread
from heliograph.filters.linear.precomputed_filter import plan_filter
from heliograph.filters.modes.channel_by_mode import ChannelByMode, channels_by_mode
from heliograph.filters.modes.linear_by_mode import (
    MotionByMode,
    centred_motion,
    centred_sensing,
    noise_by_mode,
    noise_in_mode,
    pad_with_zeros,
)
from heliograph.filters.modes.models_by_mode import find_models
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.linear.jump_system import mix_moments_of_modes, propagate_by_mode
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, Innovation, lower_claim_by_noise
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import OverTime, at, first, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.linalg import outer
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, PyTree
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.random_affine.modes import joint_modes


class ModalBelief(NamedTuple):
    """zeta, mode by mode, given the data, and E[x~ x~' 1{mode}] before any data.

    centre c = E[x] before data; P(mode) c is part of the mean, whose sum over the modes is that of x. `moved` is true
    from the first prediction on.

    Shapes: zeta (M (n + 1),), moments (M, n + 1, n + 1), centre (n,).
    """

    gaussian: Gaussian
    moments: Float[jax.Array, "M n1 n1"]
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]

    @property
    def law(self) -> jax.Array:
        """Probabilities of the modes before any data (M,)."""
        return self.moments[:, -1, -1]


class MeasurementModel(NamedTuple):
    """Model of a measurement of zeta: z = common + H zeta + noise.

    Shapes: matrix H (m, N), common (m,), noise (m, columns).
    """

    matrix: jax.Array
    common: jax.Array
    noise: WeightedColumns


class AbstractModalFilter(AbstractSizedFilter):
    """Linear filter of x~ times functions of the modes of links with memory: its state estimates these products."""

    plant: AnyPlant
    sensor: AnySensor

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """Return x, a projection of zeta, and the covariance of its error."""
        projection, x = self._projection_to_state(), state.gaussian
        return Estimate(projection @ x.mean, WeightedColumns(projection @ x.root, x.variances).covariance, self.claim)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains."""
        return plan_filter(self, inputs, self._projection_to_state())

    def process_noise_by_mode(self, u: ArrayLike, k: Step, of_mode: WeightedColumns) -> WeightedColumns:
        """Return columns of zeta's process noise and rounding, from `of_mode` = E[phi phi'] of the next functions."""
        parts = noise_in_mode(at(self.plant, k), u, second_moments_at_start(self.plant))
        return WeightedColumns(kron(of_mode.matrix, parts.matrix), outer(of_mode.weights, parts.weights).reshape(-1))

    @abstractmethod
    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return the matrix (n, N) that maps zeta to x."""


class AbstractJointModalFilter(AbstractModalFilter):
    """Linear filter of the state jointly with the mode of all links together."""

    channel: ChannelByMode | OverTime
    initial: Float[Array, " M"]

    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return x = sum_j zeta^j."""
        return make_mode_sum_matrix(len(self.states), len(self.initial))


class ModalFilter(AbstractJointModalFilter):
    """The linear minimum-mean-square-error filter of a linear system whose plant, sensor and links have modes.

    The mode of a step moves the plant and measures in it. The estimate of zeta includes the modes' indicators, which
    are linear estimates and no probabilities; its covariance is singular, since they sum to 1, which its factors take
    as it is. Which components arrive must not depend on the modes. The innovation covariance is exact; the innovation
    is not Gaussian, so its Gaussian likelihood is nominal.

    Source: Costa, Linear minimum mean square error estimation for discrete-time Markovian jump linear systems (1994),
    whose plant moves with the mode before.
    """

    plant_modes: tuple[int, ...] = eqx.field(static=True)  # which of the plant's models each mode has
    sensor_modes: tuple[int, ...] = eqx.field(static=True)

    @compile_on_call
    def init(self) -> ModalBelief:
        """Return the prior of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), x~ = (x - centre, 1).

        State and mode are independent at the start.
        """
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior, second_moment = compute_initial_moments(start, self.initial)
        moments, centre = law[:, None, None] * second_moment, jnp.asarray(start.initial_mean)
        return ModalBelief(gaussian=prior, moments=moments, centre=centre, moved=jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBelief, u: ArrayLike = (), k: Step = 0) -> ModalBelief:
        """Move the mode by the chain and x~ by its plant; at the first prediction the mode has its initial law.

        zeta holds x~ = (x - c, 1) times each mode's indicator. With the chain Pi, the plant's A~ and Q~ in each mode
        and E_i = E[x~ x~' 1{i}], the noise of zeta+ = F zeta + noise has the covariance, in the block of modes j and l,
        A~_j sum_i (delta_jl Pi_ij - Pi_ij Pi_il) E_i A~_l' + delta_jl P(j) Q~_j.
        """
        transition = self._transition_matrix(state, k)
        moments_before_motion, motion = mix_moments_of_modes(transition, state.moments), self._motion(state, u, k)
        law = moments_before_motion[:, -1, -1]
        # The mean of F zeta. The part that the centre has in it is moved by itself.
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        mean = predict_by_mode(deviation[:, None], motion.moves, transition)[:, 0] + mean_from_centre(
            law, motion.centre
        )
        root, noise = self._transition_factors(state, u, k)
        after = from_columns(mean, join_columns(WeightedColumns(root, state.gaussian.variances), noise))
        moments = propagate_by_mode(motion.moves, moments_before_motion, law[:, None, None] * motion.noises)
        return ModalBelief(gaussian=after, moments=moments, centre=motion.centre, moved=jnp.asarray(True))

    @corrects
    def correct(self, state: ModalBelief, z: ArrayLike, k: Step = 0) -> tuple[ModalBelief, Innovation]:
        """Correct with the components of z that arrived.

        zeta holds x~ = (x - c, 1) times each mode's indicator. Mode j has the sensor C~_j, R~_j, the mean gain Hbar_j
        and the spread T_j of gains. With E_j = E[x~ x~' 1{j}], Cov(z - E[z | zeta]) is
        sum_j T_j(C~_j E_j C~_j' + P(j) R~_j) + P(j) (Hbar_j R~_j Hbar_j' + Cov n_j).
        """
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        output = self._measurement_model(state, k)
        after, innovation = condition_modes_on_received(state.gaussian, deviation, output, z)
        return state._replace(gaussian=after), innovation

    def _transition_matrix(self, state: ModalBelief, k: Step) -> jax.Array:
        """Return the transition matrix (M, M) of the chain; the identity before the first prediction."""
        return jnp.where(state.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(state.moments)))

    def _transition_factors(self, state: ModalBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, WeightedColumns]:
        """Return F L of zeta = E zeta + L xi, zeta the state times each mode's indicator, and columns of its noise."""
        transition, matrices, plants = (
            self._transition_matrix(state, k),
            self._motion(state, u, k).moves,
            self._plants(k),
        )
        # The noise by which the chain draws the next mode, moved by the plant of that mode.
        chain_noise = mode_transition_covariance(state.moments, transition)
        by_mode = chain_noise.matrix.reshape(*matrices.shape[:2], -1)
        moved_chain_noise = WeightedColumns((matrices @ by_mode).reshape(chain_noise.matrix.shape), chain_noise.weights)
        initial_power = second_moments_at_start(self.plant)
        process_noise = noise_by_mode(plants, self.plant_modes, u, initial_power, state.law @ transition)
        return predict_by_mode(state.gaussian.root, matrices, transition), join_columns(
            moved_chain_noise, process_noise
        )

    def _plants(self, k: Step) -> tuple[LinearPlant, ...]:
        """Return the laws of motion of a step."""
        return list_mode_models(at(self.plant, k))

    def _motion(self, state: ModalBelief, u: ArrayLike, k: Step) -> MotionByMode:
        """Return how the state moves about its centre in each mode of the step."""
        arriving = mix_moments_of_modes(self._transition_matrix(state, k), state.moments)
        return centred_motion(self._plants(k), self.plant_modes, u, state.centre, arriving[:, :, -1])

    def _measurement_model(self, state: ModalBelief, k: Step) -> MeasurementModel:
        """Return the model z = common + H zeta + v, with columns of Cov v; zeta is the state times mode indicators."""
        channel, law = at(self.channel, k), state.law
        sensors = list_mode_models(at(self.sensor, k))
        measure, noise = centred_sensing(sensors, self.sensor_modes, state.centre)
        gains = jnp.asarray(channel.mean)
        matrix, mean_output = subtract_mean_output(gains @ measure, law)
        # E[y~ y~' 1{mode j}] of what is sent (M, p + 1, p + 1), and the spread of the gains on it (m, m).
        sent = propagate_by_mode(measure, state.moments, law[:, None, None] * noise)
        gain_noise = factor_spread(jnp.einsum("jmlab,jab->ml", jnp.asarray(channel.gain_spread), sent))
        # Noise of sensor and links, in the mean over the modes, and rounding.
        known_noise = factor_known_noise(channel, [sensors[mode].noise.columns for mode in self.sensor_modes], law)
        rounding = rounding_of_received(gains, sent)
        return MeasurementModel(concatenate_modes(matrix), mean_output, join_columns(known_noise, rounding, gain_noise))

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise, zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...).

        `slopes` is F L, for zeta = E zeta + L xi. The projection maps zeta to the plant's state x.
        """
        slopes, noise = self._transition_factors(step.before, step.u, step.k)
        slopes_and_noise = slopes, triangularise(noise)
        return smoother_step_of(step, slopes_and_noise, self.claim, projection=self._projection_to_state())


def predict_by_mode(columns: jax.Array, moves: jax.Array, rows: jax.Array) -> jax.Array:
    """Multiply columns (N, c) by F, F[j, i] = Pi[i, j] A~_j: mix all parts by the chain, then move each."""
    parts = (rows.T @ columns.reshape(len(rows), -1)).reshape(rows.shape[1], moves.shape[-1], -1)
    return jnp.reshape(moves @ parts, columns.shape)


def mode_transition_covariance(moments: jax.Array, rows: jax.Array) -> WeightedColumns:
    """Return columns of sum_i Cov(1{next} | i) x E_i (N, N), what the chain draws, from the moments E_i (M, s, s)."""
    return factor_with_last_mode(jnp.einsum("ijl,iab->jalb", covariance_of_mode(rows)[:, :-1, :-1], moments))


def covariance_of_mode(rows: jax.Array) -> jax.Array:
    """Return Cov(1{j}, 1{l} | i) = delta_jl Pi_ij - Pi_ij Pi_il, (M, M, M)."""
    return rows[:, :, None] * (np.eye(rows.shape[1]) - rows[:, None, :])


def factor_with_last_mode(covariance: jax.Array) -> WeightedColumns:
    """Return columns (M s, ...) of a covariance over all M modes, whose parts of size s sum to zero over the modes.

    `covariance` (M - 1, s, M - 1, s) is that of all modes but the last. The last part is minus the sum of the others.
    """
    other_modes, size = covariance.shape[:2]
    factors = factor_spread(covariance.reshape(other_modes * size, other_modes * size))
    minus_sum = -np.tile(np.eye(size), (1, other_modes))
    return factors.through(np.concatenate([np.eye(other_modes * size), minus_sum]))


def factor_known_noise(channel: ChannelByMode, sent: Sequence[WeightedColumns], law: jax.Array) -> WeightedColumns:
    """Return the columns of sum_j P(j) (Hbar_j Cov(v_j) Hbar_j' + Cov n_j) (m, m), which do not depend on the signal.

    Mode j has the probability P(j) and the mean gain Hbar_j. v_j is the noise of what is sent, n_j that of the link.
    """
    gains = jnp.asarray(channel.mean)[:, :, :-1]
    received = [noise.through(gain).times(p) for gain, noise, p in zip(gains, sent, law, strict=True)]
    return join_columns(*received, side_by_side(channel.noise, law))


def rounding_of_received(gains: jax.Array, sent: jax.Array) -> WeightedColumns:
    """Return the rounding (m, m) of z, of gains (M, m, p + 1), from E[y~ y~' 1{mode}] (M, p + 1, p + 1)."""
    return rounding_of(jnp.einsum("jma,jab,jmb->m", gains, sent, gains))


def kron(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return the Kronecker product of a and b, by a matrix product, which keeps known zeros."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    products = outer(a.reshape(-1), b.reshape(-1)).reshape(*a.shape, *b.shape)
    # products[i, j, k, l] = a_ij b_kl goes to row (i, k), column (j, l).
    return products.swapaxes(1, 2).reshape(len(a) * len(b), -1)


def make_mode_sum_matrix(n: int, modes: int) -> Float[np.ndarray, "n N"]:
    """Return the matrix (n, N) that maps zeta to x = sum_j zeta^j."""
    return np.tile(np.eye(n, n + 1), (1, modes))


def condition_modes_on_received(
    x: Gaussian, deviation: jax.Array, output: MeasurementModel, z: ArrayLike
) -> tuple[Gaussian, Innovation]:
    """Return the law of zeta given the components of z that arrived, and the innovation.

    zeta is the state times the indicator of each mode. `output` describes z = common + matrix deviation + noise, where
    the `deviation` is zeta less P(mode) c, with c the centre; its mean is given.
    """
    expected = output.common + output.matrix @ deviation
    slopes = output.matrix @ x.root
    return condition_on_measurement(x, slopes, output.noise, jnp.asarray(z), expected)


def compute_initial_moments(start: LinearPlant, law: Array) -> tuple[Gaussian, jax.Array]:
    """Return the law of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...) at the start, x~ = (x - c, 1), and E[x~ x~'].

    x and the mode are independent at the start, and the mode has the law p. With e = E[x~] = (0, 1) and Kronecker's
    product x, Cov(zeta) = diag(p) x Cov(x~) + (diag(p) - p p') x e e'.
    """
    covariance, law = pad_with_zeros(jnp.asarray(start.initial_covariance)), jnp.asarray(law)
    state = from_covariance(start.initial_mean, start.initial_covariance)
    mode = factor_with_last_mode((jnp.diag(law) - jnp.outer(law, law))[:-1, None, :-1, None])
    # In each mode's part of the factor, x comes before the indicator. `unit_moment` is e e'.
    unit_moment = np.zeros((len(covariance), len(covariance)))
    unit_moment[-1, -1] = 1.0
    mode_root = jnp.pad(mode.matrix, ((0, 0), (0, 1))).at[-1, -1].set(1.0)
    root = jnp.kron(np.eye(len(law)), pad_with_zeros(state.root)) + jnp.kron(mode_root, unit_moment)
    variances = jnp.concatenate([jnp.outer(law, state.variances), jnp.append(mode.weights, 0.0)[:, None]], axis=1)
    prior = Gaussian(jnp.kron(law, jnp.append(state.mean, 1.0)), below_diagonal(root), variances.reshape(-1))
    return prior, covariance + unit_moment


def mean_from_centre(law: jax.Array, centre: jax.Array) -> jax.Array:
    """Return P(mode) c, mode after mode: the part of E zeta that the centre makes."""
    return jnp.kron(law, jnp.append(centre, 0.0))


def subtract_mean_output(output: jax.Array, law: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Subtract the mean output over the modes from every mode; return what is left, and the mean output (m,).

    The modes' indicators sum to 1, so that the mean output can be added as a constant. `output` (M, m, n + 1) maps
    (x, 1) to E z in each mode. `law` (M,) holds the probabilities of the modes.
    """
    mean_output = law @ output[:, :, -1] / jnp.sum(law)
    return output.at[:, :, -1].add(-mean_output), mean_output


def concatenate_modes(output: jax.Array) -> jax.Array:
    """Concatenate output matrices (M, m, n + 1) to one matrix (m, N) that acts on zeta."""
    return jnp.concatenate(list(output), axis=1)


def modal_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModalFilter:
    """Return the best linear filter where links, plant or sensor have modes; `linear_filter` has checked the parts."""
    models = first(plant), first(sensor)
    # The plant's and the sensor's model in each joint mode.
    by_mode = joint_modes(first(channel), beside=models).beside
    claim = lower_claim_by_noise(claim_of_modes(channel), *list_mode_models(models[0]), *list_mode_models(models[1]))
    return ModalFilter(
        plant=drop_names(plant),
        sensor=drop_names(sensor),
        plant_modes=find_models("plant", plant, [model for model, _ in by_mode]),
        sensor_modes=find_models("sensor", sensor, [model for _, model in by_mode]),
        **fields_of_joint_modes(plant, sensor, channel, claim),
    )


def fields_of_joint_modes(plant: AnyPlant, sensor: AnySensor, channel: Channel, claim: Claim) -> dict[str, Any]:
    """Return the channel's observation models by mode, and the sizes, of a filter of joint modes."""
    initial, described = channels_by_mode(channel, (first(plant), first(sensor)))
    return {"channel": described, "initial": initial, **make_sizes(claim, first(plant), first(channel).outputs)}


def claim_of_modes(channel: Channel) -> Claim:
    """Return "exact" if the law of every mode is known, "nominal" if some probability in it is uncertain."""
    return "exact" if all(m.corner_count() == 1 for c in unstack(channel) for m in joint_modes(c).maps) else "nominal"
