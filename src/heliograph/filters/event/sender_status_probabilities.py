"""Probabilities of a sender's status, given each Gaussian of a sum: how long ago it sent, and what was lost.

They are an array (K, M, A, C): Gaussian, mode of the link, steps since the last transmission, transmissions lost.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.numerics.types import Array, Int


class SilenceByCause(NamedTuple):
    """Probabilities of a sender's status (K, M, A, C), jointly with each cause of silence and given its condition.

    unsent: nothing was sent, given |y - r| <= delta for the signal y and the reference r; dropped: y was sent and lost,
    given |y - r| > delta; forced: y had to be sent wherever it lay (as its first value or a heartbeat), and was lost.
    """

    unsent: jax.Array
    dropped: jax.Array
    forced: jax.Array


def split_by_obligation(
    status: jax.Array, has_sent: jax.Array, heartbeat: Int[Array, ""] | None
) -> tuple[jax.Array, jax.Array]:
    """Split probabilities of a sender's status (K, M, A, C): its rule decides whether it sends, or it must send.

    It must send if it never has, and once the number of steps since it sent (axis A) equals `heartbeat`, if there is
    one. Otherwise it sends if |y - r| > delta. The two arrays sum to `status`.
    """
    ages = status.shape[2]
    is_heartbeat = (jnp.arange(ages) == (-1 if heartbeat is None else heartbeat))[:, None]
    must_send = jnp.where(~has_sent | is_heartbeat, status, 0.0)
    return status - must_send, must_send


def status_after_sending(status: jax.Array, is_lost: bool) -> jax.Array:
    """Return the probabilities of a sender's status after a transmission, which sets its count of steps to 0.

    `status` (K, M, A, C) has axes for K Gaussians, M modes of the link, A numbers of steps since a transmission, and C
    numbers of transmissions lost since the last arrival. The last of the C entries stands for all larger numbers too.
    With C = 1 losses are not counted. `is_lost` says whether this transmission is lost.
    """
    status = jnp.zeros_like(status).at[:, :, 0].set(jnp.sum(status, axis=2))
    if status.shape[-1] == 1:
        return status
    if not is_lost:
        return jnp.zeros_like(status).at[..., 0].set(jnp.sum(status, axis=-1))
    # One more loss moves each entry of C up by one. The last one keeps its probability too.
    one_more = jnp.concatenate([jnp.zeros_like(status[..., :1]), status[..., :-1]], axis=-1)
    return one_more.at[..., -1].add(status[..., -1])


def append_losses(value: jax.Array, blocks: list[jax.Array], losses: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Append the losses that senders report to the innovation of their values, and return it with its covariance.

    A reported number is given, not predicted, so its innovation and covariance are 0; they are NaN if it is missing.

    Args:
        value: innovation of the values of all senders.
        blocks: its covariance for each sender.
        losses: reported number of losses of each sender, NaN if missing.
    """
    loss_values = jnp.where(jnp.isnan(losses), jnp.nan, 0.0)
    value = jnp.concatenate([value, loss_values])
    arrived = ~jnp.isnan(value)
    covariance = jax.scipy.linalg.block_diag(
        *(jnp.nan_to_num(block) for block in blocks), jnp.zeros((len(losses),) * 2)
    )
    return value, jnp.where(arrived[:, None] & arrived, covariance, jnp.nan)
