"""Error and powers of a network by the numbers that it is a function of, and their derivatives."""

from typing import NamedTuple

import jax
import numpy as np

from heliograph.model.over_time import first
from heliograph.numerics.check import InputError, fail, instance
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

INSIDE = 1e-9  # of the way from an end to the start


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

    def check_ends(self) -> None:
        """Raise ValueError where a number near an end of its own, the others at their starts, makes no network.

        An end itself may be one that is never reached, as a noise of variance zero.
        """
        starts = {name: one.start for name, one in self.numbers.each.items()}
        for name, (start, low, high) in self.numbers.each.items():
            for end in (low, high):
                near = np.where(np.isfinite(end), end, start)
                near = near + INSIDE * (start - near)
                values = {other: near if other == name else begin for other, begin in starts.items()}
                try:
                    self.network(np.concatenate([part.ravel() for part in values.values()]))
                except InputError as error:
                    what = f"{' '.join(str(end).split())}, where: {error}"
                    raise fail(f"ends of {name!r}", "numbers between which there is a network", what) from None

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
