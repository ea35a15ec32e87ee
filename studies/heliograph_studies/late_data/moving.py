"""A point that moves in the plane, pushed at random; each packet holds its position, measured when it was sent."""

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.live.event import Event
from heliograph_studies.late_data.packets import Packets

PUSH = 0.1  # m^2/s^3, density of the white acceleration, each axis
VARIANCE = 0.25  # m^2, each axis
BEGIN = 300.0  # s of the packets
STEP = 1.0  # s between the moments that are judged


def transition(x: jax.Array, u: jax.Array) -> jax.Array:
    """Position and velocity of both axes, (x, y, vx, vy), over dt."""
    return x + u[0] * jnp.concatenate([x[2:], jnp.zeros(2)])


def spread(u: jax.Array) -> jax.Array:
    """Covariance that the pushes of an interval add."""
    dt = u[0]
    item = PUSH * jnp.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    return jnp.kron(item, jnp.eye(2))


plant = hg.Plant(transition, spread, np.zeros(4), np.eye(4), states=("x", "y", "vx", "vy"), inputs=("dt",))
sensor = hg.LinearSensor(np.eye(2, 4), VARIANCE * np.eye(2), outputs=("x", "y"))
network = hg.Network(
    plant, {"root": hg.Node(sensor, hg.perfect(2), {"filter": hg.extended_filter(plant, sensor, hg.perfect(2))})}
)


def packets_of(packets: Packets, duration: float) -> Packets:
    """Those that were sent in the stretch that is used, from its beginning."""
    used = packets.among((packets.sent >= BEGIN) & (packets.sent < BEGIN + duration))
    return Packets(used.node, used.sequence, used.sent - BEGIN, used.received - BEGIN)


def moments(duration: float) -> np.ndarray:
    """Those that are judged."""
    return np.arange(STEP, duration + STEP / 2, STEP)


def world(packets: Packets, duration: float, seed: int) -> tuple[list[Event], np.ndarray, np.ndarray]:
    """What the packets hold, and the true position at each of the times returned beside it."""
    generator = np.random.default_rng(seed)
    times = np.unique(np.concatenate([packets.sent, moments(duration), [0.0]]))
    # The path: white acceleration over each interval.
    state, path = generator.normal(size=(2, 2)), np.zeros((len(times), 2))  # (position and velocity, axis)
    for i, dt in enumerate(np.diff(times, prepend=0.0)):
        item = PUSH * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        push = np.linalg.cholesky(item + 1e-30 * np.eye(2)) @ generator.normal(size=(2, 2)) if dt else 0.0
        state = np.array([[1.0, dt], [0.0, 1.0]]) @ state + push
        path[i] = state[0]
    # What each packet holds: the position when it was sent, and noise.
    local = packets.first_received()
    noise = dict.fromkeys(zip(packets.node, packets.sequence, packets.sent, strict=True))
    for name in noise:  # a copy holds what the first one does
        noise[name] = np.sqrt(VARIANCE) * generator.normal(size=2)
    events = []
    for i in range(len(local)):
        name = packets.node[i], packets.sequence[i], packets.sent[i]
        place = np.searchsorted(times, packets.sent[i])
        number = (int(packets.node[i]) << 16) + int(packets.sequence[i])  # one node receives them all
        events.append(
            Event("root", number, float(packets.sent[i]), path[place] + noise[name], float(packets.received[i]))
        )
    return events, times, path
