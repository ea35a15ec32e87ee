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
from heliograph.fusion.mesh.gains import correct
from heliograph.fusion.quantizer import AbstractQuantizer, widen
from heliograph.numerics.types import Array, Bool, Float, Int


class OnTheWay(NamedTuple):
    """Estimates of the state that messages sent 1, 2, ... steps ago give now, by the node that sent them.

    Shapes: mean (age, node, n), NaN of what saturated its quantizer; covariance (age, node, n, n).
    """

    mean: Float[jax.Array, "age node n"]
    covariance: Float[jax.Array, "age node n n"]


class Messages(NamedTuple):
    """Estimates of the nodes and, after them, those that messages bring, by age and node; which of them a node has.

    Shapes: mean (row, n), covariance (row, n, n); senders (node, degree), rows of the node itself and of the messages;
    arrives and fresh (node, rounds, degree): estimates that arrive, and measurements of this step that do.
    """

    mean: Float[jax.Array, "row n"]
    covariance: Float[jax.Array, "row n n"]
    senders: Int[jax.Array | np.ndarray, "node degree"]
    arrives: Bool[jax.Array, "node rounds degree"]
    fresh: Bool[jax.Array, "node rounds degree"]


def test_moved_beyond(
    alpha: Array, off: Float[jax.Array, "node degree n"], information: Float[jax.Array, "node degree n n"],
    senders: np.ndarray, present: np.ndarray,
) -> Bool[jax.Array, " node"]:  # fmt: skip
    """Test which nodes send: those that are `off` by off' P^-1 off > alpha n from what somebody received last.

    Where the message arrives, the error of what was received last is then at most (1 + sqrt(alpha n))^2 P, whatever got
    lost before: E[(e + d) (e + d)'] <= (1 + 1/t) P + (1 + t) E[d d'], d d' <= alpha n P, any t.
    """
    far = jnp.einsum("ida,idab,idb->id", off, information, off) > alpha * off.shape[-1]
    moving = (far & present)[:, 1:]  # for others
    return jnp.zeros(len(off), dtype=int).at[senders[:, 1:]].add(moving.astype(int)) > 0


def quantize_estimate(
    quantizer: AbstractQuantizer, mean: Float[jax.Array, " n"], covariance: Float[jax.Array, "n n"]
) -> tuple[Float[jax.Array, " n"], Float[jax.Array, "n n"]]:
    """Return what a node sends of an estimate: quantized, and wider; NaN where it is beyond the amplitude."""
    value = quantizer.step((), mean)[1]
    received = jnp.where(jnp.any(value.saturated), jnp.nan, value.value)
    return received, widen(covariance, jnp.asarray(quantizer.error(len(mean))))


def gather_messages(
    mean: jax.Array, covariance: jax.Array, way: OnTheWay, quantizer: AbstractQuantizer | None, senders: np.ndarray,
    ages: Int[jax.Array, "node rounds degree"],
) -> Messages:  # fmt: skip
    """Return what arrives at a step: `ages` of the messages, -1 where none does.

    An estimate that saturates its quantizer did not arrive, however late; the measurement sent with it arrives at once
    or not at all. So data decide what is fused: E[e_i e_i'] given that x was beyond the amplitude may be far above P_i.
    """
    sent = mean, covariance
    if quantizer is not None:
        sent = eqx.filter_vmap(quantize_estimate, in_axes=(eqx.if_array(0), 0, 0))(quantizer, *sent)
    means, covariances = (
        jnp.concatenate([alone, now, late.reshape(-1, *alone.shape[1:])])
        for alone, now, late in zip((mean, covariance), sent, way, strict=True)
    )
    rows = jnp.asarray(senders) + len(mean) * (1 + jnp.maximum(ages[:, -1], 0))
    # In place of an estimate that did not arrive a node's own, which is a number.
    without = jnp.any(jnp.isnan(means), axis=1)[rows]
    rows = jnp.where(without, senders[:, :1], rows).at[:, 0].set(senders[:, 0])
    return Messages(means, covariances, rows, (ages >= 0) & ~without.at[:, 0].set(False)[:, None], ages == 0)


def step_way(
    messages: Messages, way: OnTheWay, motion: Motion, common: jax.Array, weighted: jax.Array, information: jax.Array
) -> OnTheWay:
    """Return the estimates on the way after a step, of measurements with sums `weighted` of innovations about `common`.

    Shapes: common (n,); weighted (node, n), H_j' R_j^-1 (z_j - H_j common); information (node, n, n).
    """
    nodes, (ages, count) = len(weighted), way.mean.shape[:2]
    a, shift = jnp.asarray(motion.matrix), jnp.asarray(motion.shift)

    def predicted(mean: jax.Array, covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        return mean @ a.T + shift, a @ covariance @ a.T + motion.noise

    # What is sent now is corrected by the measurement that is sent with it; what was sent before is predicted.
    mean, before = predicted(messages.mean[nodes : 2 * nodes], messages.covariance[nodes : 2 * nodes])
    covariance, _ = jax.vmap(correct)(before, information)
    innovation = weighted - jnp.einsum("iab,ib->ia", information, mean - common)
    mean = mean + jnp.einsum("iab,ib->ia", covariance, innovation)
    older = predicted(*way) if ages else tuple(way)

    def first_ages(now: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.concatenate([now[None], old])[:ages].reshape(ages, count, *now.shape[1:])

    return OnTheWay(first_ages(mean, older[0]), first_ages(covariance, older[1]))
