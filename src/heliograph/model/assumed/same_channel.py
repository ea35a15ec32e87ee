"""Whether two channels agree in what a filter uses of them: as laws, or in the moments of what arrives."""

from collections.abc import Sequence

import numpy as np

from heliograph.model.assumed.assumed_model import MEAN_AND_COVARIANCE
from heliograph.model.assumed.same_plant_and_sensor import agree_at_each_step, find_sensor_matrix, same_noise
from heliograph.model.channel import Channel
from heliograph.model.fading import memory_matters, without_memory
from heliograph.model.over_time import first, unstack
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.module import are_same
from heliograph.numerics.numpy_or_jax import EQUAL, is_traced
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.erasure import second_moments
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise
from heliograph.random_affine.series_and_stack import Series


def same_channel(a: Channel, b: Channel, order: int | None, loses: bool) -> bool:
    """Return whether a filter that was made for the channel a is right for the channel b too.

    Names of memories (such as fadings) are not compared: memories at the same place count as the same.

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
    return agree_at_each_step(lambda a_k, b_k, order: _same_map(a_k, b_k, order, loses), a, b, order)


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
    if a.covers(b, lambda x, y: same_noise(x, y, order)):
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
    """Return whether two maps are the same map of what arrives, though they may lose messages in other ways.

    A filter sees what is lost, so it need not know the law of losses. False where losses depend on the gains, since a
    loss then tells of the gain.
    """
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
    The size of an entry H_ia of H = (G, n) is E[H_ia^2]^(1/2), the larger of those of a and b.
    """
    (mean_a, second_a), (mean_b, second_b) = a, b
    rows = np.ix_(arrived, arrived)
    squares = [np.abs(np.einsum("iiaa->ia", second))[arrived] for second in (second_a, second_b)]  # E[H_ia^2]
    size = np.sqrt(np.maximum(*squares))
    size_of_product = size[:, None, :, None] * size[None, :, None, :]  # of H_ia H_jb, at [i, j, a, b]
    means_agree = np.all(np.abs(mean_a - mean_b)[arrived] <= EQUAL * size)
    seconds_agree = np.all(np.abs(second_a[rows] - second_b[rows]) <= EQUAL * size_of_product)
    return bool(means_agree and seconds_agree)


def same_observation(
    a: tuple[AbstractSensor, AbstractRandomAffine], b: tuple[AbstractSensor, AbstractRandomAffine], order: int | None
) -> bool:
    """Return whether two pairs (sensor, channel), a and b, are one map from the state, though written differently.

    An example is a factor that stands in the sensor's matrix or in the channel's gain. Moments of the maps are
    compared, so that this is only decided for filters that use mean and covariance (`order`); else it is False.
    """
    if order != MEAN_AND_COVARIANCE or is_traced(a, b):
        return False
    map_of_a, map_of_b = _compose_with_sensor(*a), _compose_with_sensor(*b)
    if map_of_a is None or map_of_b is None or has_bounded_noise(a) != has_bounded_noise(b):
        return False
    return _same_map(drop_names(map_of_a), drop_names(map_of_b), order, loses=True)


def _compose_with_sensor(sensor: AbstractSensor, channel: AbstractRandomAffine) -> AbstractRandomAffine | None:
    """Return the map from the state to what is received: the sensor's y = C x + v, then the channel's z = G y + n.

    None where it is no such map: for a sensor that is not linear or has angles, or a channel that is late.
    """
    matrix = find_sensor_matrix(sensor)
    if matrix is None or sensor.angles or channel.past:
        return None
    return Series([GainAndNoise(Constant(1.0), matrix, sensor.noise), channel])
