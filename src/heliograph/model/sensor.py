"""Sensors: y = h(x) + v."""

import inspect
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.numerics.angle import Angles, angles_at, angles_named
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import (
    array,
    fail,
    function,
    instance,
    name_list,
    names,
    rank,
    show_error,
    show_value,
)
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.traced import as_real, trace_shape
from heliograph.numerics.types import ArrayLike, Float, Names
from heliograph.random_affine.memory import AbstractWithMemory
from heliograph.random_affine.noise import AbstractNoise, NoiseLike, as_noise, count_components
from heliograph.random_affine.rounded import round_without_dither

T = TypeVar("T")
LONG, SHORT = (97, 64), range(1, 13)  # lengths of a state at which a function is tried


@readable
class AbstractSensor(Module):
    """Sensor y = h(x) + v with v independent over time and of everything else.

    Args:
        noise: law of v.
        outputs: names of the components of y.
        circular: names of outputs that are angles in radians: y and y plus a full turn in one of them are the same.
    """

    noise: eqx.AbstractVar[AbstractNoise]
    outputs: eqx.AbstractVar[tuple[str, ...]]
    circular: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)

    @property
    def angles(self) -> Angles:
        """Indices of the outputs that are angles."""
        return tuple(self.outputs.index(name) for name in self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(x): shapes (n,) -> (len(outputs),)."""
        raise unwritten(self, "measure")

    def check_states(self, states: int) -> None:
        """Raise ValueError unless the sensor measures a state of this length and returns its outputs."""
        try:
            got = trace_shape("measure(x) of a sensor", self.measure, np.zeros(states))
        except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
            raise fail("sensor", f"to measure a state of length {states}", show_error(error)) from error
        if got != (len(self.outputs),):
            raise fail("sensor", f"{len(self.outputs)} outputs {list(self.outputs)}", f"shape {got}")


class Sensor(AbstractSensor):
    """Nonlinear sensor y = h(x) + v.

    The number of outputs is that of their names, of the covariance matrix, or of the noise law; a single variance
    without names means one output.

    Args:
        measure: h(x), from (n,) to (outputs,), written with jax.numpy.
        noise: law of v, its covariance (outputs, outputs), or a variance.
        outputs: names of the outputs, or a mapping of names to units.
        circular: names of outputs that are angles in radians; a channel must leave them unchanged (gain 1), but for
            noise and erasures.
        resolution: step to whose multiples y is rounded, of all outputs or for each; None, unless given, of a sensor
            that does not round.

    Raises:
        ValueError: names and noise that disagree about the number of outputs, a variance alone of a function that
            returns more than one, a function of anything but x, circular outputs that are none. A network or filter
            refuses any other function that returns another number of outputs.
    """

    function: Callable[[jax.Array], ArrayLike]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        measure: Callable[[jax.Array], ArrayLike],
        noise: NoiseLike,
        outputs: Names | None = None,
        circular: Sequence[str] = (),
        resolution: ArrayLike | None = None,
    ):
        self.function = _take_state_alone(measure)
        _refuse_function("sensor noise", noise)
        dimension = (count_components(noise) or 1) if outputs is None else len(name_list("sensor outputs", outputs))
        self.noise = as_noise("sensor noise", noise, dimension)
        self.outputs = names("sensor outputs", outputs, dimension, "y")
        # A variance alone says nothing of the number of outputs, so the function is asked.
        shape = (1,) if outputs is not None or count_components(noise) is not None else _find_shape(measure)
        if shape != (1,):
            expected = "one output, as a variance without names means (outputs=[...] names more)"
            raise fail("measure of a sensor", expected, f"shape {shape}")
        self.circular = _circular(self.outputs, circular)
        self.noise = _round_to(self.noise, resolution, self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(x)."""
        return as_real(self.function(x))


class LinearSensor(AbstractSensor):
    """A linear sensor y = C x + v; circular outputs and resolution as for `Sensor`.

    Shapes: matrix (m, n).

    Raises:
        ValueError: wrong shapes, a noise that is no covariance, numbers that are not finite, circular outputs that are
            none.
    """

    matrix: Float[jax.Array | np.ndarray, "m n"]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        matrix: ArrayLike,
        noise: NoiseLike,
        outputs: Names | None = None,
        circular: Sequence[str] = (),
        resolution: ArrayLike | None = None,
    ):
        _refuse_function("sensor matrix", matrix)
        _refuse_function("sensor noise", noise)
        self.matrix = array("sensor matrix", matrix, ("outputs", "states"))
        self.noise = as_noise("sensor noise", noise, self.matrix.shape[-2])
        self.outputs = names("sensor outputs", outputs, self.matrix.shape[-2], "y")
        self.circular = _circular(self.outputs, circular)
        self.noise = _round_to(self.noise, resolution, self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return C x."""
        return jnp.asarray(self.matrix) @ x

    def check_states(self, states: int) -> None:
        """The same of the matrix, without a trace, of which each of many nodes would need its own."""
        if self.matrix.shape[-1] != states:
            raise fail("sensor", f"to measure a state of length {states}", f"a matrix of shape {self.matrix.shape}")


def _round_to(noise: AbstractNoise, resolution: ArrayLike | None, circular: Sequence[str]) -> AbstractNoise:
    """Return the noise of a sensor that rounds to multiples of its resolution; the noise itself without one."""
    if resolution is None:
        return noise
    if circular:
        raise fail("resolution of a sensor", "outputs that are no angles", list(circular))
    m = noise.dimension
    step = array("resolution of a sensor", resolution, (m,) if rank("resolution of a sensor", resolution) else ())
    if not np.all(np.asarray(step) > 0):
        raise fail("resolution of a sensor", "a positive step", show_value(np.asarray(step).tolist()))
    return round_without_dither(noise, np.array(np.broadcast_to(step, (m,))))


def _take_state_alone(measure: object) -> Callable[[jax.Array], ArrayLike]:
    """Return a function of the state alone, refused where it needs anything else."""
    checked: Callable[[jax.Array], ArrayLike] = function("measure of a sensor", measure, "x")
    try:
        signature = inspect.signature(checked)
    except ValueError:  # of what is not Python, nothing is known before it is called
        return checked
    try:
        signature.bind(None)
    except TypeError:
        expected = "a function of x alone, as sensors do not depend on inputs"
        raise fail("measure of a sensor", expected, f"one of {signature}") from None
    return checked


def _refuse_function(name: str, value: object) -> None:
    """Raise ValueError where a plant's matrix may be a function of inputs, and a sensor's may not."""
    if callable(value):
        raise fail(name, "a constant, as sensors do not depend on inputs", "a function")


def _find_shape(measure: Callable[[jax.Array], ArrayLike]) -> tuple[int, ...]:
    """Return the shape of h(x) where it is that of every state it takes; (1,) where that depends on the state.

    What slices x gives another shape at each of two lengths; what unpacks x takes a state of one length alone.
    """

    def shape(states: int) -> tuple[int, ...] | None:
        try:
            with jax.enable_x64(True):
                return tuple(jax.eval_shape(lambda x: jnp.asarray(measure(x)), np.zeros(states)).shape)
        except Exception:  # not for this length; what is wrong for all is said where the plant is known
            return None

    first_, second = (shape(states) for states in LONG)
    if first_ is not None and second is not None:
        return first_ if first_ == second else (1,)
    taken = [taken_shape for states in SHORT if (taken_shape := shape(states)) is not None]
    return taken[0] if len(taken) == 1 else (1,)


def without_output_names(model: T) -> T:
    """Return a model with sensors, such as a filter, whose outputs are named y0, y1, ...: no number depends on names.

    Models that differ in these names alone are then of one structure, and one program is for all of them.
    """
    unnamed: T = jax.tree.map(_drop_names, model, is_leaf=_is_sensor)
    return unnamed


def _is_sensor(model: object) -> bool:
    return isinstance(model, AbstractSensor)


def _drop_names(model: Any) -> Any:
    """Return the sensor with outputs called y0, y1, ..., so that sensors that differ in names alone are equal."""
    if not _is_sensor(model) or "outputs" not in vars(model):
        return model
    parts, tree = jax.tree.flatten(model, is_leaf=lambda part: part is not model and _is_sensor(part))
    bare = jax.tree.unflatten(tree, [_drop_names(part) for part in parts])
    object.__setattr__(bare, "outputs", names("sensor outputs", None, len(model.outputs), "y"))
    object.__setattr__(bare, "circular", tuple(f"y{i}" for i in model.angles))
    return bare


def _circular(outputs: tuple[str, ...], circular: Sequence[str]) -> tuple[str, ...]:
    return tuple(outputs[i] for i in angles_named("circular outputs", circular, outputs))


AnySensor = TypeAliasType("AnySensor", AbstractSensor | OverTime)  # an OverTime holds one sensor per step


@cache_by_object
def check_sensor(sensor: AbstractSensor, states: int) -> None:
    """Raise ValueError unless the sensor takes a state of this length and returns its outputs."""
    instance("sensor", sensor, AbstractSensor, "a sensor")
    sensor.check_states(states)


def is_linear(plant: AnyPlant, sensor: AnySensor) -> bool:
    """Return whether both are linear, so that but for angles means and covariances propagate without approximation."""
    return isinstance(first(plant), LinearPlant) and isinstance(first(sensor), LinearSensor)


def check_linear(name: str, plant: AnyPlant, sensor: AnySensor) -> None:
    """Raise ValueError unless both are linear and nothing in them is an angle."""
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        modal = any(isinstance(first(model), AbstractWithMemory) for model in (plant, sensor))
        instead = " of one law (imm_filter, gpb1_filter and gpb2_filter take several)" if modal else ""
        raise fail(name, f"a LinearPlant and a LinearSensor{instead}", got)
    refuse_angles(name, plant, sensor)


def angles_of_outputs(angles: "Sequence[int] | AnySensor", outputs: int) -> Angles:
    """Return which of so many outputs are angles, from their places or from the sensor whose outputs they are."""
    sensor = first(angles)
    if not isinstance(sensor, AbstractSensor):
        return angles_at(angles, outputs)
    if len(sensor.outputs) != outputs:
        raise fail("angles", f"those of a sensor of {outputs} outputs", f"one of {list(sensor.outputs)}")
    return sensor.angles


def refuse_angles(name: str, *models: AnyPlant | AnySensor) -> None:
    """Raise ValueError where a state or an output is an angle, for what knows numbers on a line alone."""
    circular = [angle for model in models for angle in first(model).circular]
    if circular:
        raise fail(name, "no angles (cubature, extended, mixture and multiple model filters take them)", circular)


def state_space(
    F: "Float[ArrayLike, 'n n']",
    H: "Float[ArrayLike, 'm n']",
    Q: "NoiseLike",
    R: "NoiseLike",
    mean: "Float[ArrayLike, ' n']",
    covariance: "NoiseLike",
    B: "Float[ArrayLike, 'n inputs'] | None" = None,
) -> tuple[LinearPlant, LinearSensor]:
    """Return the plant x+ = F x + B u + w and the sensor z = H x + v, with Cov(w) = Q and Cov(v) = R.

    `plant, sensor = hg.state_space(F, H, Q, R, mean, covariance)`, then `hg.kalman_filter(plant, sensor)`.

    Args:
        F: transition matrix.
        H: measurement matrix.
        Q: covariance of w, a variance for all states, or a noise law.
        R: covariance of v, a variance for all outputs, or a noise law.
        mean: mean of the state before the first step; the first measurement comes one step later.
        covariance: covariance of that state, a variance for all of it, or the law of its deviation from `mean`.
        B: input matrix; a plant without inputs unless given.

    Raises:
        ValueError: shapes that do not fit, covariances that are none, numbers that are not finite.
    """
    plant = LinearPlant(F, Q, mean, covariance, B)
    sensor = LinearSensor(H, R)
    sensor.check_states(len(plant.states))
    return plant, sensor
