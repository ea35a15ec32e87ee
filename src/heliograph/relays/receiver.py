"""The best linear receiver behind relays whose gains are given: it also estimates what the relays do not know."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.recursion import lmmse
from heliograph.linear.system import LinearSystem, Schedule
from heliograph.linear.system import Steps as SystemSteps
from heliograph.model.relays import RECEIVER, RelayNetwork, Steps
from heliograph.numerics.check import array, fail, instance, table
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, Float
from heliograph.relays.design import GainsByFilter, expected_maps, join_gains, start_moments
from heliograph.relays.second_moments import correct, linear_maps, step_moments


def receiver_behind_relays(network: RelayNetwork, gains: GainsByFilter) -> Schedule:
    """Return the linear minimum-mean-square-error filter of x_k from everything that the receiver received up to k.

    Its state is an estimate of (x, e_1, ..., e_relays), e_r = x - s_r, which moves linearly; the random gains add white
    noise, with the covariance that their second moments give. Claim: "exact" for complete data.

    Args:
        network: the relay network.
        gains: relay gains by name (steps, n, received); a receiver's gain among them is not used.

    Raises:
        ValueError: gains of the wrong shape, a relay without gains.
    """
    return lmmse(receiver_system(network, gains))


def receiver_system(network: RelayNetwork, gains: GainsByFilter) -> LinearSystem:
    """Return a `network` with given relay `gains` as its receiver sees it: a linear system of (x, e_1, ..., z).

    z reads the state before the step and shares the step's noise, so it is a component. A `LinearSystemFilter` of it is
    `receiver_behind_relays` with its covariance propagated on line: for data with gaps, and for smoothing.

    Raises:
        ValueError: what `receiver_behind_relays` refuses.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    gains = table("gains", gains, "arrays (steps, n, received)")
    joined = relay_gains(network, gains)
    steps, n = network.steps(len(joined)), len(network.states)
    known, received, white = _sides(steps, start_moments(network), joined)
    d, r = known.shape[-1], received.shape[1]
    none = np.zeros((len(known), d + r, r))
    # Means: x+ has drift a, z the constant b.
    drift = np.zeros((len(known), d + r))
    drift[:, :n], drift[:, d:] = steps.drift, expected_maps(steps)[1][:, -r:]
    # (x, e, z)+ = [known; received] (x, e) + white noise, measured as z exactly.
    system = SystemSteps(
        transition=np.concatenate([np.concatenate([known, received], axis=1), none], axis=2),
        drift=drift,
        process=np.asarray(white),
        output=np.tile(np.eye(r, d + r, d), (len(known), 1, 1)),
        offset=np.zeros((len(known), r)),
        noise=np.zeros((len(known), r, r)),
    )
    mean, covariance = np.zeros(d + r), np.zeros((d + r, d + r))
    mean[:n], covariance[:d, :d] = network.initial()[0], start_moments(network)[:d, :d]
    return LinearSystem(system, mean, covariance, np.eye(n, d + r))


def relay_gains(network: RelayNetwork, gains: GainsByFilter) -> Float[np.ndarray, "steps Fn R"]:
    """Block matrices of the relays' gains, zero for the receiver.

    Raises:
        ValueError: a relay without gains, gains of the wrong shape, no relays.
    """
    gains = table("relay gains", gains, "arrays")
    missing = [name for name in network.relays if name not in gains]
    if missing or not network.relays:
        raise fail("relay gains", f"those of {list(network.relays)}", f"none for {missing}" if missing else "no relays")
    relays = {name: gains[name] for name in network.relays}
    n, first = len(network.states), network.relays[0]
    length = len(array(f"gains of {first!r}", relays[first], (None, None, None)))
    return join_gains(network, relays | {RECEIVER: np.zeros((length, n, network.received[-1]))})


class RelaySide(NamedTuple):
    """Relays closed with their gains, seen from the receiver: zeta+ = A zeta + a, z = C zeta + c, zeta = (x, e_relays).

    transition A, output C, and the joint covariance of (a, c): white, and uncorrelated with zeta, since what a random
    gain adds has mean zero given the past. Over time each has a leading axis.
    """

    transition: Float[jax.Array, "*time d d"]
    output: Float[jax.Array, "*time r d"]
    noise: Float[jax.Array, "*time d+r d+r"]


def relay_side(p: Steps, moments: Float[Array, "d d"], gain: Float[Array, "Fn R"]) -> RelaySide:
    """Return the linear system of (x, e_relays) that the receiver estimates in one step."""
    n, r = p.transition.shape[-1], p.received[-1]
    maps, d = linear_maps(p), moments.shape[0]
    known, rows = d - n, p.gain.shape[0] - r  # without the receiver's error, without its received rows
    received = (p.gain @ maps.sent)[rows:]
    full = jnp.concatenate([maps.moved[:known], maps.innovation[:rows], received])
    relays = jnp.concatenate([jnp.zeros((n, rows)), -(gain * p.live)[: known - n, :rows]])
    close = jnp.concatenate([jnp.eye(known), relays, jnp.zeros((known, r))], axis=1)
    close = jnp.concatenate([close, jnp.eye(r, known + rows + r, known + rows)])
    moved = close @ full
    noise = jax.scipy.linalg.block_diag(p.process, p.sensor_noise)
    _, sent = step_moments(p, moments)
    random = jnp.einsum("ijab,ab->ij", p.spread, sent.second)
    white = moved[:, d:] @ noise @ moved[:, d:].T + close[:, known:] @ random @ close[:, known:].T
    return RelaySide(moved[:known, :known], moved[known:, :known], white)


@compiled
def _sides(steps: Steps, start: Float[Array, "d d"], gains: Float[Array, "time Fn R"]) -> RelaySide:
    """`relay_side` at each step."""

    def single(moments: jax.Array, item: tuple[Steps, jax.Array]) -> tuple[jax.Array, RelaySide]:
        p, gain = item
        return correct(step_moments(p, moments)[0], gain * p.live), relay_side(p, moments, gain)

    return jax.lax.scan(single, jnp.asarray(start), (steps, jnp.asarray(gains)))[1]
