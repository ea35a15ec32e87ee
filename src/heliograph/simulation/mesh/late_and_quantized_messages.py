"""Messages between neighbours that are not their estimates as they are: quantized, or late by some steps.

What was sent some steps ago, an estimate of the step before and a measurement z_j, says of the state now what the
receiver makes of it: corrected by z_j, then predicted, P+ = A P A' + Q for each step on the way. An intersection may
use it whatever its correlation with other estimates.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.cross_covariance import Motion
from heliograph.fusion.mesh.node_gains import correct_by_information
from heliograph.fusion.quantizer import AbstractQuantizer, widen_by_quantization
from heliograph.numerics.types import Array, Bool, Float, Int


class MessagesOnTheWay(NamedTuple):
    """Estimates of the state now from messages that were sent 1, 2, ... steps ago and may still arrive, by sender.

    Shapes: mean (age, node, n), NaN of what saturated its quantizer; covariance (age, node, n, n).
    """

    mean: Float[jax.Array, "age node n"]
    covariance: Float[jax.Array, "age node n n"]


class ArrivingEstimates(NamedTuple):
    """Estimates that arrive in a step, one row each: the nodes' own, then those sent now, 1 step ago and so on.

    Shapes: mean (row, n), covariance (row, n, n). `senders` (node, degree): the row that each node has of itself, and
    of each neighbour. `arrives` and `fresh` (node, rounds, degree): whether an estimate arrives, and whether a
    measurement of this step does.
    """

    mean: Float[jax.Array, "row n"]
    covariance: Float[jax.Array, "row n n"]
    senders: Int[jax.Array | np.ndarray, "node degree"]
    arrives: Bool[jax.Array, "node rounds degree"]
    fresh: Bool[jax.Array, "node rounds degree"]


def find_event_senders(
    alpha: Array, difference: Float[jax.Array, "node degree n"], information: Float[jax.Array, "node degree n n"],
    senders: np.ndarray, present: np.ndarray,
) -> Bool[jax.Array, " node"]:  # fmt: skip
    """Return which nodes send: those with d' P^-1 d > alpha n for some neighbour.

    Args:
        alpha: threshold of the events.
        difference: d, for each node and neighbour: the sender's estimate minus what the node received from it last.
        information: P^-1 of the sender's estimate.
        senders: the numbers of the nodes that each node receives (node, degree), itself first.
        present: True where a node has a neighbour in this place (node, degree).

    If the sent messages arrive, the received estimate has an error covariance of at most (1 + sqrt(alpha n))^2 P:
    E[(e + d) (e + d)'] <= (1 + 1/t) P + (1 + t) E[d d'] for any t > 0, and d d' <= alpha n P where nothing is sent.
    """
    squared_distance = jnp.einsum("ida,idab,idb->id", difference, information, difference)
    is_far = squared_distance > alpha * difference.shape[-1]
    # A node sends if it is far from what any neighbour received last; place 0 is the node itself.
    is_far_for_neighbour = (is_far & present)[:, 1:].astype(int)
    zeros = jnp.zeros(len(difference), dtype=int)
    receivers_in_need = zeros.at[senders[:, 1:]].add(is_far_for_neighbour)
    return receivers_in_need > 0


def quantize_estimate(
    quantizer: AbstractQuantizer, mean: Float[jax.Array, " n"], covariance: Float[jax.Array, "n n"]
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return the estimate as it is received: its mean quantized, and its covariance widened by the quantizer's error.

    The mean is NaN if the quantizer saturates. The quantizer's state is (): quantizers between neighbours have none.
    """
    _, quantized = quantizer.step((), mean)
    received = jnp.where(jnp.any(quantized.saturated), jnp.nan, quantized.value)
    error_bound = jnp.asarray(quantizer.error(len(mean)))
    return received, widen_by_quantization(covariance, error_bound)


def gather_messages(
    mean: jax.Array, covariance: jax.Array, way: MessagesOnTheWay, quantizer: AbstractQuantizer | None,
    senders: np.ndarray, ages: Int[jax.Array, "node rounds degree"],
) -> ArrivingEstimates:  # fmt: skip
    """Return the estimates that arrive at a step.

    Nodes send their estimates to neighbours, quantised or late. An estimate that saturates its quantizer never arrives;
    the measurement sent with it arrives at once or not at all. So data decide what is fused: given that x was beyond
    the quantizer's amplitude, E[e_i e_i'] may be far above the covariance P_i.

    Args:
        mean: estimates of the nodes now (node, n).
        covariance: covariances of their errors (node, n, n).
        way: messages that were sent 1, 2, ... steps before, as estimates of the present state (age, node, ...).
        quantizer: quantizer of the estimates that are sent, stacked by node; None where they are sent as they are.
        senders: numbers of the nodes of which each node receives (node, degree), itself first.
        ages: ages in steps of the messages that arrive, -1 where none does; the last round counts.
    """
    # Rows: the nodes' own estimates, what they send now, then what they sent 1, 2, ... steps ago.
    sent = mean, covariance
    if quantizer is not None:
        sent = eqx.filter_vmap(quantize_estimate, in_axes=(eqx.if_array(0), 0, 0))(quantizer, *sent)
    means, covariances = (
        jnp.concatenate([own, now, late.reshape(-1, *own.shape[1:])])
        for own, now, late in zip((mean, covariance), sent, way, strict=True)
    )
    # The message of age a from node j is row (1 + a) nodes + j; where none arrives, age 0 stands in and is not used.
    rows = jnp.asarray(senders) + len(mean) * (1 + jnp.maximum(ages[:, -1], 0))
    # An estimate that saturated is NaN. Its row becomes the receiver's own, a number, which is then not used. The first
    # message is the receiver's own in any case.
    saturated = jnp.any(jnp.isnan(means), axis=1)[rows]
    rows = jnp.where(saturated, senders[:, :1], rows).at[:, 0].set(senders[:, 0])
    return ArrivingEstimates(
        mean=means,
        covariance=covariances,
        senders=rows,
        arrives=(ages >= 0) & ~saturated.at[:, 0].set(False)[:, None],
        fresh=ages == 0,
    )


def step_messages_on_the_way(
    messages: ArrivingEstimates,
    way: MessagesOnTheWay,
    motion: Motion,
    common: jax.Array,
    weighted: jax.Array,
    information: jax.Array,
) -> MessagesOnTheWay:
    """Return the estimates on the way after a step: those sent now join, corrected by the measurement sent with them.

    Args:
        messages: estimates that arrived in the step; its rows from `nodes` to 2 `nodes` are those sent now.
        way: estimates (age, node, ...) in messages that were sent before the step and may still arrive.
        motion: the plant over the step.
        common: the state m about which measurements are taken (n,).
        weighted: H_j' R_j^-1 (z_j - H_j m) of each node's measurement (node, n).
        information: H_j' R_j^-1 H_j (node, n, n).
    """
    nodes, (ages, senders) = len(weighted), way.mean.shape[:2]  # numbers of nodes, of ages on the way, of senders
    a, offset = jnp.asarray(motion.matrix), jnp.asarray(motion.offset)

    def predict(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return estimates (..., n) and their covariances (..., n, n) predicted by one step."""
        return mean @ a.T + offset, a @ covariance @ a.T + motion.noise

    # What is sent now, predicted, and corrected by the measurement that is sent with it.
    mean, predicted_covariance = predict(messages.mean[nodes : 2 * nodes], messages.covariance[nodes : 2 * nodes])
    covariance, _ = jax.vmap(correct_by_information)(predicted_covariance, information)
    innovation = weighted - jnp.einsum("iab,ib->ia", information, mean - common)
    mean = mean + jnp.einsum("iab,ib->ia", covariance, innovation)
    # What was sent before, predicted; nothing where no message takes longer than a step.
    older_mean, older_covariance = predict(way.mean, way.covariance) if ages else way

    def put_before(older: jax.Array, now: jax.Array) -> jax.Array:
        """Return what is sent now (node, ...) before what is older (age, node, ...), without the oldest."""
        return jnp.concatenate([now[None], older])[:ages].reshape(ages, senders, *now.shape[1:])

    return MessagesOnTheWay(put_before(older_mean, mean), put_before(older_covariance, covariance))
