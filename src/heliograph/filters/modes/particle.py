"""Rao-Blackwellised particle filter: particles for the modes of links with memory, each with a Gaussian state."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.gaussian import Gaussian, from_covariance, moments_of_mixture
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    predicts,
)
from heliograph.filters.gaussian.belief import predict_gaussian, second_moments_at_start
from heliograph.filters.gaussian.signal import signal_of
from heliograph.filters.gaussian.transform import AbstractTransform
from heliograph.filters.modes.models_by_mode import fields_of_mode_filters
from heliograph.filters.modes.multiple_model import (
    align_angles,
    correct_in_every_mode,
    replicate,
)
from heliograph.filters.modes.patterns import SideInformation
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.modes_of_motion import ModalPlant, ModalSensor
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.premises.premise import believes
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import Angles, wrap_angles
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int

NODES = 9  # modes that stand for a gain that drifts: they cost no more than few


class Particles(NamedTuple):
    """Gaussian, present mode and weight of each particle, and the key of the next random numbers.

    Shapes: the Gaussians (N, n), mode (N,), weight (N,), key (2,). `moved` is true from the first prediction on.
    """

    gaussian: Gaussian
    mode: Int[jax.Array, " N"]
    weight: Float[jax.Array, " N"]
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """The mixture: weights (N,), and the Gaussian of each particle."""
        return self.weight, self.gaussian


class ParticleFilter(AbstractSizedFilter):
    """Particles draw the modes; given their path the state is Gaussian (Rao-Blackwell). Built by `particle_filter`.

    Its random numbers come from the seed and from the data, so that runs draw independently and the same data give the
    same estimate.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SideInformation | OverTime
    initial: Float[Array, " M"]
    transform: AbstractTransform
    observed_angles: Angles = eqx.field(static=True)
    plant_modes: tuple[int, ...] = eqx.field(static=True)
    sensor_modes: tuple[int, ...] = eqx.field(static=True)
    particles: int = eqx.field(static=True)
    seed: Int[Array, ""]  # a number, so that filters of all seeds are one program

    def angles_used(self) -> FilterAngles:
        """Return the angles of its plant, and those that its channel delivers."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @in_float64
    def init(self) -> Particles:
        """Return the prior in every particle, with modes in proportion to their initial law."""
        start, n = at(self.plant, 0), self.particles
        parts = replicate(from_covariance(start.initial_mean, start.initial_covariance), n)
        mode = _invert_distribution(jnp.asarray(self.initial), (jnp.arange(n) + 0.5) / n)
        return Particles(parts, mode, jnp.full(n, 1 / n), jax.random.PRNGKey(self.seed), jnp.asarray(False))

    @predicts
    def predict(self, state: Particles, u: ArrayLike = (), k: Step = 0) -> Particles:
        """Draw each particle's next mode, and predict its Gaussian."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        key = jax.random.fold_in(state.key, 0)
        rows = jnp.asarray(at(self.channel, k).transition)[state.mode]
        drawn = jax.vmap(_invert_distribution)(rows, jax.random.uniform(key, state.weight.shape, state.weight.dtype))
        start = second_moments_at_start(self.plant)
        parts = jax.vmap(lambda x: predict_gaussian(plant, self.transform, x, u, start))(state.gaussian)
        mode = jnp.where(state.moved, drawn, state.mode)
        parts = parts._replace(mean=align_angles(plant, parts.mean, state.weight))
        return Particles(parts, mode, state.weight, key, jnp.asarray(True))

    @corrects
    def correct(self, state: Particles, z: ArrayLike, k: Step = 0) -> tuple[Particles, Innovation]:
        """Correct each particle with z, weight it by its likelihood, and resample below half the effective number."""
        (plant, sensor, channel), z = at((self.plant, self.sensor, self.channel), k), jnp.asarray(z)
        start = second_moments_at_start(self.plant)
        signals = jax.vmap(lambda x: signal_of(plant, sensor, self.transform, x, start))(state.gaussian)
        after, weight, mixed = correct_in_every_mode(
            signals, channel, state.mode, state.weight, z, self.observed_angles
        )
        after = after._replace(mean=align_angles(plant, after.mean, weight))
        # Systematic resampling.
        key = _fold_in_bits(state.key, z)
        chosen = _resample_systematically(weight, jax.random.uniform(key, (), weight.dtype))
        poor = 1 / jnp.sum(weight**2) < self.particles / 2  # the effective number of particles
        which = jnp.where(poor, chosen, jnp.arange(self.particles))
        weight = jnp.where(poor, 1 / self.particles, weight)
        kept: Gaussian = jax.tree.map(lambda leaf: leaf[which], after)
        return Particles(kept, state.mode[which], weight, key, state.moved), mixed

    @estimates
    def estimate(self, state: Particles) -> Estimate:
        """Return the mean and covariance of the whole mixture, angles between -pi and pi."""
        mean, covariance = moments_of_mixture(state.gaussian.mean, state.gaussian.covariance, state.weight)
        return Estimate(wrap_angles(mean, first(self.plant).angles), covariance, self.claim)


def _invert_distribution(law: jax.Array, uniform: jax.Array) -> jax.Array:
    """Invert each distribution function at a uniform number: the index that it draws."""
    return jnp.searchsorted(jnp.cumsum(law)[:-1], uniform)


def _resample_systematically(weight: jax.Array, start: jax.Array) -> jax.Array:
    """Resample systematically: indices where the distribution function passes (start + 0 ... N - 1) / N."""
    return _invert_distribution(weight, (start + jnp.arange(len(weight))) / len(weight))


def _fold_in_bits(key: jax.Array, z: jax.Array) -> jax.Array:
    """Return the key made of another one and of the bits of a measurement."""
    bits = jax.lax.bitcast_convert_type(jnp.where(jnp.isnan(z), 0.0, z), jnp.uint32)
    for word in bits.ravel():
        key = jax.random.fold_in(key, word)
    return key


@believes
def particle_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    particles: int = 300,
    seed: int = 0,
    transform: AbstractTransform | None = None,
    nodes: int = NODES,
) -> ParticleFilter:
    """Rao-Blackwellised particle filter of a plant behind links with memory: a reference for the other filters.

    Each particle draws a path of modes and carries the Gaussian filter of that path; systematic resampling where the
    effective number of particles is below half. Error of the mixture's moments: in proportion to 1 / root of
    `particles`.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter, with memory.
        particles: their number; 300 by default.
        seed: of the random numbers, which depend on the data too; 0 by default.
        transform: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: number of modes that stand for a gain that drifts; 9 by default.

    Claim: "nominal": with finitely many particles, and a Gaussian in each, it approaches the truth from either side.

    Raises:
        ValueError: a count of particles below 1, and as for `imm_filter`.

    Source: Doucet, Gordon and Krishnamurthy, Particle filters for state estimation of jump Markov linear systems,
        2001.
    """
    for kind, model in (("plant", plant), ("sensor", sensor)):
        if isinstance(model, ModalPlant | ModalSensor):
            raise fail(kind, "one law (imm_filter and gpb2_filter take several)", f"a markov_{kind}")
    return ParticleFilter(
        particles=check_count("particles", particles),
        seed=np.asarray(check_count("seed", seed, 0)),
        **fields_of_mode_filters(plant, sensor, channel, transform, nodes),
    )
