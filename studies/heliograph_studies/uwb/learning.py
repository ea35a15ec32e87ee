"""One setting of a rule from several drives: the one that gives their true places the largest mean log density."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from heliograph_studies.uwb.drives import Drive
from heliograph_studies.uwb.setting import FREE, SHARES, STARTS, Numbers, filter_of

REACH = 8.0  # of the logarithm of a number from where learning starts; of the lateness, in s, a hundredth of it
REFUSED = 1e6  # what an objective that is no number counts
SPREAD = 0.3  # of the logarithm of a number before any drive, about where learning starts
INDEPENDENT = 10  # errors of a drive that count as independent: they change over some ten seconds
STEP = 1e-4  # of differences of an objective of order 1, good to 1e-8
LONGEST = 8103.0  # s: a time beyond which a bias is constant over a drive
ROWS = 512  # what is compiled serves every length up to the next multiple of it


def rows(drive: Drive) -> tuple[np.ndarray, np.ndarray]:
    """Measurements (rows, anchors), NaN but for the anchor of the row, and the time since the row before (rows, 1)."""
    z = np.full((len(drive.time), len(drive.places)), np.nan)
    z[np.arange(len(z)), drive.anchor] = drive.distance
    return z, np.diff(drive.time, prepend=drive.time[0])[:, None]


def places(rule: str, numbers: Any, anchors: Any, start: Any, z: Any, u: Any) -> tuple[Any, Any]:
    """Estimated place after each row (rows, 2) and its covariance (rows, 2, 2)."""
    means, covariances = states(rule, numbers, anchors, start, z, u)
    return means[:, :2], covariances[:, :2, :2]


def states(rule: str, numbers: Any, anchors: Any, start: Any, z: Any, u: Any) -> tuple[Any, Any]:
    """Estimates after each row."""
    item = filter_of(rule, Numbers(*numbers), anchors, start)

    def step(state: Any, row: Any) -> tuple[Any, Any]:
        after, _ = item.correct(item.predict(state, row[1]), row[0])
        return after, (after.mean, after.covariance)

    _, outcome = jax.lax.scan(step, item.init(), (z, u))
    result: tuple[Any, Any] = outcome
    return result


def free_of(rule: str, numbers: Numbers) -> np.ndarray:
    """The numbers that are learned, on the whole line: logarithms, log odds of shares, the lateness in hundredths."""
    values = np.array(numbers)[: FREE[rule]]
    line = np.log(values)
    line[3] = values[3] * 100
    if rule in SHARES:
        line[4] = np.log(values[4] / (1 - values[4]))
    return line


def numbers_of(rule: str, line: Any) -> Any:
    """The way back: all numbers as an array."""
    share = rule in SHARES
    parts = [jnp.exp(line[:3]), line[3:4] / 100]
    if len(line) > 4:
        parts.append(jax.nn.sigmoid(line[4:5]) if share else jnp.exp(line[4:5]))
    parts.append(jnp.exp(line[5:]))
    learned = jnp.concatenate(parts)
    return jnp.concatenate([learned, jnp.asarray(np.array(STARTS[rule])[FREE[rule] :])])


class Padded:
    """Drives of one number of rows: what is too short ends with rows in which nothing arrives."""

    def __init__(self, drives: Sequence[Drive]):
        most = -(-max(len(drive.time) for drive in drives) // ROWS) * ROWS
        items = [rows(drive) for drive in drives]
        self.z = np.stack([np.pad(z, ((0, most - len(z)), (0, 0)), constant_values=np.nan) for z, _ in items])
        self.u = np.stack([np.pad(u, ((0, most - len(u)), (0, 0))) for _, u in items])
        self.anchors = np.stack([drive.places for drive in drives])
        self.starts = np.stack([drive.truth[0, :2] for drive in drives])
        times = [np.pad(drive.time, (0, most - len(drive.time)), constant_values=np.inf) for drive in drives]
        self.used = np.stack([inside(drive, time) for drive, time in zip(drives, times, strict=True)])
        self.time = np.where(np.isfinite(np.stack(times)), np.stack(times), 0.0)
        points = max(len(drive.truth_time) for drive in drives)
        pad = [(0, points - len(drive.truth_time)) for drive in drives]
        self.truth_time = np.stack([np.pad(d.truth_time, p, mode="edge") for d, p in zip(drives, pad, strict=True)])
        self.truth = np.stack(
            [np.pad(d.truth[:, :2], (p, (0, 0)), mode="edge") for d, p in zip(drives, pad, strict=True)]
        )


def inside(drive: Drive, time: np.ndarray) -> np.ndarray:
    """Which rows count: those within the published window."""
    return (time >= drive.window[0]) & (time <= drive.window[1])


def density(rule: str, line: Any, data: tuple[Any, ...]) -> Any:
    """Mean log density of one drive's true places, a stamp's lateness before each row."""
    z, u, anchors, start, time, used, truth_time, truth = data
    numbers = numbers_of(rule, line)
    mean, covariance = places(rule, numbers, anchors, start, z, u)
    true = jnp.stack([jnp.interp(time - numbers[3], truth_time, truth[:, i]) for i in (0, 1)], axis=1)
    a, b, d = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    area, e = a * d - b * b, true - mean
    squared = (d * e[:, 0] ** 2 - 2 * b * e[:, 0] * e[:, 1] + a * e[:, 1] ** 2) / area
    logs = -(squared + jnp.log(area)) / 2 - np.log(2 * np.pi)
    return jnp.sum(jnp.where(used, logs, 0.0)) / jnp.sum(used)


@partial(jax.jit, static_argnums=0)
def objective(rule: str, lines: Any, data: tuple[Any, ...]) -> Any:
    """Minus the mean of the drives' densities, at several sets of numbers side by side."""
    of_drives = jax.vmap(density, (None, None, 0))
    return -jnp.mean(jax.vmap(lambda line: of_drives(rule, line, data))(lines), axis=1)


def learn(rule: str, drives: Sequence[Drive], iterations: int, progress: Callable[[], None] = lambda: None) -> Numbers:
    """The numbers of a rule that these drives teach together."""
    if not iterations or not drives:
        return STARTS[rule]
    p = Padded(drives)
    data = (p.z, p.u, p.anchors, p.starts, p.time, p.used, p.truth_time, p.truth)
    start = free_of(rule, STARTS[rule])

    def evaluate(line: np.ndarray) -> tuple[float, np.ndarray]:
        # Central differences, all sets of numbers in one pass: far less than a sweep back through thousands of rows.
        moved = [line, *(line + sign * row for sign in (STEP, -STEP) for row in np.eye(len(line)))]
        with jax.enable_x64(True):
            value, *sides = np.asarray(objective(rule, np.stack(moved), data))
        slopes = np.subtract(*np.split(np.array(sides), 2)) / (2 * STEP)
        progress()
        if not np.isfinite(value) or not np.all(np.isfinite(slopes)):
            return REFUSED, np.zeros_like(line)
        away = (line - start) / SPREAD
        weight = 1 / (INDEPENDENT * len(drives))
        return float(value) + weight * float(away @ away) / 2, slopes + weight * away / SPREAD

    bounds = [(x - REACH, x + REACH) for x in start]
    bounds[3] = (0.0, 100.0)
    if rule == "bias":
        bounds[7] = (start[7] - REACH, np.log(LONGEST))
    result = minimize(evaluate, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": iterations})
    with jax.enable_x64(True):
        return Numbers(*np.asarray(numbers_of(rule, result.x)).tolist())
