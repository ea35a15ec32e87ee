"""Algorithm 1 read literally where it contradicts its own theorems: each reading as a filter of its own."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

import heliograph as hg
from heliograph.filters.base import AbstractFilter
from heliograph.filters.correction import Signal
from heliograph.filters.gaussian import Belief, GaussianFilter, corrected
from heliograph.filters.update import AbstractUpdate
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at
from heliograph.numerics.float64 import compiled
from heliograph.numerics.linalg import cholesky
from heliograph.papers.cubature_fusion.loose_interval import LooseInterval
from heliograph.papers.cubature_fusion.setting import Setting, cubature
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.second_order import SecondOrder


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


class MixedCross(AbstractFilter):
    """Step 3's P^xy: propagated points on one side, redrawn points on the other."""

    base: GaussianFilter
    claim: Claim = eqx.field(static=True)

    def init(self) -> Belief:
        """The prior."""
        return self.base.init()

    @compiled
    def step(self, state: Belief, z: Any, u: Any = (), k: Any = 0) -> tuple[Belief, Estimate]:
        """Predict, redraw for y only, correct."""
        plant, sensor, channel = (at(item, k) for item in (self.base.plant, self.base.sensor, self.base.channel))
        propagated = jax.vmap(lambda x: plant.transition(x, u))(cubature_points(*state))
        prior = self.base.predict(state, u, k)
        y = jax.vmap(sensor.measure)(cubature_points(*prior))
        mean, count = y.mean(axis=0), len(y)
        spread = (y - mean).T @ (y - mean) / count + sensor.noise.covariance
        cross = (propagated - prior.mean).T @ (y - mean) / count
        signal = Signal(mean, spread, cross, spread + jnp.outer(mean, mean))
        after = corrected(prior, signal, channel, self.base.update, jnp.asarray(z, dtype=float))
        return after, Estimate(after.mean, after.covariance, self.claim)


def variants(s: Setting, node: int) -> dict[str, AbstractFilter]:
    """The literal readings of one node, all with the scenario's fixed scalars."""
    printed, polytope = (rule(hg.Scalars(*s.beta)) for rule in (LooseInterval, hg.Polytope))
    return {
        "step_four_gain": cubature(s, node, StepFourGain(printed, s.mean_gain**-0.5)),
        "mixed_cross": MixedCross(base=cubature(s, node, polytope), claim="nominal"),
        "central_moment": cubature(s, node, CentralMoment(polytope)),
        "raw_moment": cubature(s, node, RawMoment(polytope)),
    }
