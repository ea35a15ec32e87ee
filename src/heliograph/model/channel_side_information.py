"""Channel side information: gains, pilots' readings of gains, and numbers of quality that come with each message.

A channel that tells delivers z, and then the told numbers, of which the law of its link is a function.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeVar, cast

import equinox as eqx
import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics.check import array, fail, flag, instance, name_list, scalar, show_value
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float, Names
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
from heliograph.random_affine.noise import AbstractNoise
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
        fresh: whether what the reading leaves open of the gain is drawn anew with each message, whatever is lost.
            False (of a gain that drifts, or of packets that are lost since their gain is small) makes claims
            nominal. True unless given.

    Raises:
        ValueError: a variance that is not positive (`known=True` is a gain that is told exactly).
    """

    noise: Float[jax.Array | np.ndarray, ""]
    fresh: bool = eqx.field(static=True)

    def __init__(self, noise: "Float[ArrayLike, '']", fresh: bool = True):
        """Check and hold the variance of a reading's error, and whether each message has a fresh gain."""
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

    `told(lambda a: hop(1., a[0]), ["variance"], typical=[0.1])` has the noise that each message declares; a gain, a
    scatter or the chance of a zero may depend on what is told likewise. A filter made for it uses each message by the
    law that its numbers give. The numbers are never lost with z; where one is missing, z is not used.

    Args:
        link: function of the numbers (count,) that returns a link, of the same sizes for all numbers.
        about: names of the numbers.
        law: of the numbers, to simulate them: a noise law, a law of gains for one number, or a `MarkovChain` whose
            mode is told; none by default: then recorded and live data are filtered, and nothing can be simulated.
        typical: numbers as they may come (count,); the mean of their law unless given.
        exogenous: whether the numbers are independent of the state; False (as of a strength that falls with the
            distance) makes claims nominal. True unless given.
        fresh: whether what they leave open is drawn anew with each message, whatever is lost; False (of fading that
            drifts beside them) makes claims nominal. True unless given.

    Claim: what the filter's would be behind a link of known law, given all numbers told; "nominal" if they are not
    exogenous, or what they leave open is not fresh.

    Raises:
        ValueError: no function, neither a law nor typical numbers, numbers that are not as many as their names, a link
            that remembers, is late or erases.

    Source: De Koning (1984), given the numbers.
    """
    if not callable(link):
        raise fail("link", "a function of the numbers that are told", show_value(link))
    names = tuple(name_list("numbers told", about))
    memory = law if isinstance(law, AbstractMemory) else FreshNumbers(_check_law(law), len(names))
    if memory.announced != len(names) or len(set(names)) < len(names):
        raise fail("numbers told", f"{memory.announced} different names", list(names))
    example = array("typical numbers", _average_law(law, memory) if typical is None else typical, (len(names),))
    return append_told_numbers(
        ToldMap(memory, link, example, names, flag("exogenous", exogenous), flag("fresh", fresh))
    )


def _check_law(law: object) -> AbstractLaw | AbstractNoise | None:
    """Return a law of the numbers that a link tells, or None, as it is; raise ValueError for anything else."""
    if law is None or isinstance(law, AbstractLaw | AbstractNoise):
        return law
    raise fail("law of the numbers told", "a noise law, a law of gains, or a MarkovChain", show_value(law))


def _average_law(law: object, memory: AbstractMemory) -> ArrayLike:
    """Return typical values of the numbers that a link tells: the mean of their law, or zeros for modes of a memory.

    Zeros mean the first mode. Without a law (None) it raises ValueError, since the user must then give the numbers.
    """
    if law is None:
        raise fail("typical numbers", "numbers as they may come, where there is no law", "none")
    if isinstance(law, AbstractLaw):
        return np.asarray([law.moment(1)])
    return law.mean if isinstance(law, AbstractNoise) else np.zeros(memory.announced)


KnownGain = TypeAliasType("KnownGain", bool | Pilot)  # of a hop: told, by a pilot, or not at all


def append_told_gain(hop: GainAndNoise, known: KnownGain) -> GainAndNoise | Stack:
    """Return a hop that delivers its gain, or a pilot's reading of it, after z; for `known` False the hop itself.

    `known`: True for the gain itself, or a Pilot, whose reading is the gain plus noise.
    """
    if known is False:
        return hop
    if isinstance(known, Pilot):
        reading = FreshReading(hop.law, known.noise)
        return append_told_numbers(PilotedHop(reading, hop.matrix, hop.noise, known.fresh))
    instance("known", known, bool, "True, False or a Pilot")
    gain, hop_of_known_gain = FreshNumbers(hop.law, 1), ToldGainHop(hop.matrix, hop.noise)
    mean_gain = np.asarray([hop.law.moment(1)])
    return append_told_numbers(ToldMap(gain, hop_of_known_gain, mean_gain, ("gain",)))


def append_told_numbers(link: AbstractRandomAffine) -> Stack:
    """Return a link with the numbers that are told of its maps after z."""
    return Stack([link, *_list_told_outputs(link, link.inputs)])


def _list_told_outputs(link: AbstractRandomAffine, sent: int) -> list[ModeOutput]:
    """Return the outputs that tell what each told map of a link tells, beside `sent` numbers."""
    return [ModeOutput(affine.memory, sent) for affine in list_told_maps(link)]


class SeparatedToldNumbers(NamedTuple):
    """A channel taken apart: the link of the values, and the rows of z in which values and told numbers stand.

    Numbers are in the order of the link's `list_told_maps`, each once.
    """

    link: AbstractRandomAffine
    values: tuple[int, ...]
    numbers: tuple[int, ...]


def separate_told_numbers(channel: AbstractRandomAffine) -> SeparatedToldNumbers:
    """Take a channel apart into its link, the rows of its outputs, and the rows of the numbers told about it.

    A channel that tells nothing is its own link, and all its rows are outputs.
    """
    maps = channel.maps if isinstance(channel, Stack) else (channel,)
    told_of = {affine.memory.identity for affine in list_told_maps(channel)}
    rows, links, at_row = dict[str, tuple[int, ...]](), list[AbstractRandomAffine](), 0
    values: tuple[int, ...] = ()
    for part in maps:
        places = tuple(range(at_row, at_row + part.outputs))
        at_row += part.outputs
        if isinstance(part, ModeOutput) and part.memory.identity in told_of:
            rows.setdefault(part.memory.identity, places)
        else:
            links.append(part)
            values += places
    if not rows:
        return SeparatedToldNumbers(channel, values, ())
    link = links[0] if len(links) == 1 else Stack(links)
    numbers = [row for affine in list_told_maps(link) for row in rows[affine.memory.identity]]
    return SeparatedToldNumbers(link, values, tuple(numbers))


def build_with_told_numbers(
    build: Callable[[list[AbstractRandomAffine]], M], channels: Sequence[AbstractRandomAffine]
) -> M:
    """Return what `build` makes of the channels, with all numbers that the channels tell after its outputs.

    A channel may tell its receiver numbers about itself, such as its present gain. These do not go through what is
    built: `build` gets the links without them, and they are delivered unchanged.
    """
    links = [separate_told_numbers(channel).link for channel in channels]
    built = build(links)
    # A channel that tells its receiver nothing is its own link.
    have_told_numbers = any(link is not channel for link, channel in zip(links, channels, strict=True))
    return cast(M, append_told_numbers(built)) if have_told_numbers else built


def stack_channels_with_told_numbers(
    place: Callable[[list[AbstractRandomAffine]], list[AbstractRandomAffine]], channels: Sequence[AbstractRandomAffine]
) -> Stack:
    """Return channels side by side, each with the numbers that it tells after its own outputs.

    Told numbers come with a message and say what the link did to it, such as its gain.

    Args:
        place: takes the channels' links, each of its own signal, and returns as many links of the joined signal.
        channels: the channels.
    """
    links, maps = [separate_told_numbers(channel).link for channel in channels], list[AbstractRandomAffine]()
    for link, channel, placed_link in zip(links, channels, place(links), strict=True):
        maps.append(placed_link)
        # A channel that tells nothing is its own link. For any other channel, append what it tells.
        if link is not channel:
            maps += _list_told_outputs(placed_link, placed_link.inputs)
    return Stack(maps)


def name_received_values(outputs: tuple[str, ...], channel: AbstractRandomAffine, more: int = 0) -> tuple[str, ...]:
    """Return names of what is received: of values those of the outputs where these are as many, else z0, z1, ...

    Args:
        outputs: names of the sensor's outputs.
        channel: from the sensor to the receiver; told numbers have names of their own.
        more: how many numbers are received beside what the channel delivers.
    """
    link, rows_of_values, rows_of_told_numbers = separate_told_numbers(channel)
    count = len(rows_of_values) + more
    names = list(outputs if len(outputs) == count else (f"z{i}" for i in range(count)))
    told_names = [name for affine in list_told_maps(link) for name in affine.names] if rows_of_told_numbers else []
    # Of several told numbers of one name each has a number behind it.
    distinct = [
        f"{name}_{told_names[:i].count(name) + 1}" if told_names.count(name) > 1 else name
        for i, name in enumerate(told_names)
    ]
    # From the first row to the last, so that each name is inserted at the place that it has in the end.
    for row, name in sorted(zip(rows_of_told_numbers, distinct, strict=True)):
        names.insert(row, name)
    return tuple(names)
