"""The mower of the demonstration, in continuous time; its ranges travel as the packets of a network did."""

from collections.abc import Sequence
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.live.event import INPUTS, Event
from heliograph_studies.demo import robot
from heliograph_studies.demo.recording import PlazaRecording
from heliograph_studies.late_data.packets import Packets
from heliograph_studies.late_data.replay import arrival_of

DRIVE = robot.DRIVES["plaza2"]


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    """Along an arc at a speed and a rate of turn that are held, u = (speed, rate, dt); x = (x, y, heading)."""
    distance, turn = u[0] * u[2], (u[1] - DRIVE.gyro_rate) * u[2]
    course = x[2] + turn / 2
    chord = distance * jnp.sinc(turn / (2 * jnp.pi))
    return x + jnp.stack([chord * jnp.cos(course), chord * jnp.sin(course), turn])


def drift(u: jax.Array) -> jax.Array:
    """Covariance that the odometry adds meanwhile."""
    walk = robot.POSITION_WALK * jnp.abs(u[0])
    return u[2] * jnp.diag(jnp.stack([walk, walk, jnp.asarray(robot.HEADING_WALK)]))


@cache
def network() -> hg.Network:
    """The robot's own filter, which receives ranges that come through the network, started where the truth does."""
    start = np.diag(robot.START_DEVIATION**2)
    plant = hg.Plant(move, drift, DRIVE.start, start, ("x", "y", "heading"), ("speed", "turn_rate", "dt"))
    sensor = hg.Sensor(robot.ranges(DRIVE.beacons), robot.RANGE_VARIANCE, [f"range_{i}" for i in range(1, 5)])
    channel = hg.perfect(len(DRIVE.beacons))
    filters = {"filter": hg.cubature_filter(plant, sensor, channel)}
    return hg.Network(plant, {"robot": hg.Node(sensor, channel, filters)})


def odometry(recording: PlazaRecording) -> list[Event]:
    """Speed and rate of turn from each row's time to the next one's."""
    distance, turn, duration = recording.odometry.T
    moves = duration > 0
    begin = (recording.time - recording.start - duration)[moves]
    rates = np.column_stack([distance, turn])[moves] / duration[moves, None]
    return [
        Event(INPUTS, i, max(float(t), 0.0), u, max(float(t), 0.0))
        for i, (t, u) in enumerate(zip(begin, rates, strict=True))
    ]


def ranges(recording: PlazaRecording, packets: Packets) -> tuple[list[Event], int]:
    """Each range as it was received, and how many never were.

    The beacons stand for the most received nodes; the k-th range of a beacon has the fate of the k-th packet of
    its node, from the first again after the last.
    """
    fates = fates_by_node(packets)
    clock, used = recording.time - recording.start, [0] * len(recording.beacons)
    events = []
    for row, value in enumerate(recording.ranges):
        beacon = int(np.flatnonzero(~np.isnan(value))[0])
        fate = fates[beacon % len(fates)]
        delay = fate[used[beacon] % len(fate)]
        used[beacon] += 1
        if not np.isnan(delay):
            events.append(Event("robot", row, float(clock[row]), value, float(clock[row] + delay)))
    return sorted(events, key=arrival_of), len(clock) - len(events)


def fates_by_node(packets: Packets) -> Sequence[np.ndarray]:
    """Delays of each node's packets, NaN for lost ones, one boot after another; those received most come first."""
    by_node: dict[int, list[np.ndarray]] = {}
    for part, fate in zip(packets.boots(), packets.fates(), strict=True):
        by_node.setdefault(int(part.node[0]), []).append(fate)
    joined = [np.concatenate(parts) for parts in by_node.values()]
    return sorted(joined, key=lambda fate: -np.count_nonzero(~np.isnan(fate)))
