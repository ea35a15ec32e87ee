"""Sensors of several nodes as one, and their links as one channel."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.model.channel import Channel, parallel
from heliograph.model.input_dependent_sensor import NoiseOfInputs
from heliograph.model.over_time import at_each_step
from heliograph.model.plant import split_inputs
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor, Sensor
from heliograph.numerics.check import fail, instance, names, table
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import block_diagonal, library
from heliograph.numerics.types import rename
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent


class JointSensor(AbstractSensor):
    """Several sensors of one state as one: their outputs follow one another, and their noises are independent."""

    parts: tuple[AbstractSensor, ...]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return the measurements of all sensors of the state x, one after another."""
        return jnp.concatenate([sensor.measure(x) for sensor in self.parts])


def joint_sensor(sensors: Mapping[str, AbstractSensor]) -> LinearSensor | Sensor | JointSensor:
    """Stack the sensors of nodes, in their order, as one; with `parallel` of their channels it serves a fusion centre.

    A fusion centre receives the measurements of all nodes, as from one sensor behind one channel. The noises of
    different sensors are independent. If all sensors are linear, the result is linear. Angles stay angles, and outputs
    keep their units.

    Args:
        sensors: {node: its sensor}; the outputs are named NODE_OUTPUT.

    Raises:
        ValueError: no sensors, or one that varies; nodes and outputs of which two make one name.
    """
    # Only sensors that do not vary over time can be stacked; the names of their outputs must be all different.
    by_node = table("sensors", sensors, "sensors of nodes")
    if not by_node:
        raise fail("sensors", "at least one", "none")
    for name, sensor in by_node.items():
        instance(f"sensor of node {name!r}", sensor, AbstractSensor, "one that does not vary")
    outputs = [rename(output, f"{name}_{output}") for name, sensor in by_node.items() for output in sensor.outputs]
    outputs = list(names("outputs of all nodes", outputs, len(outputs), "y"))
    circular = tuple(f"{name}_{output}" for name, sensor in by_node.items() for output in sensor.circular)
    # Sensors that depend on the plant's inputs are joined by another function.
    parts = tuple(by_node.values())
    if any(sensor.inputs for sensor in parts):
        return _join_sensors_of_inputs(parts, outputs, circular)
    noise = Independent([sensor.noise for sensor in parts])
    # A linear sensor only if all are linear: its matrix stacks theirs, which must be of the same state.
    linear = [sensor.matrix for sensor in parts if isinstance(sensor, LinearSensor)]
    if len(linear) < len(parts):
        return JointSensor(parts=parts, noise=noise, outputs=tuple(outputs), circular=circular)
    states = {matrix.shape[1] for matrix in linear}
    if len(states) > 1:
        raise fail("sensors", "those of one state", f"matrices of {sorted(states)} columns")
    return LinearSensor(library(linear).concatenate(linear), noise, outputs, circular)


class InputDependentSensors(Module):
    """Sensors side by side of which some depend on inputs, with the indices of their inputs among all.

    Args:
        parts: the sensors.
        indices: indices of each one's inputs among all.
    """

    parts: tuple[AbstractSensor, ...]
    indices: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    def given(self, u: jax.Array) -> list[Any]:
        """Return the sensors as they are under all inputs u (inputs,)."""
        return [part.given(own) for part, own in zip(self.parts, split_inputs(u, self.indices), strict=True)]


class JointMatrix(InputDependentSensors):
    """Matrix of linear sensors as one, their rows one above the other, as a function of the inputs."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return C (m, n) under the inputs u of all sensors."""
        return jnp.concatenate([jnp.asarray(sensor.matrix) for sensor in self.given(u)])


class JointMeasure(InputDependentSensors):
    """Function h(x, u) of several sensors as one: their measurements follow one another."""

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """Return the measurements h(x, u) (m,) of all sensors, of the state x under the inputs u."""
        return jnp.concatenate([sensor.measure(x) for sensor in self.given(u)])


class JointSensorNoise(InputDependentSensors):
    """Covariance of the independent noises of several sensors, block-diagonal, as a function of the inputs."""

    def __call__(self, u: jax.Array) -> jax.Array:
        """Return the covariance (m, m) under the inputs u of all sensors."""
        return jnp.asarray(block_diagonal([jnp.asarray(sensor.noise.covariance) for sensor in self.given(u)]))


def _join_sensors_of_inputs(
    parts: tuple[AbstractSensor, ...], outputs: Sequence[str], circular: Sequence[str]
) -> LinearSensor | Sensor:
    """Return several sensors, of which some depend on inputs, as one that depends on all of these inputs.

    Args:
        parts: the sensors.
        outputs: names of all outputs.
        circular: names of those that are angles.

    Raises:
        ValueError: a noise that depends on inputs beside one that is not Gaussian.
    """
    inputs = list(dict.fromkeys(name for sensor in parts for name in sensor.inputs))
    indices = tuple(tuple(inputs.index(name) for name in sensor.inputs) for sensor in parts)  # of each one's inputs
    noises = [sensor.noise for sensor in parts]
    noise: Any = JointSensorNoise(parts, indices)
    if all(isinstance(law, AbstractNoise) for law in noises):  # laws that do not depend on inputs
        noise = Independent(noises)
    elif not all(isinstance(law, Gaussian | NoiseOfInputs) for law in noises):
        raise fail("noises of joined sensors", "Gaussian ones beside one that depends on inputs", "another law")
    if all(isinstance(sensor, LinearSensor) for sensor in parts):
        return LinearSensor(JointMatrix(parts, indices), noise, outputs, circular, inputs=inputs)
    return Sensor(JointMeasure(parts, indices), noise, outputs, circular, inputs=inputs)


def join_links(sensors: Mapping[str, AnySensor], channels: Sequence[Channel]) -> tuple[AnySensor, Channel]:
    """Return the sensors and the channels of several nodes as one sensor behind one channel, over time if one varies.

    Args:
        sensors: the sensors by node; outputs of the joint sensor are named NODE_OUTPUT.
        channels: the channels of the nodes, in the same order.
    """

    def join_sensors_of_step(*sensors_of_step: AbstractSensor) -> AbstractSensor:
        """Return the joint sensor of one step, of those of the nodes in their order."""
        return joint_sensor(dict(zip(sensors, sensors_of_step, strict=True)))

    sensor: AnySensor = at_each_step(join_sensors_of_step, *sensors.values())
    channel: Channel = at_each_step(lambda *channels_of_step: parallel(channels_of_step), *channels)
    return sensor, channel
