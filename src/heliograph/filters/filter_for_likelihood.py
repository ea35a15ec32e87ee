"""Choice of the filter that a likelihood is computed by, by plant and channel: Kalman, linear, IMM or cubature."""

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.factories import cubature_filter, kalman_filter
from heliograph.filters.linear.linear import linear_filter
from heliograph.filters.modes.multiple_model import imm_filter
from heliograph.model.channel import Channel
from heliograph.model.diffuse_start import UnknownStart
from heliograph.model.fading import without_memory
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor, check_sensor
from heliograph.numerics.check import fail, flag, instance
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import memories


def likelihood_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, linear: bool) -> AbstractFilter:
    """Return the filter whose innovations give the likelihood.

    The likelihood of a model is the product of p(z_k | z_0 ... z_k-1), which the filter's innovations give. The filter
    is `imm_filter` if plant or sensor has modes (a Markov chain), and `kalman_filter` if the initial state is unknown,
    which has no channel. Else `linear` decides.

    Args:
        plant: the plant.
        sensor: its sensor.
        channel: from the sensor to the filter.
        linear: True for `linear_filter`, whose covariances with random gains use the state's moments before any data;
            False for `cubature_filter`, which uses its moments given the data.

    Raises:
        ValueError: parts that do not fit; a channel beside an unknown start.

    Source: Schweppe, Evaluation of likelihood functions for Gaussian signals (1965), by the innovations of each.
    """
    if memories((plant, sensor)):
        return imm_filter(plant, sensor, channel)
    start = read_first_plant(plant)
    check_sensor(first(sensor), len(start.states))
    link = instance("channel", first(channel), AbstractRandomAffine, "a channel")
    if isinstance(start.initial_covariance, UnknownStart):
        if words := link.in_words():
            raise fail("channel of a network to be learned", "perfect() beside an unknown start", words)
        return kalman_filter(plant, sensor)
    if flag("linear", linear):
        return linear_filter(plant, sensor, channel)
    return cubature_filter(plant, sensor, without_memory(channel))
