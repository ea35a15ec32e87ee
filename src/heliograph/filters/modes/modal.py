"""Best linear filter behind links with memory: it estimates the state jointly with the mode of the links.

With x~ = (x, 1) and modes theta, zeta^j = x~ 1{theta = j}. Its transition and its measurement are linear and their
noises white, E[zeta+ | past] = F zeta with F[j, i] = Pi[i, j] A~_j, and E[z | zeta, past] = sum_j Hbar_j C~ zeta^j, so
that a Kalman filter of zeta is the best linear filter of x = sum_j zeta^j. All moments are those of x~ = (x - c, 1),
c = E[x] before data: a mean far from zero, which the modes' indicators multiply, would leave no digits for the rest.

The covariance of zeta is carried by factors; the moments before any data, which no measurement diminishes, are plain
matrices.
"""

from abc import abstractmethod
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import (
    Columns,
    below_diagonal,
    join_columns,
    rounding_of,
    side_by_side,
    triangular,
)
from heliograph.factors.gaussian import Gaussian, given, of_columns
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.belief import process_noise, start_of
from heliograph.filters.gaussian.signal import condition, factor_spread
from heliograph.filters.linear.plan import plan
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, over_time, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.linalg import outer
from heliograph.numerics.module import Module
from heliograph.numerics.traced import stack_parts
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, PyTree
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.second_moments import divide_spread, nominal_spread, undivided


class ObservationModel(Module):
    """A channel at one step, mode by mode: E[(G, n) | mode], and what (G, n) varies by about it.

    transition: of the modes from the step before to this one; radius: bound on the error of each of its entries;
    gain_spread and noise: as in `SecondOrder`, for each mode.

    Shapes: transition and radius (M, M), mean (M, m, p + 1), gain_spread (M, m, m, p + 1, p + 1), noise (M, m, m).
    """

    transition: Float[Array, "M M"]
    radius: Float[Array, "M M"]
    mean: Float[Array, "M m p1"]
    gain_spread: Float[Array, "M m m p1 p1"]
    noise: Columns

    @property
    def spread(self) -> Float[Array, "M m m p1 p1"]:
        """E[((G, n) - mean) Y ((G, n) - mean)' | mode] as a tensor."""
        spread: Array = undivided(self.gain_spread, self.noise)
        return spread


class ModalBelief(NamedTuple):
    """Estimate of zeta, mode by mode, factors of its error's covariance, and E[x~ x~' 1{mode}] before any data.

    centre c = E[x] before data; P(mode) c is part of the mean, whose sum over the modes is that of x. `moved` is true
    from the first prediction on.

    Shapes: with N = M (n + 1): mean, variances (N,), lower (N (N - 1) / 2,), moments (M, n + 1, n + 1), centre (n,).
    """

    mean: Float[jax.Array, " N"]
    lower: Float[jax.Array, " entries"]
    variances: Float[jax.Array, " N"]
    moments: Float[jax.Array, "M n1 n1"]
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]

    @property
    def gaussian(self) -> Gaussian:
        """zeta given the data."""
        return Gaussian(*self[:3])

    @property
    def covariance(self) -> Any:
        """Covariance of the error of zeta."""
        return self.gaussian.covariance

    @property
    def law(self) -> jax.Array:
        """Probabilities of the modes before any data (M,)."""
        return self.moments[:, -1, -1]


class Output(NamedTuple):
    """A measurement z = common + H zeta + noise of zeta.

    Shapes: matrix H (m, N), common (m,), noise (m, columns).
    """

    matrix: jax.Array
    common: jax.Array
    noise: Columns


class AbstractModalFilter(AbstractSizedFilter):
    """Linear filter of x~ times functions of the modes of links with memory: its state estimates these products."""

    plant: AnyPlant
    sensor: AnySensor

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """Return x, a projection of zeta, and the covariance of its error."""
        projection, x = self._projection(), state.gaussian
        return Estimate(projection @ x.mean, Columns(projection @ x.root, x.variances).covariance, self.claim)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains."""
        return plan(self, inputs, self._projection())

    def moved_noise(self, u: ArrayLike, k: Step, of_mode: Columns) -> Columns:
        """Covariance (N, N) of the process noise and of the rounding of zeta, by E[phi phi'] of the next functions."""
        parts = noise_in_mode(at(self.plant, k), u, start_of(self.plant))
        return Columns(kron(of_mode.matrix, parts.matrix), outer(of_mode.weights, parts.weights).reshape(-1))

    @abstractmethod
    def _projection(self) -> Float[np.ndarray, "n N"]:
        """Matrix (n, N) that maps zeta to x."""


class AbstractJointModalFilter(AbstractModalFilter):
    """Linear filter of the state jointly with the mode of all links together."""

    channel: ObservationModel | OverTime
    initial: Float[Array, " M"]

    def _projection(self) -> Float[np.ndarray, "n N"]:
        """x = sum_j zeta^j."""
        return sum_of_modes(len(self.states), len(self.initial))


class ModalFilter(AbstractJointModalFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind links with memory.

    The estimate of zeta includes the modes' probabilities; its covariance is singular, since the modes' indicators
    sum to 1, which its factors take as it is. Which components arrive must not depend on the modes. The innovation
    covariance is exact; the innovation is not Gaussian, so its Gaussian likelihood is nominal.

    Source: Costa, Linear minimum mean square error estimation for discrete-time Markovian jump linear systems (1994).
    """

    @in_float64
    def init(self) -> ModalBelief:
        """Return the prior, independent of the mode."""
        law, (prior, second) = jnp.asarray(self.initial), prior_of_modes(at(self.plant, 0), self.initial)
        moments, centre = law[:, None, None] * second, jnp.asarray(at(self.plant, 0).initial_mean)
        return ModalBelief(*prior, moments, centre, jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBelief, u: ArrayLike = (), k: Step = 0) -> ModalBelief:
        """Move x~ by the plant and the mode by the chain; at the first prediction the mode has its initial law.

        Cov(zeta+ - F zeta)[j, l] = sum_i (delta_jl Pi_ij - Pi_ij Pi_il) A~ E_i A~' + delta_jl P(j) Q~.
        """
        (move, noise, centre), rows = predict_about(at(self.plant, k), u, state.centre), self._rows(state, k)
        law = state.law @ rows
        # F zeta about the moving centre.
        centred = state.mean - known_part(state.law, state.centre)
        mean = predict_by_mode(centred[:, None], move, rows)[:, 0] + known_part(law, centre)
        root, fresh = self._moves(state, u, k)
        after = of_columns(mean, join_columns(Columns(root, state.variances), fresh))
        moments = jnp.einsum("ij,iab->jab", rows, _propagate_moments(state, move)) + law[:, None, None] * noise
        return ModalBelief(*after, moments, centre, jnp.asarray(True))

    @corrects
    def correct(self, state: ModalBelief, z: ArrayLike, k: Step = 0) -> tuple[ModalBelief, Innovation]:
        """Correct with the components of z that arrived.

        Cov(z - E[z | zeta]) = sum_j T_j(C~ E_j C~' + P(j) R~) + P(j) (Hbar_j R~ Hbar_j' + Cov n_j), T_j the spread of
        the gains in mode j.
        """
        centred = state.mean - known_part(state.law, state.centre)
        after, innovation = observe_modes(state.gaussian, centred, self._output(state, k), z)
        return ModalBelief(*after, *state[3:]), innovation

    def _rows(self, state: ModalBelief, k: Step) -> jax.Array:
        """Transition matrix of the chain (M, M)."""
        return jnp.where(state.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(state.moments)))

    def _moves(self, state: ModalBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, Columns]:
        """Return F L of zeta = E zeta + L xi, and the columns of Cov(zeta+ - F zeta)."""
        move, rows = predict_about(at(self.plant, k), u, state.centre)[0], self._rows(state, k)
        own = self.moved_noise(u, k, Columns(jnp.eye(len(rows)), state.law @ rows))
        fresh = join_columns(spread_of_moves(_propagate_moments(state, move), rows), own)
        return predict_by_mode(state.gaussian.root, move, rows), fresh

    def _output(self, state: ModalBelief, k: Step) -> Output:
        """Return what is measured of zeta, less the mean output."""
        channel, sensor = at(self.channel, k), at(self.sensor, k)
        (measure, noise), law = measure_about(sensor, state.centre), state.law
        matrix, common = without_common(jnp.asarray(channel.mean) @ measure, law)
        sent = jax.vmap(lambda a: measure @ a @ measure.T)(state.moments) + law[:, None, None] * noise
        random = jnp.einsum("jmlab,jab->ml", jnp.asarray(channel.gain_spread), sent)
        plain = known_noise(channel, sensor.noise.columns, law)
        rounding = rounding_of_received(jnp.asarray(channel.mean), sent)
        return Output(place_beside(matrix), common, join_columns(plain, rounding, factor_spread(random)))

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the law of zeta before the step given its prediction."""
        slopes, fresh = self._moves(step.before, step.u, step.k)
        moved, projection = (slopes, triangular(fresh)), self._projection()
        return smoother_step_of(step.before, step.prior, step.after, moved, self.claim, projection=projection)


def _propagate_moments(state: ModalBelief, move: jax.Array) -> jax.Array:
    """Carry the moments of each mode through the plant: A~ E_i A~' (M, n + 1, n + 1)."""
    carried: jax.Array = jax.vmap(lambda a: move @ a @ move.T)(state.moments)
    return carried


def noise_in_mode(plant: LinearPlant, u: ArrayLike, start: jax.Array) -> Columns:
    """Covariance of the process noise of x~, with the rounding of the state and of the mode's indicator."""
    own = process_noise(plant, jnp.asarray(u), start)
    one = rounding_of(np.ones(1))
    return Columns(jax.scipy.linalg.block_diag(own.matrix, one.matrix), jnp.append(own.weights, one.weights))


def predict_by_mode(columns: jax.Array, move: jax.Array, rows: jax.Array) -> jax.Array:
    """Multiply columns (N, c) by F, F[j, i] = Pi[i, j] A~: move each part by the plant, then mix all by the chain."""
    parts = columns.reshape(len(rows), len(move), -1)
    moved = jax.vmap(lambda part: move @ part)(parts).reshape(len(rows), -1)
    return jnp.reshape(rows.T @ moved, columns.shape)


def spread_of_moves(carried: jax.Array, rows: jax.Array) -> Columns:
    """Covariance (N, N) of zeta+ by the random move of the mode, sum_i Cov(1{next} | i) x E_i, of E_i (M, s, s)."""
    return separate_modes(jnp.einsum("ijl,iab->jalb", covariance_of_mode(rows)[:, :-1, :-1], carried))


def covariance_of_mode(rows: jax.Array) -> jax.Array:
    """Cov(1{j}, 1{l} | i) = delta_jl Pi_ij - Pi_ij Pi_il, (M, M, M)."""
    return rows[:, :, None] * (np.eye(rows.shape[1]) - rows[:, None, :])


def separate_modes(among: jax.Array) -> Columns:
    """Columns (M s) of a covariance whose parts of size s sum to zero over the modes, from all modes but the last.

    Shapes: among (M - 1, s, M - 1, s).
    """
    others, size = among.shape[:2]
    factors = factor_spread(among.reshape(others * size, others * size))
    return factors.through(np.concatenate([np.eye(others * size), -np.tile(np.eye(size), (1, others))]))


def known_noise(channel: ObservationModel, sent: Columns, law: jax.Array) -> Columns:
    """Columns (m, M columns) of sum_j P(j) (Hbar_j Cov(v) Hbar_j' + Cov n_j), which no signal scales."""
    gains = jnp.asarray(channel.mean)[:, :, :-1]
    through = Columns(gains @ sent.matrix, jnp.broadcast_to(sent.weights, (len(law), len(sent.weights))))
    return join_columns(side_by_side(through, law), side_by_side(channel.noise, law))


def rounding_of_received(gains: jax.Array, sent: jax.Array) -> Columns:
    """Return the rounding (m, m) of z, of gains (M, m, p + 1), from E[y~ y~' 1{mode}] (M, p + 1, p + 1)."""
    return rounding_of(jnp.einsum("jma,jab,jmb->m", gains, sent, gains))


def kron(a: jax.Array, b: jax.Array) -> jax.Array:
    """Return A x B, by a matrix product, which keeps known zeros."""
    a, b = jnp.asarray(a), jnp.asarray(b)
    products = outer(a.reshape(-1), b.reshape(-1)).reshape(*a.shape, *b.shape)
    return products.swapaxes(1, 2).reshape(len(a) * len(b), -1)


def sum_of_modes(n: int, modes: int) -> Float[np.ndarray, "n N"]:
    """Matrix (n, N) that maps zeta to x = sum_j zeta^j."""
    return np.tile(np.eye(n, n + 1), (1, modes))


def observe_modes(x: Gaussian, centred: jax.Array, output: Output, z: ArrayLike) -> tuple[Gaussian, Innovation]:
    """Condition zeta on the components of z that arrived; `centred` is its mean less P(mode) c."""
    expected = output.common + output.matrix @ centred
    return condition(x, output.matrix @ x.root, output.noise, jnp.asarray(z), expected)


def move_matrix(plant: LinearPlant, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A~ = [[A, B u + E w], [0, 1]] and Q~ = diag(Q, 0)."""
    move = pad(plant.transition_matrix(u)).at[:-1, -1].set(plant.shift(u)).at[-1, -1].set(1.0)
    return move, pad(plant.noise_covariance(u))


def measure_matrix(sensor: LinearSensor) -> tuple[jax.Array, jax.Array]:
    """C~ = [[C, E v], [0, 1]] and R~ = diag(R, 0)."""
    measure = pad(jnp.asarray(sensor.matrix)).at[:-1, -1].set(sensor.noise.mean).at[-1, -1].set(1.0)
    return measure, pad(jnp.asarray(sensor.noise.covariance))


def prior_of_modes(start: LinearPlant, law: Array) -> tuple[Gaussian, jax.Array]:
    """Law of zeta at the start, and E[x~ x~'].

    Cov(zeta) = diag(p) x P_0~ + (diag(p) - p p') x e e' with e = E[x~] = (0, 1): x and the mode are independent.
    """
    spread, law = pad(jnp.asarray(start.initial_covariance)), jnp.asarray(law)
    state = given(start.initial_mean, start.initial_covariance)
    mode = separate_modes((jnp.diag(law) - jnp.outer(law, law))[:-1, None, :-1, None])
    # Factors of both, x before the indicator in each part.
    last = np.zeros((len(spread), len(spread)))
    last[-1, -1] = 1.0
    ends = jnp.pad(mode.matrix, ((0, 0), (0, 1))).at[-1, -1].set(1.0)
    root = jnp.kron(np.eye(len(law)), pad(state.root)) + jnp.kron(ends, last)
    variances = jnp.concatenate([jnp.outer(law, state.variances), jnp.append(mode.weights, 0.0)[:, None]], axis=1)
    prior = Gaussian(jnp.kron(law, jnp.append(state.mean, 1.0)), below_diagonal(root), variances.reshape(-1))
    return prior, spread + last


def known_part(law: jax.Array, centre: jax.Array) -> jax.Array:
    """P(mode) c, mode after mode."""
    return jnp.kron(law, jnp.append(centre, 0.0))


def predict_about(plant: LinearPlant, u: ArrayLike, centre: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A~ and Q~ of x - c, which no known input moves, and c one step later."""
    move, noise = move_matrix(plant, jnp.asarray(u))
    return move.at[:-1, -1].set(0.0), noise, move[:-1] @ jnp.append(centre, 1.0)


def measure_about(sensor: LinearSensor, centre: jax.Array) -> tuple[jax.Array, jax.Array]:
    """C~ and R~ of the centred state: y = C (x - c) + C c + E v."""
    measure, noise = measure_matrix(sensor)
    return measure.at[:-1, -1].add(measure[:-1, :-1] @ centre), noise


def without_common(output: jax.Array, law: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Subtract the mean output over the modes, which says nothing of the mode as the indicators sum to 1; return both.

    Shapes: output (M, m, n + 1), law (M,) -> (M, m, n + 1), (m,).
    """
    common = law @ output[:, :, -1] / jnp.sum(law)
    return output.at[:, :, -1].add(-common), common


def place_beside(output: jax.Array) -> jax.Array:
    """Put output matrices (M, m, n + 1) side by side as one matrix (m, N) that acts on zeta."""
    return jnp.concatenate(list(output), axis=1)


def pad(a: jax.Array) -> jax.Array:
    """Pad A by a row and a column of zeros: [[A, 0], [0, 0]]."""
    return jnp.pad(a, ((0, 1), (0, 1)))


M = TypeVar("M", bound=AbstractJointModalFilter)


def modal_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> ModalFilter:
    """Best linear filter behind links with memory; `linear_filter` has checked that the parts fit."""
    return built_of_modes(ModalFilter, plant, sensor, channel, claim_of_modes(channel))


def built_of_modes(kind: type[M], plant: AnyPlant, sensor: AnySensor, channel: Channel, claim: Claim) -> M:
    """Build a filter of this kind with the channel's observation models."""
    start, (initial, described) = first(plant), observation_models(channel)
    return kind(
        plant=plant,
        sensor=sensor,
        channel=described,
        initial=initial,
        **make_sizes(claim, start, first(channel).outputs),
    )


def observation_models(channel: Channel) -> tuple[Float[Array, " M"], ObservationModel | OverTime]:
    """Law of the modes at the first step, and the observation model of each; links without memory have one mode."""
    if not isinstance(channel, OverTime):
        modes = joint_modes(channel)
        return modes.initial, observation_model(modes, modes)
    steps = [joint_modes(c) for c in unstack(channel)]
    models = [observation_model(step, before) for step, before in zip(steps, [steps[0], *steps[:-1]], strict=True)]
    return steps[0].initial, over_time(models)


def observation_model(now: JointModes, before: JointModes) -> ObservationModel:
    """Moments of the channel by mode at one step, and the transition from the step before."""
    mean = stack_parts([m.moments(1).mean[:-1] for m in now.maps])
    gains, noises = zip(*(divide_spread(nominal_spread(m).center) for m in now.maps), strict=True)
    noise = Columns(*(stack_parts(part) for part in zip(*noises, strict=True)))
    return ObservationModel(before.transition, before.radius, mean, stack_parts(gains), noise)


def claim_of_modes(channel: Channel) -> Claim:
    """ "exact" if the law of every mode is known, "nominal" if some probability in it is uncertain."""
    return "exact" if all(m.corner_count() == 1 for c in unstack(channel) for m in joint_modes(c).maps) else "nominal"
