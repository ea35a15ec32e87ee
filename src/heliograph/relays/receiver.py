"""The best linear receiver behind relays whose gains are given: it also estimates what the relays do not know."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.recursion import lmmse
from heliograph.linear.schedule import Schedule
from heliograph.linear.system import LinearSystem
from heliograph.linear.system import Steps as SystemSteps
from heliograph.model.relays import RECEIVER, RelayNetwork, Steps
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import compiled
from heliograph.relays.design import GainsByFilter, expected_maps, join_gains, start_moments
from heliograph.relays.second_moments import correct, linear_maps, step_moments


def receiver_behind_relays(network: RelayNetwork, gains: GainsByFilter) -> Schedule:
    """The linear minimum-mean-square-error filter of x_k from all that the receiver heard up to k.

    Its state is an estimate of (x, e_1, ..., e_relays), e_r = x - s_r, which moves linearly; what the random gains add
    is white, with the covariance that their second moments give. Claim: "exact" for complete data.

    Shapes: gains[relay] (steps, n, received); a receiver's gain among them is not used.

    Raises:
        ValueError: gains of the wrong shape, a relay without gains.
    """
    joined = relay_gains(network, gains)
    steps, n = network.steps(len(joined)), len(network.states)
    known, heard, white = _system(steps, start_moments(network), joined)
    d, r = known.shape[-1], heard.shape[1]
    none = np.zeros((len(known), d + r, r))
    drift = np.zeros((len(known), d + r))
    drift[:, :n], drift[:, d:] = steps.drift, expected_maps(steps)[1][:, -r:]
    system = SystemSteps(
        transition=np.concatenate([np.concatenate([known, heard], axis=1), none], axis=2),
        drift=drift,
        process=np.asarray(white),
        output=np.tile(np.eye(r, d + r, d), (len(known), 1, 1)),
        offset=np.zeros((len(known), r)),
        noise=np.zeros((len(known), r, r)),
    )
    mean, covariance = np.zeros(d + r), np.zeros((d + r, d + r))
    mean[:n], covariance[:d, :d] = network.initial()[0], start_moments(network)[:d, :d]
    return lmmse(LinearSystem(system, mean, covariance, np.eye(n, d + r)))


def relay_gains(network: RelayNetwork, gains: GainsByFilter) -> np.ndarray:
    """Block matrices (steps, F n, R) of the relays' gains, zero for the receiver.

    Raises:
        ValueError: a relay without gains, gains of the wrong shape, no relays.
    """
    missing = [name for name in network.relays if name not in gains]
    if missing or not network.relays:
        raise fail("relay gains", f"those of {list(network.relays)}", f"none for {missing}" if missing else "no relays")
    relays: dict[str, Any] = {name: gains[name] for name in network.relays}
    n, length = len(network.states), len(np.asarray(relays[network.relays[0]]))
    return join_gains(network, relays | {RECEIVER: np.zeros((length, n, network.received[-1]))})


def relay_side(p: Steps, moments: jax.Array, gain: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Relays closed with their gains, seen from the receiver: zeta+ = A zeta + a, z = C zeta + c, zeta = (x, e_relays).

    Returns A (d', d'), C (r, d') and the joint covariance (d' + r, d' + r) of (a, c): white, and uncorrelated with
    zeta, since what a random gain adds has mean zero given the past.
    """
    n, r = p.transition.shape[-1], p.received[-1]
    maps, d = linear_maps(p), moments.shape[0]
    known, rows = d - n, p.gain.shape[0] - r  # all but the receiver's error, all but what the receiver hears
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
    return moved[:known, :known], moved[known:, :known], white


@compiled
def _system(steps: Steps, start: Any, gains: Any) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`relay_side` at each step."""

    def one(moments: jax.Array, item: Any) -> tuple[jax.Array, Any]:
        p, gain = item
        return correct(step_moments(p, moments)[0], gain * p.live), relay_side(p, moments, gain)

    _, (known, heard, white) = jax.lax.scan(one, jnp.asarray(start), (steps, gains))
    return known, heard, white
