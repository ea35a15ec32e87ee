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
    """W = E (sent, 1)(sent, 1)' of all T sent numbers and the constant 1; each sender's power E |signal|^2, or 0."""

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
    """Return the matrices of one step as maps of (x, e_1 .. e_F, w, v), with the means E G in place of random gains.

    x is the plant's state, e_f = x - s_f the error of filter f (relays first, the receiver last), w the process noise
    and v the sensor's. Each filter has some of the R received numbers: `step.owner` is the filter of each.
    """
    m, n = step.sensing.shape
    filters = len(step.received)
    d = (1 + filters) * n  # numbers in (x, e_1 .. e_F)
    # Rows that select x, e_1 .. e_F, and the noises w and v.
    unit = jnp.eye(d + n + m)
    state, w, v = unit[:d].reshape(1 + filters, n, -1), unit[d : d + n], unit[d + n :]
    # x+ = A x + w, and before corrections e_f+ = A e_f + w.
    moved = jnp.einsum("ab,fbc->fac", step.transition, state) + w
    # The sensor sends y = C x+ + v, each relay C s_f of its estimate s_f = x - e_f before the step.
    estimates = state[0] - state[1:]
    relayed = jnp.einsum("mn,fnc->fmc", step.sensing, estimates[:-1])
    sent = jnp.concatenate([(step.sensing @ moved[0] + v)[None], relayed]).reshape(-1, d + n + m)
    # A filter predicts what it receives as if all others had its estimate s: the sensor sends C A s, each relay C s.
    sent_by_estimate = [step.sensing @ step.transition, *[step.sensing] * (filters - 1)]
    prediction_matrix = jnp.asarray(step.gain) @ jnp.stack([jnp.asarray(c) for c in sent_by_estimate]).reshape(-1, n)
    predicted = jnp.einsum("rn,rnc->rc", prediction_matrix, estimates[step.owner])
    innovation = jnp.asarray(step.gain) @ sent - predicted  # E[G] sent - prediction, constants left out
    return ErrorStepMaps(moved=moved.reshape(d, -1), innovation=innovation, sent=sent)


def sent_mean(step: RelaySteps) -> Float[jax.Array, "sent"]:
    """Return the mean of (y, C s_1, ..., C s_relays, 1): what the sensor and the relays send, and the constant 1.

    y = C x+ + v is measured after the step, s_r are the relays' estimates before it. Each is unbiased, so the mean is
    that of C x whatever the gains are.
    """
    mean_of_y = step.sensing @ (step.transition @ step.state_mean + step.drift) + step.sensor_offset
    mean_of_each_relay = step.sensing @ step.state_mean
    relays = len(step.received) - 1  # the receiver, the last filter, sends nothing
    return jnp.concatenate([mean_of_y, *[mean_of_each_relay] * relays, jnp.ones(1)])


def step_moments(step: RelaySteps, moments: Float[Array, "d d"]) -> tuple[Float[jax.Array, "z z"], SentMoments]:
    """Return Z = Cov (eta+ before corrections, innovations), and second moments of what is sent, from Cov eta.

    eta = (x, e_1 .. e_F) holds the state x (n,) and the errors of F filters, which receive R numbers; eta+ is eta after
    the step. `moments` is Cov eta (d, d) with d = (1 + F) n, and Z is (d + R, d + R).
    """
    maps, mean = make_error_step_maps(step), sent_mean(step)
    # eta+, innovations and what is sent are linear maps of (x, e_1 .. e_F, w, v), of this covariance.
    sources = jax.scipy.linalg.block_diag(moments, step.process, step.sensor_noise)
    # E (sent, 1)(sent, 1)' = mean mean' + Cov sent; the last row and column are for the constant 1.
    second = jnp.outer(mean, mean).at[:-1, :-1].add(propagate_by_mode(maps.sent, sources, 0.0))
    # Random gains G add (G - E G) sent + n - E n to the innovations: the covariance is that of (G, n), in `step`,
    # contracted with the second moments of (sent, 1).
    linear = jnp.concatenate([maps.moved, maps.innovation])
    d = maps.moved.shape[0]
    z = propagate_by_mode(linear, sources, 0.0).at[d:, d:].add(contract(step.covariance, second))
    # E |signal|^2 of each sender, which sends m numbers.
    m = step.sensing.shape[0]
    power = jnp.diagonal(second)[:-1].reshape(-1, m).sum(axis=1) * step.transmits_in_slot
    return z, SentMoments(second, power)


def correct_moments(z: Float[Array, "z z"], gain: Float[Array, "Fn R"]) -> Float[jax.Array, "z-R z-R"]:
    """Return the covariance of eta+ = eta+ before corrections - (0; K) innovations, with K the `gain`.

    eta = (x, e_1 .. e_F) holds the state and the filters' errors. Only the errors are corrected. `z` is the covariance
    of (eta+ before corrections, innovations).
    """
    rows, received = gain.shape
    d = z.shape[0] - received  # size of eta
    identity, zeros_for_x = jnp.eye(d), jnp.zeros((d - rows, received))
    correction = jnp.concatenate([identity, jnp.concatenate([zeros_for_x, -gain])], axis=1)  # [I, -(0; K)]
    return symmetrize(propagate_by_mode(correction, z, 0.0))


def gain_mask(step: RelaySteps) -> Bool[np.ndarray, "Fn R"]:
    """Return which entries of the gains of all F filters (F n, R) may differ from zero, as one block matrix.

    Rows f n to (f + 1) n correct filter f, columns are the R received numbers. A filter uses only what it receives
    itself: `step.owner` is the filter that receives each number.
    """
    n = step.transition.shape[-1]
    filter_of_row = np.repeat(np.arange(len(step.received)), n)
    return np.asarray(filter_of_row[:, None] == step.owner)


ROUNDING = 64 * float(np.finfo(float).eps)  # of what is sent: an innovation of less says nothing


def innovations_above_rounding(predicted: Float[jax.Array, "z z"], step: RelaySteps) -> Float[jax.Array, "R"]:
    """Return 1 for each innovation whose variance is above the rounding of what is sent, 0 for the others.

    A relay that receives nothing but itself through a known gain has the innovation zero. It is computed as a
    difference of large numbers, of which the rounding remains. `predicted` is the covariance of (x, e_1 .. e_F,
    innovations), with x and each filter's error of n entries. ROUNDING is a few units in the last place.
    """
    n, relays = step.transition.shape[-1], len(step.received) - 1
    d = predicted.shape[0] - sum(step.received)  # numbers in (x, e_1 .. e_F)
    # Sizes of the numbers sent: |C| (deviation + |mean|) of x by the sensor, and of s_f = x - e_f by each relay.
    deviations = jnp.sqrt(jnp.maximum(jnp.diagonal(predicted)[:d], 0.0)).reshape(-1, n)  # rows: x, e_1 .. e_F
    size_of_state = deviations[0] + jnp.abs(step.state_mean)
    sizes = jnp.concatenate([size_of_state[None], size_of_state + deviations[1 : 1 + relays]])
    sent_sizes = jnp.append((sizes @ jnp.abs(step.sensing).T).ravel(), 1.0)  # of (sent, 1)
    # An innovation is E G sent less its prediction: its rounding is at most eps |E G| |sent|. Its variance has a term
    # sum_ab Cov(G_ia, G_ib) E[sent_a sent_b], which is computed up to eps |Cov| |sent| |sent|.
    rounding_of_innovation = ROUNDING * jnp.abs(step.gain) @ sent_sizes[:-1]
    rounding_of_variance = ROUNDING * jnp.einsum("iiab,a,b->i", jnp.abs(step.covariance), sent_sizes, sent_sizes)
    smallest_variance = rounding_of_innovation**2 + rounding_of_variance
    return jnp.where(jnp.diagonal(predicted)[d:] > smallest_variance, 1.0, 0.0)


def regression_gain(cross: Float[jax.Array, "n m"], received: Float[jax.Array, "m m"]) -> Float[jax.Array, "n m"]:
    """Return K = Cov(e, i) Cov(i)^-1, which minimises tr Cov(e - K i).

    `cross` is Cov(e, i) and `received` Cov(i). Where Cov(i) is singular, K is zero for an innovation that others
    determine.
    """
    return psd_solve(received, cross.T).T


def local_gain(predicted: Float[jax.Array, "z z"], step: RelaySteps) -> Float[jax.Array, "Fn R"]:
    """Return K_f = Cov(e_f, i_f) Cov(i_f)^-1 of each filter f, which minimises its own next tr E e_f e_f'.

    `predicted` is the covariance of (x, e_1 .. e_F, i_1 .. i_F): the state, the filters' errors before corrections (n
    entries each), and their innovations. The gains stand in one block matrix, filter after filter, zero elsewhere.

    Source: for two alternating relays, filter-and-forward successive relays, Theorems 1 and 2.
    """
    n, received = step.transition.shape[-1], sum(step.received)
    d = predicted.shape[0] - received  # the innovations follow from index d
    gain = jnp.zeros((d - n, received))
    start = 0  # index of the filter's first received number
    # 1 for an innovation that arrives in this slot and is more than rounding, else 0.
    is_informative = step.receives_in_slot * innovations_above_rounding(predicted, step)
    for f, length in enumerate(step.received):
        own = slice(start, start + length)  # the filter's innovations i_f
        used = is_informative[own]
        # An innovation without information gets the covariance 0 with all others and the variance 1: its gain is 0.
        covariance = predicted[d:, d:][own, own] * used[:, None] * used + jnp.diag(1.0 - used)
        cross = predicted[(1 + f) * n : (2 + f) * n, d:][:, own] * used  # Cov(e_f, i_f)
        gain = gain.at[f * n : (f + 1) * n, own].set(regression_gain(cross, covariance))
        start += length
    return gain


class PropagatedMoments(NamedTuple):
    """Gains of all filters, the covariance of eta = (x, e_1 .. e_F) before the first and after each step, and powers.

    power: E |signal|^2 of each sender in each step, the sensor first; 0 for one that does not transmit.
    """

    gains: Float[Array, "time Fn R"]
    moments: Float[Array, "time+1 d d"]
    power: Float[Array, "time senders"]


def propagate_error_moments(
    steps: RelaySteps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"] | None = None
) -> PropagatedMoments:
    """Propagate the covariance of eta = (x, e_1 ... e_F) over the steps; return it with gains and powers over time.

    x (n,) is the plant's state and e_f the error of filter f. The F filters, at relays and at the receiver, together
    receive R numbers; a relay forwards its estimate, so errors of filters are coupled.

    Args:
        steps: matrices of the relay network at each step.
        start: covariance of eta before the first step.
        gains: K of all filters as one block matrix (F n, R) for each step. Only columns of numbers that arrive in the
            step (its time slot) are used. None for gains that minimise each filter's own next error.
    """

    def move(moments: jax.Array, row: tuple[RelaySteps, jax.Array | None]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
        """Return the covariance of eta after a step, and the triple (gains, this covariance, powers) to collect.

        `moments` is the covariance before the step; a row has the step and its gains. Where these are None, each filter
        gets the gain that minimises its own error at this step.
        """
        step, gain = row
        uncorrected, sent = step_moments(step, moments)  # uncorrected: of (eta+ before corrections, innovations)
        used_gain = local_gain(uncorrected, step) if gain is None else gain * step.receives_in_slot
        corrected = correct_moments(uncorrected, used_gain)
        return corrected, (used_gain if gain is None else gain, corrected, sent.power)

    start = jnp.asarray(start)
    items = (steps, None if gains is None else jnp.asarray(gains))
    _last_moments, (all_gains, moments, power) = jax.lax.scan(move, start, items)
    return PropagatedMoments(all_gains, jnp.concatenate([start[None], moments]), power)


DAMPING = 1e-9  # relative, on the change of a gain: decides only what the receiver's error does not


def gain_hessian(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], step: RelaySteps, damping: float
) -> tuple[Float[jax.Array, "r r"], Float[jax.Array, ""]]:
    """Return half the Hessian of the later cost in the free gains, with damping on its diagonal, and that damping.

    The cost is tr(Lam P) with P = [I -(0; K)] Z [I -(0; K)]', the covariance of (x, e_1 .. e_F) after a correction by
    the gains K. Z = `predicted` is the covariance of (x, e_1 .. e_F before it, innovations), and Lam = `ahead` is the
    gradient of the cost of later steps by P. An entry of K is free if it multiplies a number that the filter receives
    itself.

    Newton's method in the gains uses it; damping keeps it invertible.

    Args:
        predicted: Z (d + R, d + R): d numbers (x, e_1 .. e_F), and the R received numbers' innovations.
        ahead: Lam (d, d).
        step: the network's step: which filter receives which number, and what arrives in this slot.
        damping: relative to the mean of the diagonal.
    """
    # Free entries of K: their rows (states of filters) and columns (received numbers), r of each.
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    is_free = jnp.asarray(step.receives_in_slot)[columns]
    # d^2 cost / (2 dK_ab dK_cd) = (Lam_ee)_ac (Z_ii)_bd, e: errors, from index n on, i: innovations, from index d on.
    hessian = jnp.asarray(ahead)[n:, n:][np.ix_(rows, rows)] * predicted[d:, d:][np.ix_(columns, columns)]
    # A number that does not arrive in this slot has a gain without effect: 1 on the diagonal keeps it as it is.
    hessian = hessian * is_free[:, None] * is_free
    trace = jnp.trace(hessian)
    diagonal_damping = jnp.where(trace > 0, damping * trace / len(rows), 1.0)  # 1 where the cost depends on no gain
    return hessian + jnp.diag(jnp.where(is_free > 0, diagonal_damping, 1.0)), diagonal_damping


def minimise_cost_ahead(
    predicted: Float[Array, "z z"], ahead: Float[Array, "d d"], old: Float[Array, "Fn R"], step: RelaySteps
) -> Float[jax.Array, "Fn R"]:
    """Return the gains K of all filters that minimise the cost of later steps, tr Lam [I -(0; K)] Z [I -(0; K)]'.

    A little damping towards the gains `old` decides entries on which the cost does not depend.

    Args:
        predicted: Z, the covariance of (x, e_1 .. e_F before corrections, innovations); the first d entries are eta's.
        ahead: Lam (d, d), the gradient of the cost of later steps by the covariance of (x, e_1 .. e_F) after this one.
        old: the gains (F n, R) that are to be improved.
        step: the network's step. A gain is free if it multiplies what its filter receives; others are zero.
    """
    rows, columns = np.nonzero(gain_mask(step))
    n, d = step.transition.shape[-1], ahead.shape[0]
    hessian, damping = gain_hessian(predicted, ahead, step, DAMPING)
    # The free entries ab of K solve (Lam_ee K Z_ii)_ab = (Lam_e. Z_.i)_ab: e are the errors (rows of Lam from n on), i
    # the innovations (columns of Z from d on).
    gradient = ahead[n:] @ predicted[:d, d:]
    right_side = (gradient[rows, columns] + damping * old[rows, columns]) * step.receives_in_slot[columns]
    return jnp.zeros_like(old).at[rows, columns].set(jnp.linalg.solve(hessian, right_side))


def moment_adjoint(step: RelaySteps, gain: Float[Array, "Fn R"], ahead: Float[Array, "d d"]) -> Float[jax.Array, "d d"]:
    """Return the gradient of <Lam, P+> = sum of Lam_ij P+_ij by P: one step back of the cost's gradient.

    P and P+ (d, d) are the covariances of (x, e_1 .. e_F) before and after the step with this `gain`; Lam is `ahead`.
    P+ is an affine function of P, so that the gradient is the same everywhere, and may be taken at P = 0.
    """

    def step_covariance(p: jax.Array) -> jax.Array:
        """Return P+, the covariance after the step, from P before it."""
        return correct_moments(step_moments(step, p)[0], gain)

    _, pull_back = jax.vjp(step_covariance, jnp.zeros_like(ahead))
    return symmetrize(pull_back(ahead)[0])
