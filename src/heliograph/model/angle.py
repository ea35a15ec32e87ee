"""Agreement of plant, sensor and channel on which numbers are angles.

Behind a channel a number is an angle only if its gain is 1.
"""

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first, unstack
from heliograph.model.plant import AnyPlant, check_turns
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angle import Angles
from heliograph.numerics.check import fail
from heliograph.numerics.traced import is_traced
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.delay import Delayed
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.law import Constant
from heliograph.random_affine.modes import Modes, OneStepLate


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


ROUNDING = 1e-12  # of a gain of 1 that was computed


def carried(channel: AbstractRandomAffine, sent: Angles) -> Angles:
    """Return the indices of outputs that are angles, from those of the inputs; noise and erasures leave an angle one.

    Raises:
        ValueError: an angle with another gain than 1, or one that is added to something else.
    """
    if not sent:
        return ()
    match channel:
        case GainAndNoise():
            return _through(channel, sent)
        case Series():
            for part in channel.maps:
                sent = carried(part, sent)
            return sent
        # Outputs of parts stand one after another.
        case Stack():
            starts = np.cumsum([0, *(part.outputs for part in channel.maps)])
            items = zip(starts, channel.maps, strict=False)
            return tuple(int(start) + i for start, part in items for i in carried(part, sent))
        case Erasure() | OneStepLate():
            return carried(channel.base, sent)
        case Delayed():  # one of the angles that were sent arrives; a time stamp stands after it
            return carried(channel.link, sent)
        # All choices must agree.
        case Mixture() | Modes():
            results = {carried(part, sent) for part in channel.maps}
            if len(results) == 1:
                return results.pop()
    raise _refused(type(channel).__name__)


def _through(channel: GainAndNoise, sent: Angles) -> Angles:
    matrix = channel.matrix
    if is_traced(matrix):
        raise _refused("a gain that is traced")
    of_angles = np.asarray(matrix)[:, list(sent)]
    touched = np.flatnonzero(np.any(of_angles != 0, axis=1))
    if not touched.size:
        return ()
    if not isinstance(channel.law, Constant) or is_traced(channel.law.value):
        raise _refused(f"a gain that is {type(channel.law).__name__}")
    rows = float(channel.law.value) * np.asarray(matrix)[touched]
    whole = np.abs(rows - np.round(rows)) <= ROUNDING
    if not np.all(whole & (np.round(rows) >= 0)) or np.any(np.round(rows).sum(axis=1) != 1):
        raise _refused(f"the gains {rows[rows != 0].tolist()}")
    return tuple(int(i) for i in touched)


def _refused(got: str) -> ValueError:
    expected = "gain 1 on circular outputs (behind any other, send sine and cosine, which are no angles)"
    return fail("channel", expected, got)
