"""Channels of words: the same channel of the words' bits, and of the words as numbers about the centres of their range.

Words are not amplified. They go through `decode_and_forward`, losses, constant and drawn delays, choices and modes of
such links, and are selected and copied on the way.
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

FLAG = -1  # in the place of a component: a number that is no word
Places = tuple[int, ...]  # of words: the component that each carries


class RewrittenMap(NamedTuple):
    """A map of words in another form, and the components that stand at its outputs."""

    map: AbstractRandomAffine
    places: Places


class WordForm(NamedTuple):
    """How a link of words and a selection of words are written in another form."""

    flips: Callable[[Flips, Places], AbstractRandomAffine]
    selection: Callable[[np.ndarray], AbstractRandomAffine]
    size: int  # numbers that a word is written as


def rewrite_in_bits(encoder: Words, channel: Channel) -> Channel:
    """Return a channel of words as a channel of the numbers that carry them: their bits, and unchanged dithers.

    Losses, delays and choices act on all numbers of a word. Only bits are flipped.

    Args:
        encoder: encoder of the words.
        channel: channel of the words.
    """
    beside = encoder.carried - encoder.bits  # numbers of a word beside its bits: its dither, if any
    eye = np.eye(encoder.carried)
    form = WordForm(
        flips=lambda link, places: link.on_bits(encoder.bits, beside),
        selection=lambda matrix: known(np.kron(matrix, eye)),
        size=encoder.carried,
    )
    carried: Channel = at_each_step(lambda link: rewrite_channel(link, form).map, channel)
    return carried


def rewrite_about_centres(encoder: Words, channel: Channel) -> Channel:
    """Return a channel of words as a channel of numbers, where each word counts from the centre of its range.

    Flipped bits are then a random gain and noise, which depend on the variance of a word, `power`.

    Args:
        encoder: encoder of the words.
        channel: channel of the words.
    """

    def convert(link: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the link of one step; `power` is the variance of each word if all of its values are equally likely."""
        power = encoder.each(encoder.power, signal_size(link))
        as_numbers = WordForm(
            flips=lambda flips, places: flips.about_centre(power[list(places)]), selection=known, size=1
        )
        return rewrite_channel(link, as_numbers).map

    numbers: Channel = at_each_step(convert, channel)
    return numbers


def find_carried_components(channel: Channel) -> Places:
    """Return the component of y that each output of a channel of words carries, FLAG of a number that is no word."""
    form = WordForm(lambda flips, places: known(np.eye(flips.dimension)), known, 1)
    return rewrite_channel(first(channel), form).places


def make_word_reader(channel: Channel) -> WordReader:
    """Return how the receiver behind a channel of words reads their bits."""
    return WordReader(find_carried_components(channel))


def rewrite_channel(channel: AbstractRandomAffine, form: WordForm) -> RewrittenMap:
    """Return a channel of words in another form (bits or numbers), and which component each of its outputs carries.

    Raises:
        ValueError: a channel that does more with words than select, copy, flip, delay and lose them.
    """
    sent = tuple(range(signal_size(channel)))  # repeated below for the earlier signals that a late channel takes
    return _rewrite_map(channel, sent * (1 + channel.past), form)


def _rewrite_map(link: AbstractRandomAffine, places: Places, form: WordForm) -> RewrittenMap:
    """Return a map of words written in another form, and the components of y at its outputs.

    Maps that are made of others are rewritten part by part: those in series hand on the components.

    Args:
        link: the map; it may select, copy, flip, delay and lose words.
        places: component of y that each word carries which comes in.
        form: how flips and selections are written, and how many numbers a word is.
    """
    match link:
        case Flips():
            return RewrittenMap(form.flips(link, places), places)
        case GainAndNoise():
            return _rewrite_selection(link, places, form)
        case ModeOutput():
            return RewrittenMap(ModeOutput(link.memory, link.sent * form.size), (FLAG,) * link.outputs)
        case Series():
            return _rewrite_series(link, places, form)
        case Stack():
            parts = [_rewrite_map(part, places, form) for part in link.maps]
            places_of_all = tuple(place for part in parts for place in part.places)
            return RewrittenMap(Stack([part.map for part in parts]), places_of_all)
        case AbstractOneOfSeveralMaps():
            return _rewrite_choice(link, places, form)
        case Erasure() | DelayLine():
            (inner,) = inner_maps(link)
            rewritten = _rewrite_map(inner, places, form)
            return RewrittenMap(replace_inner_maps(link, [rewritten.map]), rewritten.places)
        case DelayedLink() if not link.timestamped:  # the choice of what is late, then the link
            chosen = _rewrite_map(link.delay, places, form)
            rewritten = _rewrite_map(link.link, chosen.places, form)
            maps = [chosen.map if inner is link.delay else rewritten.map for inner in inner_maps(link)]
            return RewrittenMap(replace_inner_maps(link, maps), rewritten.places)
    raise make_word_link_error(type(link).__name__)


def _rewrite_selection(link: GainAndNoise, places: Places, form: WordForm) -> RewrittenMap:
    """Return a noiseless link that selects components, in the given form, and the component at each of its outputs.

    `places`: the components of y that it gets. Another gain, or noise, raises ValueError, since words do not pass it.
    """
    matrix, gain = np.asarray(link.matrix), link.law.constant
    is_noiseless = not np.any(np.asarray(link.noise.covariance)) and not np.any(np.asarray(link.noise.mean))
    selects_one_each = np.isin(matrix, (0, 1)).all() and (matrix.sum(axis=1) == 1).all()
    if gain is None or float(gain) != 1.0 or not is_noiseless or not selects_one_each:
        raise make_word_link_error(link.in_words() or "a gain")
    return RewrittenMap(form.selection(matrix), tuple(places[int(np.argmax(row))] for row in matrix))


def _rewrite_series(link: Series, places: Places, form: WordForm) -> RewrittenMap:
    """Return maps in series, in the given form; each gets the components that the previous one delivers.

    `places`: the components of y that the first map gets.
    """
    maps = []
    for inner in link.maps:
        rewritten = _rewrite_map(inner, places, form)
        places = rewritten.places
        maps.append(rewritten.map)
    return RewrittenMap(Series(maps), places)


def _rewrite_choice(link: AbstractOneOfSeveralMaps, places: Places, form: WordForm) -> RewrittenMap:
    """Return a choice among several maps, in the given form; raise ValueError unless all deliver the same components.

    `places`: the components of y that each map gets.
    """
    choices = [_rewrite_map(inner, places, form) for inner in link.maps]
    if len({choice.places for choice in choices}) > 1:
        raise fail("channel of words", "choices and modes that deliver the same components", "others")
    return RewrittenMap(replace_inner_maps(link, [choice.map for choice in choices]), choices[0].places)


def make_word_link_error(got: str) -> Exception:
    """Return the error of a link that words do not pass."""
    expected = "one that words pass, which are not amplified: hg.decode_and_forward([p]), perfect(), erasure, delays"
    return fail("channel of a node with an encoder", expected, got)
