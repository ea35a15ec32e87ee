"""The example's links: one plant, one sensor received through a relay and directly, under four laws of the gain."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.learning.intervals import Method
from heliograph.learning.likelihood.objective import Form
from heliograph.numerics.check import check_count, check_seed

MEAN, VARIANCE = 0.8, 0.16
PLANT_NOISE, SENSOR_NOISE, HOP_NOISE, DIRECT_NOISE = 0.2, 0.3, 0.3, 0.2
ARRIVAL = 0.8  # observed
UNTOLD = 0.7
STEPS, SHORT = 2000, 500
PERIOD, LEVEL = 60, 0.4  # of the input, a square wave
FORMS: tuple[Form, ...] = ("linear", "conditional")
METHODS: tuple[Method, ...] = ("hessian", "white", "bartlett", "cosines")

RARE = 0.04  # probability of the large gain
RARE_STEP = np.sqrt(VARIANCE / (RARE * (1 - RARE)))  # how much larger it is
LOG_VARIANCE = np.log(1 + VARIANCE / MEAN**2)

LAWS: dict[str, hg.random_affine.AbstractLaw] = {
    "rayleigh": hg.Rayleigh(MEAN / np.sqrt(np.pi / 2)),
    "two_point": hg.Discrete([MEAN - 0.4, MEAN + 0.4], [0.5, 0.5]),
    "log_normal": hg.random_affine.LogNormal(np.log(MEAN) - LOG_VARIANCE / 2, np.sqrt(LOG_VARIANCE)),
    "rare": hg.Discrete([MEAN - RARE * RARE_STEP, MEAN + (1 - RARE) * RARE_STEP], [1 - RARE, RARE]),
}


@dataclass(frozen=True)
class Setting:
    """batches of `batch` recordings for each row of the table; relays: draws of the recorded drive's relays."""

    batches: int = 10
    batch: int = 64
    relays: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("batches", "batch", "relays"):
            check_count(name, getattr(self, name))
        check_seed("seed", self.seed)


class Row(NamedTuple):
    """One row of the table: what is recorded, how long, and which form of the likelihood is climbed."""

    name: str
    law: str
    form: Form
    steps: int
    driven: bool = True


ROWS = (
    *(Row(law, law, form, STEPS) for law in LAWS for form in FORMS),
    Row("rayleigh_short", "rayleigh", "linear", SHORT),
    Row("two_point_undriven", "two_point", "conditional", STEPS, driven=False),
    *(Row("uninformed", "uninformed", form, STEPS) for form in FORMS),
)


def square_wave(row: Row) -> np.ndarray:
    """The input of each step."""
    half = np.arange(row.steps) // (PERIOD // 2)
    return np.where(half % 2 == 0, LEVEL, -LEVEL)[:, None] * row.driven


def world(row: Row) -> hg.Network:
    """The network that is recorded."""
    if row.law == "uninformed":
        return unpublished(PLANT_NOISE, HOP_NOISE, UNTOLD)
    return relayed(LAWS[row.law], PLANT_NOISE, SENSOR_NOISE, HOP_NOISE)


def learned(row: Row) -> hg.Network:
    """What is learned of it."""
    plant_noise, hop_noise = hg.free(PLANT_NOISE, "plant_noise"), hg.free(HOP_NOISE, "hop_noise")
    if row.law == "uninformed":
        return unpublished(plant_noise, hop_noise, hg.free(UNTOLD, "arrival"))
    mean, variance = hg.free(MEAN, "mean_gain"), hg.free(true_values(row)["gain_variance"], "gain_variance", "positive")
    law = hg.random_affine.GivenMoments([mean, mean**2 + variance])
    return relayed(law, plant_noise, hg.free(SENSOR_NOISE, "sensor_noise"), hop_noise)


def true_values(row: Row) -> dict[str, float]:
    """What is to be covered, by name."""
    noises = {"plant_noise": PLANT_NOISE, "hop_noise": HOP_NOISE}
    if row.law == "uninformed":
        return {**noises, "arrival": UNTOLD}
    law = LAWS[row.law]
    variance = float(law.moment(2)) - float(law.moment(1)) ** 2
    return {**noises, "mean_gain": MEAN, "gain_variance": variance, "sensor_noise": SENSOR_NOISE}


def relayed(law: hg.random_affine.AbstractLaw, plant_noise: float, sensor_noise: float, hop_noise: float) -> hg.Network:
    """z1 = g y + n1 of which a part is lost and observed, z2 = y + n2 with n2 known."""
    hop = hg.erasure(hg.hop(law, hop_noise), ARRIVAL)
    return _network(plant_noise, sensor_noise, hg.model.with_direct_link(hop, hg.hop(1.0, DIRECT_NOISE)))


def unpublished(plant_noise: float, hop_noise: float, arrival: float) -> hg.Network:
    """Lost without a word, and then noise is added."""
    lossy = hg.dropout(hg.perfect(), arrival)
    return _network(plant_noise, 0.0, hg.amplify_and_forward([lossy, hg.hop(1.0, hop_noise)]))


def _network(plant_noise: float, sensor_noise: float, channel: hg.random_affine.AbstractRandomAffine) -> hg.Network:
    plant = hg.LinearPlant([[0.95]], plant_noise, [0.0], [[1.0]], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], sensor_noise), channel, {})})
