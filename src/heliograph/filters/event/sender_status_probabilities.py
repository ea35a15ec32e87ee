"""Probabilities of what is unknown of a sender (how long ago it sent, what was lost), given each Gaussian of a sum.

They are the sender's label, an array (K, M, A, C): Gaussian, mode of the link, steps since the last transmission,
transmissions lost.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp


class SilenceByCause(NamedTuple):
    """A sender's label (K, M, A, C), split by why no value came, before it is known where y - r lies.

    unsent: nothing was sent, if |y - r| <= delta; dropped: sent and lost, if |y - r| > delta; forced: sent wherever y
    lay, since a heartbeat was due, and lost.
    """

    unsent: jax.Array
    dropped: jax.Array
    forced: jax.Array


def status_after_sending(label: jax.Array, is_lost: bool) -> jax.Array:
    """Return the probabilities of a sender's status after a transmission, which sets its count of steps to 0.

    `label` (K, M, A, C) has axes for K Gaussians, M modes of the link, A numbers of steps since a transmission, and C
    numbers of transmissions lost since the last arrival. The last of the C entries stands for all larger numbers too.
    With C = 1 losses are not counted. `is_lost` says whether this transmission is lost.
    """
    label = jnp.zeros_like(label).at[:, :, 0].set(jnp.sum(label, axis=2))
    if label.shape[-1] == 1:
        return label
    if not is_lost:
        return jnp.zeros_like(label).at[..., 0].set(jnp.sum(label, axis=-1))
    # One more loss moves each entry of C up by one. The last one keeps its probability too.
    one_more = jnp.concatenate([jnp.zeros_like(label[..., :1]), label[..., :-1]], axis=-1)
    return one_more.at[..., -1].add(label[..., -1])
