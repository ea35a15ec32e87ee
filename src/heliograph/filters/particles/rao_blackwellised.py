"""Rao-Blackwellised particle filter: some states and the modes are drawn, the others are a Gaussian given these.

A particle is a mode, and a Gaussian of x = (d, l), drawn states first. Over a step, and before z is known, it is one
Gaussian of each mode that may follow; with z one mode is drawn, then d, and l keeps its law given both.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, join_columns
from heliograph.factors.factored_gaussian import Gaussian, from_columns, from_covariance
from heliograph.filters.base import Step, corrects, estimates, predicts
from heliograph.filters.particles.base import (
    AbstractStateParticleFilter,
    Expectations,
    WeighedParticles,
    relative_to_largest,
    update_if_used,
)
from heliograph.filters.particles.expected_measurement_mixture import (
    ExpectedMixture,
    ReceivedSums,
    compute_mixture_innovation,
    find_reference_innovation,
    sum_mixtures,
)
from heliograph.filters.particles.gaussian_particles import (
    Cloud,
    PartlyDrawn,
    repeat_for_modes,
    sum_clouds_for_covariance,
    sum_clouds_for_mean,
)
from heliograph.filters.particles.leading_state_draws import (
    condition_on_draw,
    condition_on_leading_states,
    draw_index,
    find_states_without_variance,
    slopes_given_drawn,
)
from heliograph.filters.particles.moments import StateSums
from heliograph.filters.particles.proposal import factor_noise_covariance, share_drawn_from_prior
from heliograph.filters.particles.received_density import ReceivedByMode, condition_on_received, find_received_by_mode
from heliograph.filters.particles.resampling import draw_normals, draw_uniforms, fold_in_bits
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import at, first
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.types import Array, Float


class PartlyDrawnFilter(AbstractStateParticleFilter):
    """Particles draw modes and named states, the other states are Gaussian given these. Built by `particle_filter`."""

    initial: Float[Array, " M"]
    transition: Float[Array, "M M"]
    plant_modes: tuple[int, ...] = eqx.field(static=True)
    sensor_modes: tuple[int, ...] = eqx.field(static=True)
    order: tuple[int, ...] = eqx.field(static=True)  # indices of the plant's states, drawn ones first
    drawn: int = eqx.field(static=True)  # how many are drawn

    @property
    def uses_empty_rows(self) -> bool:
        """Return whether a row in which nothing arrived says something, of the modes."""
        return len(self.initial) > 1

    @compile_on_call
    def init(self) -> PartlyDrawn:
        """Return particles with the law of x_0; some states are drawn now, unless all plants are linear."""
        key, start_key = self.start_keys()
        particles = self.draw_start(start_key, jnp.arange(self.particles))
        return self.make_state(particles, jnp.zeros(self.particles), key)._replace(moved=jnp.asarray(False))

    def allocate_particles(self, count: int) -> Any:
        """Return arrays for `count` particles, to be filled: in each mode a mean, factors and a log probability."""
        modes, n = len(self.initial), len(self.order)
        arrays: Any = [np.zeros((count, modes, *shape)) for shape in ((n,), (n * (n - 1) // 2,), (n,), ())]
        mean, lower, variances, log_mode = arrays
        return Cloud(Gaussian(mean, lower, variances), log_mode)

    def get_particles(self, state: PartlyDrawn) -> Cloud:
        """Return the Gaussian of each particle in each mode, and log probabilities of the modes."""
        return Cloud(state.gaussian, state.log_mode)

    def make_state(self, particles: Cloud, log_weight: jax.Array, key: jax.Array) -> PartlyDrawn:
        """Return the filter's state of particles with these log weights (N,), after a first move."""
        return PartlyDrawn(particles.gaussian, particles.log_mode, log_weight, key, jnp.asarray(True))

    def draw_start(self, key: jax.Array, numbers: jax.Array) -> Cloud:
        """Return the particles with these indices (B,): the Gaussian of x_0 in each mode, and the modes' log law.

        The states that are drawn come first. They are drawn here unless all plants are linear.
        """
        plants, count, order = list_mode_models(at(self.plant, k=0)), len(numbers), np.array(self.order)
        prior = from_covariance(plants[0].initial_mean[order], plants[0].initial_covariance[order][:, order])
        x = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], count, axis=0), prior)
        if not self._is_linear(plants):
            x = self._draw_states(x, key, numbers)
        log_mode = jnp.tile(jnp.log(jnp.asarray(self.initial)), (count, 1))
        return Cloud(repeat_for_modes(x, len(self.initial)), log_mode)

    @predicts
    def predict(self, state: PartlyDrawn, u: Any = (), k: Step = 0) -> PartlyDrawn:
        """Resample if the effective number is too small, then move each particle over the step.

        Its mode and the states named in `drawn=` are drawn; the other states stay a Gaussian given these, which the
        plant of each mode that may follow moves by its mean and covariance.
        """
        key, choice_key, draw_keys = self.keys_of_prediction(state.key)
        chosen, log_weight = self.choose_particles(state.log_weight, choice_key)
        particles = jax.tree.map(lambda leaf: leaf[chosen], self.get_particles(state))
        predicted, _ = self.move_particles(particles, None, draw_keys, jnp.asarray(u), k, state.moved)  # None: all
        return self.make_state(predicted, log_weight, key)

    def keys_of_prediction(self, key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the key of the correction, that of the resampling, and those of drawn states and of modes (2, 2)."""
        keys = jax.random.split(jax.random.fold_in(key, 0), 4)
        return keys[0], keys[1], keys[2:]

    def move_particles(
        self, particles: Cloud, numbers: jax.Array | None, key: jax.Array, u: jax.Array, k: Step, moved: jax.Array
    ) -> tuple[Cloud, None]:
        """Draw the mode and some states of B particles before a step; return the Gaussian in each mode after it.

        Args:
            particles: for B particles the Gaussian of x in each of M modes, and the modes' log probabilities. If a
                correction drew mode and states already, these are certain, and the draws here change nothing.
            numbers: indices of the particles (B,), which select their random draws; None for all.
            key: two keys, of the states and of the modes.
            u: input of the plant.
            k: step.
            moved: False at the first step: modes keep their initial law, and x_0 stays Gaussian if plants are linear.
        """
        plants, (gaussian, log_mode) = list_mode_models(at(self.plant, k)), particles
        mode = draw_index(log_mode, draw_uniforms(key[1], numbers, 1, self.particles)[:, 0])
        in_mode: Gaussian = jax.tree.map(lambda leaf: leaf[jnp.arange(len(mode)), mode], gaussian)
        x = self._draw_states(in_mode, key[0], numbers)
        if self._is_linear(plants):
            x = jax.tree.map(lambda drawn, undrawn: jnp.where(moved, drawn, undrawn), x, in_mode)
        # Each particle moved by each plant (B, plants), then by the plant of each mode that may follow (B, M).
        by_plant = [jax.vmap(lambda x, plant=plant: self._move_particle(plant, x, u))(x) for plant in plants]
        predicted: Gaussian = jax.tree.map(
            lambda *leaves: jnp.stack(leaves, axis=1)[:, self.plant_modes, ...], *by_plant
        )
        next_law = jnp.where(moved, jnp.asarray(self.transition)[mode], jnp.asarray(self.initial))
        return Cloud(predicted, jnp.log(next_law)), None

    def _is_linear(self, plants: Sequence[AbstractPlant]) -> bool:
        """Return whether the plant is linear in the drawn states too, so that they need not be drawn to be moved."""
        return all(isinstance(plant, LinearPlant) and not plant.circular for plant in plants)

    def _draw_states(self, x: Gaussian, key: jax.Array, numbers: jax.Array | None) -> Gaussian:
        """Draw the leading `self.drawn` states of B Gaussians; return the Gaussians given them."""
        return jax.vmap(condition_on_draw)(x, draw_normals(key, numbers, self.drawn, self.particles))

    def _move_particle(self, plant: AbstractPlant, x: Gaussian, u: jax.Array) -> Gaussian:
        """Return the Gaussian of f(x) + w for a particle x; f is affine in the states that have a variance."""
        order = np.array(self.order)
        # A linear plant may have drawn states that still have a variance. With other plants they are known.
        noise, known_count = factor_noise_covariance(plant, u), 0 if self._is_linear([plant]) else self.drawn

        def move(x: jax.Array) -> jax.Array:
            """Return f(x), drawn states first in x and in the result."""
            return plant.transition(self._in_plants_order(x), u)[order]

        mean, slopes = slopes_given_drawn(move, x, known_count)
        propagated = WeightedColumns(slopes[:, known_count:], x.variances[known_count:])
        columns = join_columns(propagated, WeightedColumns(noise.matrix[order], noise.weights))
        return from_columns(mean + plant.noise_mean()[order], columns)

    def _in_plants_order(self, x: jax.Array) -> jax.Array:
        """Return x (..., n), which has the drawn states first, in the order of the plant's states."""
        return x[..., np.argsort(self.order)]

    @corrects
    def correct(self, state: PartlyDrawn, z: Any, k: Step = 0) -> tuple[PartlyDrawn, Innovation]:
        """Draw each particle's mode j and some of its states d with z, and condition its other states on z.

        They are drawn from a law q(j, d) near their posterior: the weight is multiplied by p(j, d, z) / q(j, d).
        """
        z = jnp.asarray(z)
        key, proposal_keys = self.keys_of_correction(state.key, z)
        weighed = self.weigh_particles(self.get_particles(state), law=None, numbers=None, key=proposal_keys, z=z, k=k)
        # p(z) = sum_i weight_i p(z | i)
        log_likelihood = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight) + weighed.log_likelihood)
        # A row without any number says something only of the modes. One that no particle explains is not used.
        log_weight = relative_to_largest(state.log_weight + weighed.log_likelihood)
        updated = self.make_state(weighed.particles, log_weight, key)._replace(moved=state.moved)
        is_used = (self.uses_empty_rows | ~jnp.all(jnp.isnan(z))) & (log_likelihood > -jnp.inf)
        corrected = update_if_used(is_used, updated, state._replace(key=key))
        return corrected, self.compute_innovation(state.weight, weighed.predicted, z, k, log_likelihood)

    def keys_of_correction(self, key: jax.Array, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the key of the next prediction, and those of drawn states and of uniform numbers (2, 2).

        They depend on z, so that other data get other draws.
        """
        key = fold_in_bits(key, z)
        return key, jax.random.split(jax.random.fold_in(key, 2))  # the prediction folds in 0

    def weigh_particles(
        self, particles: Cloud, law: None, numbers: jax.Array | None, key: jax.Array, z: jax.Array, k: Step
    ) -> WeighedParticles:
        """Draw mode j and states d of B particles from a law q that uses z, and weigh them by p(j, d, z) / q(j, d).

        `particles`: Gaussian in each mode and log probabilities of the modes. `law`: None, used by filters that draw
        all states. `numbers`: indices of the particles, None for all. `key`: of the states and of the uniform numbers.
        """
        sensors, (gaussian, log_mode) = list_mode_models(at(self.sensor, k)), particles
        atoms, chance = at(self.density, k).given_arrivals(z)
        received = find_received_by_mode(z, atoms)
        # Which components arrived says something of the mode: P(j, arrivals) = P(j) P(arrivals | j).
        log_mode = log_mode + jnp.log(chance)
        draws = draw_normals(key[0], numbers, self.drawn, self.particles)
        uniform = draw_uniforms(key[1], numbers, 3, self.particles)
        draw_and_weigh = jax.vmap(partial(self._draw_and_weigh, sensors, received))
        x, mode, log_ratio = draw_and_weigh(gaussian, log_mode, draws, uniform)
        plant, modes = list_mode_models(at(self.plant, k))[0], len(self.initial)
        x = x._replace(mean=wrap_angles(x.mean, self._angles_in_order(plant)))
        certain = jnp.where(jnp.arange(modes) == mode[:, None], 0.0, -jnp.inf)
        predicted = jax.vmap(partial(self._expect_received, sensors, received))(gaussian, log_mode)
        return WeighedParticles(Cloud(repeat_for_modes(x, modes), certain), log_ratio, tuple(predicted))

    def _angles_in_order(self, plant: AbstractPlant | None = None) -> Angles:
        """Return the indices of the angles in x, drawn states first: of this plant, or of the first mode's."""
        angles = (plant or list_mode_models(first(self.plant))[0]).angles
        return tuple(i for i, place in enumerate(self.order) if place in angles)

    def _measure(self, sensors: Sequence[AbstractSensor], mode: jax.Array, x: jax.Array) -> jax.Array:
        """Return h(x) by the sensor of this mode, for a state x that has the drawn states first."""
        position = self._in_plants_order(x)
        if len(sensors) == 1:
            return sensors[0].measure(position)
        by_sensor = jnp.stack([sensor.measure(position) for sensor in sensors])
        return by_sensor[jnp.array(self.sensor_modes)[mode]]

    def _draw_and_weigh(
        self,
        sensors: Sequence[AbstractSensor],
        received: ReceivedByMode,
        x: Gaussian,
        log_mode: jax.Array,
        draw: jax.Array,
        uniform: jax.Array,
    ) -> tuple[Gaussian, jax.Array, jax.Array]:
        """Draw a particle's mode j and states d from q; return its Gaussian given j, d, z, then j, log p(j, d, z) / q.

        p(j, d, z) = P(j) N(d) sum_a w_a N_a(z | d), over the Gaussians a (atoms) of the mixture of noises. q(j, d) is
        the posterior by the linearised sensor and one Gaussian noise, mixed with the prior.

        Args:
            sensors: the different sensors.
            received: what arrived, with gains and noises by mode and atom.
            x: Gaussian of the state in each mode, drawn states first.
            log_mode: log P(j, what arrived) of each mode.
            draw: standard normal numbers for d.
            uniform: three numbers, for prior or posterior, for the mode and for the atom of the noise.
        """
        # Posterior of each mode by the linearised sensor, and alpha_j = log P(j) N_j(z). If no mode can produce z there
        # is no posterior, and the draw is from the prior.
        share = share_drawn_from_prior(sensors, received.weight.shape[1], self.optimal)
        modes = jnp.arange(len(self.initial))
        posterior, alpha = jax.vmap(lambda j, x_j: self._linearised_posterior(sensors, received, j, x_j))(modes, x)
        alpha = jnp.where(jnp.isnan(alpha), -jnp.inf, alpha) + log_mode
        possible = jnp.max(alpha) > -jnp.inf
        log_posterior_mode = alpha - jnp.where(possible, jax.nn.logsumexp(alpha), 0.0)
        # Draw j, then d given j: from the prior with probability `share`, else from the posterior.
        from_prior = (uniform[0] < share) | ~possible
        mode = draw_index(jnp.where(from_prior, log_mode, alpha)[None], uniform[1:2])[0]
        prior, linearised = (jax.tree.map(lambda leaf: leaf[mode], law) for law in (x, posterior))
        source: Gaussian = jax.tree.map(lambda a, b: jnp.where(from_prior, a, b), prior, linearised)
        d = condition_on_draw(source, draw).mean[: self.drawn]
        # q = (1 - share) (linearised posterior of j and d) + share P(j | arrivals) N(d). States d that are known have
        # no density, and are left out of p and q.
        certain = find_states_without_variance(prior, d)
        x_given_d, log_prior_d = condition_on_leading_states(prior, d, certain)
        _, log_linearised_d = condition_on_leading_states(linearised, d, certain)
        log_linearised = log_posterior_mode[mode] + log_linearised_d
        log_p = log_mode[mode] + log_prior_d
        log_prior = log_p - jax.nn.logsumexp(log_mode)
        log_q = jnp.logaddexp(jnp.log1p(-share) + log_linearised, jnp.log(share) + log_prior)
        log_q = jnp.where(possible, log_q, log_prior)
        # log p(j, d, z) / q(j, d)
        corrected, log_density = self._condition_on_atoms(sensors, received, mode, x_given_d, uniform[2])
        return corrected, mode, log_density + log_p - log_q

    def _linearised_posterior(
        self, sensors: Sequence[AbstractSensor], received: ReceivedByMode, mode: jax.Array, x: Gaussian
    ) -> tuple[Gaussian, jax.Array]:
        """Return x given z = gain h(x) + n in this mode, and the log density of z.

        h is linearised at the mean of x. `overall` holds gain and noise of the one Gaussian that has the moments of the
        mode's mixture. So this law is near the posterior, and weights correct for the difference.
        """
        gain, offset, noise = jax.tree.map(lambda leaf: leaf[mode], received.overall)
        y, slopes = slopes_given_drawn(partial(self._measure, sensors, mode), x, drawn=0)
        return condition_on_received(x, gain @ slopes, gain @ y + offset, noise, received.z, self.observed_angles)

    def _condition_on_atoms(
        self,
        sensors: Sequence[AbstractSensor],
        received: ReceivedByMode,
        mode: jax.Array,
        x: Gaussian,
        uniform: jax.Array,
    ) -> tuple[Gaussian, jax.Array]:
        """Return x given z and one Gaussian of the noise's mixture, which is drawn, and the log density of z.

        `x`: Gaussian of a particle whose drawn states d are known, so that h is affine in the others. Given d, the law
        of z in this mode is sum_a weight_a N_a(z). Gaussian a is drawn with P(a | z), by a `uniform` number.
        """
        y, slopes = slopes_given_drawn(partial(self._measure, sensors, mode), x, self.drawn)

        def condition_on_atom(gain: jax.Array, offset: jax.Array, noise: WeightedColumns) -> tuple[Gaussian, jax.Array]:
            """Return x given z = gain h(x) + offset + noise, and log p(z); h(x) = y + slopes xi, x = m + L xi."""
            return condition_on_received(x, gain @ slopes, gain @ y + offset, noise, received.z, self.observed_angles)

        atoms = jax.tree.map(lambda leaf: leaf[mode], (received.gain, received.offset, received.noise))
        posteriors, log_density = jax.vmap(condition_on_atom)(*atoms)
        log_joint = jnp.where(jnp.isnan(log_density), -jnp.inf, log_density) + jnp.log(received.weight[mode])
        a = draw_index(log_joint[None], uniform[None])[0]
        return jax.tree.map(lambda leaf: leaf[a], posteriors), jax.nn.logsumexp(log_joint)

    def _expect_received(
        self, sensors: Sequence[AbstractSensor], received: ReceivedByMode, x: Gaussian, log_mode: jax.Array
    ) -> ExpectedMixture:
        """Return the Gaussians that a particle expects of z, one for each mode and atom, with y = h(x) linearised.

        `x`: Gaussian of the state in each mode; `log_mode`: log P(mode, which components arrived). Given h(x) and the
        mode, z is a mixture of Gaussians gain y + offset + noise (`received`, by mode); an atom is one of these.
        """

        def expect_in_mode(mode: jax.Array, x: Gaussian) -> tuple[jax.Array, jax.Array]:
            """Return for each atom the mean gain y + offset of z (atoms, m), and Cov z = gain Cov(y) gain' + noise."""
            y, slopes = slopes_given_drawn(partial(self._measure, sensors, mode), x, drawn=0)
            gain = received.gain[mode]
            signal_covariance = jax.vmap(lambda g: WeightedColumns(g @ slopes, x.variances).covariance)(gain)
            noise_columns = jax.tree.map(lambda leaf: leaf[mode], received.noise)
            noise_covariance = jax.vmap(lambda columns: columns.covariance)(noise_columns)
            return gain @ y + received.offset[mode], signal_covariance + noise_covariance

        expected, covariance = jax.vmap(expect_in_mode)(jnp.arange(len(self.initial)), x)
        m, share = len(received.z), jax.nn.softmax(log_mode)[:, None] * received.weight  # P(mode, atom | arrivals)
        return ExpectedMixture(
            share=share.ravel(),
            expected=expected.reshape(-1, m),
            covariance=covariance.reshape(-1, m, m),
            chance=jnp.sum(jnp.exp(log_mode)),  # P(arrivals)
        )

    def sum_received(
        self, reference: Expectations, weight: jax.Array, predicted: Expectations, z: jax.Array, k: Step
    ) -> ReceivedSums:
        """Return weighted sums, over B particles and the Gaussians that each expects of z, of the innovations of z.

        `reference` and `predicted` are the fields of an `ExpectedMixture`: of one particle, and of all. The innovation
        of the reference is subtracted from all, so that a z far from 0 costs no digits, and added back to the mean.
        """
        base = find_reference_innovation(ExpectedMixture(*reference), z, self.observed_angles)
        return sum_mixtures(base, weight, ExpectedMixture(*predicted), z, self.observed_angles)

    def innovation_from_sums(
        self, received: ReceivedSums, reference: Expectations, z: jax.Array, k: Step, density: jax.Array
    ) -> Innovation:
        """Return z - E z and Cov z over the mixtures that all particles expect of z, and the log-likelihood of z.

        `received`: sums of innovations less that of the `reference` particle. `density`: log p(z, what arrived).
        """
        base = find_reference_innovation(ExpectedMixture(*reference), z, self.observed_angles)
        return compute_mixture_innovation(received, base, z, density)

    def sum_for_mean(self, weight: jax.Array, particles: Cloud) -> StateSums:
        """Return sums over particles (B,) of weights and of weights times states, drawn states first."""
        return sum_clouds_for_mean(weight, particles, self._angles_in_order())

    def sum_for_covariance(self, weight: jax.Array, particles: Cloud, sums: StateSums) -> jax.Array:
        """Return sums of w (d d' + P) (n, n) over B particles and modes, with d the mean's difference from all's."""
        return sum_clouds_for_covariance(weight, particles, sums, self._angles_in_order())

    def estimate_from_sums(self, sums: StateSums, second: jax.Array) -> Estimate:
        """Return mean and covariance over particles and modes; the mean of an angle is the mean direction."""
        plants_order, weight = np.argsort(self.order), sums.first.weight  # sums have the drawn states first
        mean = sums.first.mean(self._angles_in_order())
        modes = None if sums.modes is None else jnp.asarray(sums.modes) / weight
        return Estimate(mean[plants_order], (second / weight)[plants_order][:, plants_order], self.claim, modes)

    @estimates
    def estimate(self, state: PartlyDrawn) -> Estimate:
        """Return mean and covariance over particles and modes; of an angle the mean direction, and moments about it."""
        return self.compute_estimate(state)
