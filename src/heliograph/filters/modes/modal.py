"""Best linear filter behind links with memory: it estimates the state jointly with the mode of the links.

With x~ = (x, 1) and modes theta, zeta^j = x~ 1{theta = j}. Its transition and its measurement are linear and their
noises white, E[zeta+ | past] = F zeta with F[j, i] = Pi[i, j] A~_j, and E[z | zeta, past] = sum_j Hbar_j C~ zeta^j, so
that a Kalman filter of zeta is the best linear filter of x = sum_j zeta^j. All moments are those of x~ = (x - c, 1),
c = E[x] before data: a mean far from zero, which the modes' indicators multiply, would leave no digits for the rest.
"""

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.codegen.engine import compiled
from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts, sized
from heliograph.filters.gaussian.belief import start_of
from heliograph.filters.gaussian.correction import absent, gain_and_covariance
from heliograph.filters.gaussian.precise import (
    above_rounding,
    noise_rounding,
    output_rounding,
    state_rounding,
)
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.linear.plan import plan
from heliograph.filters.smoother_step.base import AbstractSmootherStep, StepTrace
from heliograph.filters.smoother_step.building import linear_smoother_step
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, over_time, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.linalg import above_products, symmetrize
from heliograph.numerics.module import Module
from heliograph.numerics.traced import stacked
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, PyTree
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.second_moments import nominal_spread


class ObservationModel(Module):
    """A channel at one step, mode by mode: E[(G, n) | mode], E[((G, n) - mean) Y ((G, n) - mean)' | mode] as a tensor.

    transition: of the modes from the step before to this one; radius: bound on the error of each of its entries.

    Shapes: transition and radius (M, M), mean (M, m, p + 1), spread (M, m, m, p + 1, p + 1).
    """

    transition: Float[Array, "M M"]
    radius: Float[Array, "M M"]
    mean: Float[Array, "M m p1"]
    spread: Float[Array, "M m m p1 p1"]


class ModalBelief(NamedTuple):
    """Estimate of zeta, mode by mode, its error covariance, and E[x~ x~' 1{mode}] before any data.

    centre c = E[x] before data; P(mode) c is part of the mean, whose sum over the modes is that of x. `moved` is true
    from the first prediction on.

    Shapes: with N = M (n + 1): mean (N,), covariance (N, N), moments (M, n + 1, n + 1), centre (n,).
    """

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    moments: Float[jax.Array, "M n1 n1"]
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]


class AbstractModalFilter(AbstractSizedFilter):
    """Linear filter of the state jointly with the modes of links with memory: its state estimates zeta."""

    plant: AnyPlant
    sensor: AnySensor
    channel: ObservationModel | OverTime
    initial: Float[Array, " M"]

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """x = sum_j zeta^j."""
        projection = self._projection()
        return Estimate(projection @ state.mean, projection @ state.covariance @ projection.T, self.claim)

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains."""
        return plan(self, inputs, self._projection())

    def above_rounding(self, after: jax.Array, prior: jax.Array, law: jax.Array) -> jax.Array:
        """Cov(zeta) and, for the part of x in each mode, its share of what the mean cannot say."""
        return after + mean_rounding(at(self.plant, 0), law, after, prior)

    def rounding(self, gains: jax.Array, random: jax.Array, k: Step) -> jax.Array:
        """Variance (m,) that rounding gives to z by what y is off and, by a hundred eps, to its random gains' noise."""
        of_z = received_rounding(at(self.sensor, k), start_of(at(self.plant, 0)), gains)
        variance: jax.Array = of_z + 100 * float(np.finfo(random.dtype).eps) * jnp.diagonal(random)
        return variance

    def _projection(self) -> Float[np.ndarray, "n N"]:
        return sum_of_modes(len(self.states), len(self.initial))


class ModalFilter(AbstractModalFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind links with memory.

    The estimate of zeta includes the modes' probabilities; its covariance is singular, since the modes' indicators
    sum to 1, and is never inverted. Which components arrive must not depend on the modes. The innovation covariance
    is exact; the innovation is not Gaussian, so its Gaussian likelihood is nominal.

    Source: Costa, Linear minimum mean square error estimation for discrete-time Markovian jump linear systems (1994).
    """

    @compiled
    def init(self) -> ModalBelief:
        """Return the prior, independent of the mode."""
        law, (centre, covariance, second) = jnp.asarray(self.initial), prior_of_modes(at(self.plant, 0), self.initial)
        moments = law[:, None, None] * second
        return ModalBelief(jnp.kron(law, jnp.append(centre, 1.0)), covariance, moments, centre, jnp.asarray(False))

    @predicts
    def predict(self, state: ModalBelief, u: ArrayLike = (), k: Step = 0) -> ModalBelief:
        """Move x~ by the plant and the mode by the chain; at the first prediction the mode has its initial law.

        Cov(zeta+ - F zeta)[j, l] = sum_i (delta_jl Pi_ij - Pi_ij Pi_il) A~ E_i A~' + delta_jl P(j) Q~.
        """
        step, move, noise, centre, rows = self._moves(state, u, k)
        # E[x~ x~' 1{mode}] one step later, and F P F' + the covariance above.
        moments, fresh = _spread_of_moves(state.moments, move, noise, rows)
        covariance = symmetrize(above_products(step @ state.covariance @ step.T, step, state.covariance) + fresh)
        # F zeta about the moving centre.
        law = state.moments[:, -1, -1]
        mean = step @ (state.mean - known_part(law, state.centre)) + known_part(law @ rows, centre)
        return ModalBelief(mean, covariance, moments, centre, jnp.asarray(True))

    @corrects
    def correct(self, state: ModalBelief, z: ArrayLike, k: Step = 0) -> tuple[ModalBelief, Innovation]:
        """Correct with the components of z that arrived.

        Cov(z - E[z | zeta]) = sum_j T_j(C~ E_j C~' + P(j) R~) + P(j) Hbar_j R~ Hbar_j', T_j the spread of mode j.
        """
        observed, added, common, rounded = self._observe(state, k)
        law = state.moments[:, -1, -1]
        expected = common + observed @ (state.mean - known_part(law, state.centre))
        mean, covariance, innovation = linear_observation(
            state.mean, state.covariance, observed, added, expected, rounded, z
        )
        covariance = self.above_rounding(covariance, state.covariance, law)
        return state._replace(mean=mean, covariance=covariance), innovation

    def _moves(self, state: ModalBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, ...]:
        """Return F, the plant's A~ and Q~, the next centre c, and the transition matrix of the chain."""
        move, noise, centre = moved_about(at(self.plant, k), u, state.centre)
        rows = jnp.where(state.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(state.moments)))
        return jnp.kron(rows.T, move), move, noise, centre, rows

    def _observe(self, state: ModalBelief, k: Step) -> tuple[jax.Array, ...]:
        """Return the output matrix of zeta less the mean output, Cov(z - E[z | zeta]), mean output, rounding of z."""
        channel = at(self.channel, k)
        gains, (measure, noise) = jnp.asarray(channel.mean), measured_about(at(self.sensor, k), state.centre)
        law = state.moments[:, -1, -1]
        sent = jax.vmap(lambda a: above_products(measure @ a @ measure.T, measure, a))(state.moments)
        second = sent + law[:, None, None] * noise
        random = jnp.einsum("jmlab,jab->ml", jnp.asarray(channel.spread), second)
        added = random + jnp.einsum("j,jma,ab,jlb->ml", law, gains, noise, gains)
        observed, common = without_common(gains @ measure, law)
        return joined(observed), added, common, self.rounding(gains, random, k)

    def smoother_step(self, step: StepTrace) -> AbstractSmootherStep:
        """Return the linear update of zeta."""
        output = self._observe(step.prior, step.k)[0]
        transition, move, noise, _, rows = self._moves(step.before, step.u, step.k)
        process = _spread_of_moves(step.before.moments, move, noise, rows)[1]
        size = jnp.append(start_of(at(self.plant, 0)), 1.0)
        rounded = state_rounding(jnp.kron(step.prior.moments[:, -1, -1], size))
        return linear_smoother_step(step, (transition, process, output), rounded, self.claim, self._projection())


def _spread_of_moves(
    moments: jax.Array, move: jax.Array, noise: jax.Array, rows: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """E[x~ x~' 1{mode}] one step later (M, n + 1, n + 1), and Cov(zeta+ - F zeta) (N, N)."""
    modes, size = len(moments), len(move)
    carried = jax.vmap(lambda a: above_products(move @ a @ move.T, move, a))(moments)
    added = (moments[:, -1, -1] @ rows)[:, None, None] * noise
    chosen = rows[:, :, None] * (jnp.eye(modes) - rows[:, None, :])  # Cov(1{j}, 1{l} | mode i)
    fresh = jnp.einsum("ijl,iab->jalb", chosen, carried).reshape(modes * size, modes * size) + blocks(added)
    return jnp.einsum("ij,iab->jab", rows, carried) + added, fresh


def sum_of_modes(n: int, modes: int) -> Float[np.ndarray, "n N"]:
    """Matrix (n, N) that maps zeta to x = sum_j zeta^j."""
    return np.tile(np.eye(n, n + 1), (1, modes))


def linear_observation(
    mean: Float[jax.Array, " N"],
    covariance: Float[jax.Array, "N N"],
    received: Float[jax.Array, "m N"],
    added: Float[jax.Array, "m m"],
    expected: Float[jax.Array, " m"],
    rounded: Float[jax.Array, " m"],
    z: ArrayLike,
) -> tuple[jax.Array, jax.Array, Innovation]:
    """Posterior mean and covariance of zeta given the components of z that arrived.

    Cov(z | zeta) is `added`, and the variance that rounding gives to each component `rounded`.
    """
    z = jnp.asarray(z)
    present = ~jnp.isnan(z)
    both = present[:, None] & present
    # Innovation covariance S = H P H' + Cov(z | zeta), absent components of unit variance.
    cross = received @ covariance
    total = cross @ received.T + added
    gain, after = gain_and_covariance(
        covariance,
        jnp.where(present[:, None], cross, 0.0),
        jnp.where(both, total, 0.0) + absent(present),
        jnp.where(present[:, None], received, 0.0),
        jnp.where(both, added, 0.0) + absent(present),
        jnp.where(present, rounded, 0.0),
    )
    return mean + gain @ jnp.where(present, z - expected, 0.0), after, gaussian_innovation(z, expected, total)


def received_rounding(sensor: LinearSensor, size: jax.Array, gains: jax.Array) -> jax.Array:
    """Variance (m,) that rounding gives to z by what the outputs are off, behind the greatest of the modes' gains."""
    of_noise = noise_rounding(sensor.noise.mean, sensor.noise.covariance)
    of_outputs = output_rounding(sensor.matrix, size) + of_noise
    largest: jax.Array = jnp.max(jnp.abs(gains[..., :-1]) @ of_outputs, axis=0)
    return largest**2


def mean_rounding(
    start: LinearPlant, law: jax.Array, after: jax.Array, prior: jax.Array, precise: jax.Array | bool = False
) -> jax.Array:
    """Return what `above_rounding` adds to x = sum_j zeta^j, a part to each mode by its probability: (N, N)."""
    n, size = len(start.initial_mean), start_of(start)
    projection = sum_of_modes(n, len(law))
    left, whole = (projection @ covariance @ projection.T for covariance in (after, prior))
    return jnp.kron(jnp.diag(law), padded(above_rounding(left, whole, size, precise) - left))


def move_matrix(plant: LinearPlant, u: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A~ = [[A, B u + E w], [0, 1]] and Q~ = diag(Q, 0)."""
    move = padded(plant.transition_matrix(u)).at[:-1, -1].set(plant.shift(u)).at[-1, -1].set(1.0)
    return move, padded(plant.noise_covariance(u))


def measure_matrix(sensor: LinearSensor) -> tuple[jax.Array, jax.Array]:
    """C~ = [[C, E v], [0, 1]] and R~ = diag(R, 0)."""
    measure = padded(jnp.asarray(sensor.matrix)).at[:-1, -1].set(sensor.noise.mean).at[-1, -1].set(1.0)
    return measure, padded(jnp.asarray(sensor.noise.covariance))


def prior_of_modes(start: LinearPlant, law: Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """c, Cov(zeta) = diag(p) x P_0~ + (diag(p) - p p') x e e' with e = E[x~] = (0, 1), and E[x~ x~'], at the start."""
    spread, law = padded(jnp.asarray(start.initial_covariance)), jnp.asarray(law)
    square = jnp.zeros_like(spread).at[-1, -1].set(1.0)
    covariance = jnp.kron(jnp.diag(law), spread) + jnp.kron(jnp.diag(law) - jnp.outer(law, law), square)
    return jnp.asarray(start.initial_mean), covariance, spread + square


def known_part(law: jax.Array, centre: jax.Array) -> jax.Array:
    """P(mode) c, mode after mode."""
    return jnp.kron(law, jnp.append(centre, 0.0))


def moved_about(plant: LinearPlant, u: ArrayLike, centre: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """A~ and Q~ of x - c, which no known input moves, and c one step later."""
    move, noise = move_matrix(plant, jnp.asarray(u))
    return move.at[:-1, -1].set(0.0), noise, move[:-1] @ jnp.append(centre, 1.0)


def measured_about(sensor: LinearSensor, centre: jax.Array) -> tuple[jax.Array, jax.Array]:
    """C~ and R~ of the centred state: y = C (x - c) + C c + E v."""
    measure, noise = measure_matrix(sensor)
    return measure.at[:-1, -1].add(measure[:-1, :-1] @ centre), noise


def without_common(output: jax.Array, law: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Subtract the mean output over the modes, which says nothing of the mode as the indicators sum to 1; return both.

    Shapes: output (M, m, n + 1), law (M,) -> (M, m, n + 1), (m,).
    """
    common = law @ output[:, :, -1] / jnp.sum(law)
    return output.at[:, :, -1].add(-common), common


def joined(output: jax.Array) -> jax.Array:
    """Output matrices (M, m, n + 1) as one matrix (m, N) that acts on zeta."""
    return jnp.concatenate(list(output), axis=1)


def padded(a: jax.Array) -> jax.Array:
    """[[A, 0], [0, 0]]."""
    return jnp.pad(a, ((0, 1), (0, 1)))


def blocks(parts: jax.Array) -> jax.Array:
    """Matrices (M, s, s) as the diagonal blocks of (M s, M s)."""
    modes, size, _ = parts.shape
    placed = jnp.eye(modes)[:, None, :, None] * parts[:, :, None, :]
    return placed.reshape(modes * size, modes * size)


M = TypeVar("M", bound=AbstractModalFilter)


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
        **sized(claim, start, first(channel).outputs),
    )


def observation_models(channel: Channel) -> tuple[Float[Array, " M"], ObservationModel | OverTime]:
    """Law of the modes at the first step, and the observation model of each; links without memory have one mode."""
    if not isinstance(channel, OverTime):
        modes = joint_modes(channel)
        return modes.initial, observation_model(modes, modes)
    steps = [joint_modes(c) for c in unstack(channel)]
    items = [observation_model(step, before) for step, before in zip(steps, [steps[0], *steps[:-1]], strict=True)]
    return steps[0].initial, over_time(items)


def observation_model(now: JointModes, before: JointModes) -> ObservationModel:
    """Moments of the channel by mode at one step, and the transition from the step before."""
    mean = stacked([m.moments(1).mean[:-1] for m in now.maps])
    spread = stacked([nominal_spread(m).center for m in now.maps])
    return ObservationModel(before.transition, before.radius, mean, spread)


def claim_of_modes(channel: Channel) -> Claim:
    """ "exact" if the law of every mode is known, "nominal" if some probability in it is uncertain."""
    return "exact" if all(m.corner_count() == 1 for c in unstack(channel) for m in joint_modes(c).maps) else "nominal"
