"""The example's plants and links: a gain of two levels in bursts, and two hops whose gains drift."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed, fail, scalar

NOISE = 0.05
POWER = 0.04 / (1 - 0.98**2)  # E x^2 of the plant, where it starts
PLANT = hg.LinearPlant([[0.98]], [[0.04]], [0.0], [[POWER]])
SENSOR = hg.LinearSensor([[1.0]], NOISE)
TWO_SENSORS = hg.LinearSensor([[1.0], [1.0]], NOISE * np.eye(2))
DRIFTING_PLANT = hg.LinearPlant([[0.98, 0.1], [0.0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
DRIFTING_SENSOR = hg.LinearSensor([[1.0, 0.0]], NOISE)
CLASSES = np.array([[0.8, 0.2], [0.2, 0.8]])  # P(class of the signal's strength | mode)


@dataclass(frozen=True)
class Setting:
    """A link of two modes, bad and good, and how much is simulated.

    gains: of each mode. leaving: probability of leaving it at a step. arrival: of a packet in it, where losses are
    side information. particle_runs: of the particle filters, which cost more.
    """

    gains: tuple[float, float] = (0.2, 1.0)
    leaving: tuple[float, float] = (0.05, 0.03)
    arrival: tuple[float, float] = (0.5, 0.95)
    runs: int = 2048
    particle_runs: int = 128
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("gains", "leaving", "arrival"):
            for value in getattr(self, name):
                scalar(name, value, *((0.0, 1.0) if name != "gains" else ()))
        if min(self.leaving) <= 0:
            raise fail("leaving", "probabilities above 0", self.leaving)
        check_count("runs", self.runs, 8)  # a quarter of them where there is side information
        check_count("particle_runs", self.particle_runs, 2)
        check_seed("seed", self.seed)


def bursts(setting: Setting, correlation: float | None = None, name: str | None = None) -> hg.random_affine.Modes:
    """A link whose gain stays at one of two levels for a while; the same law with another correlation over a step."""
    bad, good = setting.leaving
    transition = np.array([[1 - bad, bad], [good, 1 - good]])
    if correlation is not None:
        law = np.array([good, bad]) / (bad + good)
        transition = correlation * np.eye(2) + (1 - correlation) * law
    return hg.markov_fading(setting.gains, transition, NOISE, name=name)


def lossy(setting: Setting) -> hg.random_affine.Modes:
    """The same link; packets arrive less often while it is bad, and the receiver knows of each whether it did."""
    modes = zip(setting.gains, setting.arrival, strict=True)
    return hg.markov_fading(
        [hg.erasure(hg.hop(gain, NOISE), arrival) for gain, arrival in modes], bursts(setting).memory
    )


def drifting() -> hg.random_affine.AbstractRandomAffine:
    """Two hops whose gains drift."""
    first, second = ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9))
    return hg.amplify_and_forward([hg.model.autoregressive_fading(*hop, NOISE) for hop in (first, second)])
