"""Plants with further states: past outputs of the sensor, offset and drift of clocks."""

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.bias import driven_by
from heliograph.model.channel import Channel, check_link
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant, NoiseFunction, Plant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor, check_linear, check_sensor
from heliograph.numerics.check import array, fail, function, instance, scalar, table
from heliograph.numerics.module import readable
from heliograph.numerics.traced import library
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.delay import of_line
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent, Matrix, Shaped, Square, Vector


def with_past(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> tuple[AnyPlant, LinearSensor, Channel]:
    """Return plant, sensor and channel with the states (x_k, y_k, y_{k-1}, ..., y_{k-D}), all sent without delay.

    y+ = C (A x + B u + w) + v is a state with its noise, so that one y received twice is known to be one. Past states x
    instead would take its noise for two independent ones, and claim too little. Before the first step zeros were sent.
    The channel, a map of all that is sent, draws as the late one does; any filter of linear plants takes the three.

    Args:
        plant: linear.
        sensor: linear.
        channel: one that delivers late, by up to D steps.

    Raises:
        ValueError: a plant or sensor that is not linear or has angles, parts that do not fit, process noise that
            depends on inputs.
    """
    check_linear("plant and sensor behind a random delay", plant, sensor)
    check_link(first(sensor), first(channel), len(first(plant).states), late=True)
    moved: AnyPlant = at_each_step(partial(_with_line, past=first(channel).past), plant, sensor)
    n, total = len(first(plant).states), len(first(moved).states)
    everything = LinearSensor(np.eye(total)[n:], np.zeros((total - n, total - n)), first(moved).states[n:])
    return moved, everything, of_line(channel)


def _with_line(plant: Any, sensor: Any, past: int) -> LinearPlant:
    """Return x+ = A x + B u + w, y+ = C x+ + v as one plant whose line of past outputs is shifted by one."""
    if not isinstance(plant.noise, AbstractNoise):
        raise fail("noise of a plant behind a random delay", "a covariance or a noise law", "a function of the inputs")
    c = sensor.matrix
    xp = library(plant.matrix, plant.input_matrix, c)
    m, n = c.shape
    length = past * m
    # (w, v) enters x+ and y+ = C w + v.
    enters = xp.block([[np.eye(n), np.zeros((n, m))], [c, np.eye(m)], [np.zeros((length, n + m))]])
    # y_k, ..., y_{k-D+1} move on by one place.
    shift = np.eye(length, length + m)
    moves = xp.concatenate([plant.matrix, c @ plant.matrix, np.zeros((length, n))])
    rest = np.concatenate([np.zeros((n + m, length + m)), shift])
    driven = xp.concatenate([plant.input_matrix, c @ plant.input_matrix, np.zeros((length, len(plant.inputs)))])
    # Nothing was sent before the start.
    law = Gaussian(plant.initial_covariance) if plant.deviation is None else plant.deviation
    names = sensor.outputs
    line = [f"{name}_{d}_ago" if d else f"{name}_sent" for d in range(past + 1) for name in names]
    return LinearPlant(
        xp.concatenate([moves, rest], axis=1),
        Shaped(enters, Independent([plant.noise, sensor.noise])),
        xp.concatenate([plant.initial_mean - law.mean, np.zeros(length + m)]),
        Independent([law, Gaussian(np.zeros((length + m, length + m)))]),
        driven,
        (*plant.states, *line),
        plant.inputs,
    )


Motion = Callable[[jax.Array], ArrayLike] | Matrix  # dx/dt, or the matrix of it


@readable
class Clock(NamedTuple):
    """A clock that shows t + offset at t; the offset grows by `drift` a unit of time, the drift wanders.

    offset, drift: their standard deviations at the start; wander: variance that the drift gains at each step; delay:
    mean of the offset at the start, by which stamps are late (`fit` learns it against a truth). The drift has mean 0.
    """

    offset: float
    drift: float
    wander: float = 0.0
    delay: float = 0.0


class Stamped(AbstractSensor):
    """A sensor whose values are of the time that its clock shows: h(x(s - o)) = h(x) - o dh/dt to first order.

    `offset` is the place of o among the states, `states` the number of those that the sensor measures.
    """

    base: AbstractSensor
    noise: AbstractNoise
    motion: Motion | None
    states: int = eqx.field(static=True)
    offset: int = eqx.field(static=True)
    outputs: tuple[str, ...] = eqx.field(static=True)

    def measure(self, x: jax.Array) -> jax.Array:
        """h(x) - o dh/dt; h(x) where the clock is right."""
        state = jnp.asarray(x)[: self.states]
        if self.motion is None:
            return self.base.measure(state)
        rate = jnp.asarray(self.motion(state) if callable(self.motion) else jnp.asarray(self.motion) @ state)
        y, change = jax.jvp(self.base.measure, (state,), (rate,))
        return jnp.asarray(y - x[self.offset] * change)


class Clocked(AbstractPlant):
    """Nonlinear plant with offset and drift of clocks as further states."""

    base: AbstractPlant
    move: Matrix
    noise: AbstractNoise | NoiseFunction
    initial_mean: Vector
    initial_covariance: Square
    deviation: AbstractNoise | None
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)

    def transition(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """(f(x, u), offset + dt drift, drift)."""
        n = len(self.base.states)
        return jnp.concatenate([self.base.transition(x[:n], u), jnp.asarray(self.move) @ x[n:]])


def with_clocks(
    plant: "AbstractPlant",
    sensors: "Mapping[str, AbstractSensor]",
    clocks: "Mapping[str, Clock]",
    motion: "Motion | Float[ArrayLike, 'n n']",
    dt: "Float[ArrayLike, '']",
) -> "tuple[LinearPlant | Plant | Clocked, dict[str, LinearSensor | Stamped]]":
    """Return the plant with an offset and a drift for each clock as states, and the sensors of all nodes for it.

    A node of `clocks` stamps its values by its own clock, s = t + o, and a value is taken as one of its stamp. The
    sensor then measures the plant o before that time, h = y - o dy/dt. The new states are "NODE_offset" and
    "NODE_drift".

    Args:
        plant: the plant, constant over time.
        sensors: sensor of each node, by its name.
        clocks: clock of each node that has one of its own.
        motion: dx/dt, a function of x or its matrix (n, n).
        dt: time of a step, over which o grows by dt drift.

    Raises:
        ValueError: a clock whose node has no sensor, negative deviations, noise that depends on inputs, wrong shapes.
    """
    instance("plant with clocks", plant, AbstractPlant, "a plant that does not vary")
    sensors, clocks = table("sensors", sensors, "sensors of nodes"), table("clocks", clocks, "clocks of nodes")
    n, step = len(plant.states), scalar("time of a step", dt, 0.0)
    if set(clocks) - set(sensors) or not clocks:
        raise fail("clocks", f"those of some of the nodes {list(sensors)}", list(clocks))
    for name, sensor in sensors.items():
        check_sensor(instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary"), n)
    moving = function("motion", motion, "x") if callable(motion) else array("motion", motion, (n, n))
    places = {name: n + 2 * i for i, name in enumerate(clocks)}
    return _plant(plant, clocks, step), {
        name: _sensor(sensor, moving, n, n + 2 * len(clocks), places.get(name)) for name, sensor in sensors.items()
    }


def _plant(plant: AbstractPlant, clocks: Mapping[str, Clock], dt: float) -> LinearPlant | Plant | Clocked:
    if not isinstance(plant.noise, AbstractNoise):
        raise fail("noise of a plant with clocks", "a covariance or a noise law", "a function of the inputs")
    # Independent initial offset and drift of each clock; drift is a random walk.
    spread, wander, start_at = [], [], []
    for name, clock in clocks.items():
        start_at += [scalar(f"delay of the clock of {name!r}", clock.delay), 0.0]
        for field in ("offset", "drift", "wander"):
            scalar(f"{field} of the clock of {name!r}", getattr(clock, field), 0.0)
        spread += [clock.offset**2, clock.drift**2]
        wander += [0.0, clock.wander]
    # o+ = o + dt d, d+ = d.
    move = np.kron(np.eye(len(clocks)), np.array([[1.0, dt], [0.0, 1.0]]))
    names = [f"{name}_{field}" for name in clocks for field in ("offset", "drift")]
    if isinstance(plant, LinearPlant):
        center = library(start_at).stack([library(start_at).asarray(x) for x in start_at])
        drifting = LinearPlant(move, np.diag(wander), center, np.diag(spread), states=names)
        return driven_by(plant, drifting, np.zeros((len(plant.states), len(move))))
    law = Gaussian(plant.initial_covariance) if plant.deviation is None else plant.deviation
    noise, start = Independent([plant.noise, Gaussian(np.diag(wander))]), Independent([law, Gaussian(np.diag(spread))])
    xp = library(plant.initial_mean, start_at)
    center = xp.concatenate([plant.initial_mean - law.mean, xp.stack([xp.asarray(x) for x in start_at])])
    return Clocked(
        base=plant,
        move=move,
        noise=noise,
        initial_mean=center + start.mean,
        initial_covariance=start.covariance,
        deviation=start,
        states=(*plant.states, *names),
        inputs=plant.inputs,
    )


def _sensor(
    sensor: AbstractSensor, motion: Motion, states: int, total: int, offset: int | None
) -> LinearSensor | Stamped:
    if offset is None and isinstance(sensor, LinearSensor):
        matrix = library(sensor.matrix).pad(sensor.matrix, ((0, 0), (0, total - states)))
        return LinearSensor(matrix, sensor.noise, sensor.outputs)
    stamped = motion if offset is not None else None
    return Stamped(
        base=sensor, noise=sensor.noise, motion=stamped, states=states, offset=offset or 0, outputs=sensor.outputs
    )


class JointSensor(AbstractSensor):
    """Sensors of one state, their outputs one above the other, their noises independent."""

    parts: tuple[AbstractSensor, ...]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def measure(self, x: jax.Array) -> jax.Array:
        """All of them."""
        return jnp.concatenate([sensor.measure(x) for sensor in self.parts])


def joint_sensor(sensors: Mapping[str, AbstractSensor]) -> JointSensor:
    """Stack the sensors of nodes, in their order, as one; with `parallel` of their channels it serves a fusion centre.

    Args:
        sensors: by node; the outputs are named NODE_OUTPUT.

    Raises:
        ValueError: no sensors, or one that varies.
    """
    by_node = table("sensors", sensors, "sensors of nodes")
    if not by_node:
        raise fail("sensors", "at least one", "none")
    for name, sensor in by_node.items():
        instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary")
    outputs = tuple(f"{name}_{output}" for name, sensor in by_node.items() for output in sensor.outputs)
    noise = Independent([sensor.noise for sensor in by_node.values()])
    return JointSensor(parts=tuple(by_node.values()), noise=noise, outputs=outputs)
