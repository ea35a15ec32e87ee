"""Search for the maximum of a likelihood: climbs from several starts, ends of domains, and a proof by the Hessian.

Free numbers are searched as unconstrained coordinates: an end of a number's domain, such as a
variance of 0, lies at minus infinity of its logarithm.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from heliograph.learning.likelihood.climbs import ClimbEnds
from heliograph.learning.likelihood.surface import LikelihoodSurface
from heliograph.learning.likelihood.trust_region import CONVERGED_GAIN_BY_ROUNDING, MOST_STEPS, maximise_from_starts
from heliograph.numerics.types import Bool, Float

HARDLY_SEEN = 0.01  # information of a logarithm or a logit below which its number may as well be the end of its domain
SAME_LIKELIHOOD = 1e-6  # nats by which a likelihood at the end of a domain may be lower, and count as the same
SPREAD_OF_LOGARITHMS = 3.0  # of starts, in each coordinate that is a logarithm or a logit
SPREAD_OF_REALS = 10.0  # standard errors of starts from a maximum, in each real number
WAY_TOWARDS_LOW_END = 10.0  # steps of a logarithm to a start near the end of its domain
WAY_TO_END = 5.0  # from where a number is hardly seen to where it counts as at the end
ROUNDS = 6  # of climbs, ends of domains, and proofs
DISTANCES_INWARDS = np.linspace(0.0, 40.0, 41)  # from the end of a domain
EXACT_FIT = 20.0  # logarithm of the size of data over that of their innovations: two in a thousand million
VISIBLE_FALL = 2.0  # nats by which a likelihood has fallen where a number is seen
SAME_POINT = 1e-3  # standard errors between starts that the first rows of a recording lead to one point
SADDLE_CURVATURE = -1e-3  # curvature in units of standard errors below which a point is no maximum

Watch = Callable[[ClimbEnds], None]


class HighestPoint(NamedTuple):
    """The highest point that a search has found.

    Args:
        x: the point in unconstrained coordinates (p,); a number at the end of its domain is so near that nothing sees
            the difference.
        ends: at which end of its domain a number is: -1 or 1, where that is at minus infinity or infinity, else 0 (p,).
        total: log-likelihood there.
        converged: whether this is a maximum, by the Hessian.
        reason: why not, in words; "" of a maximum.
        steps: steps of the last climb.
    """

    x: Float[np.ndarray, " p"]
    ends: Float[np.ndarray, " p"]
    total: float
    converged: bool
    reason: str
    steps: int

    @property
    def active(self) -> Bool[np.ndarray, " p"]:
        """Coordinates that are inside their domains (p,)."""
        return np.asarray(self.ends == 0)

    @property
    def limit(self) -> Float[np.ndarray, " p"]:
        """The point with infinite coordinates for numbers at the ends of their domains (p,)."""
        return np.where(self.ends == 0, self.x, np.copysign(np.inf, self.ends))


@dataclass
class MaximumSearch:
    """Search for the maximum over a surface, which holds the best point so far at any moment.

    Args:
        surface: the likelihood.
        watch: called at each step of a climb.
        best: the best point so far, none before the first climb began.
        ends: log-likelihood at which the climb from each start ended, best first.
    """

    surface: LikelihoodSurface
    watch: Watch
    best: HighestPoint | None = None
    ends: Float[np.ndarray, " starts"] = field(default_factory=lambda: np.zeros(0))

    def run(self, starts: Float[np.ndarray, "starts p"], seed: int) -> HighestPoint:
        """Return the highest point that climbs reach, proved to be a maximum.

        Climbs begin at all starts, then at as many points around the best, and near the low end of each interval. In a
        long recording most climbs go most of the way by its first rows; the maximum is one of all rows.
        SAME_LIKELIHOOD: 1e-6 nats, less than which is no higher top.

        Args:
            starts: where to begin (starts, p); from a single one there is a single climb.
            seed: seed of the second round.
        """
        # `_prove_maximum` takes the highest end of the climbs, puts numbers at ends of their domains that belong there,
        # and climbs on from saddles until the Hessian shows a maximum.
        no_ends = np.zeros(starts.shape[1])  # no coordinate is held at an end of its domain
        climbed = self._climb_by_first_rows(starts, no_ends, own=0)
        top = self._prove_maximum(climbed)
        self.best = top._replace(converged=False, reason="")
        totals = climbed.total  # totals: l at each climb's end
        if len(starts) > 1:
            around = self._draw_starts_around(top, len(starts) - 1, seed)
            # The top itself is the last start, so that climbs to it join it; it is no new result, hence [:-1].
            climbed = self._climb_by_first_rows(np.concatenate([around, top.x[None]]), no_ends, own=len(around))
            totals = np.concatenate([totals, climbed.total[:-1]])
            if climbed.total.max() > top.total + SAME_LIKELIHOOD:
                top = self._prove_maximum(climbed)
        self.best = top
        self.ends = -np.sort(-np.nan_to_num(totals, nan=-np.inf))  # the highest first
        return top

    def _prove_maximum(self, climbed: ClimbEnds) -> HighestPoint:
        """Return the best of some climbs, after climbing again until it is a maximum, or why after ROUNDS it is none.

        A point is a maximum if two conditions hold. For numbers inside their domains, g' H^-1 g is negligible and H is
        not indefinite, with g the gradient of the log-likelihood l and H the Hessian of -l. For numbers that were put
        at an end of their domain, l does not rise on the way back inside. `climbed`: where the climbs ended.
        `_move_to_limits` puts numbers at ends of their domains that the data hardly see. A reason is a text, "" for a
        maximum.
        """
        no_ends = np.zeros(climbed.x.shape[1])
        top = _take_best_climb(climbed, no_ends)
        for _ in range(ROUNDS):
            top = self._move_to_limits(top)
            # `again`: points from which to climb again, or None.
            again, reason = self._choose_restarts(top) if top.converged else (None, top.reason)
            if again is None:
                reason = self._explain_unbounded(top) or reason
                return top._replace(converged=not reason, reason=reason)
            top = _take_best_climb(self._climb(again, no_ends), no_ends)
        return top._replace(converged=False, reason="the search went to and fro between two points")

    def _draw_starts_around(self, top: HighestPoint, count: int, seed: int) -> Float[np.ndarray, "points p"]:
        """Return `count` points drawn around a maximum, and one more for each number on an interval, near its low end.

        Logarithms and logits are drawn within SPREAD_OF_LOGARITHMS of the maximum, real numbers within SPREAD_OF_REALS
        standard errors. The extra point of a number has its logarithm or logit lowered by WAY_TOWARDS_LOW_END.

        Args:
            top: the maximum.
            count: number of points drawn around it.
            seed: of the random numbers.
        """
        deviation = self.surface.standard_errors(top.x)
        spread = np.where(
            self.surface.domains.free,
            SPREAD_OF_REALS * np.where(np.isfinite(deviation), deviation, 0.0),
            SPREAD_OF_LOGARITHMS,
        )
        with_ends = np.flatnonzero(self.surface.domains.single)
        drawn = np.random.default_rng([seed, 2]).uniform(-1.0, 1.0, (count + len(with_ends), len(top.x)))
        # A number at an end of its domain is drawn around another centre: of the distances DISTANCES_INWARDS from the
        # end, the last at which l has not fallen by VISIBLE_FALL nats.
        centre = top.x.copy()
        for index in np.flatnonzero(top.ends):
            _, rise = self._evaluate_inwards_of_end(top, int(index))
            centre[index] -= top.ends[index] * DISTANCES_INWARDS[np.flatnonzero(rise > -VISIBLE_FALL)[-1]]
        points = centre + drawn * spread
        points[count + np.arange(len(with_ends)), with_ends] -= WAY_TOWARDS_LOW_END
        return (self.surface.of_first_rows() or self.surface).move_to_finite_likelihood(points, top.x)

    def _climb_by_first_rows(self, starts: np.ndarray, ends: np.ndarray, own: int) -> ClimbEnds:
        """Return where climbs end, one by start; in a long recording its first rows lead them most of the way.

        A search for the maximum likelihood climbs from several starts, since it may have several maxima. If the
        recording is long, its first rows, which cost little, lead the climbs most of the way. Starts whose climbs by
        the first rows end at the same point share one climb by all rows from there.

        Args:
            starts: points where the climbs begin (starts, p).
            ends: -1 or 1 where a coordinate is held at an end of its domain, else 0 (p,).
            own: index of the start that climbs by all rows from where it is, since the first rows may not have seen
                what comes later.
        """
        # Without a short likelihood, or with a single start, climb by all rows at once.
        short = self.surface.of_first_rows() if len(starts) > 1 else None
        if short is None:
            return self._climb(starts, ends)
        # Climb from all starts but `own` by the first rows. Coordinates at an end of their domain do not move.
        others = np.arange(len(starts)) != own
        x = starts.copy()
        moving = np.repeat((ends == 0)[None], len(starts) - 1, axis=0)
        short_ends = maximise_from_starts(
            short.evaluate, starts[others], moving, domains=self.surface.domains, joining=True
        )
        x[others] = short_ends.x
        # Each start joins the first one that is at the same point, to SAME_POINT standard errors: `climbing` are the
        # starts that climb, and `climb_of_start` which of these stands for each.
        error = short.standard_errors(short_ends.x[short_ends.order[0]])
        reach = SAME_POINT * np.where(np.isfinite(error), error, 0.0)
        are_same = np.all(np.abs(x[:, None] - x[None]) <= reach, axis=2)
        climbing, climb_of_start = np.unique(np.argmax(are_same, axis=1), return_inverse=True)
        # Climb by all rows. A point where the likelihood is not finite is first moved towards the start `own`.
        climbed = self._climb(self.surface.move_to_finite_likelihood(x[climbing], starts[own]), ends)
        # Copy each climb's results to all starts that it stands for; `steps` is one number for all.
        by_start = {name: leaf if name == "steps" else leaf[climb_of_start] for name, leaf in climbed._asdict().items()}
        return ClimbEnds(**by_start)

    def _climb(self, starts: np.ndarray, ends: np.ndarray) -> ClimbEnds:
        """Return the ends of climbs from all starts (starts, p); coordinates that are not 0 in `ends` are held fixed.

        The best point so far is kept at each step. `watch` shows the progress. With `joining`, a climb ends where a
        higher one goes to the same top.
        """

        def keep_best(now: ClimbEnds) -> None:
            """Keep the best point so far in `self.best`, as not converged, and call `self.watch` with the climbs.

            `ends` are the coordinates that are held at an end of their domain.
            """
            top = _take_best_climb(now, ends)
            if self.best is None or not top.total < self.best.total:  # `not <` also if the earlier total is NaN
                self.best = top._replace(converged=False, reason="")
            self.watch(now)

        moving = np.repeat((ends == 0)[None], len(starts), axis=0)
        return maximise_from_starts(
            self.surface.evaluate, starts, moving, watch=keep_best, domains=self.surface.domains, joining=True
        )

    def _move_to_limits(self, top: HighestPoint) -> HighestPoint:
        """Return the point with those numbers at an end of their domain that the data hardly see, climbed anew.

        A number is put there if the likelihood is the same there as where the climb ended. The data hardly see a number
        whose logarithm or logit has an information below HARDLY_SEEN. `top`: the highest point so far. `domains.single`
        marks numbers on an interval, of which `domains.high` have an end at infinity too; there WAY_TO_END further
        steps are as good as the end. `ends` is -1 or 1 for a number at its low or high end.
        """
        domains = self.surface.domains
        x = top.x.copy()
        total = top.total
        ends = top.ends.copy()
        information = np.diag(self.surface.evaluations(x[None]).information[0])
        for index in np.flatnonzero(top.active & domains.single & (information < HARDLY_SEEN)):
            side = 1.0 if domains.high[index] and x[index] > 0 else -1.0
            moved = x.copy()
            moved[index] += side * WAY_TO_END
            there = self.surface.evaluations(moved[None])
            is_finite = np.isfinite(there.gradient).all() and np.isfinite(there.information).all()
            if is_finite and there.total[0] > total - SAME_LIKELIHOOD:
                x, total, ends[index] = moved, float(there.total[0]), side
        if np.array_equal(ends, top.ends):
            return top
        return _take_best_climb(self._climb(x[None], ends), ends)

    def _choose_restarts(self, top: HighestPoint) -> tuple[np.ndarray | None, str]:
        """Return the points (points, p) from which to climb again if `top` is no maximum, and why it is none.

        A maximum gives (None, ""). It is none if l rises by more than SAME_LIKELIHOOD on the way inside from an end of
        a domain, or if the least curvature is below SADDLE_CURVATURE (negative): both give points to climb from. It is
        also none if Newton's step promises a gain of CONVERGED_GAIN_BY_ROUNDING or more; no points help then, and the
        reason says so. `curvature.least` is the least curvature of -l in units of standard errors, along `direction`.
        """
        # For each number at an end of its domain: climb again if l rises on the way back inside.
        for index in np.flatnonzero(top.ends):
            points, rise = self._evaluate_inwards_of_end(top, int(index))
            if rise.max() > SAME_LIKELIHOOD:
                return points[[int(rise.argmax())]], ""
        curvature = self.surface.measure_curvature(top.x, top.active)
        if curvature.least < SADDLE_CURVATURE:
            return top.x + np.array([[1.0], [-1.0]]) * curvature.direction, ""  # on both sides of the saddle
        if not curvature.gain < CONVERGED_GAIN_BY_ROUNDING:
            return None, f"a step by the Hessian promises {curvature.gain:.2g} of log-likelihood"
        return None, ""

    def _explain_unbounded(self, top: HighestPoint) -> str:
        """Return a sentence if the likelihood has no maximum because the network reproduces the data exactly, else "".

        l then grows for ever as variances fall, but a climb ends where innovations are rounding. l per number of data
        is about -log |innovation|, so l + log |data| is about log(|data| / |innovation|): above EXACT_FIT it is
        rounding. `top`: the highest point.
        """
        data = self.surface.data.measurements if self.surface.data.truth is None else self.surface.data.truth
        log_likelihood_of_number = top.total / np.count_nonzero(~np.isnan(data))
        log_size = np.log(np.nanmax(np.abs(data)))
        if log_likelihood_of_number + log_size > EXACT_FIT:
            return "the likelihood grows for ever as variances fall to 0, for the network reproduces the data exactly"
        return ""

    def _evaluate_inwards_of_end(self, top: HighestPoint, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Return points (points, p) from the end of a number's domain inwards, and how much higher l is at each.

        Their distances from the end are DISTANCES_INWARDS, 0 to 40 steps of a logarithm or logit. The log-likelihood l
        counts as -inf where it is NaN.

        Args:
            top: the point, at which the number is at an end of its domain.
            index: coordinate of the number.
        """
        points = np.repeat(top.x[None], len(DISTANCES_INWARDS), axis=0)
        points[:, index] -= top.ends[index] * DISTANCES_INWARDS
        return points, np.nan_to_num(self.surface.evaluations(points).total - top.total, nan=-np.inf)


def _take_best_climb(climbed: ClimbEnds, ends: np.ndarray) -> HighestPoint:
    """Return the best of the climbs, with the reason why it stopped if it did not converge.

    Args:
        climbed: where the climbs ended: `order` has their numbers from the highest down, and `remaining` the nats that
            a further step would still gain.
        ends: -1 or 1 if a coordinate was held at an end of its domain, else 0 (p,).
    """
    best = int(climbed.order[0])
    converged = bool(climbed.converged[best])
    remaining = float(climbed.remaining[best])
    return HighestPoint(
        x=climbed.x[best].copy(),
        ends=ends,
        total=float(climbed.total[best]),
        converged=converged,
        reason="" if converged else _explain_unconverged_climb(remaining),
        steps=climbed.steps,
    )


def _explain_unconverged_climb(remaining: float) -> str:
    """Return in words why a climb ended without converging, from the nats that a further step still promises."""
    if not np.isfinite(remaining):
        return "the likelihood has no finite derivatives there"
    return f"after {MOST_STEPS} steps a further one promises {remaining:.2g} of log-likelihood"
