"""The house: ten rooms that warm and cool at their own pace, and sensors that report on change."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.numerics.check import TINY, check_count, check_seed, scalar

ROOMS = ("hall", "kitchen", "living room", "study", "bedroom", "nursery", "bath", "attic", "cellar", "garage")


@dataclass(frozen=True)
class Setting:
    """Sensors that measure each minute and report on change, over a link that fails for a while at a time.

    delta: change in kelvin that is reported; heartbeat: minutes after which a sensor reports in any case. noise: of a
    sensor, a deviation in kelvin. fail, recover: of the link, at each minute; it loses all while it is down. hours: of
    each run.
    """

    delta: float = 0.5
    heartbeat: int = 120
    noise: float = 0.1
    fail: float = 0.02
    recover: float = 0.1
    hours: int = 12
    runs: int = 32
    seed: int = 0

    def __post_init__(self) -> None:
        scalar("delta", self.delta, TINY)
        scalar("noise", self.noise, TINY)
        for name in ("fail", "recover"):
            scalar(name, getattr(self, name), TINY, 1.0)
        for name, least in (("heartbeat", 1), ("hours", 1), ("runs", 2)):
            check_count(name, getattr(self, name), least)
        check_seed("seed", self.seed)

    @property
    def trigger(self) -> hg.SendOnDelta:
        """When a sensor reports."""
        return hg.SendOnDelta(self.delta, heartbeat=self.heartbeat)

    @property
    def link(self) -> hg.random_affine.Modes:
        """What is between a sensor and the house's computer."""
        up, down = (hg.erasure(hg.perfect(), arrival) for arrival in (1.0, 0.0))
        return hg.gilbert_elliott(up, down, self.fail, self.recover)

    @property
    def sensor(self) -> hg.LinearSensor:
        """A thermometer."""
        return hg.LinearSensor([[1.0]], self.noise**2, outputs=["temperature"])


def rooms() -> dict[str, hg.LinearPlant]:
    """Temperatures about their mean: from half an hour to five hours to follow, deviations of 0.9 to 1.8 K."""
    minutes, deviations = np.geomspace(30, 300, len(ROOMS)), np.linspace(0.9, 1.8, len(ROOMS))
    results = {}
    for name, time, deviation in zip(ROOMS, minutes, deviations, strict=True):
        a, variance = np.exp(-1 / time), deviation**2
        noise = variance * (1 - a * a)
        results[name] = hg.LinearPlant([[a]], [[noise]], [0.0], [[variance]], states=["temperature"])
    return results
