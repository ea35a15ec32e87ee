"""Error and powers of a network by the numbers that it is a function of, and their derivatives."""

from typing import NamedTuple

import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.check import instance
from heliograph.numerics.types import Float
from heliograph.planning.criterion import Error
from heliograph.planning.followed import Followed, Slopes, programs
from heliograph.planning.free_numbers import YOUNG, Build, Numbers, Vector, scalars_of_young
from heliograph.planning.hearing import means_are_known
from heliograph.planning.measuring import check_time, transmitters_of, worlds_of
from heliograph.planning.modes_told import Measured, Settled, settled
from heliograph.planning.state_power import check_stable
from heliograph.planning.weighing import Weighing, weighing
from heliograph.simulation.network import Network


class Point(NamedTuple):
    """What is known at some numbers."""

    measured: Measured
    settled: Settled
    slopes: Slopes
    weighing: Weighing

    @property
    def covariances(self) -> Float[np.ndarray, "time n n"]:
        """Of the error after each step."""
        return np.asarray(self.settled.parts.sum(axis=1))

    @property
    def error(self) -> float:
        """As it is made small: smoothed where it is an eigenvalue."""
        return self.weighing.smooth(self.covariances)[0]

    @property
    def powers(self) -> Float[np.ndarray, "time hops"]:
        """What each transmitter sends."""
        return np.asarray(self.measured.powers)


class Problem:
    """A network that is a function of numbers, each point computed once."""

    def __init__(self, build: Build, numbers: Numbers, error: Error):
        self.build, self.numbers, self.asked, self.young = build, numbers, error, False
        network = self.network(numbers.start)
        check_time(network, error)
        if not all(means_are_known(name, first(one.channel)) for name, one in worlds_of(network).items()):
            self.young, self.numbers = True, Numbers(numbers.each | {YOUNG: scalars_of_young(error.steps)})
        self.names, self.weighing = transmitters_of(network), weighing(error, error.matrix(network.states))
        self._measured, self._slopes = programs(Followed(build, self.numbers, error, self.young, network))
        self._last: dict[tuple[bytes, int | None], Point] = {}

    def network(self, x: Vector) -> Network:
        """The network at these numbers."""
        named = self.numbers.named(x).items()
        values = {name: float(v) if np.ndim(v) == 0 else v for name, v in named if name != YOUNG}
        with jax.enable_x64(True):
            return instance("network of free numbers", self.build(**values), Network, "a Network")

    def at(self, x: Vector, weighing: Weighing | None = None) -> Point:
        """Everything at a point, of an eigenvalue as sharp as the weighing has it.

        Raises:
            ValueError: an error that grows without limit, powers that do.
        """
        weigh = self.weighing if weighing is None else weighing
        key = x.tobytes(), weigh.sharpness
        if key not in self._last:
            known = Measured(*(None if part is None else np.asarray(part) for part in self._measured(np.asarray(x))))
            if known.start is None:
                scale = np.sqrt(1 + np.ravel(self.numbers.named(x)[YOUNG])[0]) if self.young else 1.0
                check_stable(known.transition[0] / scale)
            fixed = settled(known, weigh)
            slopes = Slopes(*(np.asarray(part) for part in self._slopes(np.asarray(x), fixed)))
            self._last = {key: Point(known, fixed, slopes, weigh)}
        return self._last[key]
