"""What particle filters of the state share: their fields, the resampling at the start of a step, and used rows."""

from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.filters.base import AbstractSizedFilter, FilterAngles
from heliograph.filters.particles.received_density import ReceivedDensity
from heliograph.filters.particles.resampling import effective_number, resample_systematically
from heliograph.model.modes_of_motion import models_of
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import Angles
from heliograph.numerics.types import Array, Int

State = TypeVar("State", bound=tuple[Any, ...])


class Resampled(NamedTuple):
    """Result of a resampling: numbers of the particles that go on (N,), and their log weights (N,)."""

    which: jax.Array
    log_weight: jax.Array


class AbstractStateParticleFilter(AbstractSizedFilter):
    """Weighted particles of the state, resampled at the start of a step, so that an estimate has all weights.

    Its random numbers come from the seed and from the data, so that runs draw independently and the same data give the
    same estimate. A measurement that no particle can produce is not used: its log-likelihood is -inf, the state stays.

    `resample`: share of N below which the effective number leads to resampling.
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
        return FilterAngles(models_of(first(self.plant))[0].angles, self.observed_angles)

    @property
    def of_atoms(self) -> bool:
        """True: a value of likelihood 0 under every particle is excluded by its model."""
        return True

    def resampled(self, log_weight: jax.Array, key: jax.Array) -> Resampled:
        """Resample systematically where the effective number is too small; else all particles go on as they are."""
        weight = jax.nn.softmax(log_weight)
        too_few = effective_number(weight) < jnp.asarray(self.resample) * self.particles
        start, all_particles = jax.random.uniform(key, (), weight.dtype), jnp.arange(self.particles)
        which = jax.lax.cond(too_few, resample_systematically, lambda *_: all_particles, weight, start)
        return Resampled(which, jnp.where(too_few, 0.0, log_weight))


def keep_unused(used: jax.Array, updated: State, before: State) -> State:
    """Return the updated state where the row is used, else the state before."""
    kept: State = jax.tree.map(lambda new, old: jnp.where(used, new, old), updated, before)
    return kept


def relative_to_largest(log_weight: jax.Array) -> jax.Array:
    """Return log weights of which the largest is 0, where it is finite."""
    largest = jnp.max(log_weight)
    return log_weight - jnp.where(jnp.isfinite(largest), largest, 0.0)
