"""One setting of a rule from several drives: the one that gives their true places the largest mean log density."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

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
    """Along a drive: place (slots, 2) and covariance, innovation, its variance and weight (slots, anchors)."""

    place: Any
    covariance: Any
    innovation: Any
    variance: Any
    weight: Any


def followed(rule: str, numbers: Any, anchors: Any, start: Any, z: Any, u: Any) -> Followed:
    """Estimates of a rule after each slot: of several sizes of error the mixture, each as likely as its past ranges.

    Source: Magill, Optimal adaptive estimation of sampled stochastic processes (1965), for the mixture.
    """
    parts = [_single(rule, item, anchors, start, z, u) for item in versions(rule, numbers)]
    likelihood = jnp.stack([jnp.cumsum(part[-1]) for part in parts])
    share = jax.nn.softmax(likelihood, axis=0)
    every = [jnp.stack(values) for values in zip(*(part[:-1] for part in parts), strict=True)]

    def mixed(values: jax.Array) -> jax.Array:
        return jnp.einsum("kt,kt...->t...", share, values)

    means, covariances, *others = every
    mean = mixed(means)
    apart = means - mean
    covariance = mixed(covariances + apart[..., :, None] * apart[..., None, :])
    return Followed(mean, covariance, *(mixed(values) for values in others))


def _single(rule: str, numbers: Numbers, anchors: Any, start: Any, z: Any, u: Any) -> tuple[Any, ...]:
    item = filter_of(rule, numbers, anchors, start)
    frame = numbers.frame**2 * jnp.eye(2)

    def step(state: Any, row: Any) -> tuple[Any, Any]:
        after, said = item.correct(item.predict(state, row[1]), row[0])
        weight = jnp.where(jnp.isnan(row[0]), jnp.nan, 1.0) if said.weight is None else said.weight
        size = jnp.diagonal(said.covariance)
        return after, (after.mean[:2], after.covariance[:2, :2] + frame, said.value, size, weight, said.log_likelihood)

    result: tuple[Any, ...] = jax.lax.scan(step, item.init(), (z, u))[1]
    return result


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


def numbers_of(rule: str, line: Any) -> Any:
    """The way back: all numbers as an array."""
    values: dict[str, Any] = {}
    for name, x in zip(FREE[rule], line, strict=True):
        if name in ("late", "excess"):
            values[name] = x * (LATENESS if name == "late" else LEVEL)
        else:
            values[name] = jax.nn.sigmoid(x) if name == "first" and rule in SHARES else jnp.exp(x)
    return jnp.stack([jnp.asarray(values.get(name, start)) for name, start in STARTS[rule]._asdict().items()])


class Padded(NamedTuple):
    """Drives side by side, short ones ending in slots in which nothing arrives.

    z (drives, slots, anchors), u, time, which slots count, anchors, starts, and the reference's time and places.
    """

    z: np.ndarray
    u: np.ndarray
    time: np.ndarray
    used: np.ndarray
    anchors: np.ndarray
    start: np.ndarray
    truth_time: np.ndarray
    truth: np.ndarray


def padded(drives: Sequence[Drive]) -> Padded:
    """The drives of one number of slots."""
    parts = []
    read = [slots(drive) for drive in drives]
    most = -(-max(len(part.time) for part in read) // ROWS) * ROWS
    points = max(len(drive.truth_time) for drive in drives)
    for drive, (time, z, u) in zip(drives, read, strict=True):
        more, later = (0, most - len(time)), (0, points - len(drive.truth_time))
        used = np.pad((time >= drive.window[0]) & (time <= drive.window[1]), more)
        parts.append(
            Padded(
                np.pad(z, (more, (0, 0)), constant_values=np.nan), np.pad(u, (more, (0, 0))),
                np.pad(time, more, mode="edge"), used, drive.places, drive.truth[0, :2],
                np.pad(drive.truth_time, later, mode="edge"),
                np.pad(drive.truth[:, :2], (later, (0, 0)), mode="edge"),
            )
        )  # fmt: skip
    return Padded(*(np.stack(values) for values in zip(*parts, strict=True)))


def density(rule: str, line: Any, data: Padded) -> Any:
    """Mean log density of one drive's true places, the stamps' lateness before each slot."""
    numbers = numbers_of(rule, line)
    result = followed(rule, numbers, data.anchors, data.start, data.z, data.u)
    time = data.time - numbers[Numbers._fields.index("late")]
    true = jnp.stack([jnp.interp(time, data.truth_time, data.truth[:, i]) for i in (0, 1)], axis=1)
    e = true - result.place
    a, b, d = result.covariance[:, 0, 0], result.covariance[:, 0, 1], result.covariance[:, 1, 1]
    area = a * d - b * b
    squared = (d * e[:, 0] ** 2 - 2 * b * e[:, 0] * e[:, 1] + a * e[:, 1] ** 2) / area
    logs = -(squared + jnp.log(area)) / 2 - np.log(2 * np.pi)
    return jnp.sum(jnp.where(data.used, logs, 0.0)) / jnp.sum(data.used)


@partial(jax.jit, static_argnums=0)
def objective(rule: str, lines: Any, data: Padded) -> Any:
    """Minus the mean of the drives' densities, at several sets of numbers side by side."""
    of_drives = jax.vmap(density, (None, None, 0))
    return -jnp.mean(jax.vmap(lambda line: of_drives(rule, line, data))(lines), axis=1)


def learn(rule: str, drives: Sequence[Drive], iterations: int, progress: Callable[[], None] = lambda: None) -> Numbers:
    """The numbers of a rule that these drives teach together; the starting numbers where there is none."""
    if not iterations or not drives:
        return STARTS[rule]
    data = padded(drives)
    start = line_of(rule, STARTS[rule])

    def evaluate(line: np.ndarray) -> tuple[float, np.ndarray]:
        # Central differences, all sets of numbers in one pass: far less than a sweep back through thousands of slots.
        moved = [line, *(line + sign * row for sign in (STEP, -STEP) for row in np.eye(len(line)))]
        with jax.enable_x64(True):
            value, *sides = np.asarray(objective(rule, np.stack(moved), data))
        slopes = np.subtract(*np.split(np.array(sides), 2)) / (2 * STEP)
        progress()
        if not np.isfinite(value) or not np.all(np.isfinite(slopes)):
            return REFUSED, np.zeros_like(line)
        # What was known before counts as errors of a single drive do.
        away = (line - start) / SPREAD
        weight = 1 / (INDEPENDENT * len(drives))
        return float(value) + weight * float(away @ away) / 2, slopes + weight * away / SPREAD

    result = minimize(evaluate, start, jac=True, method="L-BFGS-B", options={"maxiter": iterations})
    with jax.enable_x64(True):
        return Numbers(*np.asarray(numbers_of(rule, result.x)).tolist())
