"""Channels between a sensor and a filter, each one random affine map: hops, relays, dropouts, direct links."""

from collections.abc import Sequence
from functools import partial
from typing import Literal, overload

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.channel_side_information import (
    KnownGain,
    Pilot,
    append_told_gain,
    build_with_told_numbers,
    stack_channels_with_told_numbers,
)
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import OverTime, at_each_step, first, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, check_sensor
from heliograph.model.turn_invariance import check_turn_invariance
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.check import check_count, fail, instance, scalar
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, all_inner_maps, check_forgets, check_maps
from heliograph.random_affine.delay import Delay, DelayedLink, place_channel_of_part, signal_size
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.hop import GainAndNoise, known
from heliograph.random_affine.laws.law import AbstractLaw, Constant, LawLike
from heliograph.random_affine.memories_of_channels import separate_memories
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.modes import ModeOutput
from heliograph.random_affine.noises.noise import AbstractNoise, NoiseLike, as_noise, count_components
from heliograph.random_affine.relayed_links import connect_in_series
from heliograph.random_affine.series_and_stack import Stack
from heliograph.random_affine.sum_of_maps import Superposed

Channel = TypeAliasType("Channel", AbstractRandomAffine | OverTime)  # an OverTime holds one channel per step


# The type of the result by the arguments.
@overload
def hop(
    gain: LawLike,
    noise: NoiseLike,
    power: ArrayLike = 1.0,
    amplification: ArrayLike = 1.0,
    dimension: int = 1,
    delay: None = None,
) -> GainAndNoise:
    """Without a delay, return z = a sqrt(E) g y + n, with `power` E and the relay's `amplification` a."""


@overload
def hop(
    gain: LawLike,
    noise: NoiseLike,
    power: ArrayLike = 1.0,
    amplification: ArrayLike = 1.0,
    dimension: int = 1,
    *,
    delay: Delay,
) -> DelayedLink:
    """With a delay d, return z_k = a sqrt(E) g_k y_{k-d} + n_k, with `power` E and the relay's `amplification` a."""


@overload
def hop(
    gain: LawLike,
    noise: NoiseLike,
    power: ArrayLike = 1.0,
    amplification: ArrayLike = 1.0,
    dimension: int = 1,
    delay: None = None,
    *,
    known: Literal[True] | Pilot,
) -> Stack:
    """With a gain g, or a pilot's reading of it, in each message, return (a sqrt(E) g y + n, this number)."""


def hop(
    gain: LawLike,
    noise: NoiseLike,
    power: ArrayLike = 1.0,
    amplification: ArrayLike = 1.0,
    dimension: int = 1,
    delay: Delay | None = None,
    known: KnownGain = False,
) -> GainAndNoise | DelayedLink | Stack:
    """One radio hop: z = amplification sqrt(power) g y + n, the same gain for all components of y.

    `gain` is a law or a number; `noise` a noise law, a covariance (m, m), or one variance common to `dimension`
    components, which are independent then. A relay's hop has its amplification factor; a sensor's has 1. All numbers
    may be traced by JAX, those of the laws too. `delay` as for `delayed`.

    Args:
        gain: law of g, or a number.
        noise: law, covariance (m, m) or variance of n, in the unit of z squared.
        power: E, not negative (default 1).
        amplification: of a relay, z per unit of what it receives (default 1).
        dimension: number of components where `noise` is a variance (default 1).
        delay: in steps, or its law (default: none).
        known: True for a coherent receiver, to which each message reports the gain, z = (a sqrt(E) g y + n, g); a
            `Pilot` if it reports a reading of the gain. Reported numbers pass unchanged through all that the hop is
            built into, and stand at the end of z. False unless given.

    Raises:
        ValueError: a negative power, a noise that is no covariance, numbers that are not finite.

    Source: cubature fusion under amplify-and-forward relays, equations (3) and (5).
    """
    law = gain if isinstance(gain, AbstractLaw) else Constant(gain)
    count = count_components(noise) or check_count("dimension of a hop", dimension)
    p = scalar("hop power", power, 0.0)
    factor = scalar("amplification", amplification) * library(p).sqrt(p)
    radio_hop = GainAndNoise(law, factor * np.eye(count), as_noise("hop noise", noise, count))
    link = append_told_gain(radio_hop, known)
    return link if delay is None else delayed(link, delay)


def perfect(dimension: int = 1) -> GainAndNoise:
    """Return the channel that delivers y as it is: z = y.

    Args:
        dimension: number of components of y (default 1).

    Raises:
        ValueError: a dimension that is not a whole number of components.
    """
    return known(np.eye(check_count("dimension", dimension)))


def silent(
    outputs: int = 1, inputs: int | None = None, noise: "AbstractNoise | Float[ArrayLike, '*outputs']" = 0.0
) -> GainAndNoise:
    """Return a channel that delivers noise alone: z = n.

    Args:
        outputs: length of z, 1 unless given.
        inputs: length of y; as many as outputs unless given.
        noise: law of n, its covariance (outputs, outputs), or a variance that all components have, 0 unless given.

    Raises:
        ValueError: a noise that is no covariance or of another dimension.
    """
    rows = check_count("outputs of a silent channel", outputs)
    matrix = np.zeros((rows, rows if inputs is None else check_count("inputs of a silent channel", inputs)))
    return GainAndNoise(Constant(1.0), matrix, as_noise("noise of a silent channel", noise, outputs))


def amplify_and_forward(hops: Sequence[AbstractRandomAffine]) -> AbstractRandomAffine:
    """Return the chain `hops` through relays that amplify what they receive, noise included: z = H_N ... H_2 H_1 y.

    Two hops, sensor to relay r_k = sqrt(E_l) gamma y + m and relay to filter z = a sqrt(E_r) xi r + n, give
    z = a sqrt(E_l E_r) xi gamma y + a sqrt(E_r) xi m + n. Here gamma and xi are the random gains, E_l and E_r the
    transmitted powers, m and n the noises, and a is the relay's amplification. Each hop may be late, and the delays add
    up; a relay with a random delay may forward one value twice, with one noise m.

    Args:
        hops: from the sensor's to the filter's; each takes as many components as the one before sends.

    Raises:
        ValueError: no hop, hops whose dimensions do not fit, time stamps on the way, memory before a delay.
    Source: cubature fusion under amplify-and-forward relays, equations (3) to (6).
    """
    return build_with_told_numbers(connect_in_series, separate_memories(check_maps("series", hops)))


def delayed(link: AbstractRandomAffine, delay: Delay, timestamped: bool = False) -> DelayedLink:
    """Return a link that delivers at step k what was sent d steps before, z_k = G_k y_{k-d} + n_k.

    Before the first step zeros were sent.

    Args:
        link: the link without delay.
        delay: d in steps; a `Discrete` law from which d is drawn at each step; or a `MarkovChain` whose mode is d.
            Drawn delays may deliver one y twice, or never.
        timestamped: True if the receiver knows d, as the last number of z; False unless given.

    Raises:
        ValueError: a delay that is no whole number of steps or is negative, a link that is already late.
    """
    checked = check_maps("delayed link", [link])
    return build_with_told_numbers(lambda links: DelayedLink(links[0], delay, timestamped), checked)


def dropout(channel: AbstractRandomAffine, arrival: ArrayLike, radius: ArrayLike = 0.0) -> Mixture:
    """Return a channel whose packet is lost with probability 1 - arrival; the receiver reads z = 0 and does not know.

    If the receiver knows of the loss, use `erasure` instead.

    Args:
        channel: the channel of packets that arrive.
        arrival: probability that a packet arrives, from 0 to 1.
        radius: how far that probability may be off (default 0: it is known).

    Raises:
        ValueError: an arrival probability outside [0, 1].
    """
    p = scalar("arrival probability", arrival, 0.0, 1.0)

    def mix_with_zero(links: Sequence[AbstractRandomAffine]) -> Mixture:
        """Return the mixture of the only link in `links`, with the arrival probability p, and of z = 0, with 1 - p."""
        (link,) = links
        return Mixture([link, silent(link.outputs, link.inputs)], library(p).stack([p, 1 - p]), radius)

    # Numbers that the channel reports to its receiver after z are not lost with z.
    return build_with_told_numbers(mix_with_zero, check_maps("dropout", [channel]))


def erasure(channel: AbstractRandomAffine, arrival: ArrayLike) -> Erasure:
    """Return a channel whose packet is lost with probability 1 - arrival; the receiver knows, and reads NaN.

    Filters skip what is NaN, so give a filter the channel inside, without the erasure. A relay forwards NaN as NaN.

    Args:
        channel: that of the packets which arrive.
        arrival: probability that a packet arrives, from 0 to 1.

    Raises:
        ValueError: an arrival probability outside [0, 1]; later, when asked for moments.
    """
    return build_with_told_numbers(lambda links: Erasure(links[0], arrival), check_maps("erasure", [channel]))


def with_direct_link(relayed: AbstractRandomAffine, direct: AbstractRandomAffine) -> Stack:
    """Return a channel that delivers z = (z_relay, z_direct): y through a relay and y directly, independent given y.

    Args:
        relayed: channel through the relay.
        direct: channel of the same y that bypasses the relay.

    Raises:
        ValueError: channels that take different numbers of inputs.
    """
    # A memory without a name (such as fading) that stands in both channels becomes two. Numbers that a channel reports
    # to its receiver follow its own outputs.
    channels = separate_memories(check_maps("stack", [relayed, direct]))
    return stack_channels_with_told_numbers(_delay_all_like_latest, channels)


def _delay_all_like_latest(links: Sequence[AbstractRandomAffine]) -> list[AbstractRandomAffine]:
    """Return links of one signal as maps of one delay line (y_k, ..., y_{k-past}), as long as the latest needs."""
    past = max(c.past for c in links)
    return [c if c.past == past else place_channel_of_part(c, signal_size(c), 0, past) for c in links]


def parallel(channels: Sequence[AbstractRandomAffine]) -> Stack:
    """Return channels side by side: the first carries the first components of y, the second the next, and so on.

    Args:
        channels: one for each part of y, in order.

    Raises:
        ValueError: no channels.
    """
    # A memory without a name that stands in several channels becomes a separate one in each.
    separate = separate_memories(check_maps("parallel channels", channels))
    return stack_channels_with_told_numbers(_select_part_for_each_link, separate)


def _select_part_for_each_link(links: Sequence[AbstractRandomAffine]) -> list[AbstractRandomAffine]:
    """Return links that take the whole signal, each of which selects its own part of it, one part after another."""
    size = sum(signal_size(link) for link in links)
    past = max(link.past for link in links)  # the most steps by which a link is late: all get so many earlier signals
    links_of_whole_signal = []
    start = 0  # the first component of the link's part of the signal
    for link in links:
        links_of_whole_signal.append(place_channel_of_part(link, size, start, past))
        start += signal_size(link)
    return links_of_whole_signal


def superposed(links: Sequence[AbstractRandomAffine], noise: NoiseLike, same: bool = False) -> Superposed:
    """Return links that transmit at once, so that the receiver gets the sum z = sum_i (G_i y_i + n_i) + n.

    Link i carries its own part of y, as in `parallel` (`joint_sensor` makes one sensor of several). With `same=True`
    all links carry all of y, as relays of one signal do. Links are independent. What they have in common, such as a
    first hop that several relays hear, comes before the sum: Series([first, superposed(relays, noise, same=True)]).

    Args:
        links: one for each transmitter, with as many outputs each as the receiver gets.
        noise: law, covariance (m, m) or variance of the receiver's noise n.
        same: True if every link carries all of y; False unless given.

    Raises:
        ValueError: links of unequal sizes; an erasure in a link, since a receiver of a sum does not see who is missing;
            flags or time stamps, which would be added up.
    """
    separate = separate_memories(check_maps("links of a sum", links))  # one object given twice is two links
    # Numbers that a link reports to the receiver, such as its gain, arrive after the sum.
    return build_with_told_numbers(partial(_add_up_links, noise=noise, same=same), separate)


def _add_up_links(links: Sequence[AbstractRandomAffine], noise: NoiseLike, same: bool) -> Superposed:
    """Return the sum of links and a noise as one map of the delay line (y_k, ..., y_{k-past}), stacked.

    Args:
        links: the links, without the numbers that they report to the receiver.
        noise: law, covariance or variance of the receiver's noise.
        same: True if every link carries all of y, False if each carries its own part of y, one part after another.
    """
    for i, link in enumerate(links, 1):
        _check_can_be_added(f"link {i} of a sum", link)
    sizes, sent = [link.outputs for link in links], [signal_size(link) for link in links]
    if len(set(sizes)) > 1:
        raise fail("links of a sum", "links of one number of outputs", sizes)
    if instance("same", same, bool, "True or False") and len(set(sent)) > 1:
        raise fail("links of a sum (same=True)", "links that all carry all of y", f"links of {sent} numbers")
    past = max(link.past for link in links)
    total = sent[0] if same else sum(sent)  # length of y
    starts = [0] * len(links) if same else np.cumsum([0, *sent[:-1]]).tolist()  # of each link's part in y
    components_by_link = []
    for link, start, size in zip(links, starts, sent, strict=True):
        # y_{k-t} begins at t * total in the delay line. A link takes its part of y_k, ..., y_{k-link.past}.
        part_starts = [t * total + start for t in range(link.past + 1)]
        components_by_link.append(tuple(part_start + i for part_start in part_starts for i in range(size)))
    return Superposed(links, as_noise("noise of a sum", noise, sizes[0]), components_by_link, (1 + past) * total)


def _check_can_be_added(name: str, link: AbstractRandomAffine) -> None:
    """Raise ValueError if a link delivers what cannot be added up: flags, time stamps, or NaN for a loss.

    `name`: the name of the link in the error.
    """
    maps = [link, *all_inner_maps(link)]
    if any(isinstance(m, ModeOutput) or (isinstance(m, DelayedLink) and m.timestamped) for m in maps):
        raise fail(name, "one without flags and time stamps, which would be added up", type(link).__name__)
    if link.erases:
        expected = "a loss that the receiver does not see: dropout(link, arrival) inside, erasure(sum, arrival) outside"
        raise fail(name, expected, "an erasure")


def mean_gain(channel: Channel) -> Channel:
    """Return the channel that most people would design for: every gain taken as its mean, with the noise as it is.

    Args:
        channel: a channel of random gains; it may vary over time.

    Raises:
        ValueError: a gain law that does not know its mean, a channel that remembers.
    """

    def mean_of(channel: AbstractRandomAffine) -> AbstractRandomAffine:
        """Return the channel of one step with its gains at their means; raise ValueError if it remembers."""
        what = "channel taken at its mean gain"  # in errors
        (checked,) = check_maps(what, [channel])
        check_forgets(what, checked)
        return channel.mean_gain()

    at_mean: Channel = at_each_step(mean_of, channel)
    return at_mean


def check_link(
    sensor: AbstractSensor, channel: AbstractRandomAffine, states: int, late: bool = False, moments: bool = True
) -> None:
    """Raise ValueError unless sensor and channel fit each other and a state of so many `states`.

    `late`: True if the caller can handle delays; `moments`: True if it needs the covariance of the noise.
    """
    check_sensor(sensor, states)
    sensor.refuse_inputs("such a filter or channel")
    if moments and not late:
        _ = sensor.noise.covariance
    check_maps("channel", [channel])
    if channel.past and not late:
        constant = isinstance(channel, DelayedLink) and channel.constant
        late_filter = ", and hg.filters.late_filter this one for any filter" if constant else ""
        expected = f"one without delays (linear_filter knows them{late_filter})"
        raise fail("channel", expected, f"one that is late by up to {channel.past} steps")
    check_sent(sensor, channel)


def check_sent(sensor: AbstractSensor, channel: AbstractRandomAffine) -> None:
    """Raise ValueError unless a channel takes as many numbers as the sensor sends."""
    if signal_size(channel) != len(sensor.outputs):
        outputs = len(sensor.outputs)
        expected = f"one for the sensor's {outputs} output{'s' * (outputs > 1)}, such as perfect({outputs})"
        raise fail("channel", expected, f"one that takes {signal_size(channel)}")


def find_received_angles(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> Angles:
    """Return the indices of received components that are angles; raise ValueError unless the models fit each other."""
    plant_0 = first(plant)
    sensor_0 = first(sensor).typical(plant_0.inputs)
    for model in list_mode_models(sensor_0):
        check_turn_invariance(
            "sensor of a plant", model.measure, plant_0.initial_mean, plant_0.manifold, Manifold(sensor_0.angles)
        )
    steps = unstack(channel) if sensor_0.circular else [first(channel)]
    # At each step, which received components are angles. A gain other than 1 raises, since it does not keep an angle.
    received_angles: set[Angles] = {step.carry_angles(sensor_0.angles) for step in steps}
    if len(received_angles) > 1:
        raise fail("channel", "the same angles at every step", sorted(received_angles))
    return received_angles.pop()
