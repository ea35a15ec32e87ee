"""The examples: plants, sensors, and the links that lose and tell."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.numerics.check import fail
from heliograph_studies import check_fields

NODE, FILTER = "receiver", "informed"


@dataclass(frozen=True)
class Example:
    """x+ = A x + w, z = C x + v, Cov(w) = q I, Cov(v) = r I."""

    transition: np.ndarray
    output: np.ndarray
    process: float
    noise: float = 2.5

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
        return hg.LinearSensor(self.output, self.noise * np.eye(len(self.output)))

    def network(self, link: hg.random_affine.AbstractRandomAffine) -> hg.Network:
        """A receiver that knows what is lost, and skips it."""
        known = hg.kalman_filter(self.plant(), self.sensor())
        return hg.Network(self.plant(), {NODE: hg.Node(self.sensor(), link, {FILTER: known})})


def example(transition: list[list[float]], output: list[list[float]], process: float) -> Example:
    """An example from lists."""
    return Example(np.array(transition), np.array(output), process)


SCALAR = example([[-1.25]], [[1.0]], 1.0)
COUPLED = example([[1.25, 0.0], [1.0, 1.1]], [[1.0, 1.0]], 20.0)
ONE_UNSTABLE = example([[1.25, 1.0, 0.0], [0.0, 0.9, 7.0], [0.0, 0.0, 0.6]], [[1.0, 0.0, 2.0]], 20.0)
COMPONENTS = example([[2.5, 0.0], [0.0, 1.5]], [[1.0, 0.0], [0.0, 1.0]], 1.0)
TURNING = example([[0.0, -1.3], [1.3, 0.0]], [[1.0, 0.0]], 1.0)


@dataclass(frozen=True)
class Setting:
    """The examples, and how closely they are looked at.

    arrival: of packets in the three main examples. between: an arrival between the two conditions of the coupled plant.
    bursts: (fail, recover) of links whose losses come in bursts; the last forgets. begin: steps of a run before E P has
    come to rest. patterns: steps over which all patterns of losses are listed. iterations: of the modified Riccati
    equation. points: of a curve. digits: of a threshold that is searched. turning: shows each state every other step.
    """

    runs: int = 4000
    seed: int = 0
    arrival: float = 0.6
    between: float = 0.42
    bursts: tuple[tuple[float, float], ...] = ((0.1, 0.6), (0.3, 0.6), (0.1, 0.9), (0.4, 0.6))
    horizon: int = 100
    begin: int = 50
    patterns: int = 17
    iterations: int = 150
    points: int = 36
    digits: float = 1e-7
    scalar: Example = SCALAR
    coupled: Example = COUPLED
    one_unstable: Example = ONE_UNSTABLE
    components: Example = COMPONENTS
    turning: Example = TURNING

    def __post_init__(self) -> None:
        check_fields(self, runs=100, horizon=2, patterns=4, iterations=4, points=2)
        check_fields(self, arrival=(0.0, 1.0), between=(0.0, 1.0), digits=(1e-12, 0.1))
        if not 0 <= self.begin < self.horizon:
            raise fail("begin", f"a step from 0 to {self.horizon - 1}", self.begin)
        for name in ("scalar", "coupled", "components", "turning"):
            if (size := largest(getattr(self, name))) <= 1:
                raise fail(f"{name}.transition", "an unstable plant", f"eigenvalues up to {size:g}")

    @property
    def examples(self) -> dict[str, Example]:
        """All examples by name."""
        names = ("scalar", "coupled", "one_unstable", "components", "turning")
        return {name: getattr(self, name) for name in names}


def largest(example: Example) -> float:
    """The largest modulus of an eigenvalue."""
    return float(np.abs(np.linalg.eigvals(example.transition)).max())


def threshold(factor: float) -> float:
    """1 - 1/a^2: the arrivals that a scalar plant needs whose state grows by this factor a step."""
    return float(1 - abs(factor) ** -2)


def lossy(arrival: float, outputs: int = 1) -> hg.random_affine.AbstractRandomAffine:
    """A packet arrives with this probability, independently at each step."""
    return hg.erasure(hg.perfect(outputs), arrival)


def bursts(fail: float, recover: float) -> hg.random_affine.AbstractRandomAffine:
    """Arrivals fail and losses end with these probabilities: a chain of two modes, which the losses tell."""
    return hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.0), fail, recover)
