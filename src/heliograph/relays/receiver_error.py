"""Relays and receiver tuned together, over a horizon, so that the receiver's error is small; power may be bounded."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RelayNetwork, Steps
from heliograph.numerics.check import array, check_count, fail, instance, per_step
from heliograph.numerics.float64 import compiled
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.types import Array, ArrayLike, Float, Int
from heliograph.relays.design import (
    RelayDesign,
    given_design,
    join_gains,
    receiver_weight,
    split_gains,
    start_moments,
)
from heliograph.relays.own_error import own_error_design
from heliograph.relays.second_moments import correct, gain_mask, step_moments

DAMPING = 1e-9  # relative, on the change of a gain: decides only what the receiver's error does not
POWER_TOLERANCE = 1e-6  # relative excess over a limit that counts as met
TINY = float(np.finfo(np.float64).tiny)
BISECTIONS = 40  # halvings of a multiplier's logarithm over 18 decades


class PowerLimit(NamedTuple):
    """Each step's gains must keep <form_k, moments after the step> within limit_k: the power of the next step."""

    form: Float[Array, "*time d d"]
    limit: Float[Array, "*time"]


def receiver_error_design(
    network: RelayNetwork,
    horizon: int,
    weights: ArrayLike | None = None,
    power_limit: ArrayLike | None = None,
    sweeps: int = 200,
) -> RelayDesign:
    """Gains of relays and receiver that together make sum_k weight_k tr P_k small, P_k the receiver's error covariance.

    The cost is quadratic in the gains of one step while the others stay: tr Lam_k [I -K] Z_k [I -K]', with moments Z
    from the steps before and the gradient Lam of the cost to come. A sweep goes backward and then forward and
    minimises exactly at each step, so the cost never rises; it starts from `own_error_design`. The result is a local
    minimum, so an upper bound on the best.

    `weights` (horizon,), by default those that give the mean of tr P_k / tr P_k(own-error design). `power_limit`, a
    number or (horizon,): bound on the power that all relays send at each step, in squared units of the sensor. It can't
    be less than the power of the mean state, which every unbiased estimate sends. Only sweeps that meet the limit at
    every step are kept, and none may: the own-error design stays the result then. Over a hundred steps near that
    design's own power it hangs on rounding whether a better one is found; over forty it is.

    Raises:
        ValueError: weights or limits of the wrong shape, negative weights, no sweeps, a limit that was not met.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    check_count("sweeps", sweeps)
    own = own_error_design(network, horizon)
    weights = 1 / (horizon * own.trace("receiver")[1:]) if weights is None else array("weights", weights, (horizon,))
    if np.any(weights < 0) or sweeps < 1:
        raise fail("weights and sweeps", "no negative weight and at least one sweep", f"{np.min(weights):g}, {sweeps}")
    steps, start = network.steps(horizon), start_moments(network)
    cost = receiver_weight(weights, len(network.filters), len(network.states))
    first = join_gains(network, own.gains)
    limit = _limit(steps, own, power_limit)
    gains, best = _sweeps(steps, start, cost, limit, first, np.arange(sweeps))
    if not np.isfinite(best):
        raise fail("power limit", "one that some design meets", "one for which none was found")
    return given_design(network, split_gains(network, np.asarray(gains)))


def _limit(steps: Steps, own: RelayDesign, power_limit: ArrayLike | None) -> PowerLimit | None:
    """Limits on the moments after each step; the last step's gains send nothing."""
    if power_limit is None:
        return None
    horizon, d = len(steps.live), own.moments.shape[-1]
    value = per_step("power limit", power_limit, horizon)
    mean_signal = np.sum((steps.sensing @ steps.state_mean[..., None]) ** 2, axis=(1, 2))
    fixed = mean_signal * steps.talks[:, 1:].sum(axis=1)  # estimates are unbiased: E s = E x
    low = np.flatnonzero(value < fixed * (1 - POWER_TOLERANCE))
    if len(low):
        step, least = int(low[0]), float(fixed[low[0]])
        raise fail("power limit", f"at least {least:.6g} at step {step}, the power of the mean state", value[step])
    forms = power_forms(steps, d)
    return PowerLimit(np.concatenate([forms[1:], np.zeros((1, d, d))]), np.append((value - fixed)[1:], 1.0))


def power_forms(steps: Steps, d: int) -> Float[np.ndarray, "time {d} {d}"]:
    """Matrices with <form_k, moments before step k> = sum over talking relays of tr Cov(C s_r)."""
    time, n = steps.state_mean.shape
    forms = np.zeros((time, d, d))
    for r in range(len(steps.received) - 1):
        s = np.zeros((n, d))
        s[:, :n], s[:, (1 + r) * n : (2 + r) * n] = np.eye(n), -np.eye(n)  # s_r = x - e_r
        sent = steps.sensing @ s
        forms += np.swapaxes(sent, 1, 2) @ sent * steps.talks[:, 1 + r, None, None]
    return forms


def best_gain(
    z: Float[Array, "z z"], ahead: Float[Array, "d d"], old: Float[Array, "Fn R"], p: Steps
) -> Float[jax.Array, "Fn R"]:
    """argmin over gains K of tr Lam [I -(0; K)] Z [I -(0; K)]', nearly; all filters together.

    (Lam_ee K Z_ii)_ab = (Lam_e. Z_.i)_ab for each free entry ab: a linear system of the size of the gains.
    """
    rows, columns = np.nonzero(gain_mask(p))
    n, d = p.transition.shape[-1], ahead.shape[0]
    inner, cross = z[d:, d:], ahead[n:] @ z[:d, d:]
    normal = ahead[n:, n:][np.ix_(rows, rows)] * inner[np.ix_(columns, columns)]
    free = p.live[columns]
    normal = normal * free[:, None] * free
    damping = DAMPING * jnp.trace(normal) / len(rows)
    normal = normal + jnp.diag(jnp.where(free > 0, damping, 1.0))
    right = (cross[rows, columns] + damping * old[rows, columns]) * free
    return jnp.zeros_like(old).at[rows, columns].set(jnp.linalg.solve(normal, right))


def pull_back(p: Steps, gain: Float[Array, "Fn R"], ahead: Float[Array, "d d"]) -> Float[jax.Array, "d d"]:
    """Gradient of <Lam, moments after the step> with respect to the moments before it (an affine map)."""
    _, pull = jax.vjp(lambda m: correct(step_moments(p, m)[0], gain), jnp.zeros_like(ahead))
    return symmetrize(pull(ahead)[0])


def _bounded_gain(z: jax.Array, ahead: jax.Array, old: jax.Array, p: Steps, limit: PowerLimit) -> jax.Array:
    """`best_gain` within a power limit: the cost is convex in one step's gains, so bisect for the multiplier."""
    scale = jnp.trace(ahead) / jnp.maximum(jnp.trace(limit.form), TINY)

    def gain(multiplier: jax.Array) -> jax.Array:
        weight: jax.Array = ahead + multiplier * limit.form
        return best_gain(z, weight, old, p)

    def over(multiplier: jax.Array) -> jax.Array:
        power: jax.Array = jnp.sum(limit.form * correct(z, gain(multiplier)))
        return jnp.greater(power, limit.limit)

    def halve(_: Array, ends: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        low, high = ends
        middle = (low + high) / 2
        more = over(scale * jnp.exp(middle))
        return jnp.where(more, middle, low), jnp.where(more, high, middle)

    ends = jnp.log(jnp.asarray(1e-9)), jnp.log(jnp.asarray(1e9))
    _, high = jax.lax.fori_loop(0, BISECTIONS, halve, ends)
    multiplier = jnp.where(over(jnp.zeros(())), scale * jnp.exp(high), 0.0)
    return gain(multiplier)


class Search(NamedTuple):
    """Gains and power multipliers of the sweep, and the best gains that meet the limit with their cost."""

    gains: Float[jax.Array, "time Fn R"]
    multipliers: Float[jax.Array, "time"]
    best: Float[jax.Array, "time Fn R"]
    cost: Float[jax.Array, ""]


def _backward(
    steps: Steps, start: Array, cost: Float[Array, "time d d"], limit: PowerLimit | None, search: Search
) -> Float[jax.Array, "time d d"]:
    """Gradient of cost plus multipliers times power with respect to the moments after each step, gains improved."""

    def ahead_of(moments: jax.Array, item: tuple[Steps, jax.Array]) -> tuple[jax.Array, jax.Array]:
        p, gain = item
        z, _ = step_moments(p, moments)
        return correct(z, gain), z

    def back(ahead: jax.Array, item: tuple[Steps, jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        p, gain, z_k, cost_k = item
        ahead = ahead + cost_k
        return pull_back(p, best_gain(z_k, ahead, gain, p), ahead), ahead

    slope = jnp.asarray(cost)
    if limit is not None:
        slope = slope + search.multipliers[:, None, None] * limit.form
    _, z = jax.lax.scan(ahead_of, jnp.asarray(start), (steps, search.gains))
    return jax.lax.scan(back, jnp.zeros_like(start), (steps, search.gains, z, slope), reverse=True)[1]


def _forward(
    steps: Steps, start: Array, limit: PowerLimit | None, gains: Array, ahead: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Best gains step by step, within the limit if there is one, and the moments after each step."""

    def one(
        moments: jax.Array, item: tuple[Steps, jax.Array, jax.Array, PowerLimit | None]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        p, gain, ahead_k, limit_k = item
        z, _ = step_moments(p, moments)
        gain = best_gain(z, ahead_k, gain, p) if limit_k is None else _bounded_gain(z, ahead_k, gain, p, limit_k)
        after = correct(z, gain)
        return after, (gain, after)

    return jax.lax.scan(one, jnp.asarray(start), (steps, jnp.asarray(gains), ahead, limit))[1]


@compiled
def _sweeps(
    steps: Steps,
    start: Float[Array, "d d"],
    cost: Float[Array, "time d d"],
    limit: PowerLimit | None,
    own: Float[Array, "time Fn R"],
    count: Int[Array, "sweeps"],
) -> tuple[Float[Array, "time Fn R"], Float[Array, ""]]:
    """Sweeps from the own-error gains: the best gains that meet the limit and their cost, infinite if there are none.

    With a limit, every sweep ends with a second forward pass that enforces it step by step, so that a design is kept
    while the multipliers, mu_k <- mu_k (power_k / limit_k)^2, still settle.
    """
    form, bound = (jnp.zeros_like(cost), jnp.ones(len(cost))) if limit is None else limit

    def keep(search: Search, gains: jax.Array, moments: jax.Array) -> Search:
        value, power = jnp.sum(cost * moments), jnp.sum(form * moments, axis=(1, 2))
        better = (value < search.cost) & jnp.all(power <= bound * (1 + POWER_TOLERANCE))
        return search._replace(best=jnp.where(better, gains, search.best), cost=jnp.where(better, value, search.cost))

    def sweep(search: Search, _: jax.Array) -> tuple[Search, None]:
        ahead = _backward(steps, start, cost, limit, search)
        gains, moments = _forward(steps, start, None, search.gains, ahead)
        excess = jnp.sum(form * moments, axis=(1, 2)) / bound
        factor = jnp.clip(excess**2, 0.5, 2.0)
        multipliers = jnp.clip(search.multipliers * factor, 1e-7 * initial, 1e8 * initial)
        kept = (gains, moments) if limit is None else _forward(steps, start, limit, gains, ahead)
        return keep(search._replace(gains=gains, multipliers=multipliers), *kept), None

    def given(moments: jax.Array, item: tuple[Steps, jax.Array]) -> tuple[jax.Array, jax.Array]:
        p, gain = item
        after = correct(step_moments(p, moments)[0], gain)
        return after, after

    first = jnp.asarray(own)
    _, moments = jax.lax.scan(given, jnp.asarray(start), (steps, first))
    initial = 1e-2 * jnp.sum(cost * moments) / (bound * len(cost))
    search = keep(Search(first, initial, first, jnp.asarray(jnp.inf)), first, moments)
    search, _ = jax.lax.scan(sweep, search, jnp.asarray(count))
    return search.best, search.cost
