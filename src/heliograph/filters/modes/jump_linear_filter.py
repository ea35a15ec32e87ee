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
from heliograph.filters.gaussian.signal_moments import condition_on_measurement, factor_covariance
from heliograph.filters.linear.precomputed_filter import plan_filter
from heliograph.filters.modes.channel_by_mode import ChannelByMode, channels_by_mode
from heliograph.filters.modes.linear_by_mode import (
    MotionByMode,
    centred_motion,
    centred_sensing,
    factor_with_last_mode,
    kron,
    mode_transition_covariance,
    multiply_by_transition,
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
        """Probabilities of the modes before any data (M,): the last entry of E[x~ x~' 1{mode}], as that of x~ is 1."""
        return self.moments[:, -1, -1]


class MeasurementModel(NamedTuple):
    """Model z = common + H zeta + v of a measurement, with zeta = (x~ 1{mode = 1}, ...) for x~ = (x - centre, 1).

    Shapes: `matrix` H (m, N), common (m,), `noise` v (m, columns).
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
        """Return the estimate of x = P zeta, and the covariance of its error.

        The filter's state is the Gaussian of zeta, which holds the products of (x, 1) and functions of the modes; P is
        a fixed matrix that picks or sums x among them.
        """
        projection, zeta = self._projection_to_state(), state.gaussian
        covariance = WeightedColumns(projection @ zeta.root, zeta.variances).covariance
        return Estimate(projection @ zeta.mean, covariance, self.claim)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the filter with gains and covariances of each step computed in advance, for complete data."""
        return plan_filter(self, inputs, self._projection_to_state())

    def process_noise_by_mode(self, u: ArrayLike, k: Step, second_moment: WeightedColumns) -> WeightedColumns:
        """Return columns of the process noise of zeta = phi (x) x~, Kronecker's product, with its rounding.

        x~ = (x, 1) with the noise w~ = (w, 0), and phi are functions of the modes. zeta+ has the noise phi+ (x) w~, so
        that its covariance is E[phi+ phi+'] (x) Cov w~. `second_moment`: columns of E[phi+ phi+'] one step later.
        """
        noise = noise_in_mode(at(self.plant, k), u, second_moments_at_start(self.plant))
        # (a a') (x) (b b') = (a (x) b)(a (x) b)' for each column a of the one and b of the other.
        return WeightedColumns(
            kron(second_moment.matrix, noise.matrix), outer(second_moment.weights, noise.weights).reshape(-1)
        )

    @abstractmethod
    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return the matrix (n, N) that maps zeta, products of (x, 1) and functions of the modes, to x."""


class AbstractJointModalFilter(AbstractModalFilter):
    """Linear filter of the state jointly with the mode of all links together."""

    channel: ChannelByMode | OverTime
    initial: Float[Array, " M"]

    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return the matrix (n, N) that maps zeta = ((x, 1) 1{mode = 1}, (x, 1) 1{mode = 2}, ...) to x, their sum."""
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

        State and mode are independent at the start, so that E[x~ x~' 1{mode = j}] = P(j) E[x~ x~'].
        """
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior, second_moment = compute_initial_moments(start, self.initial)
        moments, centre = law[:, None, None] * second_moment, jnp.asarray(start.initial_mean)
        return ModalBelief(gaussian=prior, moments=moments, centre=centre, moved=jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBelief, u: ArrayLike = (), k: Step = 0) -> ModalBelief:
        """Predict zeta+ = F zeta + noise, where F has the blocks F_ji = Pi_ij A~_j.

        zeta holds x~ = (x - c, 1) times each mode's indicator, with c = E[x] before any data. The chain Pi draws the
        next mode j, whose plant A~_j, Q~_j moves x~. At the first prediction the mode keeps its initial law (Pi = I).
        """
        transition = self._transition_matrix(state, k)
        # E[x~ x~' 1{next mode = j}] = sum_i Pi_ij E[x~ x~' 1{mode = i}]
        moments_by_next_mode, motion = mix_moments_of_modes(transition, state.moments), self._motion(state, u, k)
        law = moments_by_next_mode[:, -1, -1]
        # The mean of zeta is that of the products of (x, 1): P(j) (c, 0) for each mode j, plus `deviation`, that of the
        # products of (x - c, 1), which F moves.
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        moved_deviation = multiply_by_transition(deviation[:, None], motion.matrices, transition)[:, 0]
        mean = moved_deviation + mean_from_centre(law, motion.centre)
        # Cov zeta = L diag(variances) L' becomes F L diag(variances) (F L)' + Cov noise.
        slopes, noise = self._transition_factors(state, u, k)
        predicted = from_columns(mean, join_columns(WeightedColumns(slopes, state.gaussian.variances), noise))
        # E[x~+ x~+' 1{j}] = A~_j E[x~ x~' 1{next mode = j}] A~_j' + P(j) Q~_j
        moments = propagate_by_mode(motion.matrices, moments_by_next_mode, law[:, None, None] * motion.noises)
        return ModalBelief(gaussian=predicted, moments=moments, centre=motion.centre, moved=jnp.asarray(True))

    @corrects
    def correct(self, state: ModalBelief, z: ArrayLike, k: Step = 0) -> tuple[ModalBelief, Innovation]:
        """Correct with the components of z that arrived: the Kalman update of z = common + H zeta + v.

        zeta holds x~ = (x - c, 1) times each mode's indicator, with c = E[x] before any data.
        """
        # The mean of zeta counts x from 0, the model of z from c: `deviation` is the mean of the products of x~.
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        output = self._measurement_model(state, k)
        corrected, innovation = condition_modes_on_received(state.gaussian, deviation, output, z)
        return state._replace(gaussian=corrected), innovation

    def _transition_matrix(self, state: ModalBelief, k: Step) -> jax.Array:
        """Return the transition matrix (M, M) of the modes to step k.

        Before the first prediction the mode keeps its initial law, so that it is the identity.
        """
        return jnp.where(state.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(state.moments)))

    def _transition_factors(self, state: ModalBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, WeightedColumns]:
        """Return F L, and columns of the noise's covariance, of zeta+ = F zeta + noise for zeta = E zeta + L xi.

        zeta holds x~ = (x - c, 1) times the indicator of each mode. If the mode goes from i to j, block j of zeta+ is
        A~_j x~ + w~_j, and of F zeta it is Pi_ij A~_j x~, so the noise has two causes: the draw of the mode, and w~_j.
        """
        transition, matrices = self._transition_matrix(state, k), self._motion(state, u, k).matrices
        # The draw: blocks (j, l) of A~_j sum_i Cov(1{next = j}, 1{next = l} | i) E[x~ x~' 1{mode = i}] A~_l'.
        draw = mode_transition_covariance(state.moments, transition)
        draw_by_mode = draw.matrix.reshape(*matrices.shape[:2], -1)
        moved_draw = WeightedColumns((matrices @ draw_by_mode).reshape(draw.matrix.shape), draw.weights)
        # The plant's noise: blocks P(next mode = j) Cov w~_j on the diagonal.
        initial_power = second_moments_at_start(self.plant)  # E[x_i^2] before any data, on which rounding acts
        process_noise = noise_by_mode(self._plants(k), self.plant_modes, u, initial_power, law=state.law @ transition)
        slopes = multiply_by_transition(state.gaussian.root, matrices, transition)
        return slopes, join_columns(moved_draw, process_noise)

    def _plants(self, k: Step) -> tuple[LinearPlant, ...]:
        """Return the different plants at step k; mode j has that of number `self.plant_modes[j]`."""
        return list_mode_models(at(self.plant, k))

    def _motion(self, state: ModalBelief, u: ArrayLike, k: Step) -> MotionByMode:
        """Return the transition of x~ = (x - c, 1) in each mode j, A~_j and Q~_j, and c one step later.

        c = E[x] before any data, so the next one is a mean over the modes.
        """
        moments_by_next_mode = mix_moments_of_modes(self._transition_matrix(state, k), state.moments)
        means_by_next_mode = moments_by_next_mode[:, :, -1]  # E[x~ 1{next mode = j}], as the last entry of x~ is 1
        return centred_motion(self._plants(k), self.plant_modes, u, state.centre, means_by_next_mode)

    def _measurement_model(self, state: ModalBelief, k: Step) -> MeasurementModel:
        """Return the model z = common + H zeta + v of step k, which is linear in the filter's state zeta.

        zeta holds the products x~ 1{mode = j} for each mode j, with x~ = (x - c, 1) and c = E[x] before any data. In
        mode j the sensor sends y~ = (y, 1) = C~_j x~ + noise of covariance R~_j, and z = G y~ arrives, where the random
        G has the mean Hbar_j; its last column is the link's noise. So E[z | zeta] = sum_j Hbar_j C~_j (x~ 1{mode = j}),
        and v has the covariance sum_j E[(G - Hbar_j) Y_j (G - Hbar_j)'] + P(j) Hbar_j R~_j Hbar_j', Y_j =
        E[y~ y~' 1{mode = j}].
        """
        channel, law = at(self.channel, k), state.law  # moments of G in each mode, and P(j)
        sensors = list_mode_models(at(self.sensor, k))
        sensor_matrices, sensor_noises = centred_sensing(sensors, self.sensor_modes, state.centre)  # C~_j and R~_j
        gains = jnp.asarray(channel.mean)  # Hbar_j
        # H is Hbar_j C~_j, mode after mode. Its part that is the same in all modes is taken out as a constant,
        # `common`.
        matrix, common = subtract_mean_output(gains @ sensor_matrices, law)
        # Y_j = E[y~ y~' 1{mode = j}] = C~_j E[x~ x~' 1{mode = j}] C~_j' + P(j) R~_j (M, p + 1, p + 1)
        signal_moments = propagate_by_mode(sensor_matrices, state.moments, law[:, None, None] * sensor_noises)
        # Cov v, first the random gains: sum_j E[(G - Hbar_j) Y_j (G - Hbar_j)' | j].
        gain_noise = factor_covariance(
            jnp.einsum("jmlab,jab->ml", jnp.asarray(channel.gain_covariance), signal_moments)
        )
        # Then noise of sensor and links, sum_j P(j) (Hbar_j R_j Hbar_j' + Cov n_j), and rounding.
        known_noise = factor_known_noise(channel, [sensors[mode].noise.columns for mode in self.sensor_modes], law)
        rounding = rounding_of_received(gains, signal_moments)
        return MeasurementModel(concatenate_modes(matrix), common, join_columns(known_noise, rounding, gain_noise))

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise, zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...).

        x~ = (x - centre, 1). `slopes` is F L, for zeta = E zeta + L xi. The projection maps zeta to the state x.
        """
        slopes, noise = self._transition_factors(step.before, step.u, step.k)
        slopes_and_noise = slopes, triangularise(noise)
        return smoother_step_of(step, slopes_and_noise, self.claim, projection=self._projection_to_state())


def factor_known_noise(channel: ChannelByMode, sent: Sequence[WeightedColumns], law: jax.Array) -> WeightedColumns:
    """Return the columns of sum_j P(j) (Hbar_j Cov(v_j) Hbar_j' + Cov n_j) (m, m), which do not depend on the signal.

    Mode j has the probability P(j) (`law`) and the mean gain Hbar_j (`channel.mean` without its last column). v_j is
    the noise of what is sent (columns in `sent`), n_j that of the link.
    """
    gains = jnp.asarray(channel.mean)[:, :, :-1]
    received = [noise.through(gain).times(p) for gain, noise, p in zip(gains, sent, law, strict=True)]
    return join_columns(*received, side_by_side(channel.noise, law))


def rounding_of_received(gains: jax.Array, sent: jax.Array) -> WeightedColumns:
    """Return columns of the rounding of z (m, m), whose components have E[z_i^2] = sum_j (Hbar_j Y_j Hbar_j')_ii.

    `gains`: Hbar_j (M, m, p + 1); `sent`: Y_j = E[y~ y~' 1{mode = j}] (M, p + 1, p + 1) of y~ = (y, 1) that is sent.
    """
    return rounding_of(jnp.einsum("jma,jab,jmb->m", gains, sent, gains))


def make_mode_sum_matrix(n: int, modes: int) -> Float[np.ndarray, "n N"]:
    """Return the matrix (n, N) that sums the first n entries of each of `modes` blocks of length n + 1.

    It maps zeta = ((x, 1) 1{mode = 1}, (x, 1) 1{mode = 2}, ...) to x, since the indicators sum to 1.
    """
    return np.tile(np.eye(n, n + 1), (1, modes))


def condition_modes_on_received(
    x: Gaussian, deviation: jax.Array, output: MeasurementModel, z: ArrayLike
) -> tuple[Gaussian, Innovation]:
    """Return zeta given the components of z = common + H zeta + noise that arrived, and the innovation.

    Args:
        x: zeta, the products of (x, 1) and functions of the modes, as a Gaussian of mean and factor L.
        deviation: mean of the same products of (x - c, 1), on which H acts; c is E[x] before any data.
        output: common, H and columns of the noise.
        z: measurement (m,), NaN for what did not arrive.
    """
    expected = output.common + output.matrix @ deviation
    slopes = output.matrix @ x.root
    return condition_on_measurement(x, slopes, output.noise, jnp.asarray(z), expected)


def compute_initial_moments(start: LinearPlant, law: Array) -> tuple[Gaussian, jax.Array]:
    """Return the prior of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), x~ = (x - c, 1), and E[x~ x~'].

    c = E[x]. The mode has the law p and is independent of x. With e = E[x~] = (0, 1) and Kronecker's product (x),
    Cov(zeta) = diag(p) (x) Cov(x~) + (diag(p) - p p') (x) e e'. The mean is that of the products of (x, 1).
    """
    covariance, law = pad_with_zeros(jnp.asarray(start.initial_covariance)), jnp.asarray(law)
    state = from_covariance(start.initial_mean, start.initial_covariance)
    # Columns of diag(p) - p p' (M, M - 1). A last column of variance 0 makes their matrix square.
    mode = factor_with_last_mode((jnp.diag(law) - jnp.outer(law, law))[:-1, None, :-1, None])
    mode_root = jnp.pad(mode.matrix, ((0, 0), (0, 1))).at[-1, -1].set(1.0)
    mode_variances = jnp.append(mode.weights, 0.0)
    # In each mode's block the first n columns are those of x, and the last one, of e e', is that of the indicator.
    outer_e = np.zeros((len(covariance), len(covariance)))
    outer_e[-1, -1] = 1.0
    root = jnp.kron(np.eye(len(law)), pad_with_zeros(state.root)) + jnp.kron(mode_root, outer_e)
    variances = jnp.concatenate([jnp.outer(law, state.variances), mode_variances[:, None]], axis=1)
    mean = jnp.kron(law, jnp.append(state.mean, 1.0))
    prior = Gaussian(mean, below_diagonal(root), variances.reshape(-1))
    return prior, covariance + outer_e  # E[x~ x~'] = Cov(x~) + e e'


def mean_from_centre(law: jax.Array, centre: jax.Array) -> jax.Array:
    """Return P(j) (c, 0), mode after mode: E[(x, 1) 1{mode = j}] less E[(x - c, 1) 1{mode = j}] for the centre c.

    `law` (M,) are the P(j), and `centre` is c (n,). Added to the mean of the products of (x - c, 1) and the modes'
    indicators, it gives that of the products of (x, 1).
    """
    return jnp.kron(law, jnp.append(centre, 0.0))


def subtract_mean_output(output: jax.Array, law: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Subtract the mean output over the modes, a constant, from the output of each mode; return both.

    The modes' indicators sum to 1, so a constant in all modes may be taken out and added to z as such (m,). `output`
    (M, m, n + 1) maps (x, 1) to E z in each mode. `law` (M,) holds the probabilities of the modes.
    """
    mean_output = law @ output[:, :, -1] / jnp.sum(law)
    return output.at[:, :, -1].add(-mean_output), mean_output


def concatenate_modes(output: jax.Array) -> jax.Array:
    """Concatenate output matrices by mode (M, m, n + 1) to one matrix (m, N), which acts on the blocks of all modes."""
    return jnp.concatenate(list(output), axis=1)


def modal_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModalFilter:
    """Return the best linear filter where links, plant or sensor have modes: values of hidden Markov chains.

    All modes together are one chain of joint modes. `linear_filter`, which calls this, has checked that the parts fit.
    """
    models = first(plant), first(sensor)
    # A joint mode is one of plant, sensor and channel together. Here, for each, its models (plant, sensor).
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
    """Return fields with which a filter is constructed: its channel by joint mode, initial law, sizes and claim.

    A joint mode is one of plant, sensor and channel together. The claim is what the filter's covariance is said to be.
    """
    initial, described = channels_by_mode(channel, (first(plant), first(sensor)))
    return {"channel": described, "initial": initial, **make_sizes(claim, first(plant), first(channel).outputs)}


def claim_of_modes(channel: Channel) -> Claim:
    """Return "exact" if the law of gain and noise in every mode is known, "nominal" if some probability is uncertain.

    An uncertain law is one of a set with several extreme laws (corners); a known one is its own only corner.
    """
    maps = [affine for step in unstack(channel) for affine in joint_modes(step).maps]
    return "exact" if all(affine.corner_count() == 1 for affine in maps) else "nominal"
