"""The angles that a filter uses."""

from typing import NamedTuple

from heliograph.numerics.angle import Angles


class FilterAngles(NamedTuple):
    """Places of the angles among a filter's states, and among the numbers that it receives."""

    states: Angles
    received: Angles
