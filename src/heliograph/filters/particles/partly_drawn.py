"""Particle filter of which some states are drawn, and a Gaussian of the others stands in each particle (Rao-Blackwell).

A particle is a mode, and a Gaussian of x = (d, l), drawn states first. Over a step, and before z is known, it is one
Gaussian of each mode that may follow; with z one mode is drawn, then d, and l keeps its law given both.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.columns import Columns, columns_of_each, join_columns
from heliograph.factors.gaussian import (
    Gaussian,
    condition_on_observation,
    from_columns,
    from_covariance,
    moments_of_mixture,
)
from heliograph.filters.base import Step, corrects, estimates, predicts
from heliograph.filters.innovation import mixed_innovation
from heliograph.filters.particles.base import AbstractStateParticleFilter, keep_unused, relative_to_largest
from heliograph.filters.particles.draws import (
    condition_on_draw,
    condition_on_leading,
    draw_index,
    find_certain,
    slopes_given,
)
from heliograph.filters.particles.proposal import PRIOR_SHARE, noise_columns
from heliograph.filters.particles.received_density import Atoms
from heliograph.filters.particles.resampling import draw_normals, effective_number, fold_in_bits
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.modes_of_motion import models_of
from heliograph.model.over_time import at, first
from heliograph.model.plant import AbstractPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.angle import Angles, nearest, wrap_angles
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, Bool, Float, Int


class PartlyDrawn(NamedTuple):
    """N particles: of each the Gaussian of x in every mode, drawn states first, with log probabilities of the modes.

    Where mode and drawn states are drawn, one mode has probability 1, and the drawn states have variance 0 in it.
    `moved` is true from the first prediction on.

    Shapes: the Gaussians (N, M, n), log_mode (N, M), log_weight (N,), the largest 0, key (2,).
    """

    gaussian: Gaussian
    log_mode: Float[jax.Array, "N M"]
    log_weight: Float[jax.Array, " N"]
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    @in_float64
    def weight(self) -> jax.Array:
        """Weights (N,), which sum to 1."""
        return jax.nn.softmax(self.log_weight)

    @property
    @in_float64
    def effective_number(self) -> jax.Array:
        """1 / sum of the squared weights: how many particles of equal weight would say as much."""
        return effective_number(self.weight)

    @property
    @in_float64
    def mode_weights(self) -> jax.Array:
        """Probabilities (N, M) of particle and mode."""
        return self.weight[:, None] * jax.nn.softmax(self.log_mode, axis=1)


class Received(NamedTuple):
    """What arrived: z (m,), and for each mode the atoms of its density given h(x), and these as one Gaussian.

    Shapes: weight (M, a), gain (M, a, m, p), offset (M, a, m), noise factors (M, a, m, m); `overall` without a.
    """

    z: jax.Array
    weight: jax.Array
    gain: jax.Array
    offset: jax.Array
    noise: Columns
    overall: tuple[jax.Array, jax.Array, Columns]


class PartlyDrawnFilter(AbstractStateParticleFilter):
    """Particles draw modes and named states, the other states are Gaussian given these. Built by `particle_filter`."""

    initial: Float[Array, " M"]
    transition: Float[Array, "M M"]
    plant_modes: tuple[int, ...] = eqx.field(static=True)
    sensor_modes: tuple[int, ...] = eqx.field(static=True)
    order: tuple[int, ...] = eqx.field(static=True)  # places of the states, drawn ones first
    drawn: int = eqx.field(static=True)  # how many are drawn

    @compile_on_call
    def init(self) -> PartlyDrawn:
        """Return the law of x_0 in every particle; its drawn states are drawn unless a linear plant moves them."""
        start, n, modes = models_of(at(self.plant, 0))[0], self.particles, len(self.initial)
        key, key_of_states = jax.random.split(jax.random.PRNGKey(self.seed))
        order = np.array(self.order)
        x = from_covariance(start.initial_mean[order], start.initial_covariance[order][:, order])
        x = jax.tree.map(lambda leaf: jnp.repeat(jnp.asarray(leaf)[None], n, axis=0), x)
        if not self._is_linear(models_of(at(self.plant, 0))):
            x = self._draw_states(x, key_of_states)
        log_mode = jnp.tile(jnp.log(jnp.asarray(self.initial)), (n, 1))
        return PartlyDrawn(_repeat_for_modes(x, modes), log_mode, jnp.zeros(n), key, jnp.asarray(False))

    @predicts
    def predict(self, state: PartlyDrawn, u: Any = (), k: Step = 0) -> PartlyDrawn:
        """Resample where the effective number is too small, then move each particle's Gaussian by every mode's law."""
        plants, u = models_of(at(self.plant, k)), jnp.asarray(u)
        key, key_of_choice, key_of_states, key_of_mode = jax.random.split(jax.random.fold_in(state.key, 0), 4)
        # What no measurement has drawn is drawn now; at the first step of a linear plant the start stays a Gaussian.
        mode = draw_index(state.log_mode, jax.random.uniform(key_of_mode, (self.particles,), dtype=float))
        in_mode: Gaussian = jax.tree.map(lambda leaf: leaf[jnp.arange(self.particles), mode], state.gaussian)
        x = self._draw_states(in_mode, key_of_states)
        if self._is_linear(plants):
            x = jax.tree.map(lambda new, old: jnp.where(state.moved, new, old), x, in_mode)
        which, log_weight = self.resampled(state.log_weight, key_of_choice)
        x, mode = jax.tree.map(lambda leaf: leaf[which], (x, mode))
        # The law after the step in each mode that may follow.
        by_model = [jax.vmap(lambda particle, plant=plant: self._move(plant, particle, u))(x) for plant in plants]
        moved: Gaussian = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1)[:, self.plant_modes, ...], *by_model)
        chance = jnp.where(state.moved, jnp.asarray(self.transition)[mode], jnp.asarray(self.initial))
        return PartlyDrawn(moved, jnp.log(chance), log_weight, key, jnp.asarray(True))

    def _is_linear(self, plants: Sequence[AbstractPlant]) -> bool:
        """Return whether the plant is linear in the drawn states too, so that they need not be drawn to be moved."""
        return all(isinstance(plant, LinearPlant) and not plant.circular for plant in plants)

    def _draw_states(self, x: Gaussian, key: jax.Array) -> Gaussian:
        """Return Gaussians (N, n) given their drawn states, which are drawn here."""
        draws = draw_normals(key, None, self.drawn, self.particles)
        return jax.vmap(condition_on_draw)(x, draws)

    def _move(self, plant: AbstractPlant, x: Gaussian, u: jax.Array) -> Gaussian:
        """Return the law of f(x) + w of one particle; f is affine in what of x has a variance."""
        order = np.array(self.order)
        # Of a linear plant the drawn states may have a variance still; of others they are known.
        noise, known = noise_columns(plant, u), 0 if self._is_linear([plant]) else self.drawn

        def move(x: jax.Array) -> jax.Array:
            """Return f(x), drawn states first in x and in the result."""
            return plant.transition(self._in_plants_order(x), u)[order]

        mean, slopes = slopes_given(move, x, known)
        spread = Columns(slopes[:, known:], x.variances[known:])
        return from_columns(
            mean + plant.noise_mean()[order], join_columns(spread, Columns(noise.matrix[order], noise.weights))
        )

    def _in_plants_order(self, x: jax.Array) -> jax.Array:
        """Return x (..., n) in the order of the plant's states."""
        return x[..., np.argsort(self.order)]

    @corrects
    def correct(self, state: PartlyDrawn, z: Any, k: Step = 0) -> tuple[PartlyDrawn, Innovation]:
        """Draw mode and drawn states with z, weight each particle by p(z) p / q, and condition the rest on z."""
        z, sensors, density = jnp.asarray(z), models_of(at(self.sensor, k)), at(self.density, k)
        atoms, chance = density.given_arrivals(z)
        received = self._describe_received(z, atoms)
        # That nothing or only a part arrived says something of the mode.
        log_mode = state.log_mode + jnp.log(chance)
        before = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight)[:, None] + log_mode)
        key = fold_in_bits(state.key, z)
        key_of_states, key_of_choice = jax.random.split(jax.random.fold_in(key, 2))
        draws = draw_normals(key_of_states, None, self.drawn, self.particles)
        uniform = jax.random.uniform(key_of_choice, (self.particles, 3), dtype=float)
        draw_and_weigh = jax.vmap(partial(self._draw_and_weigh, sensors, received))
        x, mode, log_ratio = draw_and_weigh(state.gaussian, log_mode, draws, uniform)
        log_weight = state.log_weight + log_ratio
        density_of_z = jax.nn.logsumexp(jax.nn.log_softmax(state.log_weight) + log_ratio) - before
        # All weights zero: the row is not used.
        plant = models_of(at(self.plant, k))[0]
        log_weight = relative_to_largest(log_weight)
        x = x._replace(mean=wrap_angles(x.mean, self._angles_in_order(plant)))
        modes = len(self.initial)
        certain = jnp.where(jnp.arange(modes) == mode[:, None], 0.0, -jnp.inf)
        updated = PartlyDrawn(_repeat_for_modes(x, modes), certain, log_weight, key, state.moved)
        used = (modes > 1) | ~jnp.all(jnp.isnan(z))
        used = used & (density_of_z > -jnp.inf)
        after = keep_unused(used, updated, state._replace(key=key))
        return after, self._innovation(sensors, received, state.gaussian, state.weight, log_mode, density_of_z)

    def _describe_received(self, z: jax.Array, atoms: Atoms) -> Received:
        """Return what arrived, with the atoms of each mode, and with one Gaussian in their place."""
        gain, offset, noise = jax.vmap(lambda of_mode: of_mode.moments())(atoms)
        return Received(
            z=z,
            weight=jnp.asarray(atoms.weight),
            gain=jnp.asarray(atoms.gain),
            offset=jnp.asarray(atoms.offset),
            noise=jax.vmap(columns_of_each)(jnp.asarray(atoms.noise)),
            overall=(gain, offset, columns_of_each(noise)),
        )

    def _angles_in_order(self, plant: AbstractPlant) -> Angles:
        """Return the places of the angles, drawn states first."""
        return tuple(i for i, place in enumerate(self.order) if place in plant.angles)

    def _measure(self, sensors: Sequence[AbstractSensor], mode: jax.Array, x: jax.Array) -> jax.Array:
        """Return h(x) of the mode's sensor, of x with the drawn states first."""
        position = self._in_plants_order(x)
        if len(sensors) == 1:
            return sensors[0].measure(position)
        return jnp.stack([sensor.measure(position) for sensor in sensors])[jnp.array(self.sensor_modes)[mode]]

    def _draw_and_weigh(
        self,
        sensors: Sequence[AbstractSensor],
        received: Received,
        x: Gaussian,
        log_mode: jax.Array,
        draw: jax.Array,
        uniform: jax.Array,
    ) -> tuple[Gaussian, jax.Array, jax.Array]:
        """Draw mode j and d of one particle from q, and condition it on z: its Gaussian, j, and log (p / q).

        p(j, d, z) is P(j) N(d) sum_a w_a N(z given d, atom a). q(j, d) is P(j) N(d) times N(z) of the linearised sensor
        and one Gaussian noise, in coordinates of the noise; where that is not p, a share of q is P(j) N(d) itself.

        Args:
            sensors: one of each mode of the sensor.
            received: what arrived, with gains and noises by mode and atom.
            x: Gaussian of the state in each mode, drawn states first.
            log_mode: log P(j) of each mode.
            draw: standard normal numbers for d.
            uniform: three numbers, for prior or posterior, for the mode and for the atom of the noise.
        """
        share = self._prior_share(sensors, received)
        modes = jnp.arange(len(self.initial))
        posterior, alpha = jax.vmap(lambda j, x_j: self._linearised_posterior(sensors, received, j, x_j))(modes, x)
        alpha = jnp.where(jnp.isnan(alpha), -jnp.inf, alpha) + log_mode
        possible = jnp.max(alpha) > -jnp.inf
        log_posterior_mode = alpha - jnp.where(possible, jax.nn.logsumexp(alpha), 0.0)
        from_prior = (uniform[0] < share) | ~possible
        mode = draw_index(jnp.where(from_prior, log_mode, alpha)[None], uniform[1:2])[0]
        prior, linearised = (jax.tree.map(lambda leaf: leaf[mode], law) for law in (x, posterior))
        source: Gaussian = jax.tree.map(lambda a, b: jnp.where(from_prior, a, b), prior, linearised)
        d = condition_on_draw(source, draw).mean[: self.drawn]
        # log p(j, d) - log q(j, d), with q = (1 - share) (linearised posterior of j and d) + share P(j) N(d).
        certain = find_certain(prior, d)
        rest, log_prior = condition_on_leading(prior, d, certain)
        log_linearised = log_posterior_mode[mode] + condition_on_leading(linearised, d, certain)[1]
        log_p = log_mode[mode] + log_prior
        log_total = log_p - jax.nn.logsumexp(log_mode)  # of the prior's share, which is a law
        log_q = jnp.logaddexp(jnp.log1p(-share) + log_linearised, jnp.log(share) + log_total)
        log_q = jnp.where(possible, log_q, log_total)
        after, log_density = self._condition_on_atoms(sensors, received, mode, rest, uniform[2])
        return after, mode, log_density + log_p - log_q

    def _prior_share(self, sensors: Sequence[AbstractSensor], received: Received) -> float:
        """Return the share of particles that are drawn without z."""
        if not self.optimal:
            return 1.0
        is_exact = all(isinstance(sensor, LinearSensor) for sensor in sensors) and received.weight.shape[1] == 1
        return 0.0 if is_exact else PRIOR_SHARE

    def _linearised_posterior(
        self, sensors: Sequence[AbstractSensor], received: Received, mode: jax.Array, x: Gaussian
    ) -> tuple[Gaussian, jax.Array]:
        """Return x given z in this mode, and the log density of z, of z = gain h(x) + n.

        h is linearised at the mean, in all states; n is one Gaussian in place of the atoms.
        """
        gain, offset, noise = jax.tree.map(lambda leaf: leaf[mode], received.overall)
        y, slopes = slopes_given(partial(self._measure, sensors, mode), x, drawn=0)
        return self._condition(x, gain @ slopes, gain @ y + offset, noise, received.z)

    def _condition(
        self, x: Gaussian, slopes: jax.Array, expected: jax.Array, noise: Columns, z: jax.Array
    ) -> tuple[Gaussian, jax.Array]:
        """Return x given z = expected + slopes xi + v, and the log density of z."""
        value = nearest(z - expected, jnp.zeros(len(z)), self.observed_angles)
        after, innovations = condition_on_observation(x, slopes, value, noise, ~jnp.isnan(z))
        return after, innovations.log_density(~jnp.isnan(z), jnp.abs(z) + jnp.abs(expected))

    def _condition_on_atoms(
        self, sensors: Sequence[AbstractSensor], received: Received, mode: jax.Array, x: Gaussian, uniform: jax.Array
    ) -> tuple[Gaussian, jax.Array]:
        """Return x, whose drawn states are known, given z and an atom drawn by its probability; and log p(z) of all."""
        y, slopes = slopes_given(partial(self._measure, sensors, mode), x, self.drawn)

        def condition_on_atom(gain: jax.Array, offset: jax.Array, noise: Columns) -> tuple[Gaussian, jax.Array]:
            """Return x given z of one atom, and the log density of z."""
            return self._condition(x, gain @ slopes, gain @ y + offset, noise, received.z)

        atoms = jax.tree.map(lambda leaf: leaf[mode], (received.gain, received.offset, received.noise))
        after, densities = jax.vmap(condition_on_atom)(*atoms)
        densities = jnp.where(jnp.isnan(densities), -jnp.inf, densities) + jnp.log(received.weight[mode])
        atom = draw_index(densities[None], uniform[None])[0]
        return jax.tree.map(lambda leaf: leaf[atom], after), jax.nn.logsumexp(densities)

    def _innovation(
        self,
        sensors: Sequence[AbstractSensor],
        received: Received,
        x: Gaussian,
        weight: jax.Array,
        log_mode: jax.Array,
        density: jax.Array,
    ) -> Innovation:
        """Return z less its mean over particles, modes and atoms, to first order in h, its covariance, and log p(z)."""
        present = ~jnp.isnan(received.z)

        def predict_in_mode(mode: jax.Array, x: Gaussian) -> tuple[jax.Array, jax.Array]:
            """Return innovations (atoms, m) and their covariances of one particle in one mode."""
            y, slopes = slopes_given(partial(self._measure, sensors, mode), x, drawn=0)
            gain = received.gain[mode]
            value = nearest(
                received.z - gain @ y - received.offset[mode], jnp.zeros(len(present)), self.observed_angles
            )
            spread = jax.vmap(lambda g: Columns(g @ slopes, x.variances).covariance)(gain)
            noise = jax.vmap(lambda matrix, weights: Columns(matrix, weights).covariance)(
                *jax.tree.map(lambda leaf: leaf[mode], received.noise)
            )
            return value, jnp.where(present[:, None] & present, spread + noise, jnp.nan)

        value, total = jax.vmap(jax.vmap(predict_in_mode), in_axes=(None, 0))(jnp.arange(len(self.initial)), x)
        share = weight[:, None, None] * jax.nn.softmax(log_mode, axis=1)[:, :, None] * received.weight
        # Particles where h(x) is no number count not at all.
        valid = jnp.all(jnp.isfinite(value) | ~present, axis=-1)
        share = jnp.where(valid, share, 0.0).ravel()
        share = share / jnp.where(jnp.sum(share) > 0, jnp.sum(share), 1.0)
        value = jnp.where(valid[..., None], value, jnp.where(present, 0.0, jnp.nan)).reshape(-1, len(present))
        value = nearest(value, value[jnp.argmax(share)], self.observed_angles)
        return mixed_innovation(share, value, total.reshape(-1, *total.shape[-2:]), density)

    @estimates
    def estimate(self, state: PartlyDrawn) -> Estimate:
        """Return mean and covariance over particles and modes; of an angle the mean direction, and moments about it."""
        plant, weight = models_of(first(self.plant))[0], jnp.asarray(state.mode_weights)
        x, n = state.gaussian, len(self.order)
        places, flat = self._angles_in_order(plant), jnp.asarray(x.mean).reshape(-1, n)
        share = weight.ravel()
        # The mean direction is that of E exp(i angle), and an angle's Gaussian has exp(i m - variance / 2).
        covariances = jnp.asarray(x.covariance).reshape(-1, n, n)
        mean = share @ flat
        for i in places:
            size = share * jnp.exp(-covariances[:, i, i] / 2)
            mean = mean.at[i].set(jnp.arctan2(size @ jnp.sin(flat[:, i]), size @ jnp.cos(flat[:, i])))
        difference = wrap_angles(flat - mean, places)
        # Second moments about this mean.
        center, covariance = moments_of_mixture(difference, covariances, share)
        covariance = covariance + jnp.outer(center, center)
        plants_order = np.argsort(self.order)
        modes = jnp.sum(weight, axis=0) if len(self.initial) > 1 else None
        return Estimate(mean[plants_order], covariance[plants_order][:, plants_order], self.claim, modes)


def _repeat_for_modes(x: Gaussian, modes: int) -> Gaussian:
    """Return Gaussians (N, n) as those of every mode (N, M, n)."""
    repeated: Gaussian = jax.tree.map(lambda leaf: jnp.repeat(leaf[:, None], modes, axis=1), x)
    return repeated
