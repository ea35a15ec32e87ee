"""Transmission of a recorded signal through any channel."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import at, first, steps_covered
from heliograph.numerics.check import array, check_horizon, check_seed, fail, instance
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, apply
from heliograph.simulation.draws import CHANNEL, CHANNEL_START, checksum, draw_key

SENDER = checksum("transmit")


def transmit(signal: Float[ArrayLike, "*shape"], channel: Channel, seed: int = 0) -> Float[np.ndarray, "steps outputs"]:
    """Transmit a recorded signal through a channel, with independent draws at each step; links with memory have theirs.

    z_k = G_k y_k + n_k. NaN in the signal was not sent: outputs that depend on it (G_k not zero there) are NaN, all
    others arrive. The result is NaN too where the channel loses it.

    Args:
        signal: (steps, inputs), or (steps,) for a channel with one input; a table of pandas or polars too.
        channel: the channel.
        seed: of the draws; 0 by default.

    Returns:
        The received signal (steps, outputs).

    Raises:
        ValueError: no channel, a signal of another shape or with infinite values, more steps than the channel covers.
    """
    instance("channel", first(channel), AbstractRandomAffine, "a channel, such as hop(...)")
    inputs = first(channel).inputs
    flat = inputs == 1 and np.ndim(np.asarray(signal, dtype=None if isinstance(signal, np.ndarray) else object)) == 1
    y = array("signal", signal, (None,) if flat else (None, inputs), missing=True).reshape(-1, inputs)
    if not len(y):
        raise fail("signal", "at least one step", "none")
    check_horizon(len(y), steps_covered(channel))
    return np.asarray(_transmitted(channel, y, np.asarray(check_seed("seed", seed))))


@compiled
def _transmitted(channel: Channel, y: Float[Array, "steps m"], seed: Array) -> jax.Array:
    key = jax.random.key(seed)

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, jax.Array]:
        k, y_k = row
        missing = jnp.isnan(y_k)
        state, h = at(channel, k).draw(state, draw_key(key, k, SENDER, CHANNEL))
        unsent = jnp.any((h[:-1, :-1] != 0) & missing, axis=1)
        return state, jnp.where(unsent, jnp.nan, apply(h, jnp.where(missing, 0.0, y_k)))

    start = at(channel, 0).init(draw_key(key, 0, SENDER, CHANNEL_START))
    received: jax.Array = jax.lax.scan(step, start, (jnp.arange(len(y)), jnp.asarray(y)))[1]
    return received
