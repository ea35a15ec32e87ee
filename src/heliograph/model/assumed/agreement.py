"""Whether two descriptions of the world agree, compared as values: the parts in which a filter believes another one.

Laws agree that are written alike. A claim that rests on means and covariances alone holds for every law that shares
them, so that of such filters only these are compared: E[G], E[n] and Cov(z | y) given what arrives, whatever is lost.
"""

from collections.abc import Sequence

import numpy as np

from heliograph.model.assumed.assumed_model import MEAN_AND_COVARIANCE, AssumedModel
from heliograph.model.assumed.same_channel import same_channel, same_observation
from heliograph.model.assumed.same_plant_and_sensor import agree_at_each_step, same_plant, same_sensor
from heliograph.model.augmented.joint_sensors import join_links
from heliograph.model.augmented.past_outputs import with_past
from heliograph.model.over_time import at_each_step, first
from heliograph.model.trigger import AbstractTrigger, Periodic
from heliograph.numerics.module import are_same
from heliograph.numerics.numpy_or_jax import equal_to_rounding
from heliograph.random_affine.hop import known
from heliograph.random_affine.series_and_stack import Series

PLANT, SENSOR, CHANNEL, TRIGGER, RELAYS = "plant", "sensor", "channel", "trigger", "relays"
RANGE = "range of values"
ENCODER = "encoder"


def list_differences(believed: AssumedModel, own: AssumedModel) -> tuple[str, ...]:
    """Return the names of the models that differ: those a filter was made for (`believed`), and its node's (`own`).

    A filter's claim on its covariance holds only where the models are those for which it was made: so the claim is
    lowered where the result is not empty. The names are "plant", "sensor", "channel", "trigger" and so on.
    """
    order = believed.order  # of the moments of noises that the filter uses; None for their whole laws
    own = _enlarge_world_by_past(believed, own)
    parts = [] if agree_at_each_step(same_plant, believed.plant, own.plant, order) else [PLANT]
    if own.relays is not None or believed.relays is not None:
        has_same_relays = are_same(believed.relays, own.relays) and _same_gains(believed, own)
        if not has_same_relays:
            parts.append(RELAYS)
        return tuple(parts)
    if believed.sensor is None or believed.channel is None:  # a filter without measurements
        return tuple(parts)
    if own.sensor is None or own.channel is None:
        return (*parts, SENSOR)
    if not _same_trigger(believed.trigger, own.trigger):
        parts.append(TRIGGER)
    if own.range is not None:  # no filter knows it: that a value is refused, for being out of range, tells of the state
        parts.append(RANGE)
    if not are_same(believed.encoder, own.encoder):
        parts.append(ENCODER)
    # Sensor and channel agree one by one, or together: what is received of the state through both may be the same.
    sensors_agree = agree_at_each_step(same_sensor, believed.sensor, own.sensor, order)
    channels_agree = same_channel(believed.channel, own.channel, order, loses=believed.trigger is None)
    if sensors_agree and channels_agree:
        return tuple(parts)
    observations = (believed.sensor, believed.channel), (own.sensor, own.channel)
    if agree_at_each_step(same_observation, *observations, order):
        return tuple(parts)
    parts += [part for part, agree in ((SENSOR, sensors_agree), (CHANNEL, channels_agree)) if not agree]
    return tuple(parts)


def _enlarge_world_by_past(believed: AssumedModel, own: AssumedModel) -> AssumedModel:
    """Return the models of a node with past signals as states if the filter was made for such a larger plant.

    `believed` are the models that the filter was made for, and `own` those where it stands. The latter are returned
    unchanged if the channel is not late (`past` is 0) or the filter's plant has no more states.
    """
    if own.sensor is None or own.channel is None or not first(own.channel).past:
        return own
    if len(first(believed.plant).states) <= len(first(own.plant).states):
        return own
    plant, sensor, channel = with_past(own.plant, own.sensor, own.channel)
    return own.replaced(plant=plant, sensor=sensor, channel=channel)


def join_assumed(assumed_models: Sequence[AssumedModel]) -> AssumedModel:
    """Return the models that a fusion filter is made for which receives the measurements of several filters of a plant.

    Their sensors and channels are stacked. The first trigger, encoder or range of values among them stands for all; a
    schedule (`Periodic`) is none of these, as silence by schedule says nothing of the state.

    Args:
        assumed_models: of each filter, the models that it is made for; all have the same plant.
    """
    if len(assumed_models) == 1:
        return assumed_models[0]
    sensors = [assumed.sensor for assumed in assumed_models if assumed.sensor is not None]
    channels = [assumed.channel for assumed in assumed_models if assumed.channel is not None]
    sensor, channel = join_links({str(i): s for i, s in enumerate(sensors)}, channels)
    triggers = [
        assumed.trigger
        for assumed in assumed_models
        if assumed.trigger is not None and not isinstance(assumed.trigger, Periodic)
    ]
    encoders = [assumed.encoder for assumed in assumed_models if assumed.encoder is not None]
    ranges = [assumed.range for assumed in assumed_models if assumed.range is not None]
    return assumed_models[0].replaced(
        sensor=sensor,
        channel=channel,
        trigger=triggers[0] if triggers else None,
        encoder=encoders[0] if encoders else None,
        range=ranges[0] if ranges else None,
        order=None if any(assumed.order is None for assumed in assumed_models) else MEAN_AND_COVARIANCE,
    )


def restrict_assumed_to_rows(assumed: AssumedModel, rows: Sequence[int]) -> AssumedModel:
    """Return the models that a filter is made for if it receives only some of its channel's outputs.

    `rows` are their indices, in the order in which they are received.
    """
    selection = known(np.eye(first(assumed.channel).outputs)[list(rows)])
    return assumed.replaced(channel=at_each_step(lambda channel: Series([channel, selection]), assumed.channel))


def _same_trigger(believed: AbstractTrigger | None, own: AbstractTrigger | None) -> bool:
    """Return whether the sender's actual rule, `own`, is the one that the filter assumes, `believed`.

    A filter that assumes no rule is also right for a schedule (Periodic), which leaves out values whatever they are, so
    that a missing value has no information.
    """
    if believed is None:
        return own is None or isinstance(own, Periodic)
    return are_same(believed, own)


def _same_gains(believed: AssumedModel, own: AssumedModel) -> bool:
    """Return whether each relay that a recording has runs with the gain that the filter assumes for it."""
    return all(equal_to_rounding(gain, own.gains[name]) for name, gain in believed.gains.items() if name in own.gains)
