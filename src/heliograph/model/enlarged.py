"""Plants with further states: past outputs of the sensor, offset and drift of clocks."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.bias import driven_by
from heliograph.model.channel import Channel, check_link, parallel
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant, Plant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor, Sensor, check_linear, check_sensor
from heliograph.model.sensor_inputs import NoiseOfInputs
from heliograph.numerics.check import array, fail, function, instance, names, scalar, table
from heliograph.numerics.module import Module, readable
from heliograph.numerics.traced import block_diagonal, library
from heliograph.numerics.types import ArrayLike, Float, rename
from heliograph.random_affine.delay import place_on_delay_line
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent, Matrix, Shaped


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
    moved: AnyPlant = at_each_step(partial(_append_line, past=first(channel).past), plant, sensor)
    n, total = len(first(plant).states), len(first(moved).states)
    everything = LinearSensor(np.eye(total)[n:], np.zeros((total - n, total - n)), first(moved).states[n:])
    return moved, everything, place_on_delay_line(channel)


def _append_line(plant: Any, sensor: Any, past: int) -> LinearPlant:
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
    line = [
        rename(name, f"{name}_{d}_ago" if d else f"{name}_sent") for d in range(past + 1) for name in sensor.outputs
    ]
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
        """Return h(x) - o dh/dt; h(x) where the clock is right."""
        state = jnp.asarray(x)[: self.states]
        if self.motion is None:
            return self.base.measure(state)
        rate = jnp.asarray(self.motion(state) if callable(self.motion) else jnp.asarray(self.motion) @ state)
        y, change = jax.jvp(self.base.measure, (state,), (rate,))
        return jnp.asarray(y - x[self.offset] * change)


def with_clocks(
    plant: "AbstractPlant",
    sensors: "Mapping[str, AbstractSensor]",
    clocks: "Mapping[str, Clock]",
    motion: "Motion | Float[ArrayLike, 'n n']",
    dt: "Float[ArrayLike, ''] | str",
) -> "tuple[LinearPlant | Plant, dict[str, LinearSensor | Stamped]]":
    """Return the plant with an offset and a drift for each clock as states, and the sensors of all nodes for it.

    A node of `clocks` stamps its values by its own clock, s = t + o, and a value is taken as one of its stamp. The
    sensor then measures the plant o before that time, h = y - o dy/dt. The new states are "NODE_offset" and
    "NODE_drift".

    Args:
        plant: the plant, constant over time.
        sensors: sensor of each node, by its name.
        clocks: clock of each node that has one of its own.
        motion: dx/dt, a function of x or its matrix (n, n).
        dt: time of a step, over which o grows by dt drift, or the name of the input that says it; wandering over a
            step of varying time is white noise in the drift, of variance wander dt, integrated exactly.

    Raises:
        ValueError: a clock whose node has no sensor, negative deviations, another input, wrong shapes.
    """
    instance("plant with clocks", plant, AbstractPlant, "a plant that does not vary")
    sensors, clocks = table("sensors", sensors, "sensors of nodes"), table("clocks", clocks, "clocks of nodes")
    n = len(plant.states)
    step = _step(plant, dt)
    if set(clocks) - set(sensors) or not clocks:
        raise fail("clocks", f"those of some of the nodes {list(sensors)}", list(clocks))
    for name, sensor in sensors.items():
        check_sensor(instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary"), n)
        sensor.refuse_inputs("a node with a clock")
    moving = function("motion", motion, "x") if callable(motion) else array("motion", motion, (n, n))
    places = {name: n + 2 * i for i, name in enumerate(clocks)}
    larger = driven_by(plant, _make_clocks(clocks, step), np.zeros((n, 2 * len(clocks))))
    return larger, {
        name: _enlarge_sensor(sensor, moving, n, n + 2 * len(clocks), places.get(name))
        for name, sensor in sensors.items()
    }


def _step(plant: AbstractPlant, dt: ArrayLike | str) -> Any:
    """Return the time of a step, or the name of the plant's input that says it."""
    if not isinstance(dt, str):
        return scalar("time of a step", dt, 0.0)
    if dt not in plant.inputs:
        raise fail("dt", f"a number, or one of the inputs {list(plant.inputs)}", repr(dt))
    return plant.inputs[plant.inputs.index(dt)]


def _make_clocks(clocks: Mapping[str, Clock], dt: str | Any) -> LinearPlant:
    """Return offset and drift of each clock: o+ = o + dt d, d+ = d + its wandering, all independent at the start."""
    spread, wander, start_at, states = [], [], [], []
    for name, clock in clocks.items():
        instance(f"clock of {name!r}", clock, Clock, "a Clock")
        start_at += [scalar(f"delay of the clock of {name!r}", clock.delay), 0.0]
        clock_offset, drift, gain = (
            scalar(f"{field} of the clock of {name!r}", getattr(clock, field), 0.0)
            for field in ("offset", "drift", "wander")
        )
        spread += [clock_offset**2, drift**2]
        wander.append(gain)
        offset = f"{name}_offset"  # in the unit of dt, where that is an input with one
        states += [rename(dt, offset) if isinstance(dt, str) else offset, f"{name}_drift"]
    center, start, strength = (library(x).asarray(library(x).stack(x)) for x in (start_at, spread, wander))
    each, xp = np.eye(len(clocks)), library(start, strength)
    start, strength = xp.diag(start), xp.diag(strength)
    if not isinstance(dt, str):
        noise = xp.kron(strength, np.diag([0.0, 1.0]))
        return LinearPlant(np.kron(each, [[1.0, dt], [0.0, 1.0]]), noise, center, start, states=states)

    def move(u: jax.Array) -> jax.Array:
        return jnp.kron(each, jnp.array([[1.0, u[0]], [0.0, 1.0]]))

    def gained(u: jax.Array) -> jax.Array:  # the integral of white noise in the drift, and of that in the offset
        of_step = jnp.array([[u[0] ** 3 / 3, u[0] ** 2 / 2], [u[0] ** 2 / 2, u[0]]])
        return jnp.kron(jnp.asarray(strength), of_step)

    return LinearPlant(move, gained, center, start, states=states, inputs=[dt])


def _enlarge_sensor(
    sensor: AbstractSensor, motion: Motion, states: int, total: int, offset: int | None
) -> LinearSensor | Stamped:
    """Return the sensor of a state that has more components behind the plant's, which it does not see."""
    if offset is None and isinstance(sensor, LinearSensor):
        matrix = library(sensor.matrix).pad(sensor.matrix, ((0, 0), (0, total - states)))
        return LinearSensor(matrix, sensor.noise, sensor.outputs, sensor.circular)
    return Stamped(
        base=sensor,
        noise=sensor.noise,
        motion=motion if offset is not None else None,
        states=states,
        offset=offset or 0,
        outputs=sensor.outputs,
        circular=sensor.circular,
    )


class JointSensor(AbstractSensor):
    """Sensors of one state, their outputs one above the other, their noises independent."""

    parts: tuple[AbstractSensor, ...]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return all of them."""
        return jnp.concatenate([sensor.measure(x) for sensor in self.parts])


def joint_sensor(sensors: Mapping[str, AbstractSensor]) -> LinearSensor | Sensor | JointSensor:
    """Stack the sensors of nodes, in their order, as one; with `parallel` of their channels it serves a fusion centre.

    Of linear sensors it is a linear one. Angles stay angles, and outputs keep their units.

    Args:
        sensors: by node; the outputs are named NODE_OUTPUT.

    Raises:
        ValueError: no sensors, or one that varies; nodes and outputs of which two make one name.
    """
    by_node = table("sensors", sensors, "sensors of nodes")
    if not by_node:
        raise fail("sensors", "at least one", "none")
    for name, sensor in by_node.items():
        instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary")
    outputs = [rename(output, f"{name}_{output}") for name, sensor in by_node.items() for output in sensor.outputs]
    outputs = list(names("outputs of all nodes", outputs, len(outputs), "y"))
    circular = tuple(f"{name}_{output}" for name, sensor in by_node.items() for output in sensor.circular)
    parts = tuple(by_node.values())
    if any(sensor.inputs for sensor in parts):
        return _join_sensors_of_inputs(parts, outputs, circular)
    noise = Independent([sensor.noise for sensor in parts])
    linear = [sensor.matrix for sensor in parts if isinstance(sensor, LinearSensor)]
    if len(linear) < len(parts):
        return JointSensor(parts=parts, noise=noise, outputs=tuple(outputs), circular=circular)
    states = {matrix.shape[1] for matrix in linear}
    if len(states) > 1:
        raise fail("sensors", "those of one state", f"matrices of {sorted(states)} columns")
    return LinearSensor(library(linear).concatenate(linear), noise, outputs, circular)


class SensorsUnderInputs(Module):
    """Sensors of which some depend on inputs.

    Args:
        parts: the sensors.
        places: places of each one's inputs among all.
    """

    parts: tuple[AbstractSensor, ...]
    places: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def given(self, u: jax.Array) -> list[Any]:
        """Return the sensors of known inputs."""
        return [p.given(jnp.asarray(u)[np.array(at, int)]) for p, at in zip(self.parts, self.places, strict=True)]


class JointMatrix(SensorsUnderInputs):
    """Matrices of linear sensors, one above the other."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return C (m, n)."""
        return jnp.concatenate([jnp.asarray(sensor.matrix) for sensor in self.given(u)])


class JointMeasure(SensorsUnderInputs):
    """Measurements of sensors, one above the other."""

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return h(x, u)."""
        return jnp.concatenate([sensor.measure(x) for sensor in self.given(u)])


class JointNoiseOfSensors(SensorsUnderInputs):
    """Covariance of independent noises of sensors."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the covariance (m, m)."""
        return jnp.asarray(block_diagonal([jnp.asarray(sensor.noise.covariance) for sensor in self.given(u)]))


def _join_sensors_of_inputs(
    parts: tuple[AbstractSensor, ...], outputs: Sequence[str], circular: Sequence[str]
) -> LinearSensor | Sensor:
    """Return sensors of which some depend on inputs as one that depends on all of these."""
    inputs = list(dict.fromkeys(name for sensor in parts for name in sensor.inputs))
    every = parts, tuple(tuple(inputs.index(name) for name in sensor.inputs) for sensor in parts)
    noises = [sensor.noise for sensor in parts]
    noise: Any = JointNoiseOfSensors(*every)
    if all(isinstance(law, AbstractNoise) for law in noises):
        noise = Independent(noises)
    elif not all(isinstance(law, Gaussian | NoiseOfInputs) for law in noises):
        raise fail("noises of joined sensors", "Gaussian ones beside one that depends on inputs", "another law")
    linear = all(isinstance(sensor, LinearSensor) for sensor in parts)
    if linear:
        return LinearSensor(JointMatrix(*every), noise, outputs, circular, inputs=inputs)
    return Sensor(JointMeasure(*every), noise, outputs, circular, inputs=inputs)


def join_links(sensors: Mapping[str, AnySensor], channels: Sequence[Channel]) -> tuple[AnySensor, Channel]:
    """Return the sensors and the channels of several nodes as one sensor behind one channel, over time if one varies.

    Args:
        sensors: by node, in their order; the outputs are named NODE_OUTPUT.
        channels: of the nodes, in the same order.
    """

    def joint(*parts: AbstractSensor) -> AbstractSensor:
        return joint_sensor(dict(zip(sensors, parts, strict=True)))

    sensor: AnySensor = at_each_step(joint, *sensors.values())
    channel: Channel = at_each_step(lambda *parts: parallel(parts), *channels)
    return sensor, channel
