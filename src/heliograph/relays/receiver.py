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
    # Gains of all relays as one matrix, and the receiver's view of each step: side.transition A, side.output C.
    joined = relay_gains(network, gains)
    steps, n = network.steps(len(joined)), len(network.states)
    side = _list_receiver_views(steps, initial_error_covariance(network), joined)
    count, r, d = side.output.shape
    # Means: x+ has the drift a. z has the constant b: the last r of all numbers that are received in the network.
    _rows, constants = steps.predict_maps()
    drift = np.zeros((count, d + r))
    drift[:, :n], drift[:, d:] = steps.drift, constants[:, -r:]
    # (x, e, z)+ = [A; C] (x, e) + white noise, whatever z was, and z is measured without noise.
    of_states, of_z = np.concatenate([side.transition, side.output], axis=1), np.zeros((count, d + r, r))
    system = SystemSteps(
        transition=np.concatenate([of_states, of_z], axis=2),
        drift=drift,
        process=np.asarray(side.noise),
        output=np.tile(np.eye(r, d + r, d), (count, 1, 1)),
        offset=np.zeros((count, r)),
        noise=np.zeros((count, r, r)),
    )
    mean, covariance = np.zeros(d + r), np.zeros((d + r, d + r))
    start_mean, _start_covariance = network.initial()
    mean[:n], covariance[:d, :d] = start_mean, initial_error_covariance(network)[:d, :d]
    # Gains on what nobody transmits are not used; the receiver comes last.
    ends, receives = np.cumsum(network.received), np.asarray(steps.receives_in_slot)
    relayed = {name: np.asarray(gains[name]) * receives[:, None, end - size : end]
               for name, size, end in zip(network.relays, network.received, ends, strict=False)}  # fmt: skip
    x_of_state = np.eye(n, d + r)
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
    """Return the linear system of zeta = (x, e_1 ... e_relays), x the state and e_r relay r's error, over one step.

    Args:
        step: the network in this step: x+ = A x + w, the sensor's noise v, moments of the links' random gains.
        moments: covariance of (x, e_1 ... e_F) of all filters before the step, the receiver last; it decides how much
            noise random gains add.
        gain: K of all filters as one block matrix (filters n, R), over all R numbers that they receive.
    """
    n, r = step.transition.shape[-1], step.received[-1]
    maps, d = make_error_step_maps(step), moments.shape[0]
    # Sizes of zeta, and of what all relays receive: without the receiver's error and what it receives.
    zeta, relay_rows = d - n, step.gain.shape[0] - r
    # (zeta+ before corrections, the relays' innovations, z), as rows over (x, e_1 ... e_F, w, v).
    received = (step.gain @ maps.sent)[relay_rows:]
    uncorrected = jnp.concatenate([maps.moved[:zeta], maps.innovation[:relay_rows], received])
    # The matrix from these to (zeta+, z): e_r+ = e_r+ before its correction - K_r i_r.
    relay_gain = -(gain * step.receives_in_slot)[: zeta - n, :relay_rows]
    from_innovations = jnp.concatenate([jnp.zeros((n, relay_rows)), relay_gain])
    correct_zeta = jnp.concatenate([jnp.eye(zeta), from_innovations, jnp.zeros((zeta, r))], axis=1)
    correct = jnp.concatenate([correct_zeta, jnp.eye(r, zeta + relay_rows + r, zeta + relay_rows)])
    corrected = correct @ uncorrected
    # White noise: of plant and sensor, and what random gains make of the signals sent.
    noise = jax.scipy.linalg.block_diag(step.process, step.sensor_noise)
    _, sent = step_moments(step, moments)
    of_random_gains = propagate_by_mode(correct[:, zeta:], contract(step.covariance, sent.second), 0.0)
    white = propagate_by_mode(corrected[:, d:], noise, of_random_gains)
    return ReceiverViewOfRelays(transition=corrected[:zeta, :zeta], output=corrected[zeta:, :zeta], noise=white)


@compile_in_float64
def _list_receiver_views(
    steps: RelaySteps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"]
) -> ReceiverViewOfRelays:
    """Return for each step the linear system that the receiver observes: its state is x and the relays' errors.

    `start` is the covariance of x and all F filters' errors before the first step. `gains` are those of all filters,
    one block matrix (F n, R) for each step.
    """

    def move(moments: jax.Array, row: tuple[RelaySteps, jax.Array]) -> tuple[jax.Array, ReceiverViewOfRelays]:
        """Return the moments of x and all filters' errors after a step, and the system that the receiver observes."""
        step, gain = row
        uncorrected, _ = step_moments(step, moments)
        # Corrected by the gains, without those on numbers that no link brings in this slot.
        corrected = correct_moments(uncorrected, gain * step.receives_in_slot)
        return corrected, make_receiver_view(step, moments, gain)

    return jax.lax.scan(move, jnp.asarray(start), (steps, jnp.asarray(gains)))[1]
