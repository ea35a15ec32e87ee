"""Who sends when, and how seldom: choices of sensors, schedules and bursts, each beside what nothing can beat.

A choice: with z_i = 1 for sensors that send and 0 else, J = sum_i z_i j_i c_i' c_i. The error is convex in z, and so is
the mean error of a period in the z of its steps; it does not mind a rotation of them. So the least error over z from 0
to 1 with sum k is below that of every choice of k, and of every schedule of every period with k at a step. A path
without noise of its own carries p / (s alpha) at the power p: with alpha = 1 / (s j_i) this z is its power, and
`hg.design` finds that least error with its proof.

Bursts: what a path of several hops carries is S-shaped in its power. The error is convex in the information of the
steps, whose mean is below the concave envelope at the mean power: with that information the error is below that of all
ways to vary a path's power over time.
"""

from collections.abc import Iterable, Iterator
from itertools import combinations, product
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.factors.square_root_update import observe_information, roots_of
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.multihop_paths.model import (
    Paths,
    PlantSteps,
    compute_error_covariances,
    compute_path_information,
)
from heliograph.planning.multihop_paths.power_split_over_hops import compute_envelope, split_paths

Steps = tuple[tuple[int, ...], ...]  # the sensors of each step

LONGEST = 400  # steps after which a greedy schedule that does not repeat itself is cut
ROUNDING = 1e-12  # relative, by which a bound stays below what is computed
SAME = 1e-9  # relative difference of covariances that count as repeated


class Choice(NamedTuple):
    """Sensors that are chosen, by number, the best of all; bound: what the convex problem alone proves."""

    chosen: tuple[int, ...]
    error: float
    bound: float


class SendingSchedule(NamedTuple):
    """Sensors that send at each step of a period.

    error: its mean over the period. bound: no schedule of any period with one sensor at each step has a smaller one.
    by_period: errors of the best schedule of each period. greedy: mean error of taking at each step the sensor that
    lowers the error of that step most.
    """

    steps: Steps
    error: float
    bound: float
    by_period: dict[int, float]
    greedy: float


class Bursts(NamedTuple):
    """Mean steady error when all send every n-th step with n times the power.

    errors: by n; error: the least of them, with `every` = n. bound: no way to vary the powers over time, and to split
    them between the hops of a path, has a smaller error at the same mean power of each path.
    """

    errors: dict[int, float]
    every: int
    error: float
    bound: float


def steady_error(paths: Paths, information: Float[np.ndarray, "time path"]) -> float:
    """Mean trace of the error over steps that repeat for ever, at each of which the paths carry this information."""
    a, q = (np.repeat(m, len(information), axis=0) for m in (paths.plants.transition, paths.plants.process))
    covariances = compute_error_covariances(paths._replace(plants=PlantSteps(a, q, None)), information)
    return float(np.trace(covariances, axis1=1, axis2=2).mean())


def information_at(paths: Paths, powers: ArrayLike) -> Float[np.ndarray, "path"]:
    """Information that steady paths carry whose hops send with these powers (hops,), or one number.

    Raises:
        ValueError: paths over several steps, powers that are not one or one for each hop.
    """
    steps, hops = instance("paths", paths, Paths, "Paths (independent_paths, paths_of)").kappa.shape
    if steps != 1 or paths.plants.start is not None:
        raise fail("paths", "steady ones", f"{steps} steps")
    p = np.asarray(powers, dtype=np.float64)
    if p.shape not in ((), (hops,)) or not np.all(np.isfinite(p) & (p >= 0)):
        raise fail("powers", f"one number or one for each of {hops} hops, of at least zero", p)
    result: Float[np.ndarray, "path"] = compute_path_information(paths, np.broadcast_to(p, (1, hops))).information[0]
    return result


def choose_sensors(paths: Paths, count: int, powers: ArrayLike) -> Choice:
    """The `count` sensors whose steady error is least, each sending with its hops' `powers` or not at all.

    Raises:
        ValueError: more sensors than there are, paths that are not steady.
    """
    information = information_at(paths, powers)
    number = len(information)
    if check_count("sensors to choose", count) > number:
        raise fail("sensors to choose", f"at most the {number} there are", count)
    errors = {chosen: _error(paths, information, (chosen,)) for chosen in combinations(range(number), count)}
    best = min(errors, key=lambda chosen: errors[chosen])
    return Choice(best, errors[best], min(_bound(paths, information, count), errors[best]))


def best_schedule(paths: Paths, powers: ArrayLike, periods: Iterable[int] = range(1, 5)) -> SendingSchedule:
    """The schedule of least mean error with one sensor at each step, with its `powers` when on.

    All schedules of each period are compared, one for all its rotations: their number grows as M^period / period.

    Raises:
        ValueError: no periods, paths that are not steady.
    """
    information = information_at(paths, powers)
    lengths = sorted({check_count("period", period) for period in periods})
    if not lengths:
        raise fail("periods", "at least one", "none")
    best: dict[int, tuple[float, Steps]] = {}
    for period in lengths:
        schedules = (tuple((i,) for i in word) for word in necklaces(len(information), period))
        best[period] = min((_error(paths, information, steps), steps) for steps in schedules)
    error, steps = min(best.values())
    bound, greedy = _bound(paths, information, 1), _error(paths, information, _greedy(paths, information))
    return SendingSchedule(steps, error, min(bound, error), {n: least for n, (least, _) in best.items()}, greedy)


def burst_sending(paths: Paths, powers: ArrayLike, every: Iterable[int] = range(1, 11)) -> Bursts:
    """Errors of sending with n times the mean `powers` (hops,) at every n-th step.

    Raises:
        ValueError: nothing to compare, paths that are not steady.
    """
    errors = {}
    for n in sorted({check_count("steps between bursts", n) for n in every}):
        loud = information_at(paths, n * np.asarray(powers, dtype=np.float64))
        errors[n] = steady_error(paths, np.eye(n)[:, :1] * loud)
    if not errors:
        raise fail("steps between bursts", "at least one", "none")
    best = min(errors, key=lambda n: errors[n])
    # The concave envelope of each path at its mean power.
    hops = np.broadcast_to(np.asarray(powers, dtype=np.float64), paths.kappa[0].shape)
    total = np.bincount(paths.path, hops, paths.second.shape[1])[None]
    whole = split_paths(paths, np.ones(len(hops), dtype=bool), np.zeros((1, len(hops))))
    bound = steady_error(paths, compute_envelope(whole, np.full(total.shape, np.inf)).information(total)[0]) * (
        1 - ROUNDING
    )
    return Bursts(errors, best, errors[best], min(bound, errors[best]))


def necklaces(letters: int, length: int) -> Iterator[tuple[int, ...]]:
    """Words over 0 .. letters - 1 of which none is a rotation of another: the first of its rotations in order."""
    for word in product(range(letters), repeat=length):
        if all(word <= word[i:] + word[:i] for i in range(1, length)):
            yield word


def _error(paths: Paths, information: Float[np.ndarray, "path"], steps: Steps) -> float:
    on = [np.isin(np.arange(len(information)), step) for step in steps]
    return steady_error(paths, np.array(on) * information)


def _bound(paths: Paths, information: Float[np.ndarray, "path"], count: int) -> float:
    """Least error of shares from 0 to 1 with this sum: powers of paths of one hop each, which carry share times j."""
    live = np.flatnonzero(information * paths.signal[0] > 0)
    if not live.size:
        return steady_error(paths, 0 * information[None])
    signal, ones = paths.signal[:, live], np.ones((1, len(live)))
    shared = paths._replace(
        rows=paths.rows[:, live], second=signal, signal=signal, path=np.arange(len(live)), kappa=ones,
        alpha=1 / (signal * information[live]), names=tuple(f"share{i}" for i in live),
    )  # fmt: skip
    return float(hg.design(shared, budget=hg.planning.Budget(count, peak=1.0)).bound)


def _greedy(paths: Paths, information: Float[np.ndarray, "path"]) -> Steps:
    """The sensor that lowers each step's error most, until choices and covariance repeat themselves."""
    a, q, rows = paths.plants.transition[0], paths.plants.process[0], paths.rows[0]
    alone = information[:, None, None] * rows[:, :, None] * rows[:, None, :]
    root = process = roots_of(q)
    before: list[np.ndarray] = []
    taken: list[int] = []
    for _ in range(LONGEST):
        after = observe_information(np.concatenate([a @ root, process], axis=1), alone)
        covariances = after.covariance
        best = int(np.argmin(np.trace(covariances, axis1=1, axis2=2)))
        root, p = after.root[best], covariances[best]
        for k, past in enumerate(before):
            if taken[k] == best and np.abs(past - p).max() <= SAME * np.abs(p).max():
                return tuple((i,) for i in (*taken[k + 1 :], best))
        before.append(p)
        taken.append(best)
    return tuple((i,) for i in taken[LONGEST // 2 :])
