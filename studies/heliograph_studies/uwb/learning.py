"""One setting of a rule from several drives: the one that gives their true places the largest mean log density."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit

import heliograph as hg
from heliograph_studies.uwb.drives import Drive
from heliograph_studies.uwb.setting import FREE, SHARES, STARTS, Numbers, filter_of, versions

REFUSED = 1e6  # value of an objective that is no number
SPREAD = 0.3  # of the prior of a number's logarithm about its start
LATENESS, LEVEL = 0.1, 0.05  # s, m: the unit in which lateness and excess are learned, where others have logarithms
INDEPENDENT = 10  # errors of a drive that count as independent: they change over some ten seconds
STEP = 1e-3  # of differences of an objective of order 1
SLOT = 0.05  # s: rows nearer than this are one measurement of several anchors
ROWS = 256  # one compiled program serves every length up to the next multiple of it


class Slots(NamedTuple):
    """A drive as the filter reads it: time (slots,), ranges (slots, anchors), NaN where none, and time between."""

    time: np.ndarray
    ranges: np.ndarray
    dt: np.ndarray


def slots(drive: Drive) -> Slots:
    """Ranges of all anchors that come within 50 ms as one measurement, at the time of the last of them."""
    begin = np.concatenate([[True], np.diff(drive.time) > SLOT / 2])
    number = np.cumsum(begin) - 1
    twice = np.zeros(len(number), bool)  # a second range of one anchor in a slot is left out
    twice[1:] = (number[1:] == number[:-1]) & (drive.anchor[1:] == drive.anchor[:-1])
    ranges = np.full((number[-1] + 1, len(drive.places)), np.nan)
    ranges[number[~twice], drive.anchor[~twice]] = drive.distance[~twice]
    time = drive.time[np.concatenate([begin[1:], [True]])]
    return Slots(time, ranges, np.diff(time, prepend=time[0])[:, None])


class Followed(NamedTuple):
    """Along a drive: place (slots, 2) and covariance, innovation, its variance and weight (slots, anchors), density."""

    place: Any
    covariance: Any
    innovation: Any
    variance: Any
    weight: Any
    log_likelihood: Any


@cache
def single(rule: str) -> Callable[..., Followed]:
    """A rule's way along one drive: a function of numbers, anchors, start, ranges and times between slots."""

    def follow(values: Any, anchors: Any, start: Any, z: Any, u: Any) -> Followed:
        numbers = Numbers(*values)
        item = filter_of(rule, numbers, anchors, start)
        frame = numbers.frame**2 * jnp.eye(2)

        def step(state: Any, row: Any) -> tuple[Any, Followed]:
            after, said = item.correct(item.predict(state, row[1]), row[0])
            weight = jnp.where(jnp.isnan(row[0]), jnp.nan, 1.0) if said.weight is None else said.weight
            size = jnp.diagonal(said.covariance)
            covariance = after.covariance[:2, :2] + frame
            return after, Followed(after.mean[:2], covariance, said.value, size, weight, said.log_likelihood)

        result: Followed = jax.lax.scan(step, item.init(), (z, u))[1]
        return result

    return follow


def followed(rule: str, numbers: Sequence[Numbers], data: "Padded") -> Followed:
    """Estimates after each slot of several runs: of several sizes of error the mixture, each as likely as its ranges.

    All runs and sizes go side by side through one program.

    Source: Magill, Optimal adaptive estimation of sampled stochastic processes (1965), for the mixture.
    """
    sized = [versions(rule, number) for number in numbers]
    runs, sizes = len(sized), len(sized[0])
    rows = [np.repeat(part, sizes, axis=0) for part in data]
    result = hg.simulation.over_runs(single(rule), np.reshape(sized, (runs * sizes, -1)), *rows)
    parts = Followed(*(value.reshape(runs, sizes, *value.shape[1:]) for value in result))
    # Each size is as likely as it made the ranges so far.
    likelihood = np.cumsum(parts.log_likelihood, axis=2)
    share = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
    share = share / share.sum(axis=1, keepdims=True)

    def mixed(values: np.ndarray) -> np.ndarray:
        return np.asarray(np.einsum("rkt,rkt...->rt...", share, values))

    mean = mixed(parts.place)
    apart = parts.place - mean[:, None]
    covariance = mixed(parts.covariance + apart[..., :, None] * apart[..., None, :])
    return Followed(mean, covariance, *(mixed(value) for value in parts[2:]))


def line_of(rule: str, numbers: Numbers) -> np.ndarray:
    """The numbers that are learned, on the whole line: logarithms, log odds of shares, lateness and excess in units."""
    line = []
    for name in FREE[rule]:
        value = getattr(numbers, name)
        if name in ("late", "excess"):
            line.append(value / (LATENESS if name == "late" else LEVEL))
        else:
            line.append(np.log(value / (1 - value)) if name == "first" and rule in SHARES else np.log(value))
    return np.array(line)


def numbers_of(rule: str, line: np.ndarray) -> Numbers:
    """The way back: all numbers."""
    values: dict[str, float] = {}
    for name, x in zip(FREE[rule], line, strict=True):
        if name in ("late", "excess"):
            values[name] = float(x * (LATENESS if name == "late" else LEVEL))
        else:
            values[name] = float(expit(x) if name == "first" and rule in SHARES else np.exp(x))
    return STARTS[rule]._replace(**values)


class Padded(NamedTuple):
    """Drives side by side, short ones ending in slots in which nothing arrives, and anchors of which nothing does.

    anchors, start, z (drives, slots, anchors), u, as `followed` takes them.
    """

    anchors: np.ndarray
    start: np.ndarray
    z: np.ndarray
    u: np.ndarray


def padded(drives: Sequence[Drive]) -> Padded:
    """The drives with one number of slots and of anchors."""
    read = [slots(drive) for drive in drives]
    most = -(-max(len(part.time) for part in read) // ROWS) * ROWS
    count = max(len(drive.places) for drive in drives)
    parts = []
    for drive, (time, z, u) in zip(drives, read, strict=True):
        later, more = (0, most - len(time)), (0, count - len(drive.places))
        parts.append(
            Padded(
                np.pad(drive.places, (more, (0, 0)), mode="edge"), drive.truth[0, :2],
                np.pad(z, (later, more), constant_values=np.nan), np.pad(u, (later, (0, 0))),
            )
        )  # fmt: skip
    return Padded(*(np.stack(values) for values in zip(*parts, strict=True)))


def true_places(drive: Drive, time: np.ndarray) -> np.ndarray:
    """The reference at these times, (times, 2)."""
    x, y = (np.interp(time, drive.truth_time, drive.truth[:, i]) for i in (0, 1))
    return np.column_stack([x, y])


def density(drive: Drive, late: float, place: np.ndarray, covariance: np.ndarray) -> float:
    """Mean log density of the true places within the window, the stamps' lateness before each slot."""
    time = slots(drive).time
    used = np.flatnonzero((time >= drive.window[0]) & (time <= drive.window[1]))
    squared = hg.nees(true_places(drive, time[used] - late), place[used], covariance[used])
    return float(np.mean(-(squared + np.log(np.linalg.det(covariance[used]))) / 2 - np.log(2 * np.pi)))


def learn(rule: str, drives: Sequence[Drive], iterations: int, progress: Callable[[], None] = lambda: None) -> Numbers:
    """The numbers of a rule that these drives teach together; the starting numbers where there is none."""
    if not iterations or not drives:
        return STARTS[rule]
    data, start = padded(drives), line_of(rule, STARTS[rule])

    def densities(lines: np.ndarray) -> np.ndarray:
        """Mean over the drives at each set of numbers, all side by side as runs of one program."""
        numbers = [numbers_of(rule, line) for line in lines]
        runs = Padded(*(np.concatenate([x] * len(lines)) for x in data))
        result = followed(rule, [number for number in numbers for _ in drives], runs)
        values = [
            density(drive, numbers[i].late, result.place[k], result.covariance[k])
            for i in range(len(lines))
            for k, drive in enumerate(drives, i * len(drives))
        ]
        return np.asarray(np.mean(np.reshape(values, (len(lines), len(drives))), axis=1))

    def evaluate(line: np.ndarray) -> tuple[float, np.ndarray]:
        moved = [line, *(line + sign * row for sign in (STEP, -STEP) for row in np.eye(len(line)))]
        value, *sides = -densities(np.stack(moved))
        slopes = np.subtract(*np.split(np.array(sides), 2)) / (2 * STEP)
        progress()
        if not np.isfinite(value) or not np.all(np.isfinite(slopes)):
            return REFUSED, np.zeros_like(line)
        # What was known before counts as errors of a single drive do.
        away = (line - start) / SPREAD
        weight = 1 / (INDEPENDENT * len(drives))
        return float(value) + weight * float(away @ away) / 2, slopes + weight * away / SPREAD

    result = minimize(evaluate, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    return numbers_of(rule, result.x)
