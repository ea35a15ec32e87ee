"""Plants with offset and drift of the nodes' clocks as states, and the sensors whose values such clocks stamp."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.augmented.bias import append_driving_plant
from heliograph.model.plant import AbstractPlant, LinearPlant, Plant
from heliograph.model.sensor import AbstractSensor, LinearSensor, check_sensor
from heliograph.numerics.check import array, fail, function, instance, scalar, table
from heliograph.numerics.module import readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, Float, rename
from heliograph.random_affine.noises.noise import AbstractNoise, Matrix

Motion = Callable[[jax.Array], ArrayLike] | Matrix  # dx/dt, or the matrix of it


@readable
class Clock(NamedTuple):
    """A clock that shows t + offset at t; the offset grows by `drift` a unit of time, the drift wanders.

    offset, drift: their standard deviations at the start; wander: variance that the drift gains, at each step where
    dt is a number, in each unit of time where it is an input; delay: mean of the offset at the start, by which stamps
    are late (`fit` learns it against a truth). The drift has mean 0.
    """

    offset: float
    drift: float
    wander: float = 0.0
    delay: float = 0.0


class StampedSensor(AbstractSensor):
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
        """Return h(x) - o dh/dt: to first order, what h was when the clock, which is o ahead, showed the present time.

        `self.states`: how many states h takes. `self.motion`: their rate of change, as a matrix or a function; None if
        the clock is right, which gives h(x). `self.offset`: the place of o among the states.
        """
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
) -> "tuple[LinearPlant | Plant, dict[str, LinearSensor | StampedSensor]]":
    """Return the plant with an offset and a drift for each clock as states, and the sensors of all nodes for it.

    A node of `clocks` measures y at the true time t and stamps the value with its own clock, s = t + o, where the
    offset o grows by its drift. The filter takes the value for one of time s; it is that of s - o, so that to first
    order it reads y(s) - o dy/dt. The new states are "NODE_offset" and "NODE_drift".

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
    # Each clock is that of a node, and each sensor one that measures the plant.
    instance("plant with clocks", plant, AbstractPlant, "a plant that does not vary")
    sensors, clocks = table("sensors", sensors, "sensors of nodes"), table("clocks", clocks, "clocks of nodes")
    n = len(plant.states)
    step = _read_step_length(plant, dt)
    if set(clocks) - set(sensors) or not clocks:
        raise fail("clocks", f"those of some of the nodes {list(sensors)}", list(clocks))
    for name, sensor in sensors.items():
        check_sensor(instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary"), n)
        sensor.refuse_inputs("a node with a clock")
    moving = function("motion", motion, "x") if callable(motion) else array("motion", motion, (n, n))
    # States: those of the plant, then offset and drift of each clock.
    total = n + 2 * len(clocks)
    offsets = {name: n + 2 * i for i, name in enumerate(clocks)}
    # The clocks are a plant of their own that does not act on x: a coupling of zeros.
    larger = append_driving_plant(plant, _make_clock_plant(clocks, step), np.zeros((n, 2 * len(clocks))))
    return larger, {
        name: _make_stamped_sensor(sensor, moving, n, total, offsets.get(name)) for name, sensor in sensors.items()
    }


def _read_step_length(plant: AbstractPlant, dt: ArrayLike | str) -> Any:
    """Return the length of a step: a number, or the name of the plant's input that says it.

    Raises:
        ValueError: a negative number, or a name that is no input of the plant.
    """
    if not isinstance(dt, str):
        return scalar("time of a step", dt, 0.0)
    if dt not in plant.inputs:
        raise fail("dt", f"a number, or one of the inputs {list(plant.inputs)}", repr(dt))
    return plant.inputs[plant.inputs.index(dt)]  # the plant's own name, which may carry a unit


def _make_clock_plant(clocks: Mapping[str, Clock], dt: str | Any) -> LinearPlant:
    """Return the plant of all clocks: offset o+ = o + dt d and drift d+ = d + w of each, independent at the start.

    The clock of a node shows t + o at the time t. If all steps have one length dt, w has the variance `wander`. If an
    input says the length, d gains white noise within the step: w has the variance wander dt, and o gains the integral
    of the noise, so that the covariance is wander [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]].

    Args:
        clocks: clock of each node: deviations of offset and drift at the start, `wander`, and the mean offset `delay`.
        dt: length of a step, or the name of the input that says it.
    """
    # Means and variances of (offset, drift) of clock after clock.
    means, variances, wanders, states = [], [], [], []
    for name, clock in clocks.items():
        instance(f"clock of {name!r}", clock, Clock, "a Clock")
        means += [scalar(f"delay of the clock of {name!r}", clock.delay), 0.0]
        offset_deviation, drift_deviation, wander_of_clock = (
            scalar(f"{field} of the clock of {name!r}", getattr(clock, field), 0.0)
            for field in ("offset", "drift", "wander")
        )
        variances += [offset_deviation**2, drift_deviation**2]
        wanders.append(wander_of_clock)
        offset = f"{name}_offset"  # in the unit of dt, where that is an input with one
        states += [rename(dt, offset) if isinstance(dt, str) else offset, f"{name}_drift"]
    # As arrays, JAX's where a number is traced.
    mean, variance, wander = (library(x).asarray(library(x).stack(x)) for x in (means, variances, wanders))
    xp = library(variance, wander)
    start, strength = xp.diag(variance), xp.diag(wander)
    one_each = np.eye(len(clocks))  # kron(one_each, F) has a block F for each clock
    # Steps of one length: F = [[1, dt], [0, 1]] of each clock, and its drift alone gains noise.
    if not isinstance(dt, str):
        matrix = np.kron(one_each, [[1.0, dt], [0.0, 1.0]])
        noise = xp.kron(strength, np.diag([0.0, 1.0]))
        return LinearPlant(matrix, noise, mean, start, states=states)

    # Steps of a length that an input says: the integral of white noise in the drift, and of that in the offset.
    def matrix_over(u: jax.Array) -> jax.Array:
        """Return the transition matrix over a step of length u[0]."""
        return jnp.kron(one_each, jnp.array([[1.0, u[0]], [0.0, 1.0]]))

    def noise_over(u: jax.Array) -> jax.Array:
        """Return the covariance of (offset, drift) of all clocks gained over a step of length u[0].

        The drift gains white noise, and the offset its integral: wander [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]] each.
        """
        of_clock = jnp.array([[u[0] ** 3 / 3, u[0] ** 2 / 2], [u[0] ** 2 / 2, u[0]]])
        return jnp.kron(jnp.asarray(strength), of_clock)

    return LinearPlant(matrix_over, noise_over, mean, start, states=states, inputs=[dt])


def _make_stamped_sensor(
    sensor: AbstractSensor, motion: Motion, states: int, total: int, offset: int | None
) -> LinearSensor | StampedSensor:
    """Return a node's sensor for the larger state: the plant's states, then offset and drift of each clock.

    Args:
        sensor: the node's sensor of the plant's states.
        motion: dx/dt of the plant's states, a function or a matrix; by it a wrong time stamp becomes an error of y.
        states: number of the plant's states, which stand first.
        total: number of all states.
        offset: index of the offset of this node's clock; None for a node whose clock is right, which needs no motion.
    """
    if offset is None and isinstance(sensor, LinearSensor):
        matrix = library(sensor.matrix).pad(sensor.matrix, ((0, 0), (0, total - states)))
        return LinearSensor(matrix, sensor.noise, sensor.outputs, sensor.circular)
    return StampedSensor(
        base=sensor,
        noise=sensor.noise,
        motion=motion if offset is not None else None,
        states=states,
        offset=offset or 0,  # not used where the clock is right
        outputs=sensor.outputs,
        circular=sensor.circular,
    )
