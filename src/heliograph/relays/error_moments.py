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


class SentMoments(NamedTuple):
    """W = E (sent, 1)(sent, 1)' and each sender's power E |signal|^2, zero if silent."""

    second: Float[jax.Array, "T+1 T+1"]
    power: Float[jax.Array, "senders"]


class ErrorStepMaps(NamedTuple):
    """Matrices that give, from (x, e_1 .. e_F, w, v), what one step makes of the state and the F filters' errors.

    moved: eta+ = (x+, e_1+ .. e_F+) before corrections; innovation: the filters' innovations; sent: the signals sent.
    """

    moved: Float[jax.Array, "d sources"]
    innovation: Float[jax.Array, "R sources"]
    sent: Float[jax.Array, "T sources"]


def initial_error_moments(covariance: Float[np.ndarray, "n n"], filters: int) -> Float[np.ndarray, "d d"]:
    """Return the covariance of (x, e_1 .. e_F) where every filter starts at the mean: each e_f is x - E x."""
    return np.asarray(np.kron(np.ones((1 + filters, 1 + filters)), covariance))


def make_error_step_maps(step: RelaySteps) -> ErrorStepMaps:
    """Return the matrices of one step, with the means E G in place of random gains."""
    (m, n), filters = step.sensing.shape, len(step.received)
    d = (1 + filters) * n
    # Rows that select x, e_1 .. e_F, and the noises w and v.
    unit = jnp.eye(d + n + m)
    state, w, v = unit[:d].reshape(1 + filters, n, -1), unit[d : d + n], unit[d + n :]
    moved = jnp.einsum("ab,fbc->fac", step.transition, state) + w
    # The sensor sends y = C x+ + v, relays C s_f of their estimates before the step, s_f = x - e_f.
    estimates = state[0] - state[1:]
    relayed = jnp.einsum("mn,fnc->fmc", step.sensing, estimates[:-1])
    sent = jnp.concatenate([(step.sensing @ moved[0] + v)[None], relayed]).reshape(-1, d + n + m)
    # What would be sent if the estimate s of a filter were everybody's: C A s by the sensor, C s by each relay. Its
    # prediction of a received row is a map of the estimate of the filter that owns the row.
    senders = [step.sensing @ step.transition, *[step.sensing] * (filters - 1)]
    sent_of_estimate = jnp.stack([jnp.asarray(c) for c in senders]).reshape(-1, n)
    prediction = jnp.asarray(step.gain) @ sent_of_estimate
    predicted = jnp.einsum("rn,rnc->rc", prediction, estimates[step.owner])
    return ErrorStepMaps(moved=moved.reshape(d, -1), innovation=jnp.asarray(step.gain) @ sent - predicted, sent=sent)


def sent_mean(step: RelaySteps) -> Float[jax.Array, "sent"]:
    """Return the mean of (y, C s_1, ..., C s_relays, 1): what the sensor and the relays send, and the constant 1.

    y = C x+ + v is measured after the step, s_r are the relays' estimates before it. Each is unbiased, so the mean is
    that of C x whatever the gains are.
    """
    mean_of_y = step.sensing @ (step.transition @ step.state_mean + step.drift) + step.sensor_offset
    mean_of_each_relay, relays = step.sensing @ step.state_mean, len(step.received) - 1
    return jnp.concatenate([mean_of_y, *[mean_of_each_relay] * relays, jnp.ones(1)])


def step_moments(step: RelaySteps, moments: Float[Array, "d d"]) -> tuple[Float[jax.Array, "z z"], SentMoments]:
    """Return Z = covariance of (eta+ before corrections, innovations), and what is sent, from the covariance of eta.

    eta = (x, e_1 .. e_F) holds the state and the errors of F filters, which receive R numbers. eta+ is eta after the
    step. The sizes are d = (1 + F) n and z = d + R.
    """
    maps, mean = make_error_step_maps(step), sent_mean(step)
    # Second moments of what is sent, from the covariance of (x, e_1 .. e_F, w, v).
    sources = jax.scipy.linalg.block_diag(moments, step.process, step.sensor_noise)
    second = jnp.outer(mean, mean).at[:-1, :-1].add(propagate_by_mode(maps.sent, sources, 0.0))
    # Z: of the known linear maps, and of innovations what the gains' spread makes of what is sent.
    linear = jnp.concatenate([maps.moved, maps.innovation])
    d = maps.moved.shape[0]
    z = propagate_by_mode(linear, sources, 0.0).at[d:, d:].add(contract(step.spread, second))
    m = step.sensing.shape[0]
    power = jnp.diagonal(second)[:-1].reshape(-1, m).sum(axis=1) * step.transmits_in_slot
    return z, SentMoments(second, power)


def correct_moments(z: Float[Array, "z z"], gain: Float[Array, "Fn R"]) -> Float[jax.Array, "z-R z-R"]:
    """Return the covariance of eta+ = eta+ before corrections - (0; K) innovations, with K the `gain`.

    eta = (x, e_1 .. e_F) holds the state and the filters' errors. Only the errors are corrected. `z` is the covariance
    of (eta+ before corrections, innovations).
    """
    rows, received = gain.shape
    d = z.shape[0] - received
    identity, zeros_for_x = jnp.eye(d), jnp.zeros((d - rows, received))
    correction = jnp.concatenate([identity, jnp.concatenate([zeros_for_x, -gain])], axis=1)  # [I, -(0; K)]
    return symmetrize(propagate_by_mode(correction, z, 0.0))


def gain_mask(step: RelaySteps) -> Bool[np.ndarray, "Fn R"]:
    """Return True where a gain may differ from zero: each filter uses what it receives itself."""
    n = step.transition.shape[-1]
    return np.asarray(np.repeat(np.arange(len(step.received)), n)[:, None] == step.owner)


ROUNDING = 64 * float(np.finfo(float).eps)  # of what is sent: an innovation of less says nothing


def innovations_above_rounding(predicted: Float[jax.Array, "z z"], step: RelaySteps) -> Float[jax.Array, "R"]:
    """Return 1 for each innovation whose variance is above the rounding of what is sent, 0 for the others.

    A relay that receives nothing but itself through a known gain has the innovation zero. It is a difference of large
    numbers, so that only their rounding is left. `predicted` is the covariance of (x, e_1 .. e_F, innovations).
    ROUNDING is a few units in the last place.
    """
    n, relays, d = step.transition.shape[-1], len(step.received) - 1, predicted.shape[0] - sum(step.received)
    # Sizes of what is sent: |C| (deviation + |mean|) of x by the sensor, and of s_f = x - e_f by each relay.
    deviations = jnp.sqrt(jnp.maximum(jnp.diagonal(predicted)[:d], 0.0)).reshape(-1, n)  # of x, e_1 .. e_F
    state = deviations[0] + jnp.abs(step.state_mean)
    sizes = jnp.concatenate([state[None], state + deviations[1 : 1 + relays]]) @ jnp.abs(step.sensing).T
    sent = jnp.append(sizes.ravel(), 1.0)
    # Rounding of an innovation by the mean gains, and of its variance by their spread.
    by_mean = ROUNDING * jnp.abs(step.gain) @ sent[:-1]
    by_spread = ROUNDING * jnp.einsum("iiab,a,b->i", jnp.abs(step.spread), sent, sent)
    return jnp.where(jnp.diagonal(predicted)[d:] > by_mean**2 + by_spread, 1.0, 0.0)


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
    informative = step.receives_in_slot * innovations_above_rounding(predicted, step)
    for f, length in enumerate(step.received):
        rows = slice(start, start + length)
        used = informative[rows]
        # An innovation that tells nothing has the covariance 0 with all others and the variance 1: its gain is 0.
        inner = predicted[d:, d:][rows, rows] * used[:, None] * used + jnp.diag(1.0 - used)
        cross = predicted[(1 + f) * n : (2 + f) * n, d:][:, rows] * used
        gain = gain.at[f * n : (f + 1) * n, rows].set(regression_gain(cross, inner))
        start += length
    return gain


class PropagatedMoments(NamedTuple):
    """Gains, the covariance of eta before and after each step, and the power of each sender."""

    gains: Float[Array, "time Fn R"]
    moments: Float[Array, "time+1 d d"]
    power: Float[Array, "time senders"]


def propagate_error_moments(
    steps: RelaySteps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"] | None = None
) -> PropagatedMoments:
    """Propagate the covariance of eta = (x, e_1 ... e_F) over the steps; return it with gains and powers over time.

    Args:
        steps: of the network.
        start: the covariance before the first step.
        gains: K of all filters as one block matrix for each step, whose entries on rows that receive nothing are not
            used; those of `local_gain` if None.
    """

    def move(moments: jax.Array, row: tuple[RelaySteps, jax.Array | None]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Return the moments after a step, to go on with; and its gains, these moments and the senders' powers.

        Where `gain` is None, each filter gets the gain that minimises its own error at this step.
        """
        step, gain = row
        uncorrected, sent = step_moments(step, moments)
        used = local_gain(uncorrected, step) if gain is None else gain * step.receives_in_slot
        corrected = correct_moments(uncorrected, used)
        return corrected, (used if gain is None else gain, corrected, sent.power)

    start = jnp.asarray(start)
    items = (steps, None if gains is None else jnp.asarray(gains))
    _, (gains, moments, power) = jax.lax.scan(move, start, items)
    return PropagatedMoments(gains, jnp.concatenate([start[None], moments]), power)


DAMPING = 1e-9  # relative, on the change of a gain: decides only what the receiver's error does not


def gain_hessian(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], step: RelaySteps, damping: float
) -> tuple[Float[jax.Array, "r r"], Float[jax.Array, ""]]:
    """Return half the Hessian of tr Lam [I -(0; K)] Z [I -(0; K)]' in the free gains, damped, and what was added.

    Z: `predicted` moments (eta+ before corrections, innovations). Lam: `ahead`, the gradient of the cost of later steps
    by the moments after this one. Gains on what a filter receives are free. The entry for the gains ab and cd is
    Lam_ac Z_bd. A gain on a number that does not arrive in this slot has 1 on the diagonal, and 0 elsewhere.
    `damping` is relative to the mean of the diagonal.
    """
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    is_free = jnp.asarray(step.receives_in_slot)[columns]
    hessian = jnp.asarray(ahead)[n:, n:][np.ix_(rows, rows)] * predicted[d:, d:][np.ix_(columns, columns)]
    hessian = hessian * is_free[:, None] * is_free
    trace = jnp.trace(hessian)
    added = jnp.where(trace > 0, damping * trace / len(rows), 1.0)  # 1 where nothing hangs on any gain
    return hessian + jnp.diag(jnp.where(is_free > 0, added, 1.0)), added


def minimise_cost_ahead(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], old: Float[Array, "Fn R"], step: RelaySteps
) -> Float[jax.Array, "Fn R"]:
    """Return the gains K of all filters that minimise the cost of later steps, tr Lam [I -(0; K)] Z [I -(0; K)]'.

    Z and Lam are those of `gain_hessian`. The free entries ab of K solve (Lam_ee K Z_ii)_ab = (Lam_e. Z_.i)_ab, where e
    stands for the errors and i for the innovations. A little damping towards the gains `old` decides entries on which
    the cost does not depend.
    """
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    hessian, damping = gain_hessian(predicted, ahead, step, DAMPING)
    cross = ahead[n:] @ predicted[:d, d:]
    right_side = (cross[rows, columns] + damping * old[rows, columns]) * step.receives_in_slot[columns]
    return jnp.zeros_like(old).at[rows, columns].set(jnp.linalg.solve(hessian, right_side))


def moment_adjoint(step: RelaySteps, gain: Float[Array, "Fn R"], ahead: Float[Array, "d d"]) -> Float[jax.Array, "d d"]:
    """Return the gradient of <Lam, moments after the step> by the moments before it; Lam is `ahead`."""
    _, pull_back = jax.vjp(lambda m: correct_moments(step_moments(step, m)[0], gain), jnp.zeros_like(ahead))
    return symmetrize(pull_back(ahead)[0])
