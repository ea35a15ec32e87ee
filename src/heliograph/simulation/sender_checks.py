"""Checks of what a node's sender does: a trigger or an encoder that fits its sensor, channel and filters."""

from collections.abc import Mapping

from heliograph.filters.base import AbstractFilter
from heliograph.filters.event.event_filter import EventFilter
from heliograph.filters.event.stochastic_event_filter import StochasticEventFilter
from heliograph.filters.wrappers.fed_back import FedBackFilter
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.sensor import AbstractSensor
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.model.words.encoder import Words
from heliograph.model.words.word_channel import FLAG, find_carried_components
from heliograph.numerics.check import fail, show_value
from heliograph.random_affine.base import AbstractRandomAffine, all_inner_maps
from heliograph.random_affine.words.bit_flips import Flips


def compares_with_prediction(filter: AbstractFilter) -> bool:
    """Return whether a filter is made for a sender that compares its signal with a prediction of it."""
    return isinstance(filter, EventFilter | StochasticEventFilter) and filter.trigger.reference == "prediction"


def refuse_words_and_feedback(what: str, nodes: Mapping[str, object]) -> None:
    """Raise ValueError if a sender rounds to words, or sends differences from a prediction that is fed back to it.

    `what` knows nothing of them: it is for the numbers that sensors measure.

    Args:
        what: what is asked for, for the message.
        nodes: nodes of a network by name, of any kind.
    """
    for name, node in nodes.items():
        if getattr(node, "encoder", None) is not None:
            raise fail(what, "senders of the numbers themselves", f"an encoder of words at node {name!r}")
        if getattr(node, "informed_by", None) is not None:
            raise fail(what, "senders of the numbers themselves", f"a sensor with feedback at node {name!r}")


def check_trigger(
    trigger: AbstractTrigger, sensor: AbstractSensor, channel: AbstractRandomAffine, filters: Mapping[str, object]
) -> None:
    """Raise ValueError unless a trigger fits the sensor, the channel and the filters of a node.

    With a trigger a sender transmits only if its signal differs enough from a reference, so that silence also tells of
    the state; filters rely on this.

    Args:
        trigger: rule that says when the sender transmits.
        sensor: the node's sensor.
        channel: the node's channel.
        filters: the node's filters by name.

    Raises:
        ValueError: numbers for another count of components; a channel that is late, or that does not carry each
            component for itself where each is sent alone; no filter whose prediction the sender could know.
    """
    check_type("trigger", trigger, AbstractTrigger)
    # The trigger's numbers must be for as many components as the sensor has, none of them an angle. The channel must
    # deliver at once, and each component for itself where each is sent alone.
    trigger.check_outputs(len(sensor.outputs))
    if sensor.circular:
        raise fail("trigger", "a sensor without angles", list(sensor.circular))
    if channel.past:
        raise fail(
            "channel of a node with a trigger", "one that is not late", f"one late by up to {channel.past} steps"
        )
    if trigger.region == "each" and channel.outputs != len(sensor.outputs):
        raise fail("channel of components that are each sent alone", f"{len(sensor.outputs)} outputs", channel.outputs)
    # No filter whose estimate is fed back to the sensor. If the reference is a prediction, a filter must exist whose
    # prediction the sender can compute too.
    if any(isinstance(filter, FedBackFilter) for filter in filters.values()):
        raise fail("trigger", "no filter that is fed back", "one")
    if trigger.reference == "prediction" and not any(
        isinstance(filter, AbstractFilter) and compares_with_prediction(filter) for filter in filters.values()
    ):
        raise fail("node whose sender compares with a prediction", "an event_filter with this trigger", list(filters))


def check_encoder(
    encoder: Words,
    sensor: AbstractSensor,
    channel: Channel,
    trigger: AbstractTrigger | None,
    filters: Mapping[str, object],
) -> None:
    """Raise ValueError unless an encoder fits the sensor, channel, trigger and filters of a node.

    An encoder rounds each measured value to a word of some bits, which the channel carries.

    Args:
        encoder: the encoder; dither is a noise that it adds before rounding, and that the receiver may subtract.
        sensor: the node's sensor.
        channel: the node's channel, which carries the words.
        trigger: the rule by which the sender transmits; None where it always does.
        filters: the node's filters, by name.

    Raises:
        ValueError: a range for another count of components, angles, words that are amplified, a trigger that compares
            with a value that sender and receiver do not share, a filter that is fed back.
    """
    # Sensor, filters and channel.
    check_type("encoder", encoder, Words)
    encoder.check_outputs(len(sensor.outputs))
    if sensor.circular:
        raise fail("encoder", "a sensor without angles", list(sensor.circular))
    if any(isinstance(filter, FedBackFilter) for filter in filters.values()):
        raise fail("encoder", "no filter that is fed back", "one")
    find_carried_components(channel)  # raises where words are amplified
    # A trigger that compares values compares words, which both ends must share. A periodic one compares nothing.
    if trigger is not None and not isinstance(trigger, Periodic):
        if encoder.subtracts:
            raise fail("trigger of a node with an encoder", "a dither that is not taken off, or Periodic", "subtracted")
        if flips_words(first(channel)):
            expected = "a link without flipped bits (erasure for a checksum), as both ends share the word; or Periodic"
            raise fail("trigger of a node with an encoder", expected, type(trigger).__name__)


def count_subtracted_dithers(encoder: Words, channel: Channel) -> int:
    """Return how many dithers a receiver is told to subtract: one for each component that arrives but flags."""
    return sum(place != FLAG for place in find_carried_components(channel)) if encoder.subtracts else 0


def flips_words(channel: AbstractRandomAffine) -> bool:
    """Return whether a channel of words may flip bits: whether a part of it has a mean rate of bit errors above 0."""
    flipping_links = [link for link in [channel, *all_inner_maps(channel)] if isinstance(link, Flips)]
    return any(float(link.error.moment(1)) > 0 for link in flipping_links)


def check_type(name: str, value: object, expected: type) -> None:
    """Raise ValueError for an object of another class than `expected`; `name`: what it is, for the error."""
    if not isinstance(value, expected):
        article = "an" if expected.__name__[0] in "AEIOU" else "a"
        raise fail(name, f"{article} {expected.__name__}", show_value(value))
