"""Inputs of a plant: a time step that does not go backwards, and what the plant's functions return for them."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.input_dependent_sensor import NoiseOfInputs
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import at, first, stack_over_time
from heliograph.model.plant import TIME_STEP, AbstractPlant, AnyPlant, LinearPlant, MatrixOfInputs, matrix_under_inputs
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, SYMMETRY_TOLERANCE, fail, standard_deviations
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.linalg import rounding
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.noises.noise import AbstractNoise

LONGEST = 2.0**53  # units of a time step; a double counts no time beyond it
WRAPPED = 2.0**32  # a difference of unsigned counters of 32 bits that is -d reads 2^32 - d
NEAR = 2.0**24  # how far below 2^32 a whole number of units is taken for such a difference
SMALLER = (1e3, 1e6)  # counts in a unit of dt, of a counter of milliseconds or microseconds in seconds
CLOSE = 2.0**10  # how far below 2^32 a number of such counts is: few steps are of 49.7 days so exactly
ROWS = 4096  # of inputs for which functions are computed at once
MOST_SHOWN = 100  # characters of a matrix
LOOSE = 100.0  # times the tolerances of eigenvalues: elimination rounds by more than they do

ModelMatrixFunction = Callable[[Any, jax.Array], jax.Array]  # of a plant or a sensor, and its inputs


class TimeStepFault(NamedTuple):
    """A row whose time step is not valid: its number from 0, what was expected and what came, for an error."""

    row: int
    expected: str
    came: str


def find_time_step_fault(dt: Float[np.ndarray, " steps"]) -> TimeStepFault | None:
    """Return the first of some time steps that is not valid, with the words of an error; None if all are.

    A step may go backwards, be beyond LONGEST (2^53), or come from a clock that went back by d counts: a clock of
    unsigned 32-bit counts then gives 2^32 - d (WRAPPED is 2^32).
    """
    is_invalid = ~np.asarray(_is_time_step(dt))
    if not is_invalid.any():
        return None
    row = int(np.argmax(is_invalid))
    got = f"{dt[row]:.10g}"
    if dt[row] < 0:
        return TimeStepFault(row, "a time step that does not go backwards", got)
    if dt[row] > LONGEST:
        return TimeStepFault(row, "a time step of at most 2^53 units, as far as a double counts", got)
    # A wrapped counter. It counts in the unit of dt, or in thousandths or millionths of it (SMALLER: counts in a unit):
    # the one in which the step is nearest to 2^32. The step that was meant is negative, the difference to 2^32.
    counts_in_unit = min((1.0, *SMALLER), key=lambda counts: abs(dt[row] * counts - WRAPPED))
    counts_meant = round(dt[row] * counts_in_unit - WRAPPED)
    step_meant = f"{counts_meant}" + (f" / {counts_in_unit:g}" if counts_in_unit > 1 else "")
    return TimeStepFault(row, "a time step", f"{got}: {step_meant} as a difference of unsigned counters of 32 bits")


def check_time_step(names: Sequence[str], u: Float[np.ndarray, "... inputs"]) -> None:
    """Raise ValueError unless each time step (input "dt") is from 0 to 2^53 and not from a counter that wrapped.

    Args:
        names: names of the inputs.
        u: one row of inputs (inputs,), or rows (steps, inputs).
    """
    if TIME_STEP not in names or isinstance(u, jax.core.Tracer):
        return
    fault = find_time_step_fault(np.atleast_2d(np.asarray(u))[:, list(names).index(TIME_STEP)])
    if fault is not None:
        where = f"input {TIME_STEP!r}" + (f", row {fault.row + 1}" if np.ndim(u) > 1 else "")
        raise fail(where, fault.expected, fault.came)


def _is_time_step(dt: Array, precision: type = np.float64) -> Array:
    """Return whether each number can be a time step: from 0 to LONGEST (2^53), and not from a counter that wrapped.

    A clock that counts in unsigned numbers of 32 bits and goes back by d gives the difference 2^32 - d. So numbers just
    below 2^32 are refused: whole ones, counts themselves, within NEAR of it; those that are thousandths or millionths
    of a unit (SMALLER: counts in a unit), within CLOSE counts. `precision`: type of the numbers.
    """
    has_wrapped = _is_near_wrap(dt, 1.0, NEAR, precision) & (dt.round() == dt)
    for counts_in_unit in SMALLER:
        has_wrapped = has_wrapped | _is_near_wrap(dt, counts_in_unit, CLOSE, precision)
    return (dt >= 0) & (dt <= LONGEST) & ~has_wrapped


def _is_near_wrap(dt: Array, counts: float, near: float, precision: type) -> Array:
    """Return whether each time step, in counts of a 32-bit counter, is at most `near` below 2^32.

    A counter that goes back by d counts wraps, so that the unsigned difference of two of its readings is 2^32 - d.

    Args:
        dt: time steps (steps,).
        counts: counts of the counter in a unit of dt.
        near: the largest d that is taken for a wrap; the least is 1, with 0.5 for rounding.
        precision: type of numbers to which dt is rounded, and so also the limits with which it is compared.
    """
    lowest, highest = (float(precision((WRAPPED - d) / counts)) for d in (near, 0.5))
    return (dt >= lowest) & (dt <= highest)


def check_inputs(
    names: Sequence[str], u: Float[Array, "steps inputs"], models: PyTree, step: int | np.ndarray = 0
) -> None:
    """Raise ValueError where a time step is none, or a plant's function of the inputs returns what it must not.

    Matrices and noise of plants and sensors may be functions of the inputs, such as of the time step dt. They are
    computed at the given inputs, before a run does so in compiled code, where nothing can be refused.

    Args:
        names: names of the inputs.
        u: the inputs of consecutive steps (steps, inputs).
        models: a filter, nodes or anything else that holds plants with these inputs.
        step: number of the first of the steps, or of each (steps,).
    """
    if isinstance(u, jax.core.Tracer) or not len(names):
        return
    u = np.asarray(u)
    check_time_step(names, u)
    steps = np.arange(len(u)) + step if np.ndim(step) == 0 else np.asarray(step)
    # Each plant and each sensor is checked once, though many filters hold the same object: `known` has their ids.
    known: set[int] = set()
    for plant in yield_plants(models):
        if id(plant) not in known and first(plant).inputs == tuple(names):
            _check_functions_of_inputs(plant, u, steps)
        known.add(id(plant))
    for sensor, indices in _sensors_of_inputs(models, names):
        if id(sensor) not in known:
            _check_functions_of_inputs(sensor, u[:, indices], steps)
        known.add(id(sensor))


def _sensors_of_inputs(models: PyTree, names: Sequence[str]) -> Iterator[tuple[AnySensor, list[int]]]:
    """Yield the sensors in `models` that depend on inputs, each with the indices of its inputs among `names`.

    So a row of all inputs gives those of a sensor. Sensors of other inputs are left out. A sensor may vary over time;
    the names of its inputs are those of its first step.
    """
    for sensor in yield_models_of_class(models, AbstractSensor):
        own_inputs = first(sensor).inputs
        if own_inputs and set(own_inputs) <= set(names):
            yield sensor, [list(names).index(name) for name in own_inputs]


def yield_plants(models: PyTree) -> Iterator[AnyPlant]:
    """Yield the plants that a model object holds; of a plant with modes the plant of each mode."""
    for plant in yield_models_of_class(models, AbstractPlant):
        yield from list_mode_models(plant)


def yield_models_of_class(models: PyTree, kind: type) -> Iterator[PyTree]:
    """Yield all models of the class `kind`, such as sensors, that a model object (a filter, say) holds anywhere.

    A model that varies over time is yielded as the `OverTime` that it is.
    """

    def is_part(part: object) -> bool:
        """Return whether an object is of the class, constant or over time."""
        return isinstance(stack_over_time(part), kind)

    yield from (part for part in jax.tree.leaves(models, is_leaf=is_part) if is_part(part))


def _list_functions_of_inputs(model: AbstractPlant | AbstractSensor) -> dict[str, ModelMatrixFunction]:
    """Return, by name for errors, the functions that give a model's matrices and noise covariance from its inputs.

    Matrices and covariances that are constants are left out: they were checked when the model was made.
    """
    every: dict[str, ModelMatrixFunction] = {}
    if isinstance(model, AbstractSensor):
        if isinstance(model, LinearSensor) and isinstance(model.matrix, MatrixOfInputs):
            every["sensor matrix(u)"] = _sensor_matrix
        if isinstance(model.noise, NoiseOfInputs):
            every[SENSOR_NOISE] = _sensor_noise
        return every
    if isinstance(model, LinearPlant):
        if isinstance(model.matrix, MatrixOfInputs):
            every["plant matrix(u)"] = LinearPlant.transition_matrix
        if isinstance(model.input_matrix, MatrixOfInputs):
            every["input matrix(u)"] = _input_matrix
    if not isinstance(model.noise, AbstractNoise):
        every[NOISE] = AbstractPlant.noise_covariance
    return every


NOISE, SENSOR_NOISE = "process noise covariance(u)", "sensor noise covariance(u)"
COVARIANCES = NOISE, SENSOR_NOISE


def _sensor_matrix(sensor: LinearSensor, u: jax.Array) -> jax.Array:
    """Return C(u) of a linear sensor."""
    return matrix_under_inputs(sensor.matrix, u)


def _sensor_noise(sensor: AbstractSensor, u: jax.Array) -> jax.Array:
    """Return the covariance R(u) of the noise of a sensor whose noise is a function of its inputs u."""
    assert isinstance(sensor.noise, NoiseOfInputs)
    return sensor.noise.given(u)


def _input_matrix(plant: AbstractPlant, u: jax.Array) -> jax.Array:
    """Return the input matrix B(u) of a linear plant."""
    assert isinstance(plant, LinearPlant)
    return matrix_under_inputs(plant.input_matrix, u)


def _check_functions_of_inputs(
    plant: AnyPlant | AnySensor, u: Float[np.ndarray, "steps inputs"], steps: np.ndarray
) -> None:
    """Raise ValueError that names the row whose inputs u give a matrix that is not finite, or no covariance.

    COVARIANCES: names of the matrices that must be covariances. `steps`: the step of each row.
    """
    functions = _list_functions_of_inputs(first(plant))
    if not functions or not len(u):
        return
    blocks = _evaluate_in_blocks_of_steps(plant, tuple(functions.values()), u, steps)
    for name, matrices_by_block in zip(functions, zip(*blocks, strict=True), strict=True):
        matrices = np.concatenate(matrices_by_block)  # of the function, at all steps
        is_covariance = name in COVARIANCES
        wrong = mask_invalid_covariances(matrices) if is_covariance else ~np.isfinite(matrices).all(axis=(1, 2))
        if wrong.any():
            row = int(np.argmax(wrong))
            inputs = ", ".join(f"{key} = {x:.6g}" for key, x in zip(first(plant).inputs, u[row], strict=True))
            where = f"row {row + 1}" if len(u) > 1 else f"step {steps[0]}"
            got = f"{_shorten(matrices[row])} in {where}, for {inputs}"
            raise fail(name, "a covariance" if is_covariance else "finite numbers", got)


def _evaluate_in_blocks_of_steps(
    plant: AnyPlant | AnySensor,
    functions: tuple[ModelMatrixFunction, ...],
    u: Float[np.ndarray, "steps inputs"],
    steps: np.ndarray,
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield the matrices of some functions of the inputs, by blocks of at most ROWS steps: memory stays bounded.

    Args:
        plant: plant or sensor, constant or over time, whose matrices they are.
        functions: each from (the model of a step, its inputs) to a matrix.
        u: inputs of each step.
        steps: number of each step.

    Yields:
        For a block, the matrices (steps of the block, n, m) of each function.
    """
    for start in range(0, len(u), ROWS):
        yield _evaluate_at_steps(plant, functions, u[start : start + ROWS], steps[start : start + ROWS])


@compile_in_float64
def _evaluate_at_steps(
    plant: AnyPlant | AnySensor, functions: tuple[ModelMatrixFunction, ...], u: Array, steps: Array
) -> Any:
    """Return for each function its matrices at all steps (steps, n, m), under the inputs u of each step.

    It is compiled, since computing one operation after another is slow.

    Args:
        plant: plant or sensor, constant or over time.
        functions: each from (the model of a step, its inputs) to a matrix.
        u: inputs of each step (steps, inputs).
        steps: number of each step (steps,).
    """

    def of_step(k: jax.Array, u_k: jax.Array) -> tuple[jax.Array, ...]:
        """Return the matrix of each function at step k, whose inputs are u_k."""
        now = at(plant, k)
        return tuple(function(now, u_k) for function in functions)

    return jax.vmap(of_step)(jnp.asarray(steps), jnp.asarray(u))


def _shorten(value: np.ndarray) -> str:
    """Return a matrix as text for an error message, cut to MOST_SHOWN characters."""
    shown = str(np.round(value, 12).tolist())
    return shown if len(shown) <= MOST_SHOWN else shown[: MOST_SHOWN - 3] + "..."


def mask_invalid_covariances(values: Float[np.ndarray, "steps n n"]) -> np.ndarray:
    """Return which of some matrices (steps, n, n) are not covariances, to rounding: (steps,), True for those.

    A covariance is finite, symmetric and positive semidefinite. The tolerances are of correlations.
    """
    is_finite = np.isfinite(values).all(axis=(1, 2))
    finite_values = np.where(is_finite[:, None, None], values, 0.0)
    deviations = standard_deviations(finite_values)  # so that tolerances do not depend on the states' units
    correlations = finite_values / (deviations[:, :, None] * deviations[:, None, :])
    asymmetry = np.abs(correlations - np.swapaxes(correlations, 1, 2)).max(axis=(1, 2), initial=0.0)
    least_eigenvalue = np.linalg.eigvalsh((correlations + np.swapaxes(correlations, 1, 2)) / 2)[:, 0]
    invalid: np.ndarray = ~is_finite | (asymmetry > SYMMETRY_TOLERANCE) | (least_eigenvalue < -DEFINITENESS_TOLERANCE)
    return invalid


def do_inputs_spoil(
    model: PyTree, names: Sequence[str], u: jax.Array, k: jax.Array | int, precision: type | None = None
) -> jax.Array:
    """Return, in a compiled step, whether inputs are invalid for the plants and sensors in a model.

    They are if the time step among them is not a valid duration, or if a plant's or sensor's function of the inputs
    returns a matrix that is not finite, or not a covariance where it must be one.

    Args:
        model: a filter, or anything else that holds plants and sensors with these inputs.
        names: names of the inputs; TIME_STEP is the name of the one that says the length of the step.
        u: inputs of the step (inputs,).
        k: number of the step.
        precision: type of numbers in which the step is computed, whose rounding is allowed (default: the matrix's).

    Returns:
        A traced boolean; compiled code cannot raise an error.
    """
    # One of the inputs may be the length of the step, which has to be a valid duration.
    spoilt = jnp.asarray(False)
    if TIME_STEP in names:
        spoilt = ~jnp.asarray(_is_time_step(u[list(names).index(TIME_STEP)], precision or np.float64))
    # Plants that depend on exactly these inputs, as they are at step k; then sensors with their own part of u.
    for varying in yield_plants(model):
        plant = at(varying, k)
        if not names or plant.inputs != tuple(names):
            continue
        spoilt |= _returns_invalid_value(plant, u, precision)
    for sensor, indices in _sensors_of_inputs(model, names):
        spoilt |= _returns_invalid_value(at(sensor, k), u[np.array(indices)], precision)
    return spoilt


def _returns_invalid_value(model: AbstractPlant | AbstractSensor, u: jax.Array, precision: type | None) -> jax.Array:
    """Return whether some matrix that a model computes from its inputs u is not finite, or no covariance.

    COVARIANCES: names of the matrices that must be covariances. `precision`: type of the numbers, for tolerances.
    """
    has_invalid = jnp.asarray(False)
    for name, function in _list_functions_of_inputs(model).items():
        value = function(model, u)
        is_valid = _is_covariance(value, precision) if name in COVARIANCES else jnp.all(jnp.isfinite(value))
        has_invalid |= ~is_valid
    return has_invalid


def _is_covariance(matrix: jax.Array, precision: type | None) -> jax.Array:
    """Decide whether a matrix (n, n) is a covariance, by elimination of its correlations.

    It has to be finite and symmetric, without a pivot below zero. Where a pivot is zero, nothing may be left of its
    column: |c_ij|^2 <= c_ii c_jj.

    Args:
        matrix: (n, n).
        precision: type of numbers whose rounding is allowed; None for the matrix's own.
    """
    variances = jnp.diagonal(matrix)
    scale = 1 / jnp.sqrt(jnp.where(variances > 0, variances, 1.0))
    remainder = matrix * scale[:, None] * scale  # correlations of the components that are not eliminated yet
    like: Array = remainder if precision is None else np.zeros(0, precision)
    is_valid = jnp.all(jnp.isfinite(matrix)) & jnp.all(variances >= 0)
    is_valid &= jnp.all(jnp.abs(remainder - remainder.T) <= rounding(LOOSE * SYMMETRY_TOLERANCE, like))
    tolerance = rounding(LOOSE * DEFINITENESS_TOLERANCE, like, 10 * len(matrix))
    for _ in range(len(matrix)):
        pivot, column = remainder[0, 0], remainder[1:, 0]
        is_zero = pivot <= tolerance
        is_valid &= (pivot >= -tolerance) & (~is_zero | jnp.all(column**2 <= 2 * tolerance))
        multiples = column / jnp.where(is_zero, 1.0, pivot)
        remainder = remainder[1:, 1:] - jnp.where(is_zero, 0.0, multiples[:, None] * remainder[0, 1:])
    return is_valid
