"""The filter behind words, built for a plant, a sensor and a channel of words."""

from copy import copy
from functools import partial
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter, make_sizes
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.words.bit_likelihoods import is_free_of_flips, make_link_of_bits
from heliograph.filters.words.two_hypothesis_filter import make_two_hypotheses_filter
from heliograph.filters.words.word_filter import WordFilter
from heliograph.filters.wrappers.late_data import late_filter
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel, check_link, perfect
from heliograph.model.fading import without_memory
from heliograph.model.over_time import at_each_step, first, unstack
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AbstractSensor, AnySensor, check_sensor, refuse_angles
from heliograph.model.words.encoder import Dither, Words
from heliograph.model.words.word_channel import FLAG, find_carried_components, rewrite_about_centres
from heliograph.numerics.check import fail, instance, show_value
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.delay import DelayedLink
from heliograph.random_affine.modes import ModeOutput
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order
from heliograph.random_affine.series_and_stack import Stack
from heliograph.random_affine.words.rounding_noise import RoundedNoise, find_rounded_noises


class WordAlphabet(NamedTuple):
    """The codewords that stand for each of m components: low + i step, i = 0, 1, ..., 2^bits - 1.

    `centre` (m,) is the middle of their range. `bits` is 0 for codewords without end, of which `low` is any one.
    `dither` is the kind of random number that the sender adds before it rounds.
    """

    low: np.ndarray
    step: np.ndarray
    centre: np.ndarray
    bits: int
    dither: Dither


def _alphabet_of(sensor: AbstractSensor, encoder: Words | None) -> WordAlphabet:
    """Return the codewords of an encoder, or those of a sensor that reports multiples of its resolution.

    A codeword is a number that is rounded to steps and sent in bits. Multiples of a resolution have no end: `bits` 0.
    """
    m = len(sensor.outputs)
    rounded = find_rounded_noises(sensor)
    if encoder is not None:
        instance("encoder", encoder, Words, "Words").check_outputs(m)
        if rounded:
            expected = "one without resolution, as words have their own"
            raise fail("sensor of a node with an encoder", expected, "a resolution")
        low, step, centre = (encoder.each(end, m) for end in (encoder.low, encoder.step, encoder.centre))
        return WordAlphabet(low=low, step=step, centre=centre, bits=encoder.bits, dither=encoder.dither)
    if not isinstance(sensor.noise, RoundedNoise):
        raise fail("word filter", "an encoder (Words), or a sensor with a resolution", "neither")
    return WordAlphabet(low=np.zeros(m), step=np.asarray(sensor.noise.step), centre=np.zeros(m), bits=0, dither="none")


def _take_off_rounding(sensor: AbstractSensor) -> AbstractSensor:
    """Return the sensor without the error of rounding: with the noise that it has before it rounds its outputs.

    A filter that knows which codeword came treats the rounding itself, not as noise.
    """
    if not isinstance(sensor.noise, RoundedNoise):
        return sensor
    unrounded = copy(sensor)
    # Past the check that fields of a built object are not assigned.
    object.__setattr__(unrounded, "noise", sensor.noise.source)
    return unrounded


def _find_moments_of_numbers(encoder: Words | None, channel: AbstractRandomAffine) -> SecondOrder:
    """Return mean and covariance of gain and noise that arriving codewords have as numbers, averaged over modes.

    The numbers count from the centre of their range. An output that reports a mode is no codeword, and is left out.
    """
    word_links = [output for output in channel.in_parallel if not isinstance(output, ModeOutput)]
    link = word_links[0] if len(word_links) == 1 else Stack(word_links)
    numbers = link if encoder is None else rewrite_about_centres(encoder, link)
    memoryless = without_memory(first(numbers).condition_on_arrival())
    return second_order(first(memoryless))


def word_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel | None = None,
    encoder: Words | None = None,
    transform: AbstractTransform | None = None,
    hypotheses: int = 2,
) -> AbstractFilter:
    """Return the filter that knows what a rounded number is, and what a flipped bit does.

    Given a Gaussian prior its update has the exact mean and covariance: of words of at most 6 bits, and of all whose
    step is a quarter of the deviation of y or more, to rounding; finer words are merged to cells of an eighth to a
    quarter of it, which changes the mean by 1e-4 deviations and the variance by .6 %. At p = .01 and 8 bits it has half
    the error of the best linear filter, and is as good as with a checksum that costs no bit.

    Where bits flip it carries two Gaussians: one given that the leading bits of the last word were right, one given
    that they were not. A single Gaussian costs a third; now and then it takes what wrong bits say for certain, and is
    far off for tens of steps.

    One word over several paths is used as one: the bits of all that came are weighed together. Error rates that are
    drawn are averaged over. Modes that are reported with each message (`hg.model.with_flag`) have their own rates.
    Words that are late by a constant delay are used for the past, which is predicted to the present.

    Args:
        plant: linear or not; n states.
        sensor: linear or not; with a `resolution` if there is no encoder.
        channel: of words, from the sensor to the filter: all arrives by default.
        encoder: `Words` of the sender; None for a sensor that reports multiples of its resolution.
        transform: moments of a plant or sensor that is not linear, `Cubature()` by default.
        hypotheses: number of Gaussians that are carried where bits flip, 2 (default) or 1.

    Claim: "nominal": the prior is not Gaussian after the first word. The squared error is as claimed within a tenth
    where a step is at most three deviations of y, and everywhere with a dither that is taken off.

    Raises:
        ValueError: parts that do not fit, angles, neither encoder nor resolution or both, a channel that is late by
            chance, modes that are not reported, words without end behind more than losses.

    Source: Curry, Estimation and control with quantized measurements (1970), the Gaussian fit, for any word channel.
    """
    if not isinstance(hypotheses, int) or hypotheses not in (1, 2):
        raise fail("hypotheses", "1 or 2", show_value(hypotheses))
    start = read_first_plant(plant)
    check_sensor(first(sensor), len(start.states))
    # Behind a constant delay: the filter of the past, predicted to the present.
    if isinstance(channel, DelayedLink) and channel.constant and not channel.timestamped:
        return late_filter(word_filter(plant, sensor, channel.link, encoder, transform, hypotheses), channel.past)
    channel = perfect(len(first(sensor).outputs)) if channel is None else channel
    check_link(first(sensor), first(channel), len(start.states), late=True)
    refuse_angles("word filter", plant, sensor)
    # The codewords, the component of y (or FLAG) at each output of the channel, and what the link does to bits.
    words = _alphabet_of(first(sensor), encoder)
    indices = find_carried_components(channel)
    links = at_each_step(make_link_of_bits, channel)
    no_flips = all(is_free_of_flips(link) for link in unstack(links))
    if encoder is None and not no_flips:
        raise fail("encoder", "Words, whose bits the channel flips", "none")
    rule = Cubature() if transform is None else instance("transform", transform, AbstractTransform, "a transform")
    # A dither that is subtracted again is received with each codeword, after what the channel delivers.
    dithers = sum(index != FLAG for index in indices) if words.dither == "subtracted" else 0
    one_gaussian = WordFilter(
        plant=plant,
        transform=rule,
        initial_mean=start.initial_mean,
        initial_covariance=start.initial_covariance,
        sensor=at_each_step(_take_off_rounding, sensor),
        links=links,
        numbers=at_each_step(partial(_find_moments_of_numbers, encoder), channel),
        low=words.low,
        spacing=words.step,
        centre=words.centre,
        indices=indices,
        bits=words.bits,
        dither=words.dither,
        certain=no_flips,
        **make_sizes("nominal", start, len(indices) + dithers),
    )
    filter: AbstractFilter = one_gaussian if no_flips or hypotheses == 1 else make_two_hypotheses_filter(one_gaussian)
    return with_assumed(filter, AssumedModel(plant, sensor, channel, encoder=encoder, order=None))
