"""Channels of codewords, rewritten as channels of their bits, or of their values less the centre of the range.

A codeword is a rounded component of y, sent as bits. Codewords are not amplified. They go through `decode_and_forward`,
losses, constant and drawn delays, choices and modes of such links, and are selected and copied on the way.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import at_each_step, first
from heliograph.model.words.encoder import WordReader, Words
from heliograph.numerics.check import fail
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps, replace_inner_maps
from heliograph.random_affine.composite import AbstractOneOfSeveralMaps
from heliograph.random_affine.delay import DelayedLink, DelayLine, signal_size
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.modes import ModeOutput
from heliograph.random_affine.series_and_stack import Series, Stack
from heliograph.random_affine.words.bit_flips import Flips

FLAG = -1  # in place of a component: the number is a flag, and no codeword
Components = tuple[int, ...]  # for each codeword the index in y of the component that it stands for, or FLAG


class RewrittenMap(NamedTuple):
    """A rewritten map of codewords, and for each codeword at its outputs the component of y that it stands for."""

    map: AbstractRandomAffine
    components: Components


class WordForm(NamedTuple):
    """How a codeword is written as numbers: as its bits, or as its value less the centre of the range.

    flips: function of a link that flips bits and of the components of y that its codewords stand for, which returns the
    link's map of these numbers. selection: function of a matrix of zeros and ones, which selects codewords; it returns
    the map that selects all numbers of these. size: how many numbers a codeword is written as.
    """

    flips: Callable[[Flips, Components], AbstractRandomAffine]
    selection: Callable[[np.ndarray], AbstractRandomAffine]
    size: int


def rewrite_in_bits(encoder: Words, channel: Channel) -> Channel:
    """Return a channel of codewords as a channel of their bits, each a sign -1 or 1.

    A receiver that subtracts the dither of a codeword needs it, so that the dither is one more number behind the bits.
    Losses, delays and choices act on all numbers of a codeword. Only bits are flipped.

    Args:
        encoder: encoder of the codewords.
        channel: channel of the codewords.
    """
    dither_count = encoder.carried - encoder.bits  # 1 or 0 for each codeword
    identity = np.eye(encoder.carried)
    form = WordForm(
        flips=lambda link, components: link.on_bits(encoder.bits, dither_count),
        selection=lambda matrix: known(np.kron(matrix, identity)),
        size=encoder.carried,
    )
    channel_of_bits: Channel = at_each_step(lambda link: rewrite_channel(link, form).map, channel)
    return channel_of_bits


def rewrite_about_centres(encoder: Words, channel: Channel) -> Channel:
    """Return a channel of codewords as a channel of one number each, q - c, with q the word and c the range's centre.

    Bits that are flipped are then a random gain g = 1 - 2p, p the probability of a flip, and a noise of variance
    U (1 - E g^2). U is the variance of a codeword if all its values are equally likely (`encoder.power`).

    Args:
        encoder: encoder of the codewords.
        channel: channel of the codewords.
    """

    def convert(link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return a link of codewords as a map of one number q - c for each, q the word and c the range's centre.

        A link that flips bits needs the variance U of a word, which `encoder.power` gives for each component of y.
        """
        power = encoder.each(encoder.power, signal_size(link))  # U by component of y
        form = WordForm(
            flips=lambda flips, components: flips.about_centre(power[list(components)]), selection=known, size=1
        )
        return rewrite_channel(link, form).map

    channel_of_numbers: Channel = at_each_step(convert, channel)
    return channel_of_numbers


def find_carried_components(channel: Channel) -> Components:
    """Return for each output of a channel of codewords the index in y of the component that it stands for.

    It is FLAG (-1) for an output that is a flag, and no codeword. Only the components are of interest here, so that a
    link that flips bits is written as the identity.
    """
    form = WordForm(flips=lambda flips, components: known(np.eye(flips.dimension)), selection=known, size=1)
    return rewrite_channel(first(channel), form).components


def make_word_reader(channel: Channel) -> WordReader:
    """Return how the receiver behind a channel of codewords reads their bits."""
    return WordReader(find_carried_components(channel))


def rewrite_channel(channel: AbstractRandomAffine, form: WordForm) -> RewrittenMap:
    """Return a channel of codewords as a map of the numbers that stand for them, and the components at its outputs.

    Args:
        channel: the channel; it takes y_k, and if it delays also y_{k-1}, ..., y_{k-past}, all as codewords.
        form: how a codeword is written as numbers: as its bits, or as its value less the centre of the range.

    Raises:
        ValueError: a channel that does more with codewords than select, copy, flip, delay and lose them.
    """
    components_of_signal = tuple(range(signal_size(channel)))
    return _rewrite_map(channel, components_of_signal * (1 + channel.past), form)


def _rewrite_map(link: AbstractRandomAffine, components: Components, form: WordForm) -> RewrittenMap:
    """Return a map of codewords as a map of the numbers that stand for them, and the components of y at its outputs.

    A codeword is a quantised number of the signal y, sent as bits. Filters need a channel of numbers, so each codeword
    is written as its bits, or as its value, according to `form`. Maps that are made of other maps are rewritten map by
    map; in a series each map gets the components that the map before it delivers.

    Args:
        link: the map; it may select, copy, flip, delay and lose codewords.
        components: for each codeword at its inputs the index in y of the component that it stands for.
        form: how flips and selections are written, and how many numbers a codeword is.
    """
    match link:
        case Flips():  # flips bits of codewords, and neither selects nor moves them
            return RewrittenMap(form.flips(link, components), components)
        case GainAndNoise():
            return _rewrite_selection(link, components, form)
        case ModeOutput():  # reports the mode of a fading whatever is sent: its outputs are flags, and no codewords
            numbers_sent = link.sent * form.size
            return RewrittenMap(ModeOutput(link.memory, numbers_sent), (FLAG,) * link.outputs)
        case Series():
            return _rewrite_series(link, components, form)
        case Stack():
            stacked = [_rewrite_map(inner, components, form) for inner in link.maps]
            components_of_all = tuple(component for inner in stacked for component in inner.components)
            return RewrittenMap(Stack([inner.map for inner in stacked]), components_of_all)
        case AbstractOneOfSeveralMaps():
            return _rewrite_choice(link, components, form)
        case Erasure() | DelayLine():
            (inner,) = inner_maps(link)
            rewritten = _rewrite_map(inner, components, form)
            return RewrittenMap(replace_inner_maps(link, [rewritten.map]), rewritten.components)
        case DelayedLink() if not link.timestamped:  # `delay` selects a past signal, which `link` transmits
            selected = _rewrite_map(link.delay, components, form)
            rewritten = _rewrite_map(link.link, selected.components, form)
            maps = [selected.map if inner is link.delay else rewritten.map for inner in inner_maps(link)]
            return RewrittenMap(replace_inner_maps(link, maps), rewritten.components)
    raise make_word_link_error(type(link).__name__)


def _rewrite_selection(link: GainAndNoise, components: Components, form: WordForm) -> RewrittenMap:
    """Return a noiseless map z = S y of codewords as a map of the numbers that stand for them, and its components.

    Each row of S selects one codeword. Codewords are not amplified, nor is noise added to them: another gain than 1, or
    noise, raises ValueError.

    Args:
        link: the map.
        components: for each codeword at its inputs the index in y of the component that it stands for.
        form: has `selection`, a function of S that returns the map of the numbers.
    """
    matrix, gain = np.asarray(link.matrix), link.law.constant
    is_noiseless = not np.any(np.asarray(link.noise.covariance)) and not np.any(np.asarray(link.noise.mean))
    selects_one_each = np.isin(matrix, (0, 1)).all() and (matrix.sum(axis=1) == 1).all()
    if gain is None or float(gain) != 1.0 or not is_noiseless or not selects_one_each:
        raise make_word_link_error(link.in_words() or "a gain")
    selected_components = tuple(components[int(np.argmax(row))] for row in matrix)
    return RewrittenMap(form.selection(matrix), selected_components)


def _rewrite_series(link: Series, components: Components, form: WordForm) -> RewrittenMap:
    """Return maps in series as maps of the numbers of their codewords, and the components that the last one delivers.

    Args:
        link: the maps in series.
        components: for each codeword at the input of the first map, the index in y of its component. Each further map
            gets the components that the map before it delivers.
        form: how a codeword is written as numbers.
    """
    maps = []
    for inner in link.maps:
        rewritten = _rewrite_map(inner, components, form)
        components = rewritten.components
        maps.append(rewritten.map)
    return RewrittenMap(Series(maps), components)


def _rewrite_choice(link: AbstractOneOfSeveralMaps, components: Components, form: WordForm) -> RewrittenMap:
    """Return a choice among maps as a choice among maps of the numbers of their codewords, and its components.

    All maps get the same `components`: for each codeword at their input, the index in y of its component. `form` says
    how a codeword is written as numbers.

    Raises:
        ValueError: maps that deliver other components, since the receiver does not see which map was chosen.
    """
    choices = [_rewrite_map(inner, components, form) for inner in link.maps]
    if len({choice.components for choice in choices}) > 1:
        raise fail("channel of words", "choices and modes that deliver the same components", "others")
    return RewrittenMap(replace_inner_maps(link, [choice.map for choice in choices]), choices[0].components)


def make_word_link_error(got: str) -> Exception:
    """Return the error of a link that codewords do not pass; `got` says in the message what link it is."""
    expected = "one that words pass, which are not amplified: hg.decode_and_forward([p]), perfect(), erasure, delays"
    return fail("channel of a node with an encoder", expected, got)
