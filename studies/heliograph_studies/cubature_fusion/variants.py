"""Algorithm 1 read literally where it contradicts its own theorems: each reading as a filter of its own."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

import heliograph as hg
from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian.belief import Belief
from heliograph.filters.gaussian.correction import Signal
from heliograph.filters.gaussian.gaussian import GaussianFilter, corrected
from heliograph.filters.gaussian.precise import initial_size
from heliograph.filters.gaussian.update import AbstractUpdate
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import at
from heliograph.numerics.linalg import cholesky
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph_studies.cubature_fusion.loose_interval import LooseInterval
from heliograph_studies.cubature_fusion.setting import Scenario, cubature


class AbstractReading(AbstractUpdate):
    """Another reading of the step in which `update` corrects; it describes the channel as that does."""

    update: AbstractUpdate

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """As the update within."""
        return self.update.describe(channel)


class StepFourGain(AbstractReading):
    """The gain of Step 4, sqrt(mu) where Theorem 2 has mu: larger by `factor` = 1 / sqrt(mu). The bound stays (31)."""

    factor: float

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Scale the gain, keep the bound."""
        gain, bound = self.update.correct(prior, signal, channel, present)
        return self.factor * gain, bound


class CentralMoment(AbstractReading):
    """The one symbol P^yy of (10) and Step 4 read as the covariance of the innovation in every term."""

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Take Cov(y) for E[y y']."""
        return self.update.correct(prior, signal._replace(second=signal.covariance), channel, present)


class RawMoment(AbstractReading):
    """The one symbol P^yy read as E[y y'] in every term."""

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Take E[y y'] for Cov(y)."""
        return self.update.correct(prior, signal._replace(covariance=signal.second), channel, present)


def cubature_points(mean: jax.Array, covariance: jax.Array) -> jax.Array:
    """mean +- sqrt(n) L e_j, (2 n, n)."""
    offsets = jnp.sqrt(float(len(mean))) * cholesky(covariance).T
    return jnp.concatenate([mean + offsets, mean - offsets])


class Propagated(NamedTuple):
    """A belief, and the points (2 n, n) that were moved to predict it."""

    mean: jax.Array
    covariance: jax.Array
    points: jax.Array


class MixedCross(AbstractFilter):
    """Step 3's P^xy: propagated points on one side, redrawn points on the other."""

    base: GaussianFilter
    claim: Claim = eqx.field(static=True)

    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    def __init__(self, base: GaussianFilter):
        self.base, self.claim = base, "nominal"
        self.states, self.inputs, self.received = base.states, base.inputs, base.received

    def init(self) -> Propagated:
        """The prior."""
        start = self.base.init()
        return Propagated(*start, jnp.zeros((2 * len(start.mean), len(start.mean))))

    @predicts
    def predict(self, state: Propagated, u: ArrayLike = (), k: Step = 0) -> Propagated:
        """Move the points, and keep them."""
        plant, (mean, covariance, _) = at(self.base.plant, k), state
        points = jax.vmap(lambda x: plant.transition(x, jnp.asarray(u)))(cubature_points(mean, covariance))
        return Propagated(*self.base.predict(Belief(mean, covariance), u, k), points)

    @corrects
    def correct(self, state: Propagated, z: ArrayLike, k: Step = 0) -> tuple[Propagated, Innovation]:
        """Redraw for y only, correct."""
        sensor, channel = at(self.base.sensor, k), at(self.base.channel, k)
        prior = Belief(state.mean, state.covariance)
        y = jax.vmap(sensor.measure)(cubature_points(*prior))
        mean, count = y.mean(axis=0), len(y)
        spread = (y - mean).T @ (y - mean) / count + sensor.noise.covariance
        cross = (state.points - prior.mean).T @ (y - mean) / count
        signal = Signal(mean, spread, cross, spread + jnp.outer(mean, mean))
        size = initial_size(self.base)
        after, innovation = corrected(prior, signal, channel, self.base.rule, jnp.asarray(z), size)
        return Propagated(*after, state.points), innovation

    def estimate(self, state: Propagated) -> Estimate:
        """The belief."""
        return Estimate(state.mean, state.covariance, self.claim)


def variants(s: Scenario, node: int) -> dict[str, AbstractFilter]:
    """The literal readings of one node, all with the scenario's fixed scalars."""
    printed, polytope = (rule(hg.filters.Scalars(*s.beta)) for rule in (LooseInterval, hg.filters.Polytope))
    return {
        "step_four_gain": cubature(s, node, StepFourGain(printed, s.mean_gain**-0.5)),
        "mixed_cross": MixedCross(cubature(s, node, polytope)),
        "central_moment": cubature(s, node, CentralMoment(polytope)),
        "raw_moment": cubature(s, node, RawMoment(polytope)),
    }
