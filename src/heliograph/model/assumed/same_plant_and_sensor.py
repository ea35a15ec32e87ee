"""Whether two plants, noises or sensors agree in what a filter uses of them."""

from collections.abc import Callable

import jax
import numpy as np

from heliograph.model.assumed.assumed_model import MEAN_AND_COVARIANCE
from heliograph.model.assumed.same_program import same_function
from heliograph.model.augmented.joint_sensors import JointSensor
from heliograph.model.diffuse_start import UnknownStart
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor
from heliograph.model.over_time import at, steps_covered
from heliograph.model.plant import AbstractPlant, LinearPlant, MatrixOfInputs
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.module import are_same
from heliograph.numerics.numpy_or_jax import equal_to_rounding, is_traced
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise


def agree_at_each_step(agree: Callable[..., bool], a: object, b: object, order: int | None) -> bool:
    """Return whether two models agree at each step: whether agree(a_k, b_k, order) is true for all k.

    Args:
        agree: compares two models of one step, as `same_plant` does.
        a: a model, constant or over time.
        b: the other. Where both vary, they must cover the same number of steps.
        order: order of the moments of noises that a filter uses, None for their whole laws.
    """
    if are_same(a, b):
        return True
    if steps_covered((a, b)) is None:
        return agree(a, b, order)
    covered = {steps for steps in (steps_covered(a), steps_covered(b)) if steps is not None}
    if len(covered) != 1:
        return False
    (horizon,) = covered
    return all(agree(at(a, k), at(b, k), order) for k in range(horizon))


def same_noise(a: AbstractNoise, b: AbstractNoise, order: int | None) -> bool:
    """Return whether two noises agree in what a filter uses of them.

    `order` is MEAN_AND_COVARIANCE for a filter that uses these alone, and None for one that uses the whole law: then
    only the same law agrees. A noise that is known by a bound of its covariance agrees with such noises only.
    """
    if are_same(a, b):
        return True
    if order != MEAN_AND_COVARIANCE or has_bounded_noise(a) != has_bounded_noise(b):
        return False
    return equal_to_rounding(a.mean, b.mean) and equal_to_rounding(a.covariance, b.covariance)


def same_plant(a: AbstractPlant, b: AbstractPlant, order: int | None) -> bool:
    """Return whether two plants agree in law, or in mean and covariance if a filter uses no more of their noises.

    Compared are the numbers of states and inputs, which states are angles or attitudes, the law of x_0, the motion, and
    the noise. `order` is the order of the moments that the filter uses, None for the whole law.
    """
    if are_same(a, b):
        return True
    if any(isinstance(plant.initial_covariance, UnknownStart) or isinstance(plant, ModalPlant) for plant in (a, b)):
        return False  # such plants are compared as a whole only, above
    sizes = [(len(plant.states), len(plant.inputs), plant.manifold) for plant in (a, b)]
    if sizes[0] != sizes[1] or not equal_to_rounding(a.initial_mean, b.initial_mean):
        return False
    if order != MEAN_AND_COVARIANCE and not are_same(a.deviation, b.deviation):
        return False
    return (
        equal_to_rounding(a.initial_covariance, b.initial_covariance)
        and _same_motion(a, b)
        and _same_disturbance(a, b, order)
    )


def _same_motion(a: AbstractPlant, b: AbstractPlant) -> bool:
    """Return whether two plants have the same transition: equal matrices A and B, or the same function f(x, u).

    Matrices that depend on inputs, and functions, are compared as programs that JAX traces.
    """
    if isinstance(a, LinearPlant) and isinstance(b, LinearPlant):
        matrices = (a.matrix, a.input_matrix, b.matrix, b.input_matrix)
        if not any(isinstance(matrix, MatrixOfInputs) for matrix in matrices):
            has_same_matrix = equal_to_rounding(a.matrix, b.matrix)
            return has_same_matrix and equal_to_rounding(a.input_matrix, b.input_matrix)
    return same_function(a.transition, b.transition, (len(a.states),), (len(a.inputs),))


def _same_disturbance(a: AbstractPlant, b: AbstractPlant, order: int | None) -> bool:
    """Return whether two plants' process noises agree, as laws or as covariances that are functions of the inputs.

    `order`: the order of the moments that a filter uses, None for the whole law.
    """
    if isinstance(a.noise, AbstractNoise) and isinstance(b.noise, AbstractNoise):
        return same_noise(a.noise, b.noise, order)
    return same_function(a.noise_covariance, b.noise_covariance, (len(a.inputs),))


def same_sensor(a: AbstractSensor, b: AbstractSensor, order: int | None) -> bool:
    """Return whether two sensors measure the same function of the state, with noises that agree.

    `order` is the order of the moments of the noise that a filter uses, None for its whole law.
    """
    if are_same(a, b):
        return True
    if isinstance(a, ModalSensor) or isinstance(b, ModalSensor):
        return False
    if a.inputs or b.inputs:
        return _same_sensor_of_inputs(a, b, order)
    if a.angles != b.angles or len(a.outputs) != len(b.outputs) or not same_noise(a.noise, b.noise, order):
        return False
    if isinstance(a, JointSensor) and isinstance(b, JointSensor) and len(a.parts) == len(b.parts):
        return all(same_sensor(x, y, order) for x, y in zip(a.parts, b.parts, strict=True))
    matrices = find_sensor_matrix(a), find_sensor_matrix(b)
    if matrices[0] is not None and matrices[1] is not None:
        return equal_to_rounding(*matrices)
    # Sensors do not know how many states they measure: any number that both take will do.
    return any(same_function(a.measure, b.measure, (n,)) for n in _find_common_state_length(a, b))


def _same_sensor_of_inputs(a: AbstractSensor, b: AbstractSensor, order: int | None) -> bool:
    """Return whether two sensors that depend on inputs u are the same functions h(x, u), with noises that agree.

    Functions are the same if JAX traces them to the same program. `order`: order of the moments of the noise that a
    filter uses, None for its whole law.
    """
    if a.inputs != b.inputs or a.angles != b.angles or len(a.outputs) != len(b.outputs):
        return False
    shape_of_u = (len(a.inputs),)
    if isinstance(a.noise, AbstractNoise) and isinstance(b.noise, AbstractNoise):
        if not same_noise(a.noise, b.noise, order):
            return False
    elif not same_function(_noise_as_function_of_inputs(a), _noise_as_function_of_inputs(b), shape_of_u):
        return False
    # Sensors do not know how many states they measure: any number that both take will do.
    return any(
        same_function(_measure_as_function_of_inputs(a), _measure_as_function_of_inputs(b), (n,), shape_of_u)
        for n in _find_common_state_length(a, b)
    )


def _noise_as_function_of_inputs(sensor: AbstractSensor) -> Callable[[jax.Array], object]:
    """Return the covariance of a sensor's noise as a function of its inputs."""
    return lambda u: sensor.given(u).noise.covariance


def _measure_as_function_of_inputs(sensor: AbstractSensor) -> Callable[[jax.Array, jax.Array], object]:
    """Return what a sensor measures as a function of state and inputs."""
    return lambda x, u: sensor.given(u).measure(x)


def _find_common_state_length(*sensors: AbstractSensor) -> list[int]:
    """Return the least number of states up to 32 that both sensors take, in a list; [] if there is none."""
    return [n for n in range(1, 33) if all(_takes_states(sensor, n) for sensor in sensors)][:1]


def _takes_states(sensor: AbstractSensor, states: int) -> bool:
    """Return whether a sensor can measure a plant with this number of states."""
    try:
        sensor.check_states(states)
    except ValueError:
        return False
    return True


def find_sensor_matrix(sensor: AbstractSensor) -> np.ndarray | None:
    """Return the matrix of a linear sensor, or of linear sensors stacked into one.

    It is None for any other sensor, for a matrix that depends on inputs, and for one that JAX traces.
    """
    if isinstance(sensor, LinearSensor):
        return None if sensor.inputs or is_traced(sensor.matrix) else np.asarray(sensor.matrix)
    if not isinstance(sensor, JointSensor):
        return None
    matrices = [find_sensor_matrix(part) for part in sensor.parts]
    known_matrices = [matrix for matrix in matrices if matrix is not None]
    return np.concatenate(known_matrices) if len(known_matrices) == len(matrices) else None
