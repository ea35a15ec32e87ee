"""Particle filter of the state: weighted points for any plant, and any sensor and link whose noise has a density."""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import Columns, columns_of, join_columns, square_root, triangularise
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.innovation import mixed_innovation
from heliograph.filters.particles.proposal import Moved, noise_columns, propose
from heliograph.filters.particles.received_density import Atoms, ReceivedDensity, find_received_density
from heliograph.filters.particles.resampling import effective_number, fold_in_bits, resample_systematically
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, list_steps, restack, steps_covered, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angle import Angles, nearest, wrap_angles
from heliograph.numerics.check import check_count, fail, instance, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int
from heliograph.random_affine.noise import AbstractNoise, Gaussian

Proposal = Literal["optimal", "prior"]
PROPOSALS: tuple[Proposal, ...] = ("optimal", "prior")
MANY = 1000


class StateParticles(NamedTuple):
    """Positions of N particles, their log weights, and the key of the next random numbers.

    `center` and `root` are those of the last move, x+ = center + root e: a proposal that knows z draws e anew. `moved`
    is true from the first prediction on.

    Shapes: position, center (N, n), log_weight (N,), the largest 0, root (n, n), key (2,).
    """

    position: Float[jax.Array, "N n"]
    log_weight: Float[jax.Array, " N"]
    center: Float[jax.Array, "N n"]
    root: Float[jax.Array, "n n"]
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    @in_float64
    def weight(self) -> jax.Array:
        """Weights (N,) of the particles, which sum to 1."""
        return jax.nn.softmax(self.log_weight)

    @property
    @in_float64
    def effective_number(self) -> jax.Array:
        """1 / sum of the squared weights: how many particles of equal weight would say as much."""
        return effective_number(self.weight)


class StateParticleFilter(AbstractSizedFilter):
    """Weighted particles of the whole state, resampled at the start of a step. Built by `particle_filter`.

    Its random numbers come from the seed and from the data, so that runs draw independently and the same data give the
    same estimate. A measurement that no particle can produce is not used: its log-likelihood is -inf, the state stays.
    """

    plant: AnyPlant
    sensor: AnySensor
    density: ReceivedDensity | OverTime
    resample: Array
    observed_angles: Angles = eqx.field(static=True)
    particles: int = eqx.field(static=True)
    optimal: bool = eqx.field(static=True)
    seed: Int[Array, ""]  # a number, so that filters of all seeds are one program

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @property
    def of_atoms(self) -> bool:
        """True: a value of likelihood 0 under every particle is excluded by its model."""
        return True

    @in_float64
    def init(self) -> StateParticles:
        """Draw the particles from the law of x_0."""
        plant, n = at(self.plant, 0), self.particles
        key, own = jax.random.split(jax.random.PRNGKey(self.seed))
        x = jax.vmap(plant.sample_initial)(jax.random.split(own, n))
        return StateParticles(x, jnp.zeros(n), x, jnp.zeros((x.shape[1],) * 2), key, jnp.asarray(False))

    @predicts
    def predict(self, state: StateParticles, u: ArrayLike = (), k: Step = 0) -> StateParticles:
        """Resample where the effective number is too small, then move each particle with a noise of its own."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        key, choice, own = jax.random.split(jax.random.fold_in(state.key, 0), 3)
        weight = state.weight
        poor = effective_number(weight) < jnp.asarray(self.resample) * self.particles
        chosen = resample_systematically(weight, jax.random.uniform(choice, (), weight.dtype))
        x = state.position[jnp.where(poor, chosen, jnp.arange(self.particles))]
        log_weight = jnp.where(poor, 0.0, state.log_weight)
        center = jax.vmap(lambda one: plant.transition(one, u))(x)
        noise = _draw_noise(plant, own, u, self.particles)
        law = self._moved(plant, state, center, u) if self.optimal else Moved(center, state.root)
        position = wrap_angles(center + noise, plant.angles)
        return StateParticles(position, log_weight, *law, key, jnp.asarray(True))

    def _moved(self, plant: AbstractPlant, state: StateParticles, center: jax.Array, u: jax.Array) -> Moved:
        """Return the law of x+ of each particle; at the first step of a linear plant that of x_0 and w together.

        So a first measurement that is far more precise than x_0 leaves more than few of the particles.
        """
        own = noise_columns(plant, u)
        root, center = _root_of(own), center + plant.noise_mean()
        if not isinstance(plant, LinearPlant) or plant.deviation is not None or plant.circular:
            return Moved(center, root)
        start = at(self.plant, 0)
        both = join_columns(columns_of(start.initial_covariance).through(plant.transition_matrix(u)), own)
        mean = plant.transition(jnp.asarray(start.initial_mean), u) + plant.noise_mean()
        return Moved(jnp.where(state.moved, center, mean), jnp.where(state.moved, root, _root_of(both)))

    @corrects
    def correct(self, state: StateParticles, z: ArrayLike, k: Step = 0) -> tuple[StateParticles, Innovation]:
        """Weight each particle by the density of z, where the proposal is optimal after drawing it anew with z."""
        z, sensor = jnp.asarray(z), at(self.sensor, k)
        atoms = jax.tree.map(lambda leaf: leaf[0], at(self.density, k).given_arrivals(z)[0])
        key = fold_in_bits(state.key, z)
        predicted = jax.vmap(sensor.measure)(state.position)
        position, correction = state.position, jnp.zeros(self.particles)
        if self.optimal:
            angles = self.observed_angles
            drawn = propose(Moved(state.center, state.root), sensor, atoms, z, angles, jax.random.fold_in(key, 2))
            position, correction = wrap_angles(drawn.position, at(self.plant, k).angles), drawn.correction
        received = predicted if not self.optimal else jax.vmap(sensor.measure)(position)
        likelihood = jax.vmap(lambda y: atoms.log_density(y, z, self.observed_angles))(received) + correction
        density = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight) + likelihood)
        updated = _weighted(state, position, state.log_weight + likelihood, key)
        used = ~jnp.all(jnp.isnan(z)) & (density > -jnp.inf)
        after = jax.tree.map(lambda new, old: jnp.where(used, new, old), updated, state._replace(key=key))
        return after, self._innovation(state.weight, atoms, predicted, z, density)

    def _innovation(
        self, weight: jax.Array, atoms: Atoms, predicted: jax.Array, z: jax.Array, density: jax.Array
    ) -> Innovation:
        """Return z less its mean over particles and atoms, the covariance of these, and the log-likelihood.

        Over those particles where h(x) is a number.
        """
        valid = jnp.all(jnp.isfinite(predicted), axis=1)
        predicted = jnp.where(valid[:, None], predicted, 0.0)
        share = jnp.sum(jnp.where(valid, weight, 0.0))
        weight = jnp.where(share > 0, jnp.where(valid, weight, 0.0) / jnp.where(share > 0, share, 1.0), weight)
        expected, present = jax.vmap(atoms.expected)(predicted), ~jnp.isnan(z)
        value = nearest(z - expected, jnp.zeros(len(z)), self.observed_angles).reshape(-1, len(z))
        value = nearest(value, value[jnp.argmax(weight)], self.observed_angles)
        both = (weight[:, None] * jnp.asarray(atoms.weight)).ravel()
        noise = jnp.where(present[:, None] & present, jnp.asarray(atoms.noise), jnp.nan)
        total = jnp.broadcast_to(noise, (self.particles, *noise.shape)).reshape(-1, *noise.shape[1:])
        return mixed_innovation(both, value, total, density)

    @estimates
    def estimate(self, state: StateParticles) -> Estimate:
        """Return the weighted mean and covariance; of an angle its mean direction, and second moments about it."""
        angles, weight, x = first(self.plant).angles, jnp.asarray(state.weight), jnp.asarray(state.position)
        mean = weight @ x
        for i in angles:
            mean = mean.at[i].set(jnp.arctan2(weight @ jnp.sin(x[:, i]), weight @ jnp.cos(x[:, i])))
        apart = wrap_angles(x - mean, angles)
        return Estimate(mean, (apart * weight[:, None]).T @ apart, self.claim)


def _weighted(state: StateParticles, position: jax.Array, log_weight: jax.Array, key: jax.Array) -> StateParticles:
    """Return the particles with new positions and log weights, of which the largest is 0; nothing left to draw."""
    largest = jnp.max(log_weight)
    relative = log_weight - jnp.where(jnp.isfinite(largest), largest, 0.0)
    return StateParticles(position, relative, position, jnp.zeros_like(state.root), key, state.moved)


def _draw_noise(plant: AbstractPlant, key: jax.Array, u: jax.Array, count: int) -> jax.Array:
    """Draw w for each of so many particles, (count, n); Gaussian noise in one piece."""
    if not isinstance(plant.noise, Gaussian):
        return jax.vmap(lambda own: plant.sample_noise(own, u))(jax.random.split(key, count))
    draws = jax.random.normal(key, (count, len(plant.states)), dtype=float)
    return plant.noise_mean() + draws @ _root_of(noise_columns(plant, u)).T


def _root_of(columns: Columns) -> jax.Array:
    """Return a square root (n, n) of a covariance given by its columns."""
    triangular = triangularise(columns)
    return jnp.asarray(triangular.matrix * square_root(triangular.weights))


def build_state_particles(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, particles: int, seed: int, proposal: str, resample: float
) -> StateParticleFilter:
    """Return the particle filter of the state, as `particle_filter` takes what it is made of."""
    start, senses = instance("plant", first(plant), AbstractPlant, "a plant"), first(sensor)
    instance("sensor", senses, AbstractSensor, "a sensor")
    senses.refuse_inputs("particle_filter")
    check_link(senses, first(channel), len(start.states), moments=False)
    if proposal not in PROPOSALS:
        raise fail("proposal", "'optimal' or 'prior'", repr(proposal))
    if proposal == "optimal":
        for step in unstack(plant):
            _check_gaussian(step)
    steps = steps_covered((sensor, channel)) or 1
    by_step = zip(list_steps(sensor, steps), list_steps(channel, steps), strict=True)
    return StateParticleFilter(
        plant=plant,
        sensor=sensor,
        density=restack([find_received_density([s], [c]) for s, c in by_step], sensor, channel),
        resample=np.asarray(scalar("resample", resample, 0.0, 1.0)),
        observed_angles=find_received_angles(plant, sensor, channel),
        particles=check_count("particles", particles),
        optimal=proposal == "optimal",
        seed=np.asarray(check_count("seed", seed, 0)),
        **make_sizes("nominal", start, first(channel).outputs),
    )


def _check_gaussian(plant: AbstractPlant) -> None:
    """Raise ValueError unless the process noise is Gaussian."""
    if isinstance(plant.noise, AbstractNoise) and not isinstance(plant.noise, Gaussian):
        expected = "Gaussian process noise (proposal='prior' takes any)"
        raise fail("particle_filter with the optimal proposal", expected, type(plant.noise).__name__)
