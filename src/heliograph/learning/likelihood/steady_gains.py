"""Innovations of a linear filter over complete data, with derivatives: gains to their steady state, means in chunks.

Where nothing varies over time the covariance follows a recursion without data, which converges; from there on gain
and innovation covariance are constant. Given the gains the mean is linear in its start and in the data, so that time
is cut into chunks that run in parallel, each from every unit vector and from zero, and are joined afterwards: about
2 sqrt(T) steps in a row in place of T.
"""

from collections.abc import Callable
from math import isqrt
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.filters.linear.linear import LinearBelief, LinearFilter
from heliograph.filters.linear.plan import Plan, followed
from heliograph.numerics.linalg import times
from heliograph.numerics.types import Array, Float, PyTree

PART = 1 / 20  # of all steps, within which gains have to become constant, or nothing is gained
FEWEST = 100  # the same where that is fewer
STILL = 4e-15  # of a variance: a step that changes moments by less changes them by rounding alone


class Innovations(NamedTuple):
    """Innovations z - E z, and their covariances.

    Shapes: value (recordings, steps, m), covariance (steps, m, m).
    """

    value: Float[jax.Array, "recordings steps m"]
    covariance: Float[jax.Array, "steps m m"]


class Gains(NamedTuple):
    """Matrices of a step, and gains (steps, n, m) and innovation covariances (steps, m, m) of all."""

    plan: Plan
    gain: jax.Array
    covariance: jax.Array


class _SteadyIteration(NamedTuple):
    """Iteration's state, matrices, moments that have to converge, and gains so far, with derivatives (p, ...)."""

    step: jax.Array
    moving: jax.Array
    state: PyTree
    plan: PyTree
    watched: PyTree
    filled: PyTree


def innovations(
    item: LinearFilter, slopes: PyTree, z: Float[Array, "recordings steps m"], random: bool
) -> tuple[Innovations, Innovations, jax.Array]:
    """Innovations of a filter without inputs of which nothing varies over time, with their derivatives (p, ...).

    The third result says whether the gains reached their steady state in time; the others are wrong if not.

    Args:
        item: the filter.
        slopes: derivatives of its arrays, None for what is no array.
        z: measurements (recordings, steps, m), complete.
        random: true if gains of the channel are random: the filter's gains then depend on the state's second moment.
            Where they are known that moment may grow without end.
    """
    gains, gain_slopes, converged = _gains(item, slopes, z.shape[1], random)

    def observe(filter: LinearFilter, gains: Gains) -> Innovations:
        return Innovations(in_chunks(gains.plan, gains.gain, filter.init().mean, z), gains.covariance)

    return *_along(observe, (item, gains), (slopes, gain_slopes)), converged


def _along(function: Callable[..., object], primals: tuple[PyTree, ...], slopes: tuple[PyTree, ...]) -> PyTree:
    """Value and derivatives of a function in all directions at once."""
    return eqx.filter_vmap(lambda *along: eqx.filter_jvp(function, primals, along), out_axes=(None, 0))(*slopes)


def _gains(item: LinearFilter, slopes: PyTree, steps: int, random: bool) -> tuple[Gains, Gains, jax.Array]:
    """Gains step by step until the moments converge, constant from there on; and whether they did in time."""
    quiet, limit = jnp.zeros(item.received), min(steps, max(int(PART * steps), FEWEST))

    def one_step(filter: LinearFilter, state: LinearBelief) -> tuple[LinearBelief, Plan, list[jax.Array]]:
        plan, prior, after = followed(filter, state, quiet, jnp.zeros(0), 0)
        return after, plan, _moments(prior, random)

    def further(state: PyTree) -> tuple[PyTree, ...]:
        values, derivatives = _along(one_step, (item, state[0]), (slopes, state[1]))
        return tuple(zip(values, derivatives, strict=True))

    def body(now: _SteadyIteration) -> _SteadyIteration:
        state, plan, watched = further(now.state)
        filled = [every.at[now.step].set(single) for every, single in zip(now.filled, _varying(plan), strict=True)]
        return _SteadyIteration(now.step + 1, ~_still(now.watched, watched), state, plan, watched, filled)

    # iterate until a step changes the moments by rounding alone, or the limit is reached
    start = _along(lambda local: jax.tree.map(jnp.asarray, local.init()), (item,), (slopes,))
    shapes = jax.eval_shape(further, start)
    _, plan, watched = jax.tree.map(lambda single: jnp.full(single.shape, jnp.nan, single.dtype), shapes)
    filled = [jnp.zeros((limit, *single.shape)) for single in _varying(plan)]
    begin = _SteadyIteration(jnp.asarray(0), jnp.asarray(True), start, plan, watched, filled)
    end = jax.lax.while_loop(lambda now: now.moving & (now.step < limit), body, begin)
    # the last gains stand for all later steps
    done = jnp.arange(limit) < end.step
    over_time = []
    for every, last in zip(end.filled, _varying(end.plan), strict=True):
        first = jnp.where(jnp.expand_dims(done, range(1, every.ndim)), every, last)
        over_time.append(jnp.concatenate([first, jnp.broadcast_to(last, (steps - limit, *last.shape))]))
    values, slopes = over_time[:2], [jnp.moveaxis(single, 0, 1) for single in over_time[2:]]
    return Gains(end.plan[0], *values), Gains(end.plan[1], *slopes), ~end.moving | (limit == steps)


def _varying(plan: tuple[Plan, Plan]) -> list[jax.Array]:
    """Gain and innovation covariance, and their derivatives."""
    return [part for item in plan for part in (item.gain, item.innovation)]


def _moments(prior: LinearBelief, random: bool) -> list[jax.Array]:
    """Second moments on which later gains depend, as predicted: after a precise measurement rounding shows."""
    local = prior.state_covariance + prior.state_mean[:, None] * prior.state_mean
    return [prior.covariance, local] if random else [prior.covariance]


def _still(before: tuple[PyTree, PyTree], after: tuple[PyTree, PyTree]) -> jax.Array:
    """Decide whether a step changed moments (n, n) and derivatives (p, n, n) by rounding alone, in any units."""
    result = jnp.asarray(True)
    for old, old_slope, new, new_slope in zip(*before, *after, strict=True):
        every = jnp.concatenate([new[None], new_slope])
        change = every - jnp.concatenate([old[None], old_slope])
        local = jnp.max(jnp.abs(jnp.diagonal(every, axis1=1, axis2=2)), axis=0)
        result = result & jnp.all(jnp.abs(change) <= STILL * jnp.sqrt(local[:, None] * local))
    return result


def in_chunks(
    plan: Plan, gain: Float[jax.Array, "steps n m"], start: Float[Array, " n"], z: Float[Array, "recordings steps m"]
) -> Float[jax.Array, "recordings steps m"]:
    """Innovations for m- = F m + f, m = m- + K_k (z_k - C m- - c), in chunks of time.

    Chunk j starts at X = (I, 0 ... 0), a column for each recording behind the unit vectors, and ends at (Phi_j, b_j):
    the mean at its start is s_(j+1) = Phi_j s_j + b_j, and its innovations are E_0 + E_I s_j.
    """
    r, steps, m = z.shape
    n = len(start)
    chunks = isqrt(steps - 1) + 1
    length = -(-steps // chunks)
    received = _cut(jnp.transpose(jnp.asarray(z), (1, 2, 0)), chunks, length)  # (length, m, recordings, chunks)
    gains = _cut(gain, chunks, length)
    # all chunks in parallel, from the unit vectors and from zero
    unit = jnp.broadcast_to(jnp.eye(n, n + r)[..., None], (n, n + r, chunks))
    drift, offset = (jnp.pad(jnp.tile(b[:, None], r), ((0, 0), (n, 0)))[..., None] for b in (plan.drift, plan.offset))
    move, output = plan.transition[..., None], plan.output[..., None]

    def step(x: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        gain, z = row
        prior = times(move, x) + drift
        missed = jnp.pad(z, ((0, 0), (n, 0), (0, 0))) - offset - times(output, prior)
        return prior + times(gain, missed), missed

    ends, missed = jax.lax.scan(step, unit, (gains, received))

    # s_(j+1) = Phi_j s_j + b_j from chunk to chunk
    def join(s: jax.Array, end: jax.Array) -> tuple[jax.Array, jax.Array]:
        return end[:, :n] @ s + end[:, n:], s

    starts = jax.lax.scan(join, jnp.tile(start[:, None], r), jnp.moveaxis(ends, -1, 0))[1]
    result = missed[:, :, n:] + jnp.einsum("kmnc,cnr->kmrc", missed[:, :, :n], starts)
    return jnp.transpose(result, (2, 3, 0, 1)).reshape(r, chunks * length, m)[:, :steps]


def _cut(x: jax.Array, chunks: int, length: int) -> jax.Array:
    """(steps, ...) as (length, ..., chunks), with zeros behind the end."""
    full = jnp.pad(x, [(0, chunks * length - len(x)), *[(0, 0)] * (x.ndim - 1)])
    return jnp.moveaxis(full.reshape(chunks, length, *x.shape[1:]), 0, -1)
