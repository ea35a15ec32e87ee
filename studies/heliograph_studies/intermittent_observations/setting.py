"""The examples: plants, sensors, and the links that lose and tell."""

from typing import NamedTuple

import numpy as np

import heliograph as hg

NODE, FILTER = "receiver", "told"
ARRIVAL = 0.6
NOISE = 2.5  # of every sensor


class Example(NamedTuple):
    """x+ = A x + w, z = C x + v, Cov(w) = q I, Cov(v) = 2.5 I."""

    transition: np.ndarray
    output: np.ndarray
    process: float

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.transition)

    def plant(self) -> hg.LinearPlant:
        """The plant, started at what one step of noise leaves."""
        q = self.process * np.eye(self.states)
        return hg.LinearPlant(self.transition, q, np.zeros(self.states), q)

    def sensor(self) -> hg.LinearSensor:
        """All outputs in one packet."""
        return hg.LinearSensor(self.output, NOISE * np.eye(len(self.output)))

    def network(self, link: hg.random_affine.AbstractRandomAffine) -> hg.Network:
        """A receiver that is told what is lost, and skips it."""
        told = hg.kalman_filter(self.plant(), self.sensor())
        return hg.Network(self.plant(), {NODE: hg.Node(self.sensor(), link, {FILTER: told})})


def example(transition: list[list[float]], output: list[list[float]], process: float) -> Example:
    """An example from lists."""
    return Example(np.array(transition), np.array(output), process)


SCALAR = example([[-1.25]], [[1.0]], 1.0)
COUPLED = example([[1.25, 0.0], [1.0, 1.1]], [[1.0, 1.0]], 20.0)
ONE_UNSTABLE = example([[1.25, 1.0, 0.0], [0.0, 0.9, 7.0], [0.0, 0.0, 0.6]], [[1.0, 0.0, 2.0]], 20.0)
COMPONENTS = example([[2.5, 0.0], [0.0, 1.5]], [[1.0, 0.0], [0.0, 1.0]], 1.0)
TURNING = example([[0.0, -1.3], [1.3, 0.0]], [[1.0, 0.0]], 1.0)  # shows each state every other step

BURSTS = ((0.1, 0.6), (0.3, 0.6), (0.1, 0.9), (0.4, 0.6))  # (fail, recover); the last forgets
BETWEEN = 0.42  # an arrival between the two conditions of the coupled plant


def lossy(arrival: float, outputs: int = 1) -> hg.random_affine.AbstractRandomAffine:
    """A packet arrives with this probability, independently at each step."""
    return hg.erasure(hg.perfect(outputs), arrival)


def bursts(fail: float, recover: float) -> hg.random_affine.AbstractRandomAffine:
    """Arrivals fail and losses end with these probabilities: a chain of two modes, which the losses tell."""
    return hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.0), fail, recover)
