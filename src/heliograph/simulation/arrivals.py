"""Arrivals of a record as events: each received value with its step and its time of arrival."""

import numpy as np

from heliograph.model.over_time import OverTime, at
from heliograph.numerics.check import check_count, fail, instance
from heliograph.random_affine.delay import Delayed
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.record import Record

Arrival = tuple[str, int, float, np.ndarray, float]  # node, sequence, time, values, arrival


def arrivals(record: Record, network: Network, run: int = 0) -> list[Arrival]:
    """List what was received in one run, (node, sequence, time, values, arrival), in the order of arrival.

    Times are steps from 0. A value belongs to the step at which it was sent, which is its sequence number too: by a
    constant delay, or by its time stamp. A value that is received twice has one number, and two channel noises.
    Values received before the first was sent, and lost ones, are left out.

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
        values = z if z.ndim == 2 else z[check_count("run", run, 0)]
        values, late = _timed(name, network.nodes[name], values)
        there = ~np.isnan(values).all(axis=1) & ~np.isnan(late)
        for k in np.flatnonzero(there):
            sent = int(k - late[k])
            if sent >= 0:
                results.append((name, sent, float(sent), values[k], float(k)))
    return sorted(results, key=lambda event: event[-1])


def _timed(name: str, node: object, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (steps, m), and the delay of each (steps,)."""
    channel = node.channel if isinstance(node, Node) else None
    link = at(channel, 0) if isinstance(channel, OverTime) else channel
    if link is None or not link.past:
        return z, np.zeros(len(z))
    if isinstance(link, Delayed) and link.timestamped:
        return z[:, :-1], z[:, -1]
    if isinstance(link, Delayed) and link.constant:
        return z, np.full(len(z), float(link.past))
    raise fail(f"delays of node {name!r}", "constant ones, or time stamps", "random ones without time stamps")
