"""What particle filters of the state share: their fields, the resampling at the start of a step, and used rows."""

from abc import abstractmethod
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.filters.base import AbstractSizedFilter, FilterAngles, Step
from heliograph.filters.particles.expected_measurement import find_reference_particle
from heliograph.filters.particles.moments import StateSums
from heliograph.filters.particles.native_particle_loop import filter_particles
from heliograph.filters.particles.received_density import ReceivedDensity
from heliograph.filters.particles.resampling import effective_number, resample_systematically
from heliograph.filters.rows.chunks import ScanResult
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.types import Array, Int, PyTree

ENOUGH = 200  # particles; of 100 a row takes 80 us in lanes and half of it otherwise, of 300 90 and three times that
State = TypeVar("State", bound=tuple[Any, ...])
Expectations = tuple[jax.Array, ...]  # what a particle expects of z, one or several arrays; (N, ...) of N particles


class ResampledParticles(NamedTuple):
    """Result of a resampling: for each particle (N,) the index of the one it is a copy of, and log weights (N,)."""

    which: jax.Array
    log_weight: jax.Array


class WeighedParticles(NamedTuple):
    """Particles that were weighed by z.

    Args:
        particles: the particles (B, ...), drawn again with z if the filter does so. log_likelihood: log of the factor
        on each weight, p(z | particle) times prior density over that of the draw (B,). predicted: what each expected of
        z before z was known, arrays (B, ...).
    """

    particles: PyTree
    log_likelihood: jax.Array
    predicted: tuple[jax.Array, ...]


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
        """Return the indices of states that are angles, and of components of z that are.

        The plants of all modes have the same states, so that those of the first mode stand for all.
        """
        return FilterAngles(list_mode_models(first(self.plant))[0].angles, self.observed_angles)

    def start_keys(self) -> tuple[jax.Array, jax.Array]:
        """Return two random keys, both from the seed: that of the first step, and that of the draws of x_0."""
        key, start_key = jax.random.split(jax.random.PRNGKey(self.seed))
        return key, start_key

    def filter_rows(self, z: Array, u: Array, state: PyTree | None = None, begin: Array | int = 0) -> ScanResult | None:
        """Filter rows of data in native code, a SIMD lane for each particle; None if there are too few particles."""
        return filter_particles(self, z, u, state, begin) if self.particles >= ENOUGH else None

    @abstractmethod
    def allocate_particles(self, count: int) -> Any:
        """Return arrays for `count` particles, to be filled: a tree whose leaves have the particles as first axis."""

    @abstractmethod
    def get_particles(self, state: Any) -> Any:
        """Return the particles (N, ...) of a filter's state: positions, or Gaussians in each mode."""

    @abstractmethod
    def sum_for_mean(self, weight: jax.Array, particles: Any) -> StateSums:
        """Return sums over B particles, of weights and of weights times states, from which the mean follows.

        The weights need not sum to 1. The sums of several groups of particles add up to that of all.
        """

    @abstractmethod
    def sum_for_covariance(self, weight: jax.Array, particles: Any, sums: StateSums) -> jax.Array:
        """Return the sum over B particles of weight times second moment (n, n), about the mean of all particles.

        `sums`: those of all particles by `sum_for_mean`, from which their mean follows.
        """

    @abstractmethod
    def estimate_from_sums(self, sums: StateSums, second: jax.Array) -> Estimate:
        """Return the estimate: the mean from `sums`, the covariance from `second`, both over all particles.

        `second` (n, n) is the sum of w d d' with the difference d of each particle from that mean.
        """

    @abstractmethod
    def sum_received(
        self, reference: Expectations, weight: jax.Array, predicted: Expectations, z: jax.Array, k: Step
    ) -> PyTree:
        """Return sums over B particles, from which E z and Cov z follow: of w_i, w_i d_i and w_i d_i d_i'.

        w_i is the weight of particle i, and d_i = e_i - e_r its innovation e_i = z - E[z | particle i] less that of a
        reference particle r. So no digits are lost if z is far from 0. Sums of several groups of particles add up.

        Args:
            reference: what one particle, the heaviest, expects of z: arrays as in `predicted`, without a first axis.
            weight: weights of the particles before z is known, of any sum.
            predicted: what each expects of z: arrays with the particles as first axis.
            z: measurement (m,), NaN for what did not arrive.
            k: step.
        """

    @abstractmethod
    def innovation_from_sums(
        self, received: PyTree, reference: Expectations, z: jax.Array, k: Step, density: jax.Array
    ) -> Innovation:
        """Return the innovation z - E z = e_r + sum w_i d_i / sum w_i, its covariance Cov z, and log p(z).

        e_r is the innovation of a reference particle r, and d_i = e_i - e_r that of particle i less it.

        Args:
            received: the sums of w_i, w_i d_i and w_i d_i d_i' over all particles, as `sum_received` makes them.
            reference: what particle r, the heaviest, expects of z: e_r = z - that.
            z: measurement (m,), NaN for what did not arrive.
            k: step.
            density: log p(z), which is found by the weights, and put into the result as it is.
        """

    def compute_estimate(self, state: Any) -> Estimate:
        """Return the weighted mean of all particles, and the covariance about it, by sums over them."""
        weight, particles = jax.tree.map(jnp.asarray, (state.weight, self.get_particles(state)))
        sums = self.sum_for_mean(weight, particles)
        return self.estimate_from_sums(sums, self.sum_for_covariance(weight, particles, sums))

    def compute_innovation(
        self, weight: jax.Array, predicted: tuple[jax.Array, ...], z: jax.Array, k: Step, density: jax.Array
    ) -> Innovation:
        """Return z - E z over N weighted particles, its covariance Cov z, and log p(z).

        The expectation of the heaviest particle is subtracted before anything is summed, so that large numbers keep
        their digits.

        Args:
            weight: of the particles before z is known (N,).
            predicted: what each particle expects of z, as one or several arrays (N, ...).
            z: measurement (m,), NaN for what did not arrive.
            k: step.
            density: log p(z), which the weights after z have given.
        """
        heaviest = find_reference_particle(weight, predicted)
        reference = tuple(expectations[heaviest] for expectations in predicted)
        sums = self.sum_received(reference, weight, predicted, z, k)
        return self.innovation_from_sums(sums, reference, z, k, density)

    @property
    def of_atoms(self) -> bool:
        """True: the law of z is a mixture over particles, so likelihood 0 says that its model excludes z."""
        return True

    def choose_particles(self, log_weight: jax.Array, key: jax.Array) -> ResampledParticles:
        """Resample systematically if the effective number is too small; else keep all particles.

        It is too small below the share `resample` of all. Resampled particles have log weights of 0. Else the log
        weights do not change.
        """
        weight = jax.nn.softmax(log_weight)
        # The effective number is 1 / sum w_i^2: N if all weights are equal, 1 if one particle has all the weight.
        resamples = effective_number(weight) < jnp.asarray(self.resample) * self.particles
        start, all_particles = jax.random.uniform(key, (), weight.dtype), jnp.arange(self.particles)
        indices = jax.lax.cond(resamples, resample_systematically, lambda *_: all_particles, weight, start)
        return ResampledParticles(indices, jnp.where(resamples, 0.0, log_weight))


def update_if_used(used: jax.Array, updated: State, before: State) -> State:
    """Return the updated state where the flag `used` () holds, else the state before: two trees of arrays alike.

    A row of data is not used if nothing arrived, or if no particle can have produced it.
    """
    chosen: State = jax.tree.map(lambda new, old: jnp.where(used, new, old), updated, before)
    return chosen


def relative_to_largest(log_weight: jax.Array) -> jax.Array:
    """Return log weights (N,) less the largest of them, so that exp does not overflow.

    If all are -inf, they are returned as they are.
    """
    largest = jnp.max(log_weight)
    return log_weight - jnp.where(jnp.isfinite(largest), largest, 0.0)
