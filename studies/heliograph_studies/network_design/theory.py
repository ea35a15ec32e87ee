"""Theory that the study needs beside planning: who sends when, seldom and loud, and where relays stand.

A choice: with z_i = 1 for sensors that send and 0 else, J = sum_i z_i j_i c_i' c_i. The error is convex in z, and so is
the mean error of a period in the z of its steps; it does not mind a rotation of them. So the least error over z from 0
to 1 with sum k is below that of every choice of k, and of every schedule of every period with k at a step. A path
without noise of its own carries p / (s alpha) at the power p: with alpha = 1 / (s j_i) this z is its power, and
`hg.design` finds that least error with its proof.

Bursts: what a path of several hops carries is S-shaped in its power. The error is convex in the information of the
steps, whose mean is below the concave envelope at the mean power: with that information the error is below that of all
ways to vary a path's power over time.

Relays on a line: over the whole way a hop has the noise rho, in units of the total power; over a part d of it rho d^e.
With shares q of the power the noise of the path is s K F - t with F = prod_h (1 + rho d_h^e / q_h) and K = kappa^hops.
Where lengths and shares are best together, d F / d d_h and d F / d q_h are each the same for all hops, and so d_h /
q_h is: q = d, and
  log F = sum_h log(1 + rho d_h^(e - 1)),   sum_h d_h = 1.
Each term is convex in d up to a length and concave beyond, so at the least at most one hop is of the longer kind: all
hops are equal, or all but one. That leaves a function of one number, which is searched.
"""

from collections.abc import Iterable, Iterator
from itertools import combinations, product
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

import heliograph as hg
from heliograph.linear.recursion import information_step
from heliograph.numerics.check import check_count, fail, instance, scalar
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.paths.model import Paths, Plants, error_covariances, path_information
from heliograph.planning.paths.relaxation import envelope, split_paths
from heliograph_studies.network_design.feedback import fed_back_channel as fed_back_channel
from heliograph_studies.network_design.feedback import feedback_limit as feedback_limit

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
    covariances = error_covariances(paths._replace(plants=Plants(a, q, None)), information)
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
    result: Float[np.ndarray, "path"] = path_information(paths, np.broadcast_to(p, (1, hops))).information[0]
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
    bound = steady_error(paths, envelope(whole, np.full(total.shape, np.inf)).information(total)[0]) * (1 - ROUNDING)
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
    p = q
    before: list[np.ndarray] = []
    taken: list[int] = []
    for _ in range(LONGEST):
        after = [information_step(a @ p @ a.T + q, received) for received in alone]
        best = int(np.argmin([np.trace(covariance) for covariance in after]))
        p = after[best]
        for k, past in enumerate(before):
            if taken[k] == best and np.abs(past - p).max() <= SAME * np.abs(p).max():
                return tuple((i,) for i in (*taken[k + 1 :], best))
        before.append(p)
        taken.append(best)
    return tuple((i,) for i in taken[LONGEST // 2 :])


GRID = 400  # lengths of the short hops that are tried, evenly and on a logarithmic scale
SHORTEST = 1e-9  # of the way


class RelayLine(NamedTuple):
    """Relays on a line.

    lengths: of each hop, parts of the way, and the shares of the total power. noise: K F, as that of the path is
    s K F - t. even: the same for hops of equal length. direct: without a relay.
    """

    lengths: Float[np.ndarray, "H"]
    noise: float
    even: float
    direct: float

    @property
    def sites(self) -> Float[np.ndarray, "H-1"]:
        """Where the relays stand: parts of the way from the sensor."""
        return np.cumsum(self.lengths)[:-1]


def relay_line(rho: float, exponent: float, relays: int = 1, kappa: float = 1.0) -> RelayLine:
    """Best sites of so many relays, and the noise with them.

    rho: noise Var m / (E g^2 P) of one hop over the whole way with all the power; exponent e of the path loss, at least
    1; kappa of each hop. One relay stands best at the midpoint for rho <= 2^e (e / 2 - 1) only, beyond gradually nearer
    to one end: with e = 3 at x (1 - x) = 1 / rho, where the noise is rho, 1 + rho without it. The midpoint is better
    than no relay for rho < 4^(e - 1) - 2^e.

    Raises:
        ValueError: a negative rho, an exponent or kappa below 1.
    """
    for name, value, least in (("rho", rho, 0.0), ("path loss exponent", exponent, 1.0), ("kappa", kappa, 1.0)):
        scalar(name, value, least)
    hops = check_count("relays", relays, 0) + 1
    equal, best = np.full(hops, 1 / hops), _lengths(hops, _short(rho, exponent, hops))
    noise, even = (kappa**hops * float(np.exp(_log_noise(rho, exponent, d))) for d in (best, equal))
    return RelayLine(best if noise < even else equal, min(noise, even), even, kappa * (1 + rho))


def best_relays(rho: float, exponent: float, most: int, kappa: float = 1.0) -> list[RelayLine]:
    """Best lines of 0, 1, ..., `most` relays, the best of them first.

    Without fading (kappa = 1) and with e > 2 more relays are always better; kappa above 1 makes each one cost.

    Raises:
        ValueError: what `relay_line` refuses.
    """
    lines = [relay_line(rho, exponent, n, kappa) for n in range(check_count("most relays", most, 0) + 1)]
    return sorted(lines, key=lambda line: line.noise)


def _short(rho: float, exponent: float, hops: int) -> float:
    """Length of all hops but one that makes the noise least."""
    if hops == 1:
        return 1.0

    def noise(short: float) -> float:
        return _log_noise(rho, exponent, _lengths(hops, short))

    tried = np.unique(np.append(np.geomspace(SHORTEST, 1 / hops, GRID), np.linspace(SHORTEST, 1 / hops, GRID)))
    values = np.array([noise(x) for x in tried])
    at = int(np.argmin(values))
    low, high = tried[max(at - 1, 0)], tried[min(at + 1, len(tried) - 1)]
    search = minimize_scalar(noise, bounds=(low, high), method="bounded", options={"xatol": 1e-12})
    return float(search.x) if search.fun < values[at] else float(tried[at])


def _lengths(hops: int, short: float) -> Float[np.ndarray, "H"]:
    """All hops but one of this length."""
    return np.append(np.full(hops - 1, short), 1 - (hops - 1) * short)


def _log_noise(rho: float, exponent: float, lengths: Float[np.ndarray, "H"]) -> float:
    """log F with shares of the power that are the lengths."""
    return float(np.log1p(rho * lengths ** (exponent - 1)).sum())
