"""A linear model as maps of each step: from the state to the next one, and from it to what arrives."""

from collections.abc import Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx

from heliograph.model.channel import Channel, check_link
from heliograph.model.over_time import OverTime, first, list_models_by_step, steps_covered
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.check import check_horizon, fail
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.moments.pushed_moments import TabulatedNoise
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.series_and_stack import Series
from heliograph.random_affine.sum_of_maps import move_sensor_into_links

T = TypeVar("T")


class PlantAndMeasurementMaps(NamedTuple):
    """One step of the model as two maps: the plant's, x -> x+, and from the state to what arrives, x+ -> z."""

    plant: GainAndNoise
    measurement: AbstractRandomAffine


def check_model(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> None:
    """Raise ValueError unless plant and sensor are linear, without inputs, fit the channel, and have noise laws.

    Numbers that JAX traces are refused: NumPy computes the moments.
    """
    if is_traced(plant, sensor, channel):
        expected = "known numbers (hg.linear_filter, of degree 1, takes traced ones)"
        raise fail("polynomial filter", expected, "traced ones")
    first_plant = first(plant)
    check_linear("polynomial filter", plant, sensor)
    check_link(first(sensor), first(channel), len(first_plant.states))
    if first_plant.inputs:
        expected = "a plant without inputs (take the response to known inputs off the measurements first)"
        raise fail("polynomial filter", expected, list(first_plant.inputs))
    if not isinstance(first_plant.noise, AbstractNoise):
        raise fail("polynomial filter", "process noise with a law", "a covariance that depends on inputs")


def make_plant_and_measurement_maps(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, order: int, horizon: int
) -> list[PlantAndMeasurementMaps]:
    """Return the plant's and the measurement's random map of each step; steps that do not vary share one object.

    A filter that needs moments of the state and of what arrives takes them from these maps. The noises' moments are
    tabulated up to `order`; steps with the same noise share a table.

    Args:
        plant: linear plant, perhaps over time.
        sensor: linear sensor, perhaps over time.
        channel: random affine map from the sensor to the filter, perhaps over time.
        order: highest order of the moments of the noises.
        horizon: number of steps.
    """
    plants = _tabulate_affine_maps(list_checked_steps(plant, horizon), order)
    sensors, channels = list_checked_steps(sensor, horizon), list_checked_steps(channel, horizon)
    if not isinstance(sensor, OverTime) and not isinstance(channel, OverTime):
        measurements = [_make_measurement_maps(sensors[:1], channels[:1], order)[0]] * horizon
    else:
        measurements = _make_measurement_maps(sensors, channels, order)
    return [PlantAndMeasurementMaps(*pair) for pair in zip(plants, measurements, strict=True)]


def _make_measurement_maps(
    sensors: Sequence[AnySensor], channels: Sequence[AbstractRandomAffine], order: int
) -> list[AbstractRandomAffine]:
    """Return the random map from the state to what is received, z, at each step.

    `sensors` and `channels` are those of each step; noises are tabulated up to the `order` of their moments. The map
    is is the sensor's map followed by the channel's. If the channel is a sum of links and the sensor's outputs have
    independent noises at all steps, the sensor is moved into each link instead (`move_sensor_into_links`). That gives
    one map of the state itself.
    """
    maps_by_link = list[AbstractRandomAffine]()
    for sensor, channel in zip(sensors, channels, strict=True):
        assert isinstance(sensor, LinearSensor)  # checked before
        map_by_link = move_sensor_into_links(sensor.matrix, sensor.noise, channel)
        if map_by_link is not None:
            maps_by_link.append(map_by_link)
    if len(maps_by_link) == len(sensors):
        return maps_by_link
    sensor_maps = _tabulate_affine_maps(sensors, order)
    return [Series(sensor_and_channel) for sensor_and_channel in zip(sensor_maps, channels, strict=True)]


def _tabulate_affine_maps(models: Sequence[PyTree], order: int) -> list[GainAndNoise]:
    """Return the map x -> A x + noise of each plant or sensor, with the noise's moments tabulated up to `order`.

    `check_model` has checked that all models are linear, with A in `matrix`. A step whose model is the same object as
    at the step before shares its map. A step with an equal noise shares the table. The gain of each map is 1 times A.
    """
    maps: list[GainAndNoise] = []
    before, noise = None, TabulatedNoise(models[0].noise, order)
    for model in models:
        if model is before:
            maps.append(maps[-1])
            continue
        if not eqx.tree_equal(model.noise, noise.source):
            noise = TabulatedNoise(model.noise, order)
        maps.append(GainAndNoise(Constant(1.0), model.matrix, noise))
        before = model
    return maps


def list_checked_steps(model: T | OverTime, horizon: int) -> list[T]:
    """Return a plant, sensor or channel at each of `horizon` steps; raise ValueError if it covers fewer steps."""
    check_horizon(horizon)
    check_horizon(horizon, steps_covered(model))
    return list_models_by_step(model, horizon)
