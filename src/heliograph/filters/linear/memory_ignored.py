"""Linear filters that ignore a memory or a delay of their channel: what the usual mistakes give, to compare with."""

from dataclasses import replace

import heliograph.filters.wrappers as wrappers
from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.uncertain_channel_updates import Polytope
from heliograph.filters.linear.linear import LinearFilter, linear_filter
from heliograph.filters.wrappers.accepted_models import accept_sensor_inputs, accept_told_numbers
from heliograph.model.assumed.assumed_model import believes, with_assumed
from heliograph.model.channel import Channel
from heliograph.model.fading import memory_matters, without_memory
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, check_linear
from heliograph.random_affine.base import check_maps


@believes
@accept_sensor_inputs
@accept_told_numbers
def memoryless_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None
) -> AbstractFilter:
    """Return the best linear filter for links with independent draws, behind links that may have memory.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter; its memory is ignored.
        update: how uncertain probabilities are bounded; `Polytope()` by default.

    Claim: as `linear_filter` for links without memory, lowered to "nominal" where memory matters (`memory_matters`);
    `true_error` computes the error that results, before any data.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, losses.

    Source: De Koning (1984), for multiplicative noise that is independent over time.
    """
    # The channel with its modes drawn anew at each step, and whether its memory correlates mean gains over time.
    check_linear("memoryless filter", plant, sensor)
    memoryless_channel, is_memory_relevant = without_memory(channel), memory_matters(channel)

    def make(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> LinearFilter:
        """Return the filter of a channel without memory.

        Its claim is "nominal" if a memory that matters was ignored. `update` says how uncertain probabilities are
        bounded.
        """
        filter = linear_filter(plant, sensor, channel, update)
        assert isinstance(filter, LinearFilter)  # a channel without delay or memory has no other
        return _claim_nominal(filter) if is_memory_relevant else filter

    # A channel that delivers late: the same filter for the system enlarged by past signals.
    if check_maps("channel", [first(memoryless_channel)])[0].past:
        return wrappers.build_behind_delays(plant, sensor, memoryless_channel, make)
    return make(plant, sensor, memoryless_channel)


def as_current_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, update: Polytope | None = None
) -> LinearFilter:
    """Return the filter that takes delayed signals as current: the best linear filter if all delays were zero.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter; its delays and memory are ignored.
        update: how uncertain probabilities are bounded; `Polytope()` by default.

    Claim: "nominal" where anything can be late or memory matters. `true_error` computes the error that results before
    any data.

    Raises:
        ValueError: what `linear_filter` refuses, losses.

    Source: the usual mistake; De Koning (1984), with y_k in place of y_{k-d}.
    """
    check_linear("filter that takes delayed signals as current", plant, sensor)
    without_delay = without_memory(wrappers.deliver_line_as_current(channel))
    filter = linear_filter(plant, sensor, without_delay, update)
    assert isinstance(filter, LinearFilter)  # a channel without delay or memory has no other
    return _claim_nominal(filter) if first(channel).past or memory_matters(channel) else filter


def _claim_nominal(filter: LinearFilter) -> LinearFilter:
    """Return the same filter, which states of its covariance only that it is "nominal": neither exact nor a bound.

    For a filter that ignores a delay or memory of its channel.
    """
    return with_assumed(replace(filter, claim="nominal"), filter.assumed)
