"""Which of a filter's states, and of the numbers that it receives, are angles."""

from typing import NamedTuple

from heliograph.numerics.angles.angle import Angles


class FilterAngles(NamedTuple):
    """Indices of the angles among a filter's states, and among the numbers that it receives."""

    states: Angles
    received: Angles
