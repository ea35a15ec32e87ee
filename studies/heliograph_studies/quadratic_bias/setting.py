"""Section 4's example as printed, and a scenario of ours with outages and rare shocks, as heliograph models."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.model import OverTime, over_time, with_bias
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail
from heliograph.random_affine import FiniteSupport, GainAndNoise, Independent, Shaped
from heliograph_studies import check_fields

C, D = np.array([[0.2, 0.18]]), np.array([[0.01]])
B = np.array([[0.05], [0.1]])
F = np.array([[0.1, 0.0], [0.1, 0.2]])
INITIAL_VARIANCE = 0.01
SENSOR_GAIN = (1.0, 1.5, 2.0), (0.1, 0.3, 0.6)  # l_t and its probabilities; the gain is its root
RELAY_GAIN = (1.0, 1.1, 1.2), (0.2, 0.4, 0.4)  # m_t, printed 'l_t' for its last value

TABLE_1 = {  # second, third and fourth moments as printed, rounded to four digits
    "w": (1.0, 0.0, 1.0), "v": (0.9100, -0.5460, 1.1557),
    "eps1": (0.9600, 0.3840, 1.0752), "eps2": (0.1875, -0.0938, 0.0820),
    "xi1": (0.7500, -0.7500, 1.3125), "xi2": (0.3750, -0.0938, 0.1641),
    "varpi": (0.3600, -0.5760, 1.0512), "sigma": (0.2100, -0.0840, 0.0777),
}  # fmt: skip


class Model(NamedTuple):
    """A plant with a bias, its sensor and channel, how long it runs, and the first step whose errors are averaged."""

    plant: AnyPlant
    sensor: AnySensor
    channel: Channel
    horizon: int
    begin: int

    @property
    def states(self) -> tuple[str, ...]:
        """Names of state and bias."""
        names: tuple[str, ...] = first(self.plant).states
        return names


@dataclass(frozen=True)
class TwoValues:
    """A law: the value `first` with probability `chance`, else `second`."""

    first: float
    second: float
    chance: float

    def law(self, mean: float = 0.0) -> FiniteSupport:
        """The law, moved by `mean`."""
        return FiniteSupport([[self.first + mean], [self.second + mean]], [self.chance, 1 - self.chance])


@dataclass(frozen=True)
class Noises:
    """Laws of all noises of Section 4, each of mean zero; `mean` is added to that of the receiver, sigma."""

    mean: float = 0.0
    w: TwoValues = TwoValues(-1.0, 1.0, 0.5)
    v: TwoValues = TwoValues(0.7, -1.3, 0.65)
    eps1: TwoValues = TwoValues(-0.8, 1.2, 0.6)
    eps2: TwoValues = TwoValues(-0.75, 0.25, 0.25)
    xi1: TwoValues = TwoValues(-1.5, 0.5, 0.25)
    xi2: TwoValues = TwoValues(-0.75, 0.5, 0.4)
    varpi: TwoValues = TwoValues(-1.8, 0.2, 0.1)
    sigma: TwoValues = TwoValues(-0.7, 0.3, 0.3)


@dataclass(frozen=True)
class Outages:
    """Our scenario: both transmitters are off at random, and a shock is rare and large."""

    horizon: int = 150
    begin: int = 100
    sensor_off: float = 0.7
    relay_off: float = 0.3
    shock_probability: float = 0.005  # one large shock in 200 steps


@dataclass(frozen=True)
class Setting:
    """The publication's example and our scenario; errors are averaged from library step `begin` on, t = begin + 1.

    plant, sensor, channel: others in the place of (1) to (7), for a state of two numbers and a bias of two.
    """

    runs: int = 20_000
    seed: int = 0
    horizon: int = 100
    begin: int = 30
    theta: float = 3.0
    noise: Noises = Noises()
    outages: Outages = Outages()
    plant: AnyPlant | None = None
    sensor: AnySensor | None = None
    channel: Channel | None = None

    def __post_init__(self) -> None:
        check_fields(self, runs=100)  # standard errors come from batches of runs
        for name, part in (("", self), ("outages.", self.outages)):
            check_count(f"{name}horizon", part.horizon, 8)
            if not 0 <= part.begin < part.horizon:
                raise fail(f"{name}begin", f"a step from 0 to {part.horizon - 1}", part.begin)
        if self.plant is not None and len(first(self.plant).states) != 4:
            raise fail("plant", "two states and a bias of two numbers", f"{len(first(self.plant).states)} in all")

    def example(self) -> Model:
        """Section 4."""
        parts = self.plant or plant(self.horizon, self.noise), self.sensor or sensor(self.noise)
        return Model(*parts, self.channel or channel(self.theta, self.noise), self.horizon, self.begin)

    def outage(self) -> Model:
        """Our scenario."""
        return Model(*outage_parts(self.outages), self.outages.horizon, self.outages.begin)


def plant(horizon: int, noise: Noises) -> OverTime:
    """State (x1, x2) and bias (eps1, eps2), (1) and (2), over `horizon` steps from t = 0."""
    drive, start = (Independent([law.law() for law in pair]) for pair in
                    ((noise.xi1, noise.xi2), (noise.eps1, noise.eps2)))  # fmt: skip
    bias = hg.LinearPlant(F, drive, np.zeros(2), start, states=("eps1", "eps2"))
    shaped = Shaped(B, noise.w.law())

    def at_time(t: int) -> AbstractPlant:
        matrix = [[0.6, 0.5], [-0.1 * np.sin(0.2 * t), 0.8]]
        coupling = [[0.1, 0.0], [0.03 * np.cos(0.2 * t), 0.15]]
        state = hg.LinearPlant(matrix, shaped, np.zeros(2), INITIAL_VARIANCE * np.eye(2), states=("x1", "x2"))
        return with_bias(state, hg.LinearSensor(C, 0.0), bias, coupling=coupling)[0]

    return over_time([at_time(t) for t in range(horizon)])


def sensor(noise: Noises) -> hg.LinearSensor:
    """y = C x + D v, (3)."""
    return hg.LinearSensor(np.concatenate([C, np.zeros((1, 2))], axis=1), Shaped(D, noise.v.law()))


def channel(theta: float, noise: Noises) -> Channel:
    """z = theta sqrt(m) (sqrt(l) y + varpi) + sigma, (5) to (7)."""
    first_gain, second_gain = (hg.Discrete(np.sqrt(values), chances) for values, chances in (SENSOR_GAIN, RELAY_GAIN))
    return hg.amplify_and_forward(
        [
            GainAndNoise(first_gain, np.eye(1), noise.varpi.law()),
            GainAndNoise(second_gain, theta * np.eye(1), noise.sigma.law(noise.mean)),
        ]
    )


def shock(size: float, probability: float) -> FiniteSupport:
    """Mean zero: far from zero with a small probability, near it else."""
    return TwoValues(size * (1 - probability), -size * probability, probability).law()


def outage_parts(outages: Outages) -> tuple[AnyPlant, AnySensor, Channel]:
    """x+ = 0.9 x + 0.3 bias + w with rare large shocks w, bias+ = 0.8 bias + xi; y = x + v; two links that are off."""
    drive, start = TwoValues(-0.1, 0.1, 0.5).law(), TwoValues(-0.3, 0.3, 0.5).law()
    bias = hg.LinearPlant([[0.8]], drive, [0.0], start, states=("bias",))
    noise = shock(outages.shock_probability**-0.5, outages.shock_probability)
    state = hg.LinearPlant([[0.9]], noise, [0.0], TwoValues(-1.0, 1.0, 0.5).law(), states=("x",))
    hops = [
        GainAndNoise(hg.Discrete([0.0, 1.0], [off, 1 - off]), np.eye(1), shock(1.0, 0.1))
        for off in (outages.sensor_off, outages.relay_off)
    ]
    return *with_bias(state, hg.LinearSensor([[1.0]], shock(1.0, 0.1)), bias, coupling=[[0.3]]), hg.amplify_and_forward(
        hops
    )
