"""Probabilities of a sender's status, given each Gaussian of a sum: how long ago it sent, and what was lost.

They are an array (K, M, A, C): Gaussian, mode of the link, steps since the last transmission, transmissions lost.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.filters.event.gaussian_sum import FLOOR
from heliograph.model.trigger import REFUSED, Losses
from heliograph.numerics.types import Array, Int


class Message(NamedTuple):
    """What came from a sender at a step.

    sender: its number; value: what arrived, all NaN in silence; losses: how many it reports (1 or 0 where only the last
    one is known), NaN if it reports none; has_sent: it has a reference to compare its signal with; is_refused: a value
    came, and was refused, so that it is NaN here.
    """

    sender: int
    value: jax.Array
    losses: jax.Array
    has_sent: jax.Array
    is_refused: jax.Array

    @classmethod
    def read(cls, sender: int, value: jax.Array, losses: jax.Array, has_sent: jax.Array, told: Losses) -> "Message":
        """Return the message of a sender, of which a refused value shows in its number of losses.

        Where losses are "known" (`told`), the number is REFUSED; where they are "numbered", it came without a value.
        """
        has_number = losses == REFUSED if told == "known" else ~jnp.isnan(losses)
        return cls(sender, value, losses, has_sent, has_number & jnp.all(jnp.isnan(value)))


class SilenceByCause(NamedTuple):
    """Probabilities of a sender's status (K, M, A, C), jointly with each cause of silence and given its condition.

    unsent: nothing was sent, given |y - r| <= delta for the signal y and the reference r; dropped: y was sent and lost,
    given |y - r| > delta; forced: y had to be sent wherever it lay (as its first value or a heartbeat), and was lost.
    A value that came and counts as not arrived is as one that was lost.
    """

    unsent: jax.Array
    dropped: jax.Array
    forced: jax.Array


def split_by_obligation(
    status: jax.Array, has_sent: jax.Array, heartbeat: Int[Array, ""] | None
) -> tuple[jax.Array, jax.Array]:
    """Split probabilities of a sender's status in two: those where its rule decides whether it sends, or it must send.

    A sender sends its signal y if |y - r| > delta, where r is the reference that it compares with. But it must send,
    wherever y lies, if it never has, and once the steps since it sent equal `heartbeat`, if there is one.

    Args:
        status: probabilities (K, M, A, C) of the status: Gaussian k of the filter's sum, mode m of the link, a steps
            since the sender sent, c transmissions lost.
        has_sent: whether it has sent at all.
        heartbeat: largest number of steps without sending, or None.

    Returns:
        The parts of `status` where the rule decides, and where it must send; they sum to `status`.
    """
    longest_silence = -1 if heartbeat is None else heartbeat  # -1 steps never occur
    ages = jnp.arange(status.shape[2])
    is_heartbeat = (ages == longest_silence)[:, None]  # along the axis of steps since it sent
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


def split_by_cause(
    unsent: jax.Array, must_send: jax.Array, loss_probability: jax.Array, message: Message, told: Losses
) -> SilenceByCause:
    """Split probabilities of a sender's status (K, M, A, C), from which no value came, by the causes of its silence.

    Args:
        unsent: where the sender's rule decides whether it sends.
        must_send: where it must send.
        loss_probability: that what it sends is lost, for each mode (M, 1, 1).
        message: what came of it. Its losses, where they are known, are above 0 if its value was lost; where they are
            numbered, how many were lost before a value that came and was refused.
        told: what is known of losses.
    """
    # What is lost may be a value that the receiver refused without a word, also behind a link that loses nothing.
    lost = loss_probability if told == "unknown" else jnp.maximum(loss_probability, FLOOR)
    dropped, forced = (status_after_sending(status * lost, is_lost=True) for status in (unsent, must_send))
    if told == "unknown":
        return SilenceByCause(unsent, dropped, forced)
    # A value that came and was refused: y was sent, and not lost.
    losses, is_refused = message.losses, message.is_refused
    came = 1.0 - loss_probability
    if told == "numbered":
        came = came * agrees_with_number(losses, unsent.shape[-1])
    refused = [status_after_sending(status * came, is_lost=False) for status in (unsent, must_send)]
    # No value and no word of a loss: where losses are known y was not sent, else it may be lost.
    is_silent = ~(losses > 0) if told == "known" else ~is_refused
    may_be_lost = losses > 0 if told == "known" else ~is_refused
    return SilenceByCause(
        unsent=jnp.where(is_silent, unsent, 0.0),
        dropped=jnp.where(is_refused, refused[0], jnp.where(may_be_lost, dropped, 0.0)),
        forced=jnp.where(is_refused, refused[1], jnp.where(may_be_lost, forced, 0.0)),
    )


def agrees_with_number(losses: jax.Array, counted: int) -> jax.Array:
    """Return which of the counts 0 to `counted` - 1 of lost transmissions agree with a number that came; all with NaN.

    The last count stands for all larger numbers too.
    """
    number = jnp.clip(jnp.where(jnp.isnan(losses), 0.0, losses).astype(int), 0, counted - 1)
    return jnp.isnan(losses) | (jnp.arange(counted) == number)


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
