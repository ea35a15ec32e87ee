"""Channel side information: gains, pilots' readings of gains, or noise variances that are reported with each message.

Such a channel delivers z, and then the reported ("told") numbers, on which the law of its link depends.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.check import array, fail, flag, instance, name_list, scalar, show_value
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Float, Names
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.channel_state_information import (
    PilotedHop,
    ToldGainHop,
    ToldMap,
    list_told_maps,
)
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import AbstractLaw
from heliograph.random_affine.markov_chain_and_autoregression import AbstractMemory
from heliograph.random_affine.modes import ModeOutput
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.reported_numbers import FreshNumbers, FreshReading
from heliograph.random_affine.series_and_stack import Stack

M = TypeVar("M", bound=AbstractRandomAffine)


LinkGivenNumbers = TypeAliasType("LinkGivenNumbers", Callable[[jax.Array | np.ndarray], AbstractRandomAffine])
LawOfNumbers = TypeAliasType("LawOfNumbers", AbstractLaw | AbstractNoise | AbstractMemory)


@readable
class Pilot(Module):
    """A reading of a gain that comes with each message: a = g + e with e of N(0, `noise`), fresh at each step.

    A pilot that is sent with amplitude b and received with noise variance r has `noise` r / b^2.

    Args:
        noise: variance of e, positive.
        fresh: whether the gain, given its reading, is drawn independently with each message, whatever is lost. False
            (of a gain that drifts, or of packets that are lost since their gain is small) makes claims nominal. True
            unless given.

    Raises:
        ValueError: a variance that is not positive (`known=True` is a gain that is told exactly).
    """

    noise: Float[jax.Array | np.ndarray, ""]
    fresh: bool = eqx.field(static=True)

    def __init__(self, noise: "Float[ArrayLike, '']", fresh: bool = True):
        """Check and hold the variance of the error e in a pilot's reading a = g + e of a link's gain g.

        `fresh` says whether each message has a gain drawn independently of the others; else claims are nominal.
        """
        self.noise = scalar("noise of a pilot", noise, np.finfo(float).tiny)
        self.fresh = flag("fresh", fresh)


def told(
    link: LinkGivenNumbers,
    about: Names,
    law: LawOfNumbers | None = None,
    typical: "Float[ArrayLike, ' told'] | None" = None,
    exogenous: bool = True,
    fresh: bool = True,
) -> Stack:
    """Return a link whose law is a function of numbers that come with each message: z = (link's z, numbers).

    `told(lambda a: hop(1., a[0]), ["variance"], typical=[0.1])` has the noise variance that each message reports; a
    gain, a scatter or the chance of a zero may depend on reported numbers in the same way. A filter made for the link
    uses each message by the law that its numbers give. The numbers are never lost with z; where one is missing, z is
    not used.

    Args:
        link: function of the numbers (count,) that returns a link, of the same sizes for all numbers.
        about: names of the numbers.
        law: of the numbers, to simulate them: a noise law, a law of gains for one number, or a `MarkovChain` whose
            mode is told; none by default: then recorded and live data are filtered, and nothing can be simulated.
        typical: an example of the numbers (count,), used where none was reported; the mean of their law unless given.
        exogenous: whether the numbers are independent of the plant's state; False (as of a strength that falls with
            the distance) makes claims nominal. True unless given.
        fresh: whether the link, given its numbers, is drawn independently with each message, whatever is lost; False
            (as of a fading that drifts and is not reported) makes claims nominal. True unless given.

    Claim: that of the same filter behind a link of known law, given all reported numbers; "nominal" if the numbers are
    not exogenous, or the link is not fresh.

    Raises:
        ValueError: no function, neither a law nor typical numbers, numbers that are not as many as their names, a link
            that remembers, is late or erases.

    Source: De Koning (1984), given the numbers.
    """
    if not callable(link):
        raise fail("link", "a function of the numbers that are told", show_value(link))
    # The memory draws the numbers in a simulation; there must be as many names as numbers, all different.
    names = tuple(name_list("numbers told", about))
    memory = law if isinstance(law, AbstractMemory) else FreshNumbers(_check_law(law), len(names))
    if memory.announced != len(names) or len(set(names)) < len(names):
        raise fail("numbers told", f"{memory.announced} different names", list(names))
    example = array("typical numbers", _average_law(law, memory) if typical is None else typical, (len(names),))
    return append_told_numbers(
        ToldMap(memory, link, example, names, flag("exogenous", exogenous), flag("fresh", fresh))
    )


def _check_law(law: object) -> AbstractLaw | AbstractNoise | None:
    """Return the law of the numbers that messages report, None for none; raise ValueError for anything else."""
    if law is None or isinstance(law, AbstractLaw | AbstractNoise):
        return law
    raise fail("law of the numbers told", "a noise law, a law of gains, or a MarkovChain", show_value(law))


def _average_law(law: object, memory: AbstractMemory) -> ArrayLike:
    """Return an example of reported numbers: the mean of their law, or zeros if they are the mode of a memory.

    Zeros mean the first mode. Without a law (None) it raises ValueError, since the user must then give the numbers.
    """
    if law is None:
        raise fail("typical numbers", "numbers as they may come, where there is no law", "none")
    if isinstance(law, AbstractLaw):
        return _list_mean(law)
    return law.mean if isinstance(law, AbstractNoise) else np.zeros(memory.announced)


def _list_mean(law: AbstractLaw) -> Array:
    """Return the mean of a gain's law as an array of one number; traced where the law is, as one that is learned."""
    mean = law.moment(1)
    array_of_one: Array = library(mean).stack([mean])
    return array_of_one


KnownGain = TypeAliasType("KnownGain", bool | Pilot)  # of a hop: told, by a pilot, or not at all


def append_told_gain(hop: GainAndNoise, known: KnownGain) -> GainAndNoise | Stack:
    """Return a hop z = g A y + n with a reported number after z: the gain g, or a pilot's reading a = g + e of it.

    `known` is True if messages report g itself, a `Pilot`, which has the variance of e, if they report a, and False if
    they report nothing: then the hop is returned unchanged.
    """
    if known is False:
        return hop
    if isinstance(known, Pilot):
        gain_and_reading = FreshReading(hop.law, variance=known.noise)
        piloted_hop = PilotedHop(gain_and_reading, hop.matrix, hop.noise, fresh=known.fresh)
        return append_told_numbers(piloted_hop)
    instance("known", known, bool, "True, False or a Pilot")
    told_hop = ToldMap(
        memory=FreshNumbers(hop.law, count=1),
        make=ToldGainHop(hop.matrix, hop.noise),
        typical=_list_mean(hop.law),
        names=("gain",),
    )
    return append_told_numbers(told_hop)


def append_told_numbers(link: AbstractRandomAffine) -> Stack:
    """Return a link that delivers its z and then the numbers that messages report of the maps inside the link.

    Such a map's law is a function of reported ("told") numbers, such as its present gain.
    """
    return Stack([link, *_list_told_outputs(link, link.inputs)])


def _list_told_outputs(link: AbstractRandomAffine, sent: int) -> list[ModeOutput]:
    """Return a map to the reported numbers of each told map in a link; each takes the `sent` numbers with gain 0."""
    return [ModeOutput(affine.memory, sent) for affine in list_told_maps(link)]


class SeparatedToldNumbers(NamedTuple):
    """A channel taken apart: its link without reported numbers, and which rows of z are the link's and which are they.

    Args:
        link: the channel without the numbers that messages report, such as its gain.
        values: rows of z that the link delivers.
        numbers: rows of z with reported numbers, in the order of the link's `list_told_maps`, each once.
    """

    link: AbstractRandomAffine
    values: tuple[int, ...]
    numbers: tuple[int, ...]


def separate_told_numbers(channel: AbstractRandomAffine) -> SeparatedToldNumbers:
    """Return a channel's link without reported numbers, the rows of z of the link, and those of the reported numbers.

    A stack delivers reported numbers by maps of their own (`ModeOutput`), which are taken out. They belong to a map in
    the link that depends on the same memory. A channel that reports nothing is its own link, with all rows.
    """
    stacked_maps = channel.maps if isinstance(channel, Stack) else (channel,)
    memories_of_told_maps = {affine.memory.identity for affine in list_told_maps(channel)}
    rows_of_numbers, links = dict[str, tuple[int, ...]](), list[AbstractRandomAffine]()  # rows by memory
    rows_of_values: tuple[int, ...] = ()
    start = 0  # first row of the map
    for affine in stacked_maps:
        rows = tuple(range(start, start + affine.outputs))
        start += affine.outputs
        if isinstance(affine, ModeOutput) and affine.memory.identity in memories_of_told_maps:
            rows_of_numbers.setdefault(affine.memory.identity, rows)
        else:
            links.append(affine)
            rows_of_values += rows
    if not rows_of_numbers:
        return SeparatedToldNumbers(channel, values=rows_of_values, numbers=())
    link = links[0] if len(links) == 1 else Stack(links)
    numbers = [row for told_map in list_told_maps(link) for row in rows_of_numbers[told_map.memory.identity]]
    return SeparatedToldNumbers(link, values=rows_of_values, numbers=tuple(numbers))


def build_with_told_numbers(
    build: Callable[[list[AbstractRandomAffine]], M], channels: Sequence[AbstractRandomAffine]
) -> M:
    """Return a channel that `build` makes of the channels' links, followed by all numbers that the channels report.

    A channel may report to its receiver numbers about itself, such as its present gain, after its outputs. These must
    not pass through what is built, such as a relay. So `build` gets the links without reported numbers, and the result
    delivers them unchanged after its own outputs.
    """
    links = [separate_told_numbers(channel).link for channel in channels]
    built = build(links)
    # A channel that reports nothing is its own link.
    report_numbers = any(link is not channel for link, channel in zip(links, channels, strict=True))
    return cast(M, append_told_numbers(built)) if report_numbers else built


def stack_channels_with_told_numbers(
    widen: Callable[[list[AbstractRandomAffine]], list[AbstractRandomAffine]], channels: Sequence[AbstractRandomAffine]
) -> Stack:
    """Return channels side by side, each followed by the numbers that it reports to its receiver, such as its gain.

    Args:
        widen: function that takes the channels' links without reported numbers, each a map of its own signal, and
            returns as many maps of the whole signal, from which each selects its own.
        channels: the channels.
    """
    links = [separate_told_numbers(channel).link for channel in channels]
    maps = list[AbstractRandomAffine]()
    for link, channel, widened_link in zip(links, channels, widen(links), strict=True):
        maps.append(widened_link)
        # A channel that reports nothing is its own link. For any other, append maps to the reported numbers.
        if link is not channel:
            maps += _list_told_outputs(widened_link, widened_link.inputs)
    return Stack(maps)


def name_received_values(outputs: tuple[str, ...], channel: AbstractRandomAffine, more: int = 0) -> tuple[str, ...]:
    """Return the names of all received numbers, in the order of rows of z.

    Values have the names of the sensor's outputs if there are as many, else z0, z1, ... Numbers that the channel
    reports about itself have their maps' names for them, such as "gain"; equal names get _1, _2, ... behind them.

    Args:
        outputs: names of the sensor's outputs.
        channel: from the sensor to the receiver.
        more: number of values that are received in addition to those of the channel, such as flags of lost messages.
    """
    link, rows_of_values, rows_of_numbers = separate_told_numbers(channel)
    value_count = len(rows_of_values) + more
    names = list(outputs if len(outputs) == value_count else (f"z{i}" for i in range(value_count)))
    told_names = [name for affine in list_told_maps(link) for name in affine.names] if rows_of_numbers else []
    distinct_names = [
        f"{name}_{told_names[:i].count(name) + 1}" if told_names.count(name) > 1 else name
        for i, name in enumerate(told_names)
    ]
    # In the order of rows, so that each name is inserted at the index that it has in the end.
    for row, name in sorted(zip(rows_of_numbers, distinct_names, strict=True)):
        names.insert(row, name)
    return tuple(names)
