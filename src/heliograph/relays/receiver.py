"""The receiver behind relays of given gains: its filter's system, and what it receives of each relay."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.jump_system import propagate_by_mode
from heliograph.linear.lmmse_recursion import lmmse
from heliograph.linear.system import LinearSystem, Schedule
from heliograph.linear.system import Steps as SystemSteps
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.estimate import lower_claim_by_noise
from heliograph.model.relays import RelayNetwork, RelaySteps
from heliograph.numerics.check import instance, table
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.linalg import contract
from heliograph.numerics.types import Array, Float
from heliograph.relays.design import GainsByFilter, initial_error_covariance, relay_gains
from heliograph.relays.error_moments import (
    correct_moments,
    make_error_step_maps,
    step_moments,
)


def receiver_behind_relays(network: RelayNetwork, gains: GainsByFilter) -> Schedule:
    """Return the linear minimum-mean-square-error filter of x_k from everything that the receiver received up to k.

    Its state is an estimate of (x, e_1, ..., e_relays), e_r = x - s_r, which moves linearly; the random gains add white
    noise, with the covariance that their second moments give. Claim: "exact" for complete data, "upper" where noise is
    known by bounds.

    Args:
        network: the relay network.
        gains: relay gains by name (steps, n, received); a receiver's gain among them is not used.

    Raises:
        ValueError: gains of the wrong shape, a relay without gains.
    """
    return lmmse(receiver_system(network, gains), lower_claim_by_noise("exact", network))


def receiver_system(network: RelayNetwork, gains: GainsByFilter) -> LinearSystem:
    """Return a `network` with given relay `gains` as its receiver sees it: a linear system of (x, e_1, ..., z).

    e_r = x - s_r is the error of relay r. What the receiver receives, z, depends on the state before the step and
    shares the step's noise, so it is a component of the state, which is measured without noise. A `LinearSystemFilter`
    of the system is `receiver_behind_relays` with its covariance propagated on line: for data with gaps, and for
    smoothing.

    Args:
        network: relays that filter what they receive and send their estimates s_r on.
        gains: K by relay, (steps, n, received).

    Raises:
        ValueError: what `receiver_behind_relays` refuses.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    gains = table("gains", gains, "arrays (steps, n, received)")
    # Gains of all relays as one block matrix a step, and with them the system (x, e)+ = A (x, e) + noise, z = C (x, e)
    # + noise that the receiver observes: A is view.transition (d, d), C is view.output (r, d).
    joined = relay_gains(network, gains)
    steps, n = network.steps(len(joined)), len(network.states)
    view = _list_receiver_views(steps, initial_error_covariance(network), joined)
    count, r, d = view.output.shape
    # Means: x+ has the drift a. z has the constant b: the last r of all numbers that are received in the network.
    _rows, constants = steps.predict_maps()
    drift = np.zeros((count, d + r))
    drift[:, :n], drift[:, d:] = steps.drift, constants[:, -r:]
    # (x, e, z)+ = [A; C] (x, e) + white noise, whatever z was, and z is measured without noise.
    of_states = np.concatenate([view.transition, view.output], axis=1)
    of_z = np.zeros((count, d + r, r))
    system = SystemSteps(
        transition=np.concatenate([of_states, of_z], axis=2),
        drift=drift,
        process=np.asarray(view.noise),
        output=np.tile(np.eye(r, d + r, d), (count, 1, 1)),
        offset=np.zeros((count, r)),
        noise=np.zeros((count, r, r)),
    )
    # At the start x has its mean, errors have the mean 0, and z, which nobody has received yet, is 0.
    mean, covariance = np.zeros(d + r), np.zeros((d + r, d + r))
    mean[:n], _initial_covariance = network.initial()
    covariance[:d, :d] = initial_error_covariance(network)[:d, :d]
    # The relays' gains as used: zero on what nobody transmits in a slot.
    receives = np.asarray(steps.receives_in_slot)  # (steps, R): 1 for each number that arrives
    relayed = {}
    ends = np.cumsum(network.received)
    for name, size, end in zip(network.relays, network.received, ends, strict=False):  # the receiver, last, is left out
        relayed[name] = np.asarray(gains[name]) * receives[:, None, end - size : end]
    x_of_state = np.eye(n, d + r)  # selects x, the first n states
    assumed = AssumedModel(network.plant, relays=network, gains=relayed)
    return with_assumed(LinearSystem(system, mean, covariance, x_of_state), assumed)


class ReceiverViewOfRelays(NamedTuple):
    """Relays closed with their gains, seen from the receiver: zeta+ = A zeta + a, z = C zeta + c, zeta = (x, e_relays).

    transition A, output C, and the joint covariance of (a, c): white, and uncorrelated with zeta, since what a random
    gain adds has mean zero given the past. Over time each has a leading axis.
    """

    transition: Float[jax.Array, "*time d d"]
    output: Float[jax.Array, "*time r d"]
    noise: Float[jax.Array, "*time d+r d+r"]


def make_receiver_view(
    step: RelaySteps, moments: Float[Array, "d d"], gain: Float[Array, "Fn R"]
) -> ReceiverViewOfRelays:
    """Return the linear system zeta+ = A zeta + noise, z = C zeta + noise that the receiver observes in one step.

    zeta = (x, e_1 .. e_relays) is the plant's state and each relay's error e_r = x - s_r; z is what the receiver
    receives. With sources = (x, e_1 .. e_F, w, v) and a fixed matrix M,
      (zeta+ before corrections, i, z) = M sources + (0, what random gains add),  i the relays' innovations,
    and relay r corrects its error by -K_r i_r: (zeta+, z) = L (zeta+ before corrections, i, z), L as in
    `_make_relay_correction`.

    Args:
        step: the network in this step: x+ = A x + w, the sensor's noise v, moments of the links' random gains.
        moments: covariance (d, d) of (x, e_1 .. e_F) of all F filters before the step, the receiver's error last; it
            decides how much noise random gains add.
        gain: K of all filters as one block matrix (F n, R), over all R numbers that they receive.
    """
    maps, d = make_error_step_maps(step), moments.shape[0]
    zeta_size = d - step.transition.shape[-1]  # without the receiver's error
    relay_rows = step.gain.shape[0] - step.received[-1]  # numbers that relays receive; those of the receiver follow
    # M, and L M, whose columns are (x, e_1 .. e_relays), the receiver's error (on which nothing depends), and (w, v).
    z_of_sources = (step.gain @ maps.sent)[relay_rows:]
    m_matrix = jnp.concatenate([maps.moved[:zeta_size], maps.innovation[:relay_rows], z_of_sources])
    l_matrix = _make_relay_correction(step, gain, zeta_size, relay_rows)
    corrected = l_matrix @ m_matrix
    # Covariance of the white noise: L Cov(0, random gains' part) L' + (L M)_wv Cov(w, v) (L M)_wv'.
    _, sent = step_moments(step, moments)
    added_by_random_gains = contract(step.covariance, sent.second)  # (R, R), of all received numbers
    of_random_gains = propagate_by_mode(l_matrix[:, zeta_size:], added_by_random_gains, 0.0)
    noise = jax.scipy.linalg.block_diag(step.process, step.sensor_noise)
    white = propagate_by_mode(corrected[:, d:], noise, of_random_gains)
    return ReceiverViewOfRelays(
        transition=corrected[:zeta_size, :zeta_size], output=corrected[zeta_size:, :zeta_size], noise=white
    )


def _make_relay_correction(
    step: RelaySteps, gain: Float[Array, "Fn R"], zeta_size: int, relay_rows: int
) -> Float[jax.Array, "rows columns"]:
    """Return the matrix L of (zeta+, z) = L (zeta+ before corrections, i, z) for zeta = (x, e_1 .. e_relays).

    i holds the relays' innovations and z what the receiver receives. L = [[I, -(0; K), 0], [0, 0, I]]: the state x is
    not corrected, and the errors by the relays' gains K, whose columns count only for numbers that arrive in this slot.

    Args:
        step: the network in this step.
        gain: gains of all filters as one block matrix (F n, R), the receiver's last.
        zeta_size: length of zeta.
        relay_rows: how many numbers the relays receive together.
    """
    n, r = step.transition.shape[-1], step.received[-1]
    relay_gain = -(gain * step.receives_in_slot)[: zeta_size - n, :relay_rows]
    of_innovations = jnp.concatenate([jnp.zeros((n, relay_rows)), relay_gain])
    rows_of_zeta = jnp.concatenate([jnp.eye(zeta_size), of_innovations, jnp.zeros((zeta_size, r))], axis=1)
    rows_of_z = jnp.eye(r, zeta_size + relay_rows + r, zeta_size + relay_rows)
    return jnp.concatenate([rows_of_zeta, rows_of_z])


@compile_in_float64
def _list_receiver_views(
    steps: RelaySteps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"]
) -> ReceiverViewOfRelays:
    """Return for each step the linear system that the receiver observes: its state is x and the relays' errors.

    `start` is the covariance of x and all F filters' errors before the first step. `gains` are those of all filters,
    one block matrix (F n, R) for each step.
    """

    def move(moments: jax.Array, row: tuple[RelaySteps, jax.Array]) -> tuple[jax.Array, ReceiverViewOfRelays]:
        """Return the moments of x and all filters' errors after a step, and the system that the receiver observes.

        `moments` are those before the step; a row has the step and the gains of all filters in it.
        """
        step, gain = row
        uncorrected, _ = step_moments(step, moments)
        # Corrected by the gains, without those on numbers that no link brings in this slot.
        corrected = correct_moments(uncorrected, gain * step.receives_in_slot)
        return corrected, make_receiver_view(step, moments, gain)

    return jax.lax.scan(move, jnp.asarray(start), (steps, jnp.asarray(gains)))[1]
