"""Filters of plants whose states have limits: what a filter says of the state, given that it lies within them.

The base filter runs as if there were no limits. Its Gaussian conditioned on the limits is the law of x_k given the data
and that x_k lies within them: exact for a linear plant, at every step, since the conditioned law is only reported, not
filtered further. (A filter that went on from the truncated moments would count the same limits anew at each step: it
would push a state that hardly moves away from them, with ever smaller variance.) That earlier states lay within the
limits too is not used. If a mean leaves the limits, the filter goes on from the most likely point within them.
"""

from copy import copy
from dataclasses import replace
from typing import ClassVar, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp

import heliograph.filters.particles as particles
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.base import (
    AbstractFilter,
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.remark import Remark
from heliograph.filters.smoother_step import SmootherStep, StepTrace, gaussian_of, with_gaussian
from heliograph.filters.truncation import PlacedLimits, hold_mean_within_limits, truncate_to_limits
from heliograph.filters.wrappers.sensor_inputs import StateUnderInputs
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.estimate import Claim, Estimate, Innovation, weakest
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, PyTree

F = TypeVar("F", bound=AbstractFilter)
P = ParamSpec("P")


class LimitedFilter(AbstractSizedFilter):
    """A filter that conditions its estimates on the limits of its plant's states.

    Its state is that of the base filter, which knows no limits. The likelihood of a measurement is that given that the
    plant's state lies within the limits: p(z) P(within | z) / P(within).

    Args:
        base: the filter of the plant without limits.
        limits: index, lowest and highest value of each limited state.
    """

    takes_limits: ClassVar[bool] = True
    base: AbstractFilter
    limits: PlacedLimits = eqx.field(static=True)

    @in_float64
    def init(self) -> PyTree:
        """Return the first state of the base filter, which knows no limits."""
        return self.base.init()

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict from a Gaussian whose mean is moved to the most likely point within the limits.

        A particle filter predicts from the particles within the limits.
        """
        return self.base.predict(self._state_before_prediction(state), u, k)

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct the prediction, its mean moved into the limits, with z.

        The likelihood that is returned is p(z | x within the limits) = p(z) P(within | z) / P(within).
        """
        after, innovation = self.base.correct(self.hold(state), z, k)
        # log p(z | within) = log p(z) + log P(within | z) - log P(within); no change where either P is 0 to rounding.
        log_within_after = self._log_probability_within(after)
        log_within_before = self._log_probability_within(state)
        are_possible = jnp.isfinite(log_within_after) & jnp.isfinite(log_within_before)
        change = jnp.where(are_possible, log_within_after - log_within_before, 0.0)
        return after, replace(innovation, log_likelihood=innovation.log_likelihood + change)

    @estimates
    def estimate(self, state: PyTree) -> Estimate:
        """Return the mean and covariance given that the state lies within the limits."""
        return self._with_own_claim(self.base.estimate(self.condition_on_limits(state)))

    def after_step(self, state: PyTree, k: Step) -> Estimate:
        """Return the mean and covariance after step k, given that the state lies within the limits."""
        return self._with_own_claim(self.base.after_step(self.condition_on_limits(state), k))

    def hold(self, state: PyTree) -> PyTree:
        """Return the state from which the base filter corrects: a Gaussian's mean is moved into the limits."""
        return state if _holds_particles(state) else self._hold_means(state)

    def condition_on_limits(self, state: PyTree, without: int | None = None) -> PyTree:
        """Return the state of the inner filter, given that the plant's state lies within the limits.

        `without` is the index of a state whose limits are left out, or None.
        """
        other_limits = tuple(limit for limit in self.limits if limit[0] != without)
        filter = self if without is None else replace(self, limits=other_limits)
        return filter._condition_with_log_probability(state)[1]

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the base filter, whose smoothed estimates are then conditioned on the limits.

        Predictions and corrections began from means moved into the limits, so the states of the step have these too.
        The smoothed covariance is nominal, since that earlier and later states keep the limits is not used.
        """
        inner = self.base.smoother_step(step.map_states(self._hold_means))
        return replace(inner, limits=self.limits, claim=weakest([inner.claim, "nominal"]))

    def angles_used(self) -> FilterAngles | None:
        """Return which states, inputs and measured values are angles: those of the base filter."""
        return self.base.angles_used()

    @property
    def remarks(self) -> bool:
        """True if the base filter may have a remark on its state, such as that it diverges."""
        return self.base.remarks

    def remark(self, state: PyTree) -> Remark:
        """Return what the base filter remarks on its state."""
        return self.base.remark(state)

    @property
    def of_atoms(self) -> bool:
        """True if the base filter is a mixture (particles, modes) that excludes z only by a likelihood of 0."""
        return self.base.of_atoms

    def _with_own_claim(self, estimate: Estimate) -> Estimate:
        """Return the estimate with this filter's claim of what its covariance is ("nominal" at most)."""
        return replace(estimate, claim=self.claim)

    def _state_before_prediction(self, state: PyTree) -> PyTree:
        """Return the state from which the next prediction starts.

        Particles outside the limits are dropped. A Gaussian keeps its covariance: only its mean is moved into them.
        """
        return self.condition_on_limits(state) if _holds_particles(state) else self._hold_means(state)

    def _hold_means(self, state: PyTree) -> PyTree:
        """Return a filter's state with the means of its Gaussians moved into the limits.

        If a wrapper's state holds other states, those are changed. Particles do not change here: they are conditioned
        on the limits elsewhere.
        """
        if isinstance(state, StateUnderInputs):
            return state._replace(base=self._hold_means(state.base))
        if hasattr(state, "believed"):  # the state of a gate, with its rival
            return state._replace(believed=self._hold_means(state.believed), rival=self._hold_means(state.rival))
        if _holds_particles(state):
            return state
        x = Gaussian(*map(jnp.asarray, gaussian_of(state)))
        hold = jax.vmap(self._hold_mean) if x.mean.ndim == 2 else self._hold_mean
        return with_gaussian(state, hold(x))

    def _hold_mean(self, x: Gaussian) -> Gaussian:
        """Return one Gaussian with its mean at its most likely point within the limits."""
        return hold_mean_within_limits(x, self.limits)

    def _log_probability_within(self, state: PyTree) -> jax.Array:
        """Return log P(the plant's state lies within the limits), by the law that the filter's state describes."""
        return self._condition_with_log_probability(state)[0]

    def _condition_with_log_probability(self, state: PyTree) -> tuple[jax.Array, PyTree]:
        """Return the log probability that the plant's state lies within the limits, and the filter's state given that.

        Limits are known bounds of the plant's states, such as a level that is not negative; estimates are conditioned
        on them. `state` is one of four: one that holds another filter's state, particles, a Gaussian, or a mixture.
        """
        # States that hold another one, of a filter of sensor inputs or of a gate, and particles.
        if isinstance(state, StateUnderInputs):
            log_mass, inner = self._condition_with_log_probability(state.base)
            return log_mass, state._replace(base=inner)
        if hasattr(state, "believed"):  # the state of a gate, with its rival
            log_mass, inner = self._condition_with_log_probability(state.believed)
            return log_mass, state._replace(believed=inner)
        if isinstance(state, particles.StateParticles):
            return self._condition_particles(state)
        # A Gaussian (mean (n,)) is truncated as a mixture (mean (K, n)) with K = 1.
        held_state = self._hold_means(state)
        x = Gaussian(*map(jnp.asarray, gaussian_of(held_state)))
        if x.mean.ndim == 1:
            log_mass, truncated = truncate_to_limits(jax.tree.map(lambda leaf: leaf[None], x), self.limits)
            return log_mass[0], with_gaussian(held_state, jax.tree.map(lambda leaf: leaf[0], truncated))
        # A mixture: each Gaussian a is truncated, and its weight becomes w_a P_a(within) over their sum. If all
        # P_a(within) are 0 to rounding, the weights stay.
        log_masses, truncated = truncate_to_limits(x, self.limits)
        weight = jnp.asarray(held_state.weight)
        per_gaussian = (-1, *[1] * (weight.ndim - 1))  # one number for each Gaussian, along the first axis
        weight_within = weight * jnp.exp(log_masses).reshape(per_gaussian)
        mass = jnp.sum(weight_within)
        is_possible = mass > 0
        weight = jnp.where(is_possible, weight_within / jnp.where(is_possible, mass, 1.0), weight)
        log_mass = jnp.where(is_possible, jnp.log(jnp.where(is_possible, mass, 1.0)), -jnp.inf)
        return log_mass, held_state._replace(gaussian=truncated, weight=weight)

    def _condition_particles(self, state: "particles.StateParticles") -> tuple[jax.Array, "particles.StateParticles"]:
        """Return log P(within the limits), and the particles given that: those outside get the weight 0.

        n or fewer particles of n states span no covariance (n, n). If no more than n lie within, all keep their
        weights, and each one outside is mirrored at the limit that it exceeds: a value x > high becomes 2 high - x.
        """
        position = jnp.asarray(state.position)
        inside = jnp.ones(len(state.log_weight), bool)
        mirrored = position
        for index, low, high in self.limits:
            value = position[:, index]
            inside = inside & (low <= value) & (value <= high)
            reflected = jnp.where(value < low, 2 * low - value, jnp.where(value > high, 2 * high - value, value))
            mirrored = mirrored.at[:, index].set(jnp.clip(reflected, low, high))
        log_weight_within = jnp.where(inside, state.log_weight, -jnp.inf)
        log_mass = jax.nn.logsumexp(log_weight_within) - jax.nn.logsumexp(state.log_weight)
        enough_within = jnp.sum(jnp.isfinite(log_weight_within)) > position.shape[1]
        # Log weights relative to the largest one.
        largest = jnp.where(enough_within, jnp.max(log_weight_within), 0.0)
        return log_mass, state._replace(
            log_weight=jnp.where(enough_within, log_weight_within - largest, state.log_weight),
            position=jnp.where(enough_within, position, mirrored),
        )


def _holds_particles(state: PyTree) -> bool:
    """Return whether a filter's state, or the inner state of a filter of sensor inputs, holds particles."""
    return isinstance(getattr(state, "base", state), particles.StateParticles)


def without_limits(plant: AnyPlant) -> AnyPlant:
    """Return a copy of the plant, of each step if it varies over time, without limits of its states."""

    def drop_limits(limited: AbstractPlant) -> AbstractPlant:
        """Return a copy of the plant of one step, without limits."""
        unlimited = copy(limited)
        object.__setattr__(unlimited, "limits", ())  # fields are frozen
        return unlimited

    without: AnyPlant = at_each_step(drop_limits, plant)
    return without


def build_limited_filter(base: AbstractFilter, plant: AnyPlant) -> LimitedFilter:
    """Return the filter of a plant with limits of its states, from `base`, the filter of the plant without limits.

    Its covariance is claimed to be "nominal" at most, not "exact" or an "upper" bound: that earlier states lay within
    the limits too is not used.
    """
    start = first(plant)  # limits do not vary over time
    # A limit has the state's index, the low end and the high end.
    limits = tuple((start.states.index(name), low, high) for name, (low, high) in start.limits)
    claim: Claim = weakest([base.claim, "nominal"])
    limited = LimitedFilter(base=base, limits=limits, **make_sizes(claim, base, base.received))
    assumed = base.assumed  # the models for which `base` was made; the plant among them is to be that with limits
    return with_assumed(limited, assumed and assumed.replaced(plant=plant))
