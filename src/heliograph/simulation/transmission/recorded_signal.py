"""Transmission of a recorded signal through any channel, and what arrived of a record as events."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.model.channel import Channel
from heliograph.model.over_time import at, first, steps_covered
from heliograph.numerics.check import array, check_count, check_horizon, check_seed, fail, instance, rank
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.delay import DelayedLink
from heliograph.random_affine.moments.signal_path import apply
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.random_keys import CHANNEL, CHANNEL_START, checksum, draw_key
from heliograph.simulation.results.record import Record

Arrival = tuple[str, int, float, np.ndarray, float]  # node, sequence, time, values, arrival

SENDER = checksum("transmit")


def transmit(signal: Float[ArrayLike, "*shape"], channel: Channel, seed: int = 0) -> Float[np.ndarray, "steps outputs"]:
    """Transmit a recorded signal y through a channel, z_k = G_k y_k + n_k, with new draws of G_k and n_k at each step.

    Measured data can so be tried behind a radio link before it exists. Draws are independent unless the channel has
    memory. NaN in the signal was not sent: outputs to which G_k carries it are NaN. Outputs that the channel loses are
    NaN too.

    Args:
        signal: (steps, inputs), or (steps,) for a channel with one input; a table of pandas or polars too.
        channel: the law of G_k and n_k; it may vary over time, or have modes that follow a Markov chain.
        seed: seed of the draws; 0 by default.

    Returns:
        The received signal (steps, outputs).

    Raises:
        ValueError: no channel, a signal of another shape or with infinite values, more steps than the channel covers.
    """
    instance("channel", first(channel), AbstractRandomAffine, "a channel, such as hop(...)")
    inputs = first(channel).inputs
    is_one_axis = inputs == 1 and rank("signal", signal) == 1
    shape = (None,) if is_one_axis else (None, inputs)
    y = array("signal", signal, shape, missing=True).reshape(-1, inputs)
    if not len(y):
        raise fail("signal", "at least one step", "none")
    # A channel that varies over time may cover fewer steps than the signal. Then draw all steps, natively or by XLA.
    check_horizon(len(y), steps_covered(channel))
    arguments = channel, y, np.asarray(check_seed("seed", seed))
    return np.asarray(compute_once(_transmit_all, _by_xla, arguments))


def _transmit_all(channel: Channel, y: Float[Array, "steps m"], seed: Array) -> jax.Array:
    """Return the rows of y (steps, m) as a channel delivers them, by the draws of a seed.

    NaN where a missing number would be used.
    """
    key = jax.random.key(seed)

    def step(state: PyTree, row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, jax.Array]:
        """Return the channel's next state, and what arrives of y in row k, by the drawn `matrix` [G n; 0 1]."""
        k, y_k = row
        is_missing = jnp.isnan(y_k)
        state, matrix = at(channel, k).draw(state, draw_key(key, k, SENDER, CHANNEL))
        # An output lacks an input if the gain carries a number to it that was not sent.
        gain = matrix[:-1, :-1]
        lacks_input = jnp.any((gain != 0) & is_missing, axis=1)
        received = apply(matrix, jnp.where(is_missing, 0.0, y_k))
        return state, jnp.where(lacks_input, jnp.nan, received)

    start = at(channel, k=0).init(draw_key(key, k=0, source=SENDER, purpose=CHANNEL_START))
    received: jax.Array
    _, received = jax.lax.scan(step, start, (jnp.arange(len(y)), jnp.asarray(y)))
    return received


_by_xla = quickly_compiled(_transmit_all)


def arrivals(record: Record, network: Network, run: int = 0) -> list[Arrival]:
    """Return what was received in one run, (node, sequence, time, values, arrival), in the order of arrival.

    Times are steps from 0. A value belongs to the step at which it was sent, which is its sequence number too. This
    step is known from the channel's constant delay, or from the value's time stamp. A value that is received twice has
    one number, and two channel noises. Values received before the first was sent, and lost ones, are left out.

    Args:
        record: the record.
        network: the network that it is a record of.
        run: number of the run; 0 by default.

    Raises:
        ValueError: a node whose delays are random without time stamps, so that a value's step is unknown.
    """
    instance("record", record, Record, "a Record")
    instance("network", network, Network, "a Network")
    if set(record.measurements) - set(network.nodes):
        raise fail("network", f"one with the record's nodes {list(record.measurements)}", list(network.nodes))
    results: list[Arrival] = []
    # Node by node; a value of step k - delay arrives at step k.
    for name, z in record.measurements.items():
        values = z if z.ndim == 2 else z[check_count("run", run, least=0)]
        values, delays = _separate_delays(name, network.nodes[name], values)
        # A row arrived if any of its numbers did, and its delay is known; it was sent at step k - delay.
        arrived = ~np.isnan(values).all(axis=1) & ~np.isnan(delays)
        for k in np.flatnonzero(arrived):
            sent = int(k - delays[k])
            if sent >= 0:
                results.append((name, sent, float(sent), values[k], float(k)))
    return sorted(results, key=lambda event: event[-1])


def _separate_delays(name: str, node: object, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (steps, m) of what a node received, and the delay of each row in steps (steps,).

    The delay is 0 without delays, and the link's if that is constant. If messages have time stamps, it is the last
    number of each row of z, which is taken off, and NaN for a lost message.
    """
    channel = node.channel if isinstance(node, Node) else None
    link = first(channel)
    if link is None or not link.past:
        return z, np.zeros(len(z))
    if isinstance(link, DelayedLink) and link.timestamped:
        return z[:, :-1], z[:, -1]
    if isinstance(link, DelayedLink) and link.constant:
        return z, np.full(len(z), float(link.past))
    raise fail(f"delays of node {name!r}", "constant ones, or time stamps", "random ones without time stamps")
