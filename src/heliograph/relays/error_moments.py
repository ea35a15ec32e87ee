"""Exact second moments of a relay network: one linear system with random coefficients.

With e_f = x - s_f for each filter f, eta = (x, e_1, ..., e_F) and what is sent (y, C s_1, ..., C s_relays), one step is
  s_f+ = A s_f + K_f i_f,   i_f = z_f - E[z_f if every estimate were s_f],   z = G sent + n,  (G, n) random.
Every i_f is a known linear map of eta and noises plus (G - E G) sent + n - E n, which is uncorrelated with all of them.
So the moments of (eta+ before corrections, i) follow exactly, and every gain acts on them as a known matrix.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.relays import RelaySteps
from heliograph.numerics.linalg import contract, psd_solve, symmetrize
from heliograph.numerics.types import Array, Bool, Float


class Sent(NamedTuple):
    """W = E (sent, 1)(sent, 1)' and each sender's power E |signal|^2, zero if silent."""

    second: Float[jax.Array, "T+1 T+1"]
    power: Float[jax.Array, "senders"]


class LinearMaps(NamedTuple):
    """Rows over (x, e_1 .. e_F, w, v): eta+ before corrections, innovations, sent signals."""

    moved: Float[jax.Array, "d sources"]
    innovation: Float[jax.Array, "R sources"]
    sent: Float[jax.Array, "T sources"]


def initial_error_moments(covariance: Float[np.ndarray, "n n"], filters: int) -> Float[np.ndarray, "d d"]:
    """Return the covariance of (x, e_1 .. e_F) where every filter starts at the mean: each e_f is x - E x."""
    return np.asarray(np.kron(np.ones((1 + filters, 1 + filters)), covariance))


def linear_maps(step: RelaySteps) -> LinearMaps:
    """Return the deterministic part of one step."""
    (m, n), filters = step.sensing.shape, len(step.received)
    d = (1 + filters) * n
    unit = jnp.eye(d + n + m)
    state, w, v = unit[:d].reshape(1 + filters, n, -1), unit[d : d + n], unit[d + n :]
    moved = jnp.einsum("ab,fbc->fac", step.transition, state) + w
    estimates = state[0] - state[1:]  # s_f = x - e_f
    relayed = jnp.einsum("mn,fnc->fmc", step.sensing, estimates[:-1])
    sent = jnp.concatenate([(step.sensing @ moved[0] + v)[None], relayed]).reshape(-1, d + n + m)
    local_sends = [
        step.sensing @ step.transition,
        *[step.sensing] * (filters - 1),
    ]  # as if each estimate were everybody's
    believed = jnp.stack([jnp.asarray(c) for c in local_sends])
    expects = jnp.asarray(step.gain) @ believed.reshape(
        -1, n
    )  # prediction of each row, as a map of its filter's estimate
    expected = jnp.einsum("rn,rnc->rc", expects, estimates[step.owner])
    return LinearMaps(moved.reshape(d, -1), jnp.asarray(step.gain) @ sent - expected, sent)


def sent_mean(step: RelaySteps) -> Float[jax.Array, "sent"]:
    """Return E (sent, 1): every estimate is unbiased, so it does not depend on the gains."""
    y = step.sensing @ (step.transition @ step.state_mean + step.drift) + step.sensor_offset
    relayed = step.sensing @ step.state_mean
    return jnp.concatenate([y, *[relayed] * (len(step.received) - 1), jnp.ones(1)])


def step_moments(step: RelaySteps, moments: Float[Array, "d d"]) -> tuple[Float[jax.Array, "z z"], Sent]:
    """Return Z = covariance of (eta+ before corrections, innovations), and what is sent, from the covariance of eta.

    d = (1 + F) n, z = d + R.
    """
    maps, mean = linear_maps(step), sent_mean(step)
    sources = jax.scipy.linalg.block_diag(moments, step.process, step.sensor_noise)
    second = jnp.outer(mean, mean).at[:-1, :-1].add(propagate_by_mode(maps.sent, sources, 0.0))
    known = jnp.concatenate([maps.moved, maps.innovation])
    d = maps.moved.shape[0]
    z = propagate_by_mode(known, sources, 0.0).at[d:, d:].add(contract(step.spread, second))
    m = step.sensing.shape[0]
    power = jnp.diagonal(second)[:-1].reshape(-1, m).sum(axis=1) * step.transmits_in_slot
    return z, Sent(second, power)


def correct_moments(z: Float[Array, "z z"], gain: Float[Array, "Fn R"]) -> Float[jax.Array, "z-R z-R"]:
    """Return the covariance of eta+ = eta+ before corrections - (0; K) innovations."""
    rows, received = gain.shape
    d = z.shape[0] - received
    full = jnp.concatenate([jnp.eye(d), jnp.concatenate([jnp.zeros((d - rows, received)), -gain])], axis=1)
    return symmetrize(propagate_by_mode(full, z, 0.0))


def gain_mask(step: RelaySteps) -> Bool[np.ndarray, "Fn R"]:
    """Return True where a gain may differ from zero: each filter uses what it receives itself."""
    n = step.transition.shape[-1]
    return np.asarray(np.repeat(np.arange(len(step.received)), n)[:, None] == step.owner)


ROUNDING = 64 * float(np.finfo(float).eps)  # of what is sent: an innovation of less says nothing


def innovations_above_rounding(predicted: Float[jax.Array, "z z"], step: RelaySteps) -> Float[jax.Array, "R"]:
    """Return 1 for each innovation whose variance is above the rounding of what is sent, 0 for the others.

    Of a relay that receives nothing but itself through a known gain the innovation is zero, computed from large ones.
    """
    n, relays, d = step.transition.shape[-1], len(step.received) - 1, predicted.shape[0] - sum(step.received)
    reach = jnp.sqrt(jnp.maximum(jnp.diagonal(predicted)[:d], 0.0)).reshape(-1, n)  # of x, e_1 .. e_F
    state = reach[0] + jnp.abs(step.state_mean)
    sizes = jnp.concatenate([state[None], state + reach[1 : 1 + relays]]) @ jnp.abs(step.sensing).T
    sent = jnp.append(sizes.ravel(), 1.0)
    known = ROUNDING * jnp.abs(step.gain) @ sent[:-1]
    spread = ROUNDING * jnp.einsum("iiab,a,b->i", jnp.abs(step.spread), sent, sent)
    return jnp.where(jnp.diagonal(predicted)[d:] > known**2 + spread, 1.0, 0.0)


def regression_gain(cross: Float[jax.Array, "n m"], received: Float[jax.Array, "m m"]) -> Float[jax.Array, "n m"]:
    """Return K = Cov(e, i) Cov(i)^-1, which minimises tr Cov(e - K i); zero for what other innovations determine."""
    return psd_solve(received, cross.T).T


def local_gain(predicted: Float[jax.Array, "z z"], step: RelaySteps) -> Float[jax.Array, "Fn R"]:
    """Return K_f = Z_(e_f, i_f) Z_(i_f, i_f)^-1, which minimises each filter's own next tr E e_f e_f'.

    Source: for two alternating relays, filter-and-forward successive relays, Theorems 1 and 2.
    """
    n, received = step.transition.shape[-1], sum(step.received)
    d = predicted.shape[0] - received
    gain, start = jnp.zeros((d - n, received)), 0
    used = step.receives_in_slot * innovations_above_rounding(predicted, step)
    for f, length in enumerate(step.received):
        rows = slice(start, start + length)
        says = used[rows]
        inner = predicted[d:, d:][rows, rows] * says[:, None] * says + jnp.diag(
            1.0 - says
        )  # what says nothing: solve with 1
        cross = predicted[(1 + f) * n : (2 + f) * n, d:][:, rows] * says
        gain = gain.at[f * n : (f + 1) * n, rows].set(regression_gain(cross, inner))
        start += length
    return gain


class Propagated(NamedTuple):
    """Gains, the covariance of eta before and after each step, and the power of each sender."""

    gains: Float[Array, "time Fn R"]
    moments: Float[Array, "time+1 d d"]
    power: Float[Array, "time senders"]


def propagate_slots(
    steps: RelaySteps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"] | None = None
) -> Propagated:
    """Propagate the covariance of eta from `start`, under given gains, or with each filter's own best next error.

    Entries of given gains on rows that receive nothing are not used.
    """

    def single(moments: jax.Array, row: tuple[RelaySteps, jax.Array | None]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        p, gain = row
        z, sent = step_moments(p, moments)
        used = local_gain(z, p) if gain is None else gain * p.receives_in_slot
        after = correct_moments(z, used)
        return after, (used if gain is None else gain, after, sent.power)

    start = jnp.asarray(start)
    items = (steps, None if gains is None else jnp.asarray(gains))
    _, (gains, moments, power) = jax.lax.scan(single, start, items)
    return Propagated(gains, jnp.concatenate([start[None], moments]), power)


DAMPING = 1e-9  # relative, on the change of a gain: decides only what the receiver's error does not


def gain_hessian(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], step: RelaySteps, damping: float
) -> tuple[Float[jax.Array, "r r"], Float[jax.Array, ""]]:
    """Return half the Hessian of tr Lam [I -(0; K)] Z [I -(0; K)]' in the free gains, damped, and the damping.

    Its entry for the gains ab and cd is Lam_ac Z_bd; 1 on the diagonal of a gain that receives nothing. `damping` is
    relative to the mean of the diagonal.
    """
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    free = jnp.asarray(step.receives_in_slot)[columns]
    normal = jnp.asarray(ahead)[n:, n:][np.ix_(rows, rows)] * predicted[d:, d:][np.ix_(columns, columns)]
    normal = normal * free[:, None] * free
    trace = jnp.trace(normal)
    added = jnp.where(trace > 0, damping * trace / len(rows), 1.0)  # 1 where nothing hangs on any gain
    return normal + jnp.diag(jnp.where(free > 0, added, 1.0)), added


def best_gain(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], old: Float[Array, "Fn R"], step: RelaySteps
) -> Float[jax.Array, "Fn R"]:
    """Return argmin over gains K of tr Lam [I -(0; K)] Z [I -(0; K)]', nearly; all filters together.

    (Lam_ee K Z_ii)_ab = (Lam_e. Z_.i)_ab for each free entry ab: a linear system of the size of the gains.
    """
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    normal, damping = gain_hessian(predicted, ahead, step, DAMPING)
    cross = ahead[n:] @ predicted[:d, d:]
    right = (cross[rows, columns] + damping * old[rows, columns]) * step.receives_in_slot[columns]
    return jnp.zeros_like(old).at[rows, columns].set(jnp.linalg.solve(normal, right))


def moment_adjoint(step: RelaySteps, gain: Float[Array, "Fn R"], ahead: Float[Array, "d d"]) -> Float[jax.Array, "d d"]:
    """Return the gradient of <Lam, moments after the step> by the moments before it, the adjoint of the propagation."""
    _, pull = jax.vjp(lambda m: correct_moments(step_moments(step, m)[0], gain), jnp.zeros_like(ahead))
    return symmetrize(pull(ahead)[0])
