"""Particle filter of the state: weighted points for any plant, and any sensor and link whose noise has a density."""

from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import Columns, columns_of, join_columns, square_root, triangularise
from heliograph.filters.base import Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.innovation import innovation_of_means
from heliograph.filters.particles.base import AbstractStateParticleFilter, keep_unused, relative_to_largest
from heliograph.filters.particles.proposal import Moved, noise_columns, propose
from heliograph.filters.particles.received_density import Atoms, find_received_density
from heliograph.filters.particles.resampling import draw_normals, effective_number, fold_in_bits
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import at, first, list_steps, restack, steps_covered, unstack
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.angle import nearest, wrap_angles
from heliograph.numerics.check import check_count, fail, instance, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, Bool, Float, Int
from heliograph.random_affine.noise import AbstractNoise, Gaussian

Proposal = Literal["optimal", "prior"]
PROPOSALS: tuple[Proposal, ...] = ("optimal", "prior")
MANY = 1000


class StateParticles(NamedTuple):
    """Positions of N particles, their log weights, and the key of the next random numbers.

    `law` is that of the last move, of which a proposal that knows z makes other positions; None where there is no such
    proposal. `moved` is true from the first prediction on.

    Shapes: position (N, n), log_weight (N,), the largest 0, key (2,).
    """

    position: Float[jax.Array, "N n"]
    log_weight: Float[jax.Array, " N"]
    law: Moved | None
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


class StateParticleFilter(AbstractStateParticleFilter):
    """Weighted particles of the whole state, which are drawn from the prior or with z. Built by `particle_filter`."""

    @in_float64
    def init(self) -> StateParticles:
        """Draw the particles from the law of x_0."""
        plant, n = at(self.plant, 0), self.particles
        key, key_of_start = jax.random.split(jax.random.PRNGKey(self.seed))
        x = jax.vmap(plant.sample_initial)(jax.random.split(key_of_start, n))
        size = x.shape[1]
        law = Moved(x, jnp.zeros((size, size)), jnp.zeros((n, size))) if self.optimal else None
        return StateParticles(x, jnp.zeros(n), law, key, jnp.asarray(False))

    @predicts
    def predict(self, state: StateParticles, u: ArrayLike = (), k: Step = 0) -> StateParticles:
        """Resample where the effective number is too small, then move each particle with a noise of its own."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        key, key_of_choice, key_of_noise = jax.random.split(jax.random.fold_in(state.key, 0), 3)
        which, log_weight = self.resampled(state.log_weight, key_of_choice)
        center = jax.vmap(lambda x: plant.transition(x, u))(state.position[which])
        if isinstance(plant.noise, AbstractNoise) and not isinstance(plant.noise, Gaussian):
            keys = jax.random.split(key_of_noise, self.particles)
            noise = jax.vmap(lambda key: plant.sample_noise(key, u))(keys)
            position = wrap_angles(center + noise, plant.angles)
            return StateParticles(position, log_weight, None, key, jnp.asarray(True))
        draws = draw_normals(key_of_noise, center.shape)
        center, root = center + plant.noise_mean(), _root_of(noise_columns(plant, u))
        position = wrap_angles(center + draws @ root.T, plant.angles)
        law = self._find_law_of_move(plant, state, Moved(center, root, draws), u) if self.optimal else None
        return StateParticles(position, log_weight, law, key, jnp.asarray(True))

    def _find_law_of_move(self, plant: AbstractPlant, state: StateParticles, moved: Moved, u: jax.Array) -> Moved:
        """Return the law of x+ of each particle; at the first step of a linear plant that of x_0 and w together.

        So a first measurement that is far more precise than x_0 leaves more than few of the particles.
        """
        if not isinstance(plant, LinearPlant) or plant.deviation is not None or plant.circular:
            return moved
        start = at(self.plant, 0)
        start_moved = columns_of(start.initial_covariance).through(plant.transition_matrix(u))
        mean = plant.transition(jnp.asarray(start.initial_mean), u) + plant.noise_mean()
        center = jnp.where(state.moved, moved.center, mean)
        root = jnp.where(state.moved, moved.root, _root_of(join_columns(start_moved, noise_columns(plant, u))))
        return moved._replace(center=center, root=root)

    @corrects
    def correct(self, state: StateParticles, z: ArrayLike, k: Step = 0) -> tuple[StateParticles, Innovation]:
        """Weight each particle by the density of z, where the proposal is optimal after drawing it anew with z."""
        z, sensor = jnp.asarray(z), at(self.sensor, k)
        atoms = jax.tree.map(lambda leaf: leaf[0], at(self.density, k).given_arrivals(z)[0])
        key = fold_in_bits(state.key, z)
        predicted = received = jax.vmap(sensor.measure)(state.position)
        position, correction = state.position, jnp.zeros(self.particles)
        if state.law is not None:
            drawn = propose(state.law, sensor, atoms, z, self.observed_angles, jax.random.fold_in(key, 2))
            position, correction = wrap_angles(drawn.position, at(self.plant, k).angles), drawn.correction
            received = jax.vmap(sensor.measure)(position)
        likelihood = atoms.log_densities(received, z, self.observed_angles) + correction
        density = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight) + likelihood)
        # The positions are drawn: no law is left to draw them from.
        law = None if state.law is None else state.law._replace(center=position, root=jnp.zeros_like(state.law.root))
        log_weight = relative_to_largest(state.log_weight + likelihood)
        used = ~jnp.all(jnp.isnan(z)) & (density > -jnp.inf)
        before = state._replace(key=key)
        after = keep_unused(used, StateParticles(position, log_weight, law, key, state.moved), before)
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
        weight_of_both = (weight[:, None] * jnp.asarray(atoms.weight)).ravel()
        within = jnp.einsum("a,aij->ij", jnp.asarray(atoms.weight), jnp.asarray(atoms.noise))
        within = jnp.where(present[:, None] & present, within, jnp.nan)
        return innovation_of_means(weight_of_both, value, within, density)

    @estimates
    def estimate(self, state: StateParticles) -> Estimate:
        """Return the weighted mean and covariance; of an angle its mean direction, and second moments about it."""
        angles, weight, x = first(self.plant).angles, jnp.asarray(state.weight), jnp.asarray(state.position)
        mean = weight @ x
        for i in angles:
            mean = mean.at[i].set(jnp.arctan2(weight @ jnp.sin(x[:, i]), weight @ jnp.cos(x[:, i])))
        deviation = wrap_angles(x - mean, angles)
        return Estimate(mean, (deviation * weight[:, None]).T @ deviation, self.claim)


def _root_of(columns: Columns) -> jax.Array:
    """Return a square root (n, n) of a covariance given by its columns."""
    triangular = triangularise(columns)
    return jnp.asarray(triangular.matrix * square_root(triangular.weights))


def build_state_particles(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, particles: int, seed: int, proposal: str, resample: float
) -> StateParticleFilter:
    """Return the particle filter of the state, as `particle_filter` takes what it is made of."""
    start, first_sensor = instance("plant", first(plant), AbstractPlant, "a plant"), first(sensor)
    instance("sensor", first_sensor, AbstractSensor, "a sensor")
    first_sensor.refuse_inputs("particle_filter")
    check_link(first_sensor, first(channel), len(start.states), moments=False)
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
