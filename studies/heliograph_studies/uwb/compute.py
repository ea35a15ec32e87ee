"""What every rule makes of every drive, each with numbers that the other drives taught."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

import heliograph as hg
from heliograph.filters import InnovationSummary, Weighed
from heliograph_studies import Stages, Unlisted
from heliograph_studies.uwb.drives import Drive, drives
from heliograph_studies.uwb.learning import followed, learn, padded, slots, true_places
from heliograph_studies.uwb.setting import BEST, HEIGHT, STARTS, Numbers, Setting

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
    x, y = (np.interp(time, drive.truth_time, drive.truth[:, i]) for i in (0, 1))
    place = np.column_stack([x, y])
    # Distances of the true places, and the power of each range beside them.
    apart = np.column_stack([place, np.full(len(place), HEIGHT)])[:, None] - drive.places
    distance = np.linalg.norm(apart, axis=2)
    rssi = np.full(ranges.shape, np.nan)
    row = np.searchsorted(time, drive.time).clip(max=len(time) - 1)
    rssi[row, drive.anchor] = drive.power
    rssi[(distance < NEAR) | np.isnan(ranges)] = np.nan
    rows = slice(None, None, EVERY)
    fitted = hg.fit(_power_network(len(drive.places)), rssi[rows], -10 * np.log10(distance[rows]), starts=1)
    by_name = {item.name: item for item in fitted.table}
    exponent = by_name["exponent"]
    return Power(
        by_name["level"].estimate, exponent.estimate, exponent.low, exponent.high,
        float(np.sqrt(by_name["variance"].estimate)),
    )  # fmt: skip


@cache
def _power_network(count: int) -> Callable[[], hg.Network]:
    """Level and exponent as free numbers of a sensor whose input is -10 log10(distance); one for all drives."""

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

    return network


@dataclass(frozen=True)
class Published:
    """Published RMS errors in the plane, m: least squares, and an error-state filter with inertial data; None: none."""

    ls: float | None
    eskf: float | None


@dataclass(frozen=True)
class Rule:
    """A rule on one drive within the published window.

    rmse: of the place in the plane at the time that the range is of, m. nees: per dimension; 1 where the claim is
    right. at_stamp: RMSE of the place predicted to the stamp. numbers: what it was read with. The path, its covariance,
    its innovations and weights are for figures.
    """

    rmse: float
    nees: float
    at_stamp: float
    numbers: Numbers
    time: Unlisted[np.ndarray]
    place: Unlisted[np.ndarray]
    deviation: Unlisted[np.ndarray]
    error: Unlisted[np.ndarray]
    weight: Unlisted[np.ndarray]
    anchors: dict[str, InnovationSummary]
    blamed: list[str]


@dataclass(frozen=True)
class OfDrive:
    """One drive: rows, window (s), published errors, rules, losses and power, which drives taught, true path."""

    rows: int
    window: tuple[float, float]
    published: Published
    rules: dict[str, Rule]
    losses: Loss
    power: Power
    learned_from: list[str]
    truth: Unlisted[np.ndarray]
    places: Unlisted[np.ndarray]


@dataclass(frozen=True)
class Outcome:
    """The drives by name, and the mean NEES of each rule over them."""

    drives: dict[str, OfDrive]
    mean_nees: dict[str, float]


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Read the drives; learn each rule on all drives but one, and judge it on that one."""
    recorded = stages("reading the drives", partial(drives, Path(setting.recording)))
    results: dict[str, OfDrive] = {}
    for i, drive in enumerate(recorded):
        others = [other for other in recorded if other is not drive]
        work = partial(of_drive, drive, others, setting.iterations)
        results[drive.name] = stages("drives", work, done=i, total=len(recorded))
    mean = {rule: float(np.mean([d.rules[rule].nees for d in results.values()])) for rule in STARTS}
    return Outcome(results, mean)


def of_drive(drive: Drive, others: Sequence[Drive], iterations: int) -> OfDrive:
    """One drive, with numbers from the others alone."""
    rules = {rule: judged(rule, drive, learn(rule, others, iterations)) for rule in STARTS}
    learned_from = [other.name for other in others] if iterations else []
    return OfDrive(
        len(drive.time), drive.window, Published(*drive.published), rules, losses(drive), power(drive), learned_from,
        drive.truth[:, :2], drive.places,
    )  # fmt: skip


def judged(rule: str, drive: Drive, numbers: Numbers) -> Rule:
    """The rule's path against the reference, and what its innovations say of the anchors."""
    read = slots(drive)
    length = len(read.time)
    result = followed(rule, [numbers], padded([drive]))
    place, covariance, innovation, variance, weight, _ = (value[0, :length] for value in result)
    used = (read.time >= drive.window[0]) & (read.time <= drive.window[1])

    def off(time: np.ndarray, estimate: np.ndarray) -> np.ndarray:
        return np.asarray((estimate - true_places(drive, time))[used])

    # The place that a range is of lies before its stamp; the place at the stamp is predicted.
    error = off(read.time - numbers.late, place)
    ahead = place + numbers.late * np.gradient(place, np.maximum.accumulate(read.time), axis=0)
    squared = hg.nees(error, np.zeros_like(error), covariance[used])
    summaries = Weighed(innovation, variance, weight).summarise()
    return Rule(
        _rms(error), float(squared.mean() / 2), _rms(off(read.time, ahead)), numbers, read.time[used], place[used],
        np.sqrt(np.trace(covariance[used], axis1=1, axis2=2)), np.linalg.norm(error, axis=1), weight[used],
        dict(zip(drive.names, summaries, strict=True)),
        [drive.names[i] for i in InnovationSummary.find_outlying(summaries)],
    )  # fmt: skip


def _rms(error: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def best_of(drive: OfDrive) -> Rule:
    """The rule that the page is about."""
    return drive.rules[BEST]
