"""Linear filters behind words: the same filter of numbers about the centres of the words' range."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import (
    AbstractFilter,
    Step,
    corrects,
    make_sizes,
)
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.words.bit_likelihoods import list_links_by_reported_mode
from heliograph.filters.words.overload import Overload, bound_overload, refuse_overload
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.channel import Channel, check_sent
from heliograph.model.estimate import Claim, Innovation, lower_claim_by_noise, weakest
from heliograph.model.over_time import at_each_step, first, unstack
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.model.words.encoder import Words
from heliograph.model.words.word_channel import FLAG, find_carried_components, rewrite_about_centres
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Array, ArrayLike, PyTree
from heliograph.random_affine.moments.second_moments import has_random_gain, second_order
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian
from heliograph.random_affine.words.rounding_noise import RoundedNoise, find_rounded_noises

SEEN = 0.01  # share of the rms error that overload may change a claim by
MakeFilter = Callable[[AnyPlant, AnySensor, Channel], AbstractFilter]


class LinearWordsFilter(AbstractWrapper):
    """A linear filter of the numbers z = q - c - E[g] d, for received codewords q with centre c, and dithers d.

    A dither d was added before rounding, and is subtracted with the mean gain E[g] of the link. If E[g] depends on a
    mode that is not reported, z is NaN.

    Args:
        base: the filter of z.
        centres: c of each output of the channel; 0 for an output that reports a mode.
        gains: E[g] of each codeword with a dither, in each mode (modes, words), one row without modes; (1, 0) without
            dithers that are subtracted.
        words: outputs that are codewords.
        flag: output that reports the mode on which E[g] depends; None without one.
        overload: how often codewords overload before any data.
    """

    base: AbstractFilter
    centres: Array
    gains: Array
    words: tuple[int, ...] = eqx.field(static=True)
    flag: int | None = eqx.field(static=True)
    overload: Overload

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct with the codewords that arrived, as numbers less their centres and dithers.

        z: the codewords, and then their dithers, which are known numbers.
        """
        numbers = self._convert_words_to_numbers(jnp.asarray(z))
        corrected, innovation = self.base.correct(state, numbers, k)
        # Dithers are given, so that they have no innovation.
        dithers = self.received - len(self.centres)
        value = jnp.concatenate([jnp.asarray(innovation.value), jnp.full(dithers, jnp.nan)])
        covariance = jnp.pad(innovation.covariance, ((0, dithers), (0, dithers)), constant_values=jnp.nan)
        return corrected, Innovation(value, covariance, innovation.log_likelihood)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a backward pass needs of a step: the base filter's, with the codewords in z as its numbers."""
        return self.base.smoother_step(step._replace(z=self._convert_words_to_numbers(jnp.asarray(step.z))))

    def _convert_words_to_numbers(self, z: jax.Array) -> jax.Array:
        """Return q - c - E[g] d for the received codewords q, their centres c and dithers d.

        A dither was added before rounding, so the link's mean gain E[g] times the dither is subtracted. `self.flag` is
        the index of the number that reports the mode on which E[g] depends, or None without modes. If that number is
        NaN, the result is NaN.
        """
        about_centres = z[: len(self.centres)] - jnp.asarray(self.centres)
        if self.received == len(self.centres):
            return about_centres
        gains = jnp.asarray(self.gains)
        if self.flag is None:
            gain = gains[0]
        else:
            mode = z[self.flag]
            indicator = jnp.where(mode == jnp.arange(len(gains)), 1.0, 0.0)
            gain = jnp.where(jnp.isnan(mode), jnp.nan, indicator @ gains)
        dithers = z[len(self.centres) :]
        return about_centres.at[np.array(self.words)].add(-gain * dithers)


def build_behind_words(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, encoder: Words, make: MakeFilter
) -> LinearWordsFilter:
    """Return a linear filter of codewords: a filter of the numbers that they stand for, less the centres of the range.

    Args:
        plant: a linear plant.
        sensor: a linear sensor, whose outputs are sent as words.
        channel: of words.
        encoder: the words.
        make: builds a linear filter of numbers, of a plant, a sensor and a channel.

    Raises:
        ValueError: words that do not fit, a dither that is not known behind a link that remembers, a range that is
            overloaded more often than once in a thousand steps.
    """
    start = read_first_plant(plant)
    check_linear("linear filter", plant, sensor)
    outputs = len(first(sensor).outputs)
    instance("encoder", encoder, Words, "Words").check_outputs(outputs)
    check_sent(first(sensor), first(channel))
    indices, numbers = find_carried_components(channel), rewrite_about_centres(encoder, channel)
    # The channel of codewords as numbers, z = G (y - c) + n: in each mode if modes are reported, else at each step.
    channel_by_mode = [rewrite_about_centres(encoder, link) for link in list_links_by_reported_mode(first(channel))]
    channels = [first(link) for link in channel_by_mode or unstack(numbers)]
    # Whether G is random given the reported mode, as it is if bits flip.
    remembers = first(channel).remembers
    fades = (remembers and not channel_by_mode) or any(has_random_gain(link, second_order(link)) for link in channels)
    _check_rounding(sensor, encoder, remembers and fades)
    # Whether the rounding of a Gaussian y is described exactly; filters of modes, and of past signals, use bounds.
    gaussian = _is_gaussian(plant, sensor) and not first(channel).past and not remembers
    # The sensor of y - c with rounding, and the filter of numbers behind it.
    rounded = at_each_step(lambda sensor: _add_rounding_noise(sensor, encoder, gaussian, fades), sensor)
    base = make(plant, rounded, numbers)
    overload = bound_overload(plant, rounded, numbers, encoder, indices)
    refuse_overload(overload)
    words = tuple(i for i, index in enumerate(indices) if index != FLAG)  # rows of z that are words
    centres = np.array([0.0 if index == FLAG else encoder.each(encoder.centre, outputs)[index] for index in indices])
    gains = _gains_by_mode(channels if channel_by_mode else [numbers], words) if encoder.subtracts else np.zeros((1, 0))
    # Behind a late link the noise of rounding is counted from the first step on, before any word can have come.
    claim_of_delay: Claim = "upper" if first(channel).past else "exact"
    claim = weakest([lower_claim_by_noise(base.claim, rounded), claim_of_delay, _claim_despite_overload(overload)])
    return LinearWordsFilter(
        base=base,
        centres=centres,
        gains=gains,
        words=words,
        flag=len(indices) - 1 if channel_by_mode else None,
        overload=overload,
        **make_sizes(claim, start, len(indices) + gains.shape[1]),
    )


def _check_rounding(sensor: AnySensor, encoder: Words, fades_with_memory: bool) -> None:
    """Raise ValueError if the dither's error has no known law, or if the sensor rounds already.

    Behind gains that depend on the past (`fades_with_memory`), a "stochastic" or "subtracted" dither has none.
    """
    if encoder.dither in ("stochastic", "subtracted") and fades_with_memory:
        expected = 'dither="triangular" (or "none"), or modes with one error rate each, told last (hg.model.with_flag)'
        raise fail("encoder behind a channel that remembers", expected, repr(encoder.dither))
    if find_rounded_noises(sensor):
        raise fail(
            "sensor of a node with an encoder", "one without resolution, as words have their own", "a resolution"
        )


def _claim_despite_overload(overload: Overload) -> Claim:
    """Return "exact" where overload changes the rms error by at most SEEN (1 %), else "nominal".

    A codeword is overloaded if y lies beyond the range that it can stand for. Where that change has no known bound, it
    is NaN, and the claim "nominal".
    """
    return "exact" if float(np.max(overload.bound, initial=0.0)) <= SEEN else "nominal"


def _add_rounding_noise(sensor: LinearSensor, encoder: Words, gaussian: bool, matters: bool) -> LinearSensor:
    """Return the sensor of y - c, with the error of rounding y to codewords as a part of its noise, c their centre.

    Args:
        sensor: of y.
        encoder: rounds y to codewords.
        gaussian: True if y is Gaussian before any data. The variance of the error is then known, else only bounded.
        matters: True behind a random gain g. The error of g (y + e) then depends on E[(y + e)^2], so that the claim on
            the filter's covariance holds only if the second moment of the rounded signal is right too.
    """
    m = len(sensor.outputs)
    step, centre, high = (encoder.each(end, m) for end in (encoder.step, encoder.centre, encoder.high))
    noise = RoundedNoise(
        source=sensor.noise,
        step=step,
        half=high - centre,
        centre=centre,
        dither=encoder.dither,
        gaussian=gaussian,
        matters=matters,
    )
    return LinearSensor(sensor.matrix, noise, sensor.outputs)


def _gains_by_mode(laws: list[Channel], words: tuple[int, ...]) -> np.ndarray:
    """Return the mean gain E[g] of each codeword in each mode (modes, words).

    `laws`: the channel of the numbers that codewords stand for, in each mode; `words`: outputs that are codewords.
    """
    return np.stack([_mean_gains(law)[list(words)] for law in laws])


def _mean_gains(channel: Channel) -> np.ndarray:
    """Return E[g] (m,) of each output of the channel of the numbers that words stand for.

    Each output carries one word, so that its row of E[G] has one entry that is not 0, and the row's sum is E[g].
    """
    gains_by_step = [np.asarray(second_order(link).mean_gain).sum(axis=1) for link in unstack(channel)]
    if any(not np.array_equal(gains, gains_by_step[0]) for gains in gains_by_step):
        raise fail("channel of words whose dither is taken off", "the same mean gains at every step", "others")
    return np.asarray(gains_by_step[0])


def _is_gaussian(plant: AnyPlant, sensor: AnySensor) -> bool:
    """Return whether what the sensor measures is Gaussian before any data.

    It is Gaussian if the initial law and all noises of plant and sensor are.
    """
    laws: list[object] = [first(plant).deviation]
    laws += [step.noise for step in unstack(plant)] + [step.noise for step in unstack(sensor)]
    return all(isinstance(law, Gaussian) for law in laws if isinstance(law, AbstractNoise))
