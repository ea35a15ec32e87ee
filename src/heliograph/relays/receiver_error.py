"""Relays and receiver tuned together, over a horizon, so that the receiver's error is small; power may be bounded."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RelayNetwork, Steps
from heliograph.numerics.check import array, check_count, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, ArrayLike, Float, Int
from heliograph.relays.design import (
    RelayDesign,
    given_design,
    join_gains,
    own_error_design,
    receiver_weight,
    split_gains,
    start_moments,
)
from heliograph.relays.power_limit import Limited, best_within, power_limit_of
from heliograph.relays.second_moments import best_gain, correct, propagate, pull_back, step_moments

STEPS = 4  # of a descent within a power limit, for each sweep


def receiver_error_design(
    network: RelayNetwork,
    horizon: int,
    weights: "Float[ArrayLike, ' horizon'] | None" = None,
    power_limit: "Float[ArrayLike, '*horizon'] | None" = None,
    sweeps: int = 200,
) -> RelayDesign:
    """Design gains of relays and receiver that make sum_k weight_k tr P_k small, P_k the receiver's covariance.

    The cost is quadratic in the gains of one step while the others stay: tr Lam_k [I -K] Z_k [I -K]', with moments Z
    from the steps before and the gradient Lam of the cost to come. A sweep goes backward and then forward and
    minimises exactly at each step, so the cost never rises; it starts from `own_error_design`. The result is a local
    minimum, so an upper bound on the best.

    With a power limit the gains of all steps move at once, inside a logarithmic barrier that is lowered bit by bit, in
    four quasi-Newton steps for a sweep; the own-error design stays the result where it meets the limit and is better. A
    limit changed by 1e-14 to 1e-8 changes the remaining error by 0.1 % over the published example's 100 steps.

    Args:
        network: the relay network.
        horizon: number of steps.
        weights: weight_k (horizon,); those that give the mean of tr P_k / tr P_k(own-error design) unless given.
        power_limit: bound on the power that all relays send at each step, a number or (horizon,), in squared units of
            the sensor, met to 1e-6; none unless given. It can't be less than the power of the mean state, which every
            unbiased estimate sends.
        sweeps: number of sweeps, 200 unless given.

    Raises:
        ValueError: weights or limits of the wrong shape, negative weights, no sweeps, a limit that no design meets.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    check_count("sweeps", sweeps)
    design = own_error_design(network, horizon)
    weights = 1 / (horizon * design.trace("receiver")[1:]) if weights is None else array("weights", weights, (horizon,))
    if np.any(weights < 0) or sweeps < 1:
        raise fail("weights and sweeps", "no negative weight and at least one sweep", f"{np.min(weights):g}, {sweeps}")
    steps, start = network.steps(horizon), start_moments(network)
    cost = receiver_weight(weights, len(network.filters), len(network.states))
    first = join_gains(network, design.gains)
    if power_limit is None:
        gains = _sweeps(steps, start, cost, first, np.arange(sweeps))
    else:
        limit = power_limit_of(steps, power_limit, start.shape[0])
        gains = best_within(Limited(steps, start, cost, limit), first, STEPS * sweeps)
    return given_design(network, split_gains(network, np.asarray(gains)))


def _backward(
    steps: Steps, start: Array, cost: Float[Array, "time d d"], gains: jax.Array
) -> Float[jax.Array, "time d d"]:
    """Gradient of the cost with respect to the moments after each step, gains improved."""

    def ahead_of(moments: jax.Array, item: tuple[Steps, jax.Array]) -> tuple[jax.Array, jax.Array]:
        p, gain = item
        z, _ = step_moments(p, moments)
        return correct(z, gain), z

    def back(ahead: jax.Array, item: tuple[Steps, jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        p, gain, z_k, cost_k = item
        ahead = ahead + cost_k
        return pull_back(p, best_gain(z_k, ahead, gain, p), ahead), ahead

    _, z = jax.lax.scan(ahead_of, jnp.asarray(start), (steps, gains))
    items = (steps, gains, z, jnp.asarray(cost))
    return jax.lax.scan(back, jnp.zeros_like(start), items, reverse=True)[1]


def _forward(steps: Steps, start: Array, gains: jax.Array, ahead: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Best gains step by step and the moments after each step."""

    def single(
        moments: jax.Array, item: tuple[Steps, jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        p, gain, ahead_k = item
        z, _ = step_moments(p, moments)
        gain = best_gain(z, ahead_k, gain, p)
        after = correct(z, gain)
        return after, (gain, after)

    return jax.lax.scan(single, jnp.asarray(start), (steps, gains, ahead))[1]


class Search(NamedTuple):
    """Gains of the sweep, and the best gains with their cost: rounding may raise it at the end."""

    gains: Float[jax.Array, "time Fn R"]
    best: Float[jax.Array, "time Fn R"]
    cost: Float[jax.Array, ""]


@compiled
def _sweeps(
    steps: Steps,
    start: Float[Array, "d d"],
    cost: Float[Array, "time d d"],
    local: Float[Array, "time Fn R"],
    count: Int[Array, "sweeps"],
) -> Float[Array, "time Fn R"]:
    """The best gains of sweeps from the own-error gains."""

    def sweep(search: Search, _: jax.Array) -> tuple[Search, None]:
        gains, moments = _forward(steps, start, search.gains, _backward(steps, start, cost, search.gains))
        value = jnp.sum(cost * moments)
        better = value < search.cost
        best = jnp.where(better, gains, search.best)
        return Search(gains, best, jnp.where(better, value, search.cost)), None

    first = jnp.asarray(local)
    value = jnp.sum(cost * propagate(steps, start, first).moments[1:])
    search, _ = jax.lax.scan(sweep, Search(first, first, value), jnp.asarray(count))
    return search.best
