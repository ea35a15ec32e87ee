"""Sensors: y = h(x) + v."""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.input_dependent_sensor import (
    MeasureUnderInputs,
    NoiseOfInputs,
    count_matrix_rows,
    read_function_of_state_alone,
    read_input_names,
    read_noise_of_inputs,
    require_constant,
)
from heliograph.model.over_time import OverTime, first
from heliograph.model.plant import AnyPlant, LinearPlant, MatrixFunction, MatrixOfInputs, NoiseFunction
from heliograph.model.turn_invariance import SOME_INPUTS
from heliograph.numerics.angles.angle import Angles, angles_at, read_angles
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import (
    array,
    error_text,
    fail,
    function,
    instance,
    name_list,
    names,
    rank,
    show_value,
)
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.numpy_or_jax import as_real, trace_shape
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.memories_of_channels import AbstractWithMemory
from heliograph.random_affine.noises.noise import AbstractNoise, NoiseLike, as_noise, count_components
from heliograph.random_affine.words.rounding_noise import round_without_dither

T = TypeVar("T")
LONG, SHORT = (97, 64), range(1, 13)  # lengths of a state at which a function is tried


@readable
class AbstractSensor(Module):
    """Sensor y = h(x) + v with v independent over time and of everything else.

    Args:
        noise: law of v.
        outputs: names of the components of y.
        circular: names of outputs that are angles in radians: y and y plus a full turn in one of them are the same.
        inputs: names of the plant's inputs on which it depends; none of most sensors.
    """

    noise: eqx.AbstractVar[AbstractNoise]
    outputs: eqx.AbstractVar[tuple[str, ...]]
    circular: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)
    inputs: tuple[str, ...] = eqx.field(static=True, default=(), kw_only=True)

    @property
    def angles(self) -> Angles:
        """Indices of the outputs that are angles."""
        return tuple(self.outputs.index(name) for name in self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(x): shapes (n,) -> (len(outputs),)."""
        raise unwritten(self, "measure")

    def given(self, u: jax.Array) -> "AbstractSensor":
        """Return the sensor as it is under its inputs u (inputs,): one that depends on none."""
        return self

    def under(self, names: Sequence[str], u: Array) -> "AbstractSensor":
        """Return the sensor under the inputs u of a plant, whose names are `names`: a sensor that depends on none."""
        if not self.inputs:
            return self
        indices = np.array([list(names).index(name) for name in self.inputs])
        return _sensor_under_inputs(self, u[indices])

    def typical(self, names: Sequence[str]) -> "AbstractSensor":
        """Return the sensor under example inputs; raise ValueError if the plant, with inputs `names`, lacks one of its.

        The examples are not whole numbers. Else h(x) = u * angle would seem unchanged by a full turn of the angle.
        """
        lacking = [name for name in self.inputs if name not in names]
        if lacking:
            expected = f"some of the plant's, {list(names)} (it may have ones that move nothing)"
            raise fail("inputs of a sensor", expected, lacking)
        return self.under(names, np.resize(SOME_INPUTS, len(names)))

    def refuse_inputs(self, name: str) -> None:
        """Raise ValueError, with the name of what needs a constant sensor, where this one depends on inputs."""
        if self.inputs:
            raise fail(f"sensor of {name}", "one that depends on no inputs", f"one of {list(self.inputs)}")

    def check_states(self, states: int) -> None:
        """Raise ValueError unless the sensor measures a state of this length and returns one number for each output."""
        if self.inputs:  # check with inputs of 1, since any will do
            _sensor_under_inputs(self, np.ones(len(self.inputs))).check_states(states)
            return
        try:
            got = trace_shape("measure(x) of a sensor", self.measure, np.zeros(states))
        except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
            raise fail("sensor", f"to measure a state of length {states}", error_text(error)) from error
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
        inputs: names of inputs of the plant on which the sensor depends: then h is a function of (x, u), and the
            covariance of v may be one of u. None by default.
        resolution: step to whose multiples y is rounded, of all outputs or for each; None, unless given, of a sensor
            that does not round.

    Raises:
        ValueError: names and noise that disagree about the number of outputs, a variance alone of a function that
            returns more than one, a function of anything but x without named inputs, circular outputs that are none. A
            network or filter refuses any other function that returns another number of outputs.
    """

    function: Callable[..., ArrayLike]
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        measure: Callable[..., ArrayLike],
        noise: "NoiseLike | NoiseFunction",
        outputs: "Names | None" = None,
        circular: "Sequence[str]" = (),
        resolution: "ArrayLike | None" = None,
        inputs: "Names" = (),
    ):
        """Check and hold y = h(x) + v, or h(x, u) + v: h, the law of v, names, angles and resolution.

        `measure` is h, `noise` the law of v, `circular` names outputs that are angles, and `inputs` names those of u.
        `resolution`: step to which outputs are rounded, which adds to the noise.
        """
        self.inputs = read_input_names(inputs)
        if self.inputs:  # a function of (x, u), with a noise that may depend on u too
            self.function = function("measure of a sensor", measure, "(x, u)")
            self.outputs, self.noise = read_noise_of_inputs(noise, outputs, rows=None, inputs=self.inputs)
        else:
            # A function of x alone: the number of outputs is that of their names, or of the noise's components, or one.
            self.function, law = read_function_of_state_alone(measure), require_constant("sensor noise", noise)
            count = (count_components(law) or 1) if outputs is None else len(name_list("sensor outputs", outputs))
            self.noise = as_noise("sensor noise", law, count)
            self.outputs = names("sensor outputs", outputs, count, "y")
            # A variance alone says nothing of the number of outputs: without names the function must have one.
            is_count_given = outputs is not None or count_components(law) is not None
            shape = (1,) if is_count_given else _find_output_shape(measure)
            if shape != (1,):
                expected = "one output, as a variance without names means (outputs=[...] names more)"
                raise fail("measure of a sensor", expected, f"shape {shape}")
        self.circular = read_angles("circular outputs", circular, self.outputs)
        self.noise = _round_noise_to_resolution(self.noise, resolution, self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return h(x); raise ValueError if the sensor depends on inputs."""
        self.refuse_inputs("what gives no inputs")
        return as_real(self.function(x))

    def given(self, u: jax.Array) -> AbstractSensor:
        """Return the sensor y = h(x, u) + v of a known u."""
        if not self.inputs:
            return self
        noise = self.noise.given(u) if isinstance(self.noise, NoiseOfInputs) else self.noise
        return Sensor(MeasureUnderInputs(self.function, u), noise, self.outputs, self.circular)


class LinearSensor(AbstractSensor):
    """A linear sensor y = C x + v; circular outputs and resolution as for `Sensor`.

    C and the covariance of v may be functions of some of the plant's inputs, `LinearSensor(lambda u: u[None], .1,
    inputs=["dose"])`: it is linear all the same, and what filters claim stays exact. What is computed before data (a
    steady state, schedules, designs) needs constants, and refuses. Shapes: matrix (m, n).

    Raises:
        ValueError: wrong shapes, a noise that is no covariance, numbers that are not finite, circular outputs that are
            none, functions of inputs without names.
    """

    matrix: Float[jax.Array | np.ndarray, "m n"]  # or MatrixOfInputs, which refuses to be taken for an array
    noise: AbstractNoise
    outputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        matrix: "ArrayLike | MatrixFunction",
        noise: "NoiseLike | NoiseFunction",
        outputs: "Names | None" = None,
        circular: "Sequence[str]" = (),
        resolution: "ArrayLike | None" = None,
        inputs: "Names" = (),
    ):
        """Check and hold y = C x + v: C, the law of v, names of outputs, angles and resolution.

        `matrix` is C and `noise` the law of v; with named `inputs` u, C and the covariance of v may be functions of u.
        `resolution`: step to which outputs are rounded, which adds to the noise.
        """
        self.inputs = read_input_names(inputs)
        if self.inputs:
            count = count_matrix_rows(matrix, self.inputs)  # C has a row for each output
            self.outputs, self.noise = read_noise_of_inputs(noise, outputs, count, self.inputs)
            C: Any = MatrixOfInputs(matrix, "sensor matrix", self.inputs) if callable(matrix) else matrix
            self.matrix = C if callable(matrix) else array("sensor matrix", C, ("outputs", "states"))
        else:
            self.matrix = array("sensor matrix", require_constant("sensor matrix", matrix), ("outputs", "states"))
            self.noise = as_noise("sensor noise", require_constant("sensor noise", noise), self.matrix.shape[-2])
            self.outputs = names("sensor outputs", outputs, self.matrix.shape[-2], "y")
        self.circular = read_angles("circular outputs", circular, self.outputs)
        self.noise = _round_noise_to_resolution(self.noise, resolution, self.circular)

    def measure(self, x: jax.Array) -> jax.Array:
        """Return C x."""
        return jnp.asarray(self.matrix) @ x

    def given(self, u: jax.Array) -> AbstractSensor:
        """Return the sensor of a known u: its matrix and noise are constants."""
        if not self.inputs:
            return self
        matrix: Any = self.matrix
        noise = self.noise.given(u) if isinstance(self.noise, NoiseOfInputs) else self.noise
        return LinearSensor(
            matrix(u) if isinstance(matrix, MatrixOfInputs) else matrix, noise, self.outputs, self.circular
        )

    def check_states(self, states: int) -> None:
        """Raise ValueError unless the sensor's matrix has as many columns as the state is long.

        The shape of a constant matrix is known. Only a matrix that is a function of inputs is traced.
        """
        if self.inputs:
            super().check_states(states)
        elif self.matrix.shape[-1] != states:
            raise fail("sensor", f"to measure a state of length {states}", f"a matrix of shape {self.matrix.shape}")


def _round_noise_to_resolution(
    noise: AbstractNoise, resolution: ArrayLike | None, circular: Sequence[str]
) -> AbstractNoise:
    """Return the noise of a sensor that rounds to multiples of its resolution; the noise itself without one."""
    if resolution is None:
        return noise
    if isinstance(noise, NoiseOfInputs):
        expected = "a noise that depends on no inputs beside it"
        raise fail("resolution of a sensor", expected, f"one of {list(noise.inputs)}")
    if circular:
        raise fail("resolution of a sensor", "outputs that are no angles", list(circular))
    m = noise.dimension
    step = array("resolution of a sensor", resolution, (m,) if rank("resolution of a sensor", resolution) else ())
    if not np.all(np.asarray(step) > 0):
        raise fail("resolution of a sensor", "a positive step", show_value(np.asarray(step).tolist()))
    return round_without_dither(noise, np.array(np.broadcast_to(step, (m,))))


@in_float64
def _sensor_under_inputs(sensor: AbstractSensor, u: Array) -> AbstractSensor:
    """Return the sensor under its inputs u, computed in double precision."""
    return sensor.given(jnp.asarray(u))


def _find_output_shape(measure: Callable[[jax.Array], ArrayLike]) -> tuple[int, ...]:
    """Return the shape of h(x) where it is that of every state it takes; (1,) where that depends on the state.

    What slices x gives another shape at each of two lengths; what unpacks x takes a state of one length alone.
    """

    def shape(states: int) -> tuple[int, ...] | None:
        """Return the shape of h(x) for a state of this length, or None if h, `measure`, cannot take it."""
        try:
            with jax.enable_x64(True):
                return tuple(jax.eval_shape(lambda x: jnp.asarray(measure(x)), np.zeros(states)).shape)
        except Exception:  # it may take other lengths; other faults are reported when the plant is known
            return None

    one, other = (shape(states) for states in LONG)
    if one is not None and other is not None:
        return one if one == other else (1,)
    shapes = [found for found in map(shape, SHORT) if found is not None]
    return shapes[0] if len(shapes) == 1 else (1,)


def without_output_names(model: T) -> T:
    """Return a model with its sensors' outputs renamed to y0, y1, ..., which changes no number.

    Models that differ only in names then have one structure, so that one program serves all.
    """
    unnamed: T = jax.tree.map(_drop_names, model, is_leaf=_is_sensor)
    return unnamed


def _is_sensor(model: object) -> bool:
    """Return whether an object is a sensor, at which a walk through a model's tree stops."""
    return isinstance(model, AbstractSensor)


def _drop_names(model: Any) -> Any:
    """Return a sensor with its outputs, and those of sensors inside it, named y0, y1, ...; anything else as it is."""
    if not _is_sensor(model) or "outputs" not in vars(model):
        return model
    leaves, tree = jax.tree.flatten(model, is_leaf=lambda leaf: leaf is not model and _is_sensor(leaf))
    copy = jax.tree.unflatten(tree, [_drop_names(leaf) for leaf in leaves])
    object.__setattr__(copy, "outputs", names("sensor outputs", None, count=len(model.outputs), prefix="y"))
    object.__setattr__(copy, "circular", tuple(f"y{i}" for i in model.angles))
    return copy


AnySensor = TypeAliasType("AnySensor", AbstractSensor | OverTime)  # an OverTime holds one sensor per step


@cache_by_object
def check_sensor(sensor: AbstractSensor, states: int) -> None:
    """Raise ValueError unless the sensor takes a state of this length and returns its outputs."""
    instance("sensor", sensor, AbstractSensor, "a sensor")
    sensor.check_states(states)


SEVERAL_TAKEN_BY = "hg.linear_filter, hg.filters.imm_filter, gpb1_filter, gpb2_filter and particle_filter take several"


def is_linear(plant: AnyPlant, sensor: AnySensor) -> bool:
    """Return whether both are linear, so that but for angles means and covariances propagate without approximation."""
    return isinstance(first(plant), LinearPlant) and isinstance(first(sensor), LinearSensor)


def check_linear(name: str, plant: AnyPlant, sensor: AnySensor) -> None:
    """Raise ValueError unless plant and sensor are linear, without modes, and nothing in them is an angle."""
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        modal = any(isinstance(first(model), AbstractWithMemory) for model in (plant, sensor))
        instead = f" of one law ({SEVERAL_TAKEN_BY})" if modal else ""
        raise fail(name, f"a LinearPlant and a LinearSensor{instead}", got)
    refuse_angles(name, plant, sensor)


def angles_of_outputs(angles: "Sequence[int] | AnySensor", outputs: int) -> Angles:
    """Return which of `outputs` outputs are angles, from their indices or from the sensor whose outputs they are."""
    sensor = first(angles)
    if not isinstance(sensor, AbstractSensor):
        return angles_at(angles, outputs)
    if len(sensor.outputs) != outputs:
        raise fail("angles", f"those of a sensor of {outputs} outputs", f"one of {list(sensor.outputs)}")
    return sensor.angles


def refuse_angles(name: str, *models: AnyPlant | AnySensor) -> None:
    """Raise ValueError if a state or an output is an angle; `name`: what cannot handle angles."""
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
