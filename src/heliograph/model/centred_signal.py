"""Centred signals, which cost less: a reference that both ends know is subtracted before sending, added back after."""

from typing import overload

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.model.channel import Channel, amplify_and_forward
from heliograph.model.fading import without_memory
from heliograph.model.over_time import OverTime, at, at_each_step, first, steps_covered
from heliograph.model.plant import AbstractPlant, AnyPlant, read_first_plant
from heliograph.model.sensor import AbstractSensor, AnySensor, check_sensor
from heliograph.numerics.check import array, check_horizon, fail, rank
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, check_maps
from heliograph.random_affine.hop import known


@overload
def centred(channel: AbstractRandomAffine, reference: "Float[ArrayLike, '*m']") -> AbstractRandomAffine: ...
@overload
def centred(channel: Channel, reference: "Float[ArrayLike, '*m'] | OverTime") -> Channel: ...


def centred(channel: Channel, reference: "Float[ArrayLike, '*m'] | OverTime") -> Channel:
    """Return the channel that sends y - r: z = G (y - r) + n + E[G] r, where the receiver knows r and adds E[G] r.

    E[z | y] is that of the channel itself; power and the gain's noise see E (y - r)^2 in place of E y^2. Any sensor,
    linear or not, and any filter take the result, and so does a relay between two hops.

    Args:
        channel: a channel without delays and erasures, constant or an `OverTime`.
        reference: r (m,), a number where one is sent, or an `OverTime` of one for each step: a trajectory, or
            `expected_signal`, the best of all that is known before.

    Raises:
        ValueError: a reference of another length than what is sent; a channel that is late or erases: put
            `centred` inside, as in `delayed(centred(link, r), d)` and `erasure(centred(link, r), p)`.
    """
    centred_channel: Channel = at_each_step(_subtract_reference, channel, reference)
    return centred_channel


def _subtract_reference(channel: AbstractRandomAffine, reference: ArrayLike | OverTime) -> AbstractRandomAffine:
    """Return z = G (y - r) + n + E[G] r: the reference r is subtracted before the channel, E[G] r added after it."""
    (channel,) = check_maps("channel less a reference", [channel])
    if channel.past or channel.erases:
        what = "late" if channel.past else "one that erases"
        raise fail("channel less a reference", "neither late nor lossy by itself (put `centred` inside)", what)
    rank("reference", reference)
    r = array("reference", library(reference).atleast_1d(reference), (channel.inputs,))
    memoryless = without_memory(channel)
    assert isinstance(memoryless, AbstractRandomAffine)
    homogeneous = memoryless.moments(1).mean  # E of [G, n; 0, 1], which maps (y, 1) to (z, 1)
    mean_gain = homogeneous[:-1, :-1]  # E[G]
    subtract, add_back = known(np.eye(len(r)), -r), known(np.eye(channel.outputs), mean_gain @ r)
    return amplify_and_forward([subtract, channel, add_back])


def predict_signal(
    plant: AbstractPlant, sensor: AbstractSensor, x: Float[Array, " n"], u: ArrayLike
) -> Float[jax.Array, " m"]:
    """Return h(f(x, u) + E w) + E v, the prediction of the signal y from the state x one step before.

    f is the plant's transition and w its noise; h is the sensor's function and v its noise. Both ends of a link compute
    the prediction, so that only the difference from it must be sent.
    """
    predicted = plant.transition(jnp.asarray(x), jnp.asarray(u)) + plant.noise_mean()
    return jnp.asarray(sensor.measure(predicted) + sensor.noise.mean)


def expected_signal(
    plant: AnyPlant, sensor: AnySensor, horizon: int, inputs: "Float[ArrayLike, 'horizon inputs'] | None" = None
) -> Float[np.ndarray, "horizon outputs"]:
    """Return E[y_k] at each step for a linear plant and sensor, or h along the noise-free path for nonlinear ones.

    y_k is the sensor's signal. A sender that transmits y - r needs the power E (y - r)^2 = Var y + (E y - r)^2. Among
    all references r that do not depend on data, it is least for r = E[y_k].

    Args:
        plant: the plant.
        sensor: its sensor.
        horizon: number of steps.
        inputs: planned inputs (horizon, inputs); None for a plant without inputs.

    Returns:
        E[y_k], (horizon, outputs).

    Raises:
        ValueError: more steps than a varying plant or sensor has, a sensor that does not fit, inputs of another shape.
    """
    check_horizon(horizon, steps_covered((plant, sensor)))
    plant_0 = read_first_plant(plant)
    check_sensor(first(sensor), len(plant_0.states))
    if inputs is None and plant_0.inputs:
        raise fail("inputs", f"an array ({horizon}, {len(plant_0.inputs)}) of {list(plant_0.inputs)}", "none")
    shape = (horizon, len(plant_0.inputs))
    u = np.zeros(shape) if inputs is None else array("inputs", inputs, shape)
    return np.asarray(_predict_outputs(plant, sensor, u))


@compile_on_call
def _predict_outputs(plant: AnyPlant, sensor: AnySensor, inputs: Float[Array, "horizon inputs"]) -> jax.Array:
    """Return h(x_k) + E v at each step, with x_0 = E x_0 and x_k+1 = f(x_k, u_k) + E w under the given inputs.

    It is E[y_k] of the sensor's signal where plant and sensor are linear.
    """

    def step(x: jax.Array, row: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the state's mean after step k, to go on with, and the measurement's mean there; row: (k, inputs u)."""
        k, u = row
        plant_k, sensor_k = at(plant, k), at(sensor, k)
        x = plant_k.transition(x, u) + plant_k.noise_mean()
        return x, sensor_k.measure(x) + sensor_k.noise.mean

    start = jnp.asarray(at(plant, 0).initial_mean)
    expected: jax.Array = jax.lax.scan(step, start, (jnp.arange(len(inputs)), jnp.asarray(inputs)))[1]
    return expected
