"""The radio of a drive: the law of its losses, and how the received power falls with distance."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.uwb.drives import Drive
from heliograph_studies.uwb.learning import slots
from heliograph_studies.uwb.setting import HEIGHT

PERIOD = 0.1  # s: each anchor is asked ten times a second
NEAR = 3.0  # m: closer, power is not a law of distance
EVERY = 20  # slots: power is fitted two seconds apart, where it is new


@dataclass(frozen=True)
class Loss:
    """Losses of all anchors: share, chain, what the chain says more than independent losses (nats), and by anchor."""

    packets: int
    loss: float
    good_to_bad: float
    bad_to_good: float
    chain_gain: float
    by_anchor: dict[str, float]
    best: str


@dataclass(frozen=True)
class Power:
    """RSSI = level - 10 exponent log10(distance / m): level in dBm, its deviation in dB, intervals of 95 %."""

    level: float
    exponent: float
    low: float
    high: float
    deviation: float


def fates(drive: Drive) -> list[np.ndarray]:
    """Of each anchor the slots from its first range to its last: 1 where none came."""
    result = []
    for i in range(len(drive.places)):
        steps = np.maximum(np.rint(np.diff(drive.time[drive.anchor == i]) / PERIOD).astype(int), 1)
        lost = np.ones(int(steps.sum()) + 1)
        lost[np.concatenate([[0], np.cumsum(steps)]).astype(int)] = 0.0
        result.append(lost)
    return result


def losses(drive: Drive) -> Loss:
    """The losses of a drive, learned from its gaps."""
    parts = fates(drive)
    learned = hg.learning.learn_losses(parts)
    chain, single = learned.laws["markov"], learned.laws["independent"]
    shares = chain.shares()
    gain = float(np.nansum(chain.log_likelihoods(parts)) - np.nansum(single.log_likelihoods(parts)))
    return Loss(
        learned.packets, learned.lost / learned.packets, float(shares["fail"].estimate),
        float(shares["recover"].estimate), gain,
        {name: float(part.mean()) for name, part in zip(drive.names, parts, strict=True)}, learned.best,
    )  # fmt: skip


def power(drive: Drive) -> Power:
    """The fading law of a drive's received power, by `fit`, over the reference's distances."""
    time, ranges, _ = slots(drive)
    place = np.column_stack([np.interp(time, drive.truth_time, drive.truth[:, i]) for i in (0, 1)])
    apart = np.column_stack([place, np.full(len(place), HEIGHT)])[:, None] - drive.places
    distance = np.linalg.norm(apart, axis=2)
    rssi = np.full(ranges.shape, np.nan)
    row = np.searchsorted(time, drive.time).clip(max=len(time) - 1)
    rssi[row, drive.anchor] = drive.power
    rssi[(distance < NEAR) | np.isnan(ranges)] = np.nan
    count = len(drive.places)

    def network() -> hg.Network:
        plant = hg.LinearPlant(
            np.zeros((count, count)), np.zeros((count, count)), np.zeros(count), np.zeros((count, count)), np.eye(count)
        )
        exponent, level = hg.free(1.0, "exponent"), hg.free(-75.0, "level")
        variance = hg.free(4.0, "variance")
        sensor = hg.LinearSensor(
            exponent * np.eye(count), hg.Gaussian(variance * np.eye(count), level * np.ones(count))
        )
        return hg.Network(plant, {"tag": hg.Node(sensor, hg.perfect(count), {})})

    rows = slice(None, None, EVERY)
    fitted = hg.fit(network, rssi[rows], -10 * np.log10(distance[rows]), starts=1)
    by_name = {item.name: item for item in fitted.table}
    exponent = by_name["exponent"]
    return Power(
        by_name["level"].estimate, exponent.estimate, exponent.low, exponent.high,
        float(np.sqrt(by_name["variance"].estimate)),
    )  # fmt: skip
