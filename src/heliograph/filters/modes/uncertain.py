"""Upper bound behind Markov chains with uncertain, time-varying transition probabilities.

With Pi + Delta_k for Pi, |Delta| <= radius, rows that sum to 0: the error before z is F e + (Delta x A~) zeta + w, so
Sigma- <= (1 + b) F Sigma F' + (1 + 1/b) D + W with D >= sum_i p_i Delta_i Delta_i' x A~ Xi A~' for every such chain.
Terms that depend on the law p of the modes are bounded over the interval of possible p.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.codegen.engine import compiled
from heliograph.filters.base import Step, corrects, predicts
from heliograph.filters.modes.modal import (
    AbstractModalFilter,
    built_of_modes,
    claim_of_modes,
    joined,
    known_part,
    linear_observation,
    measured_about,
    moved_about,
    prior_of_modes,
    without_common,
)
from heliograph.filters.smoother_step.base import AbstractSmootherStep, StepTrace
from heliograph.filters.smoother_step.building import moments_smoother_step
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Innovation
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.lapack import eigh
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import ArrayLike, Bool, Float


class UncertainBelief(NamedTuple):
    """Estimate of zeta, a bound on its error covariance, E[x~ x~'], and bounds on the modes' probabilities.

    x~ = (x - c, 1) with the centre c = E[x], as in `ModalBelief`. `moved` is true from the first
    prediction on.

    Shapes: mean (N,), covariance (N, N), second (n + 1, n + 1), centre (n,), law, low and high (M,).
    """

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    second: Float[jax.Array, "n1 n1"]
    centre: Float[jax.Array, " n"]
    law: Float[jax.Array, " M"]
    low: Float[jax.Array, " M"]
    high: Float[jax.Array, " M"]
    moved: Bool[jax.Array, ""]


class UncertainModalFilter(AbstractModalFilter):
    """A linear filter whose covariance bounds its error's for every chain within the radius of the nominal one.

    Source: the filter of Costa (1994) with Young's inequality for the uncertain part of the chain.
    """

    @compiled
    def init(self) -> UncertainBelief:
        """Return the prior, independent of the mode, whose initial law is known."""
        law, (centre, covariance, second) = jnp.asarray(self.initial), prior_of_modes(at(self.plant, 0), self.initial)
        mean = jnp.kron(law, jnp.append(centre, 1.0))
        return UncertainBelief(mean, covariance, second, centre, law, law, law, jnp.asarray(False))

    @predicts
    def predict(self, state: UncertainBelief, u: ArrayLike = (), k: Step = 0) -> UncertainBelief:
        """Propagate the bound on Sigma-; at the first prediction the mode has its initial law."""
        channel = at(self.channel, k)
        move, noise, centre = moved_about(at(self.plant, k), u, state.centre)
        modes = len(state.law)
        # Bounds on Cov(1{next} | i) and on Delta_i Delta_i', over all laws of the mode.
        rows = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(modes))
        radius = jnp.where(state.moved, jnp.asarray(channel.radius), 0.0)
        carried = move @ state.second @ move.T
        chosen, wandering = _each_row(rows, radius)
        middle, reach = _middle(state.low, state.high)
        # F Sigma F', D, and the bound W on the covariance of the noise.
        step = jnp.kron(rows.T, move)
        known = step @ state.covariance @ step.T
        apart = jnp.kron(_worst(wandering, middle, reach), carried)
        low, high = _bounds(rows, radius, state.low, state.high)
        fresh = jnp.kron(_worst(chosen, middle, reach), carried) + jnp.kron(_worst_diagonal(low, high), noise)
        # Young's inequality, b = root(tr D / tr F Sigma F').
        young = jnp.sqrt(_ratio(jnp.trace(apart), jnp.trace(known)))
        extra = jnp.where(young > 0, apart + apart / jnp.where(young > 0, young, 1.0), 0.0)
        covariance = symmetrize((1 + young) * known + extra + fresh)
        # E[x~ x~'], nominal law and mean one step later.
        after, law = carried + noise, state.law @ rows
        mean = step @ (state.mean - known_part(state.law, state.centre)) + known_part(law, centre)
        return UncertainBelief(mean, covariance, after, centre, law, low, high, jnp.asarray(True))

    @corrects
    def correct(self, state: UncertainBelief, z: ArrayLike, k: Step = 0) -> tuple[UncertainBelief, Innovation]:
        """Correct with z; the covariance of z given zeta is bounded over the laws of the modes."""
        sensor, channel, z = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        gains, (measure, noise) = jnp.asarray(channel.mean), measured_about(sensor, state.centre)
        second = measure @ state.second @ measure.T + noise
        random = jnp.einsum("jmlab,ab->jml", jnp.asarray(channel.spread), second)
        added = _worst(random + gains @ noise @ gains.swapaxes(1, 2), *_middle(state.low, state.high))
        output, common = without_common(gains @ measure, state.law)
        observed = joined(output)
        expected = common + observed @ (state.mean - known_part(state.law, state.centre))
        rounded = self.rounding(gains, jnp.max(random, axis=0), k)
        mean, covariance, innovation = linear_observation(
            state.mean, state.covariance, observed, added, expected, rounded, z
        )
        covariance = self.above_rounding(covariance, state.covariance, state.law)
        return state._replace(mean=mean, covariance=covariance), innovation

    def smoother_step(self, step: StepTrace) -> AbstractSmootherStep:
        """Return the moments of zeta around the update; the filter's bound is not proved for smoothed estimates."""
        before, k = step.before, step.k
        move, _, _ = moved_about(at(self.plant, k), step.u, before.centre)
        rows = jnp.where(before.moved, jnp.asarray(at(self.channel, k).transition), jnp.eye(len(before.law)))
        cross = before.covariance @ jnp.kron(rows.T, move).T
        moments = moments_smoother_step(step.after, step.prior, cross, "nominal")
        return replace(moments, projection=jnp.asarray(self._projection()))


def _ratio(numerator: jax.Array, denominator: jax.Array) -> jax.Array:
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0)


def _each_row(rows: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bounds on Cov(1{next} | i) and on Delta_i Delta_i', for each mode i and every Delta_i.

    Cov = sum_j (pi_j + Delta_j)(e_j - pi)(e_j - pi)' - Delta Delta'; and Delta Delta' <= P diag(r_j sum r) P, with P
    the projection that removes the mean, since Delta = P Delta and |Delta_j Delta_l| <= r_j r_l.
    """
    modes = len(rows)
    apart = jnp.eye(modes)[None] - rows[:, None, :]  # [i, j] = e_j - pi_i
    chosen = jnp.einsum("ij,ija,ijb->iab", rows + radius, apart, apart)
    centred = jnp.eye(modes) - 1 / modes
    sizes = radius * jnp.sum(radius, axis=1, keepdims=True)
    return chosen, jnp.einsum("aj,ij,jb->iab", centred, sizes, centred)


def _middle(low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """A law between the ends (its sum is 1), and the largest deviation of a possible law from it."""
    middle = (low + high) / 2
    middle = middle + (1 - jnp.sum(middle)) / len(low)
    return middle, jnp.maximum(high - middle, middle - low)


def _worst(items: jax.Array, middle: jax.Array, reach: jax.Array) -> jax.Array:
    """Bound on sum_i p_i X_i for all laws p: sum_i middle_i X_i + sum_i reach_i |X_i - mean of all|."""
    values, vectors = jax.vmap(eigh)(items - jnp.mean(items, axis=0))
    sizes = (vectors * jnp.abs(values)[:, None, :]) @ vectors.swapaxes(1, 2)
    return jnp.einsum("i,iab->ab", middle, items) + jnp.einsum("i,iab->ab", reach, sizes)


def _worst_diagonal(low: jax.Array, high: jax.Array) -> jax.Array:
    """Bound on diag(p) for all laws p, tight in the direction of x, which is that of equal entries.

    delta = p - middle sums to 0, so with u = (1, ..., 1) / root M and P = I - u u':
    diag(delta) = P diag(delta) P + u d' + d u' with d = delta / root M, and u d' + d u' <= e u u' + d d' / e.
    P diag(delta) P is 0 for two modes.
    """
    modes, (middle, reach) = len(low), _middle(low, high)
    centred, total = jnp.eye(modes) - 1 / modes, jnp.sum(reach)
    share = total / modes / 2
    safe = jnp.where(share > 0, share, 1.0)
    across = centred @ jnp.diag(reach * total) @ centred / (safe * modes)
    within = centred @ jnp.diag(reach) @ centred if modes > 2 else jnp.zeros((modes, modes))
    return jnp.diag(middle) + share / modes * jnp.ones((modes, modes)) + across + within


def _bounds(rows: jax.Array, radius: jax.Array, low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Bounds on every mode's next probability, over the laws between `low` and `high`."""
    least, most = jnp.clip(rows - radius, 0.0, 1.0), jnp.clip(rows + radius, 0.0, 1.0)
    return -jax.vmap(_largest, (1, None, None))(-least, low, high), jax.vmap(_largest, (1, None, None))(most, low, high)


def _largest(payoff: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """max p payoff over low <= p <= high, sum p = 1: the remaining mass goes to the largest payoffs first."""
    number = jnp.arange(len(payoff))
    earlier = (payoff[:, None] > payoff) | ((payoff[:, None] == payoff) & (number[:, None] < number))
    room = high - low
    given = jnp.clip(1 - jnp.sum(low) - room @ earlier, 0.0, room)
    return (low + given) @ payoff


def uncertain_modal_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> UncertainModalFilter:
    """Build the filter behind a channel with an uncertain chain; `linear_filter` has checked that the parts fit."""
    claim: Claim = "upper" if claim_of_modes(channel) == "exact" else "nominal"
    return built_of_modes(UncertainModalFilter, plant, sensor, channel, claim)
