"""Whether two descriptions of the world agree, compared as values: the parts in which a filter believes another one.

Laws agree that are written alike. A claim that rests on means and covariances alone holds for every law that shares
them, so that of such filters only these are compared: E[G], E[n] and Cov(z | y) given what arrives, whatever is lost.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np

from heliograph.model.augmented.joint_sensors import JointSensor, join_links
from heliograph.model.augmented.past_outputs import with_past
from heliograph.model.channel import Channel
from heliograph.model.diffuse_start import UnknownStart
from heliograph.model.fading import memory_matters, without_memory
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor
from heliograph.model.over_time import at, at_each_step, first, steps_covered, unstack
from heliograph.model.plant import AbstractPlant, LinearPlant, MatrixOfInputs
from heliograph.model.premises.premise import MEAN_AND_COVARIANCE, Premise
from heliograph.model.premises.same_program import same_function
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.numerics.module import are_same
from heliograph.numerics.numpy_or_jax import EQUAL, equal_to_rounding, is_traced
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.erasure import second_moments
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise
from heliograph.random_affine.series_and_stack import Series

PLANT, SENSOR, CHANNEL, TRIGGER, RELAYS = "plant", "sensor", "channel", "trigger", "relays"
RANGE = "range of values"
ENCODER = "encoder"


def list_differences(believed: Premise, own: Premise) -> tuple[str, ...]:
    """Return the names of the models that differ: those a filter was made for (`believed`), and its node's (`own`).

    Models are plant, sensor, channel and relays. Its claim holds only in the world for which it was made.
    """
    # `order`: the moments of noises that the filter uses; None for their laws. Past signals may be states of both.
    order, own = believed.order, _enlarge_world_by_past(believed, own)
    parts = [] if _agree_at_each_step(_same_plant, believed.plant, own.plant, order) else [PLANT]
    if own.relays is not None or believed.relays is not None:
        agree = are_same(believed.relays, own.relays) and _same_gains(believed, own)
        return (*parts, *([] if agree else [RELAYS]))
    if believed.sensor is None or believed.channel is None:  # a filter without measurements
        return tuple(parts)
    if own.sensor is None or own.channel is None:
        return (*parts, SENSOR)
    if not _same_trigger(believed.trigger, own.trigger):
        parts.append(TRIGGER)
    if own.range is not None:  # no filter knows it: that a value is refused, for being out of range, tells of the state
        parts.append(RANGE)
    if not are_same(believed.encoder, own.encoder):
        parts.append(ENCODER)
    # Sensor and channel agree one by one, or together: what is received of the state through both may be the same.
    sensors = _agree_at_each_step(_same_sensor, believed.sensor, own.sensor, order)
    channels = _same_channel(believed.channel, own.channel, order, believed.trigger is None)
    if sensors and channels:
        return tuple(parts)
    observations = (believed.sensor, believed.channel), (own.sensor, own.channel)
    if _agree_at_each_step(_same_observation, *observations, order):
        return tuple(parts)
    parts += [part for part, agree in ((SENSOR, sensors), (CHANNEL, channels)) if not agree]
    return tuple(parts)


def _enlarge_world_by_past(believed: Premise, own: Premise) -> Premise:
    """Return the models of a node with past signals as states if the filter was made for such a larger plant.

    `believed` are the models that the filter was made for, and `own` those where it stands. The latter are returned
    unchanged if the channel is not late (`past` is 0) or the filter's plant has no more states.
    """
    if own.sensor is None or own.channel is None or not first(own.channel).past:
        return own
    if len(first(believed.plant).states) <= len(first(own.plant).states):
        return own
    plant, sensor, channel = with_past(own.plant, own.sensor, own.channel)
    return own.replaced(plant=plant, sensor=sensor, channel=channel)


def join_premises(premises: Sequence[Premise]) -> Premise:
    """Return what a filter assumes (its premise) that receives the measurements of several filters of one plant.

    Sensors and channels are stacked. The first trigger, encoder or range of values among them stands for all.
    """
    if len(premises) == 1:
        return premises[0]
    sensors = [premise.sensor for premise in premises if premise.sensor is not None]
    channels = [premise.channel for premise in premises if premise.channel is not None]
    sensor, channel = join_links({str(i): s for i, s in enumerate(sensors)}, channels)
    triggers = [p.trigger for p in premises if p.trigger is not None and not isinstance(p.trigger, Periodic)]
    encoders = [premise.encoder for premise in premises if premise.encoder is not None]
    ranges = [premise.range for premise in premises if premise.range is not None]
    return premises[0].replaced(
        sensor=sensor,
        channel=channel,
        trigger=triggers[0] if triggers else None,
        encoder=encoders[0] if encoders else None,
        range=ranges[0] if ranges else None,
        order=None if any(premise.order is None for premise in premises) else MEAN_AND_COVARIANCE,
    )


def restrict_premise_to_rows(premise: Premise, rows: Sequence[int]) -> Premise:
    """Return what a filter assumes (its premise) if only these rows of its channel's outputs are received."""
    selection = known(np.eye(first(premise.channel).outputs)[list(rows)])
    return premise.replaced(channel=at_each_step(lambda channel: Series([channel, selection]), premise.channel))


def _agree_at_each_step(agree: Callable[..., bool], a: object, b: object, order: int | None) -> bool:
    """Return whether agree(a, b, order) at each step; `order` of the moments that a filter uses, None for the law."""
    if are_same(a, b):
        return True
    if steps_covered((a, b)) is None:
        return agree(a, b, order)
    covered = {steps for steps in (steps_covered(a), steps_covered(b)) if steps is not None}
    return len(covered) == 1 and all(agree(at(a, k), at(b, k), order) for k in range(covered.pop()))


def _same_noise(a: AbstractNoise, b: AbstractNoise, order: int | None) -> bool:
    """Return whether noises agree in what a filter uses of them: mean and covariance (`order`), or the whole law."""
    if are_same(a, b):
        return True
    if order != MEAN_AND_COVARIANCE or has_bounded_noise(a) != has_bounded_noise(b):
        return False
    return equal_to_rounding(a.mean, b.mean) and equal_to_rounding(a.covariance, b.covariance)


def _same_plant(a: AbstractPlant, b: AbstractPlant, order: int | None) -> bool:
    """Tell whether two plants agree in law, or in mean and covariance where the filter uses no more."""
    if are_same(a, b):
        return True
    if any(isinstance(plant.initial_covariance, UnknownStart) or isinstance(plant, ModalPlant) for plant in (a, b)):
        return False  # of these, only the same is the same
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
    """Return whether two plants move a state alike: by equal matrices, or by the same function of state and inputs."""
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
        return _same_noise(a.noise, b.noise, order)
    return same_function(a.noise_covariance, b.noise_covariance, (len(a.inputs),))


def _same_sensor(a: AbstractSensor, b: AbstractSensor, order: int | None) -> bool:
    """Tell whether two sensors measure the same, and with noise of the same moments up to `order`."""
    if are_same(a, b):
        return True
    if isinstance(a, ModalSensor) or isinstance(b, ModalSensor):
        return False
    if a.inputs or b.inputs:
        return _same_sensor_of_inputs(a, b, order)
    if a.angles != b.angles or len(a.outputs) != len(b.outputs) or not _same_noise(a.noise, b.noise, order):
        return False
    if isinstance(a, JointSensor) and isinstance(b, JointSensor) and len(a.parts) == len(b.parts):
        return all(_same_sensor(x, y, order) for x, y in zip(a.parts, b.parts, strict=True))
    matrices = find_sensor_matrix(a), find_sensor_matrix(b)
    if matrices[0] is not None and matrices[1] is not None:
        return equal_to_rounding(*matrices)
    # Sensors do not know how many states they measure: any number that both take will do.
    return any(same_function(a.measure, b.measure, (n,)) for n in _find_common_state_length(a, b))


def _same_sensor_of_inputs(a: AbstractSensor, b: AbstractSensor, order: int | None) -> bool:
    """Return whether two sensors that depend on inputs are the same programs of state and inputs, with like noise.

    `order`: of the moments of noise that a filter uses, None for its whole law.
    """
    if a.inputs != b.inputs or a.angles != b.angles or len(a.outputs) != len(b.outputs):
        return False
    u = (len(a.inputs),)
    if isinstance(a.noise, AbstractNoise) and isinstance(b.noise, AbstractNoise):
        if not _same_noise(a.noise, b.noise, order):
            return False
    elif not same_function(_noise_as_function_of_inputs(a), _noise_as_function_of_inputs(b), u):
        return False
    # Sensors do not know how many states they measure: any number that both take will do.
    return any(
        same_function(_measure_as_function_of_inputs(a), _measure_as_function_of_inputs(b), (n,), u)
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
    matrices = [matrix for part in sensor.parts if (matrix := find_sensor_matrix(part)) is not None]
    return np.concatenate(matrices) if len(matrices) == len(sensor.parts) else None


def _same_trigger(believed: AbstractTrigger | None, own: AbstractTrigger | None) -> bool:
    """Return whether the sender's actual rule, `own`, is the one that the filter assumes, `believed`.

    A filter that assumes no rule is also right for a schedule (Periodic), which leaves out values whatever they are, so
    that a missing value has no information.
    """
    if believed is None:
        return own is None or isinstance(own, Periodic)
    return are_same(believed, own)


def _same_gains(believed: Premise, own: Premise) -> bool:
    """Return whether each relay that a recording has runs with the gain that the filter assumes for it."""
    return all(equal_to_rounding(gain, own.gains[name]) for name, gain in believed.gains.items() if name in own.gains)


def _same_channel(a: Channel, b: Channel, order: int | None, loses: bool) -> bool:
    """Return whether two channels agree; memories at the same place count as the same.

    Args:
        a: a channel, constant or over time.
        b: the other.
        order: the order of the moments that a filter uses, None for the whole law.
        loses: True if they may differ in what they lose, since the filter sees losses.
    """
    if a is b:
        return True
    if isinstance(a, AbstractRandomAffine) and isinstance(b, AbstractRandomAffine):
        return _same_map(drop_names(a), drop_names(b), order, loses)
    if are_same(drop_names(a), drop_names(b)):
        return True
    if first(a).remembers or first(b).remembers:
        return False
    return _agree_at_each_step(lambda a_k, b_k, order: _same_map(a_k, b_k, order, loses), a, b, order)


def _same_map(a: AbstractRandomAffine, b: AbstractRandomAffine, order: int | None, loses: bool) -> bool:
    """Return whether a filter that assumes the map a, z = G y + n, is right for the map b.

    `order` is MEAN_AND_COVARIANCE if the filter uses only E[(G, n)] and E[z z' | y], and None if it uses the whole law.
    `loses` is True if losses may have another law, since the filter sees which outputs are lost.
    """
    if are_same(a, b):
        return True
    # Numbers under JAX tracing cannot be compared; maps of other sizes, or of `past` outputs (delays), never agree.
    if is_traced(a, b) or (a.outputs, a.inputs, a.past) != (b.outputs, b.inputs, b.past) or a.past:
        return False
    # Alike in structure, with all laws of b possible under a; or alike in each of several maps in parallel.
    if a.covers(b, lambda x, y: _same_noise(x, y, order)):
        return True
    maps_of_a, maps_of_b = a.in_parallel, b.in_parallel
    if len(maps_of_a) > 1 and [m.outputs for m in maps_of_a] == [m.outputs for m in maps_of_b]:
        return all(_same_map(x, y, order, loses) for x, y in zip(maps_of_a, maps_of_b, strict=True))
    # Compare what arrives, whatever is lost, by its law and then by its moments.
    if not loses:
        return False
    if (a.erases or b.erases) and _same_given_arrival(a, b):
        return True
    try:
        return order == MEAN_AND_COVARIANCE and _same_moments(a, b)
    except ValueError:  # no moments, or more than can be listed
        return False


def _same_given_arrival(a: AbstractRandomAffine, b: AbstractRandomAffine) -> bool:
    """Return whether two maps are the same except for what they lose; False if losses depend on gains."""
    try:
        return are_same(a.condition_on_arrival(), b.condition_on_arrival())
    except ValueError:  # losses depend on gains
        return False


def _same_moments(a: AbstractRandomAffine, b: AbstractRandomAffine) -> bool:
    """Return whether what arrives of z = G y + n has the same E[(G, n)] and E[z z' | y] through a and b.

    If noise is only known by a bound in one of them, the result is False, since bounds cannot be compared by moments.
    """
    if has_bounded_noise(a) != has_bounded_noise(b):
        return False
    moments_of_a, moments_of_b = _take_moments_by_arrival(a), _take_moments_by_arrival(b)
    if not moments_of_b:
        return False
    where_all_arrive = next((moments for arrived, moments in moments_of_a if arrived.all()), None)
    if where_all_arrive is None:
        return False
    # In both, each set of components that may arrive must have the moments that it has when all arrive.
    pairs = [*moments_of_a, *moments_of_b]
    return all(_moments_agree(where_all_arrive, moments, arrived) for arrived, moments in pairs)


Moments = tuple[np.ndarray, np.ndarray]  # E[(G, n)] (m, p + 1) and the tensor of E[z z' | y] (m, m, p + 1, p + 1)


def _take_moments_by_arrival(channel: AbstractRandomAffine) -> list[tuple[np.ndarray, Moments]]:
    """Return which outputs arrive (m,) and their moments, for each possible set of outputs that arrive.

    If losses depend on a hidden mode, a set is listed once for each mode.

    Raises:
        ValueError: uncertain probabilities, gains that are correlated over time, or more sets than are listed.
    """
    maps: Sequence[AbstractRandomAffine]
    try:
        if_all_arrives = channel.condition_on_arrival()
    except ValueError:  # losses depend on the mode
        maps = joint_modes(channel).maps
    else:
        if memory_matters(if_all_arrives):
            raise ValueError("memory")
        maps = unstack(without_memory(if_all_arrives))
    outcomes = [outcome for m in maps for outcome in m.list_outcomes() if outcome.arrived.any()]
    if any(outcome.map.corner_count() > 1 for outcome in outcomes):  # several possible laws
        raise ValueError("uncertain probabilities")
    return [(np.asarray(outcome.arrived), second_moments(outcome.map)) for outcome in outcomes]


def _moments_agree(a: Moments, b: Moments, arrived: np.ndarray) -> bool:
    """Return whether the moments of the components that arrived are equal to rounding (EQUAL), relative to their size.

    a and b are each E[(G, n)] (m, p + 1), and E[z z' | y] as a tensor (m, m, p + 1, p + 1) acting on (y, 1) (y, 1)'.
    """
    (mean_a, second_a), (mean_b, second_b) = a, b
    rows = np.ix_(arrived, arrived)
    powers = [np.abs(np.einsum("iiaa->ia", second))[arrived] for second in (second_a, second_b)]
    size = np.sqrt(np.maximum(*powers))
    scale = size[:, None, :, None] * size[None, :, None, :]
    means_agree = np.all(np.abs(mean_a - mean_b)[arrived] <= EQUAL * size)
    return bool(means_agree and np.all(np.abs(second_a[rows] - second_b[rows]) <= EQUAL * scale))


def _same_observation(
    a: tuple[AbstractSensor, AbstractRandomAffine], b: tuple[AbstractSensor, AbstractRandomAffine], order: int | None
) -> bool:
    """Return whether two pairs of sensor and channel are one map from the state, though written differently.

    This is only decided for filters that use mean and covariance (`order`).
    """
    if order != MEAN_AND_COVARIANCE or is_traced(a, b):
        return False
    map_of_a, map_of_b = _compose_with_sensor(*a), _compose_with_sensor(*b)
    if map_of_a is None or map_of_b is None or has_bounded_noise(a) != has_bounded_noise(b):
        return False
    return _same_map(drop_names(map_of_a), drop_names(map_of_b), order, loses=True)


def _compose_with_sensor(sensor: AbstractSensor, channel: AbstractRandomAffine) -> AbstractRandomAffine | None:
    """Return the map from the state to what is received; None unless the sensor is linear, without angles, delays."""
    matrix = find_sensor_matrix(sensor)
    if matrix is None or sensor.angles or channel.past:
        return None
    return Series([GainAndNoise(Constant(1.0), matrix, sensor.noise), channel])
