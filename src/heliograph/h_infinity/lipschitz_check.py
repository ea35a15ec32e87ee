"""Check a function's growth (Lipschitz) constant over a box: search for the largest slope and a pair that breaks it."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy
from typing_extensions import TypeAliasType

from heliograph.h_infinity.slope_bounds import prove_slope_bound
from heliograph.numerics.check import array, check_seed, error_text, fail, flag, scalar
from heliograph.numerics.check import function as check_callable
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

POINTS = 2**12  # of a low-discrepancy sequence, at which slopes are taken
CLIMBERS, TRIALS, ROUNDS = 16, 32, 60  # steepest points kept, random moves from each, and times this is repeated
SHRINK = 0.8  # of the moves' size from round to round: from half the region to 1e-6 of it
NEARBY = 1e-4  # distance of a close pair, relative to the region's width; closer ones lose digits
TOLERANCE = 1e-9  # relative excess over the constant that counts as rounding

Pair = TypeAliasType("Pair", tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]])  # two points
Function = Callable[[jax.Array], jax.Array]  # (n,) -> (m,) or (), written with jax.numpy


@readable
class GrowthFinding(NamedTuple):
    """Evidence for or against |f(x) - f(y)| <= constant |x - y| and f(0) = 0 in a box.

    `refuted` if any evidence breaks the constant, `proved` if the bound is within it; otherwise it is assumed.

    Args:
        name: the function's name in sentences.
        constant: the growth constant a.
        low: lower corner of the box (n,).
        high: upper corner of the box (n,).
        slope: largest norm of a Jacobian met in the box: at least this large is every true constant; infinite where f
            is no number.
        point: where that slope is (n,).
        pair: the points x, y with the largest ratio met, each (n,).
        ratio: |f(x) - f(y)| / |x - y| of that pair.
        at_zero: |f(0)|.
        bound: a bound of every slope in the box by interval arithmetic on f's operations; None where these cannot be
            followed.
        reason: why there is no bound; empty if there is one.
        differences: false for evidence about |f(x)| <= constant |x| alone.
    """

    name: str
    constant: float
    low: Float[np.ndarray, "n"]
    high: Float[np.ndarray, "n"]
    slope: float
    point: Float[np.ndarray, "n"]
    pair: Pair
    ratio: float
    at_zero: float
    bound: float | None
    reason: str
    differences: bool

    @property
    def limit(self) -> float:
        """Constant plus what counts as rounding."""
        return self.constant * (1 + TOLERANCE)

    @property
    def starts_at_zero(self) -> bool:
        """True if f(0) = 0, to rounding of what the constant allows over the box."""
        return self.at_zero <= TOLERANCE * self.constant * float(np.linalg.norm(self.high - self.low))

    @property
    def around_zero(self) -> bool:
        """True if 0 is in the box: slopes then bound f itself too."""
        return bool(np.all(self.low <= 0) and np.all(self.high >= 0))

    @property
    def refuted(self) -> bool:
        """True if evidence breaks the constant a: a pair, a slope, or an f(0) other than 0.

        A slope counts where a is to bound differences of f; |f(x)| <= a |x| alone allows steep slopes.
        """
        is_too_steep = self.differences and not self.slope <= self.limit  # NaN counts as too steep
        has_too_large_ratio = not self.ratio <= self.limit
        return is_too_steep or has_too_large_ratio or not self.starts_at_zero

    @property
    def proved(self) -> bool:
        """True if no slope in the box exceeds the constant, for certain."""
        return not self.refuted and self.bound is not None and self.bound <= self.limit

    @property
    def text(self) -> str:
        """One line that says whether the growth constant is proved, assumed or false in the box, and why.

        It is false if a point or a pair refutes it, proved if a bound of all slopes is within it, assumed otherwise.
        """
        region = f"in the box from {np.round(self.low, 4).tolist()} to {np.round(self.high, 4).tolist()}"
        if self.proved:
            return f"{self.name}: constant {self.constant:g} is proved {region} (no slope above {self.bound:.6g})"
        if not self.refuted:
            finding = "nothing is proved" if self.bound is None else f"slopes up to {self.bound:.6g} proved"
            reason = self.reason or finding
            verdict = f"not refuted {region} (largest slope {self.slope:.6g})"
            return f"{self.name}: constant {self.constant:g} is assumed: {verdict}; {reason}"
        return f"{self.name}: constant {self.constant:g} is false {region}: {self._describe_evidence()}"

    def _describe_evidence(self) -> str:
        """Return in words what refutes the constant: f(0), the slope at a point, or the ratio |df| / |dx| of a pair."""
        if not self.starts_at_zero:
            return f"f(0) has the norm {self.at_zero:.6g}, not 0"
        if self.ratio <= self.limit:
            return f"slope {self.slope:.6g} at {np.round(self.point, 6).tolist()}"
        x, y = (np.round(point, 6).tolist() for point in self.pair)
        return f"ratio {self.ratio:.6g} at {x} and {y}"


def check_growth(
    function: Function,
    constant: float,
    low: "Float[ArrayLike, ' n']",
    high: "Float[ArrayLike, ' n']",
    name: str = "f",
    seed: int = 0,
    differences: bool = True,
) -> GrowthFinding:
    """Search a box for a function's largest slope, for a pair that refutes a growth constant, and for a proof of it.

    Slopes are norms of Jacobians, by automatic differentiation, at 4,096 points of a Sobol sequence; from the steepest
    ones the search goes on by random moves of shrinking size. Pairs start close together along the steepest directions,
    and far apart, and move likewise. A box is convex, so in it the largest slope is the smallest true constant. Where f
    is written in operations that interval arithmetic can follow, bounds of the Jacobian over parts of the box then
    prove the constant. An f(0) other than 0 refutes any: a proof over a box with 0 holds for |f(x)| <= a |x| too.

    Args:
        function: f, from (n,) to (m,) or a number, written with jax.numpy.
        constant: the growth constant a, not negative.
        low: lower corner of the box (n,).
        high: upper corner of the box (n,).
        name: the function's name in sentences; "f" by default.
        seed: seed of the search; 0 by default.
        differences: False for the weaker condition |f(x)| <= a |x|: pairs with 0, which is in the box (default True).

    Raises:
        ValueError: a negative constant, a box of the wrong shape, upside down, or without 0 where it has to be in it.
    Source: H-infinity fusion over amplify-and-forward relays, condition (2).
    """
    constant = float(scalar("growth constant", constant, low=0.0))
    bottom, top = _check_box(low, high)
    differences = flag("differences", differences)
    seed = check_seed("seed", seed)
    _check_function(check_callable("function", function, "the state"), bottom)
    if not differences and (np.any(bottom > 0) or np.any(top < 0)):
        raise fail("region", "a box around 0", f"{bottom.tolist()} and {top.tolist()}")
    meter, random = _LipschitzMeter(function, float(np.linalg.norm(top - bottom))), np.random.default_rng(seed)
    starts = bottom + (top - bottom) * scipy.stats.qmc.Sobol(len(bottom), seed=seed).random(POINTS)
    if differences:
        points, pairs = _search_slopes_and_pairs(meter, starts, bottom, top, random)
    else:  # |f(x)| <= a |x| alone: pairs of a point and 0
        points = _climb_at_random(lambda x: meter.measure_ratios(_pair_with_zero(x)), starts, bottom, top, random)
        pairs = _pair_with_zero(points)
    return _make_finding(name, constant, bottom, top, meter, points, pairs, differences)


def _check_function(function: Function, point: Float[np.ndarray, "n"]) -> None:
    """Raise ValueError unless the function returns a number or a vector at a point."""
    expected = "one of the state in operations of jax.numpy that returns a number or a vector"
    try:
        with jax.enable_x64(True):
            axes = len(jax.eval_shape(lambda x: jnp.atleast_1d(function(x)), point).shape)
    except (TypeError, ValueError, IndexError, ArithmeticError, AttributeError) as error:
        raise fail("function", expected, error_text(error)) from error
    if axes != 1:
        raise fail("function", expected, f"{axes} axes")


def _check_box(low: ArrayLike, high: ArrayLike) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Return the corners of a box as arrays; raise ValueError unless low <= high, and low < high somewhere."""
    bottom = np.asarray(array("low corner of the region", low, (None,)))
    top = np.asarray(array("high corner of the region", high, bottom.shape))
    if np.any(top < bottom) or not np.any(top > bottom):
        raise fail("region", "a low corner below the high one", f"{bottom.tolist()} and {top.tolist()}")
    return bottom, top


class _LipschitzMeter:
    """Slopes |Jacobian| of a function at points (count, n), and ratios |f(x) - f(y)| / |x - y| of pairs (count, 2n).

    A pair is x and y behind each other. Function and Jacobian are compiled once. `width` is that of the box.
    """

    def __init__(self, function: Function, width: float):
        """Compile the function and its Jacobian; `width` is that of the region, by which distances are judged."""
        self.width, self.function = width, function
        self.jacobian = _compile_by_part(jax.vmap(jax.jacfwd(lambda x: jnp.atleast_1d(function(x)))))
        self.values = _compile_by_part(jax.vmap(lambda x: jnp.atleast_1d(function(x))))

    def measure_slopes(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count"]:
        """Return the spectral norm of the Jacobian at each point, infinite where the Jacobian is not finite."""
        values = np.asarray(self.jacobian(points))
        is_finite = np.isfinite(values).all(axis=(-2, -1))
        finite_values = np.where(is_finite[:, None, None], values, 0.0)
        return np.where(is_finite, np.linalg.norm(finite_values, 2, axis=(-2, -1)), np.inf)

    def find_steepest_directions(self, points: Float[np.ndarray, "count n"]) -> Float[np.ndarray, "count n"]:
        """Return the unit direction in which the function changes most at each point."""
        jacobians = np.nan_to_num(self.jacobian(points), posinf=0.0, neginf=0.0)
        _left, _singular_values, right = np.linalg.svd(jacobians)
        return right[:, 0]  # the right singular vector of the largest singular value

    def measure_ratios(self, pairs: Float[np.ndarray, "count both"]) -> Float[np.ndarray, "count"]:
        """Return the ratio |f(x) - f(y)| / |x - y| of each pair, 0 if x and y are so close that it is rounding."""
        x, y = np.split(pairs, 2, axis=1)
        distance = np.linalg.norm(x - y, axis=1)
        are_apart = distance > NEARBY * self.width / 2  # NEARBY: 1e-4
        change = np.linalg.norm(np.asarray(self.values(x)) - self.values(y), axis=1)
        change = np.where(np.isfinite(change), change, np.inf)
        return np.where(are_apart, change / np.where(are_apart, distance, 1), 0)

    def measure_at_zero(self, n: int) -> float:
        """Return the size |f(0)|, infinite where it is no number."""
        size = float(np.linalg.norm(self.values(np.zeros((1, n)))))
        return size if np.isfinite(size) else np.inf


def _pair_with_zero(points: Float[np.ndarray, "points n"]) -> Float[np.ndarray, "points n+n"]:
    """Return each point with 0 behind it, as a pair."""
    return np.concatenate([points, np.zeros_like(points)], axis=1)


def _search_slopes_and_pairs(
    meter: _LipschitzMeter,
    starts: Float[np.ndarray, "starts n"],
    low: Float[np.ndarray, "n"],
    high: Float[np.ndarray, "n"],
    random: np.random.Generator,
) -> tuple[Float[np.ndarray, "points n"], Float[np.ndarray, "pairs n+n"]]:
    """Return points of large slopes in the box, and pairs (x, y) of large ratios |f(x) - f(y)| / |x - y|.

    Args:
        meter: measures slopes and ratios of the function f.
        starts: points of the box with which the search begins.
        low: lower corner of the box.
        high: upper corner.
        random: generator of the search's moves.
    """
    # Largest slope: the starts, then random moves from the steepest.
    points = _climb_at_random(meter.measure_slopes, starts, low, high, random)
    # Largest ratio: close pairs along the steepest directions, and as many pairs of any two points of the box.
    move = meter.find_steepest_directions(points) * NEARBY * meter.width / 2  # half of a pair's distance
    close = np.concatenate([np.clip(points - move, low, high), np.clip(points + move, low, high)], axis=1)
    far = low + (high - low) * random.random((POINTS, 2, len(low)))
    pairs = np.concatenate([close, far.reshape(POINTS, -1)])
    return points, _climb_at_random(meter.measure_ratios, pairs, np.tile(low, 2), np.tile(high, 2), random)


def _compile_by_part(function: Callable[[Any], jax.Array]) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function of points (count, n), compiled once, for a fixed number of points at a time.

    A compiled program takes one shape alone; any other count is cut into parts. The number is CLIMBERS * TRIALS, as
    many as one round of the search tries.
    """
    compute = compile_in_float64(function)

    def call(points: np.ndarray) -> np.ndarray:
        """Return the function at points (count, n), in parts of `size`; copies of the last point fill the last part."""
        size = CLIMBERS * TRIALS
        padded = np.concatenate([points, np.repeat(points[-1:], -len(points) % size, axis=0)])
        values = [compute(padded[start : start + size]) for start in range(0, len(padded), size)]
        return np.concatenate(values)[: len(points)]

    return call


def _make_finding(
    name: str,
    constant: float,
    low: np.ndarray,
    high: np.ndarray,
    meter: _LipschitzMeter,
    points: np.ndarray,
    pairs: np.ndarray,
    differences: bool,
) -> GrowthFinding:
    """Return the finding from the points and pairs that a search ended at, with a bound unless it is refuted.

    It is whether |f(x) - f(y)| <= a |x - y| in a box: a steeper point refutes it, a bound of all slopes proves it.

    Args:
        name: name of the function.
        constant: a, the growth constant in question.
        low: lower corner of the box (n,).
        high: upper corner of the box (n,).
        meter: measures slopes (norms of the Jacobian) and ratios |f(x) - f(y)| / |x - y| of the function.
        points: points (points, n); the steepest is reported.
        pairs: x and y of each pair (pairs, 2n); the pair of the largest ratio is reported.
        differences: whether the constant bounds |f(x) - f(y)| / |x - y|; else |f(x)| / |x|.
    """
    slopes, ratios = meter.measure_slopes(points), meter.measure_ratios(pairs)
    steepest, largest_ratio = int(np.argmax(slopes)), int(np.argmax(ratios))
    x, y = np.split(pairs[largest_ratio], 2)
    finding = GrowthFinding(
        name=name,
        constant=float(constant),
        low=low,
        high=high,
        slope=float(slopes[steepest]),
        point=points[steepest],
        pair=(x, y),
        ratio=float(ratios[largest_ratio]),
        at_zero=meter.measure_at_zero(len(low)),
        bound=None,
        reason="",
        differences=differences,
    )
    if finding.refuted:
        return finding
    bound = prove_slope_bound(meter.function, low, high, finding.limit)
    return finding._replace(bound=bound.value if np.isfinite(bound.value) else None, reason=bound.reason)


def _climb_at_random(
    objective: Callable[[np.ndarray], np.ndarray],
    starts: Float[np.ndarray, "starts n"],
    low: Float[np.ndarray, "n"],
    high: Float[np.ndarray, "n"],
    random: np.random.Generator,
) -> Float[np.ndarray, "climbers n"]:
    """Return points of the box where an objective is large: a random search that climbs from the best `starts`.

    The CLIMBERS best starts are kept. In each of ROUNDS rounds each moves to the best of TRIALS points, itself and
    random ones around it, whose distance shrinks by SHRINK from round to round.

    Args:
        objective: from points (count, n) to the numbers (count,) that are to be large.
        starts: points to begin with.
        low: lower corner of the box.
        high: upper corner.
        random: generator of the moves.
    """
    climbers = starts[np.argsort(-objective(starts), kind="stable")[:CLIMBERS]]
    deviation = (high - low) / 2
    for _ in range(ROUNDS):
        # TRIALS normal moves of each, the first of which stays.
        trials = climbers[:, None] + deviation * random.normal(size=(len(climbers), TRIALS, len(low)))
        trials[:, 0] = climbers
        trials = np.clip(trials, low, high)
        values = objective(trials.reshape(-1, len(low))).reshape(len(climbers), TRIALS)
        best = values.argmax(axis=1)  # of each climber's trials
        climbers = trials[np.arange(len(climbers)), best]
        deviation = SHRINK * deviation
    return climbers
