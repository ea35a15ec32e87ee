"""Agreement of plant, sensor and channel on which numbers are angles."""

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first, unstack
from heliograph.model.plant import AnyPlant, check_turns
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import Angles
from heliograph.numerics.check import fail
from heliograph.random_affine.carried import carried


def received_angles(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> Angles:
    """Return the indices of received components that are angles; plant, sensor and channel must fit each other.

    Raises:
        ValueError: a channel that leaves no angle of one, or a sensor whose outputs a full turn of a state changes.
    """
    start, senses = first(plant), first(sensor)
    check_turns("sensor of a plant", senses.measure, start.initial_mean, start.angles, senses.angles)
    steps = unstack(channel) if isinstance(channel, OverTime) and senses.circular else [first(channel)]
    results = {carried(step, senses.angles) for step in steps}
    if len(results) > 1:
        raise fail("channel", "the same angles at every step", sorted(results))
    return results.pop()
