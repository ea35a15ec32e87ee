"""Likelihood of recordings over the free numbers: climbed, cut along one of them, and measured at its top.

A point is a vector of unconstrained coordinates; l is the log-likelihood there.
"""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from heliograph.learning.free_parameters import Parameter
from heliograph.learning.likelihood.climbs import Evaluated, OpenEnds
from heliograph.learning.likelihood.data import LikelihoodData
from heliograph.learning.likelihood.evaluation import Evaluation, evaluate_at_points
from heliograph.learning.likelihood.objective import Objective
from heliograph.learning.likelihood.trust_region import maximise_from_starts
from heliograph.learning.likelihood.trust_region_step import FLAT_EIGENVALUE
from heliograph.numerics.types import Bool, Float

DIFFERENCE_WIDTH = 1e-3  # standard errors over which scores are differenced
MOST_CUTS = 40  # of a profile at most
ACCURACY_OF_FALL = 1e-3  # of the root of a fall
CLOSE_ON_PROFILE = 1e-6  # nats that may remain to be gained on a profile
HALVINGS = 8  # of the way to a point at which the likelihood is finite
FIRST_ROWS = 1 << 14  # rows of a long recording that say where climbs from drawn starts begin
LONG_RECORDING = 1 << 17  # rows
TINY = 1e-300


class LeastCurvature(NamedTuple):
    """How the log-likelihood l bends at a point, by the Hessian H of -l in units of standard errors.

    Args:
        least: least eigenvalue of H; negative at a saddle.
        direction: its eigenvector in unconstrained coordinates (p,).
        gain: what a Newton step would gain, g' |H|^-1 g / 2 with the gradient g of l, in nats.
    """

    least: float
    direction: Float[np.ndarray, " p"]
    gain: float


@dataclass(frozen=True)
class LikelihoodSurface:
    """The log-likelihood l of all recordings as a function of the free numbers; the last evaluation is cached.

    A point is a vector x (p,) of the free numbers as unconstrained coordinates.
    """

    objective: Objective
    data: LikelihoodData
    _last: list[tuple[np.ndarray, Evaluation]] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def domains(self) -> OpenEnds:
        """Return which coordinates end at minus infinity (`low`) and at infinity (`high`): logarithms and logits.

        A coordinate is a free number, or its logarithm or logit if its domain has ends. `single`: which coordinates are
        of a number on an interval, and not an entry of a covariance or a law that has several coordinates.
        """
        every = self.objective.description.parameters.every
        low, high = (np.concatenate(column) for column in zip(*map(_find_ends_at_infinity, every), strict=True))
        single = np.concatenate([np.full(number.size, number.domain.kind == "interval") for number in every])
        return OpenEnds(low=low, high=high, single=single & (low | high))

    def of_first_rows(self) -> "LikelihoodSurface | None":
        """Return the likelihood of only the first FIRST_ROWS (16,384) rows of recordings, which costs little.

        None if recordings are shorter than LONG_RECORDING (131,072) rows.
        """
        data = self.data
        if data.measurements.shape[1] < LONG_RECORDING:
            return None
        first_rows = LikelihoodData(
            measurements=data.measurements[:, :FIRST_ROWS],
            inputs=data.inputs[:, :FIRST_ROWS],
            lengths=tuple(min(length, FIRST_ROWS) for length in data.lengths),
            truth=None if data.truth is None else data.truth[:, :FIRST_ROWS],
        )
        return LikelihoodSurface(self.objective, first_rows)

    def evaluations(self, x: Float[np.ndarray, "points p"]) -> Evaluation:
        """Return l, scores and information at each point (points, p); the last result is kept for equal points.

        A search asks at the same points for the value, the gradient and the information one after another. `self._last`
        holds the last points with their evaluation.
        """
        if self._last:
            last_points, last_evaluation = self._last[0]
            if np.array_equal(last_points, x):
                return last_evaluation
        evaluation = evaluate_at_points(self.objective, np.asarray(x), self.data)
        self._last[:] = [(np.array(x), evaluation)]
        return evaluation

    def evaluate_rows(self, x: Float[np.ndarray, "points p"]) -> Evaluation:
        """Return the evaluation at points (points, p) with densities and scores by row.

        Results by row are not kept for long recordings. For those, only sums over rows were kept, one block, so that
        they are evaluated again.
        """
        whole = self.evaluations(x)
        # The kept result has every row, unless recordings are long.
        if whole.density.shape[2] == self.data.measurements.shape[1]:
            return whole
        return evaluate_at_points(self.objective, np.asarray(x), self.data, by_row=True)

    def evaluate(self, x: Float[np.ndarray, "points p"]) -> Evaluated:
        """Return l (points,), its gradient (points, p) and its Gauss-Newton information (points, p, p) at points."""
        evaluation = self.evaluations(x)
        return evaluation.total, evaluation.gradient, evaluation.information

    def hessian(self, x: Float[np.ndarray, " p"], active: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
        """Return the Hessian of -l at x (p, p), by central differences of gradients: the observed information.

        Rows and columns of coordinates that are not `active` (p,), or of which the data say nothing, are those of the
        Gauss-Newton information.
        """
        information: np.ndarray = self.evaluations(x[None]).information[0]
        # Each coordinate is moved by DIFFERENCE_WIDTH standard errors to either side.
        diagonal = np.diag(information)
        has_information = diagonal > 0
        width = np.where(has_information, DIFFERENCE_WIDTH / np.sqrt(np.where(has_information, diagonal, 1.0)), 0.0)
        moving = np.flatnonzero(active & has_information)
        if not len(moving):
            return information
        shifts = np.zeros((len(moving), len(x)))
        shifts[np.arange(len(moving)), moving] = width[moving]
        gradient = self.evaluations(np.concatenate([x + shifts, x - shifts])).gradient
        forward = gradient[: len(moving)]
        backward = gradient[len(moving) :]
        # Row i, column j: -(dl/dx_j at x + w_i - dl/dx_j at x - w_i) / (2 w_i).
        block = (-(forward - backward) / (2 * width[moving][:, None]))[:, moving]
        # Made symmetric, as rounding leaves it almost.
        hessian: np.ndarray = information.copy()
        hessian[np.ix_(moving, moving)] = (block + block.T) / 2
        return hessian

    def information_by_row(
        self, x: Float[np.ndarray, " p"], coordinates: np.ndarray
    ) -> list[Float[np.ndarray, "steps k"]]:
        """Return for each recording each row's observed information on k coordinates, -d(score_k)/dx_k, (steps, k).

        By central differences at the point x (p,), over DIFFERENCE_WIDTH standard errors; `coordinates`: their indices.
        `evaluate_rows(points).score` is (points, recordings, steps, p).
        """
        deviation = self.standard_errors(x)[coordinates]
        # A number without a finite standard error is not moved, and has information 0.
        width = DIFFERENCE_WIDTH * np.where(np.isfinite(deviation), deviation, 0.0)
        shifts = np.zeros((len(coordinates), len(x)))
        shifts[np.arange(len(coordinates)), coordinates] = width
        score = self.evaluate_rows(np.concatenate([x + shifts, x - shifts])).score
        # From the points moved along coordinate k only the scores in k are taken: (recordings, steps, k).
        forward, backward = (
            np.stack([scores[..., k] for scores, k in zip(half, coordinates, strict=True)], axis=-1)
            for half in (score[: len(coordinates)], score[len(coordinates) :])
        )
        information = (backward - forward) / np.where(width > 0, 2 * width, 1.0)
        return [rows[:steps] for rows, steps in zip(information, self.data.lengths, strict=True)]

    def standard_errors(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return each coordinate's standard error at x if the others were known, (p,); infinite without information."""
        information: np.ndarray = np.diag(self.evaluations(x[None]).information[0])
        return np.where(information > 0, 1 / np.sqrt(np.where(information > 0, information, 1.0)), np.inf)

    def move_to_finite_likelihood(
        self, points: Float[np.ndarray, "points p"], near: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "points p"]:
        """Return the points, each moved towards `near` (p,), where l is finite, until l is finite at the point too.

        Each turn halves the distance. After HALVINGS turns the points are returned as they are.
        """
        points = points.copy()
        for _ in range(HALVINGS):
            is_impossible = ~np.isfinite(self.evaluations(points).total)
            if not is_impossible.any():
                break
            points[is_impossible] = (points[is_impossible] + near) / 2
        return points

    def measure_curvature(self, x: Float[np.ndarray, " p"], active: Bool[np.ndarray, " p"]) -> LeastCurvature:
        """Return the least curvature of -l at x, its direction, and what a step by the Hessian would gain.

        l is the log-likelihood of the free numbers x (p,). A negative least curvature means that x is no maximum but a
        saddle, from which the search goes on along the direction. Only coordinates with `active` (p,) true count, along
        directions that the data identify, and lengths are in standard errors. The gain is infinite if the Hessian is
        not finite, and 0 if the data identify no direction.
        """
        evaluation = self.evaluations(x[None])
        coordinates = np.flatnonzero(active)
        information = evaluation.information[0][np.ix_(coordinates, coordinates)]
        gradient = evaluation.gradient[0][coordinates]
        # `unit`: standard error of each coordinate alone, 1 / sqrt(I_ii) of the information I. In these units,
        # eigenvectors of the information with eigenvalues above FLAT_EIGENVALUE are the identified directions; `basis`
        # has them as columns.
        unit = np.where(np.diag(information) > 0, 1 / np.sqrt(np.maximum(np.diag(information), TINY)), 0.0)
        eigenvalues, directions = np.linalg.eigh(information * unit[:, None] * unit)
        basis = unit[:, None] * directions[:, eigenvalues > FLAT_EIGENVALUE]
        if not basis.size:
            return LeastCurvature(least=np.inf, direction=np.zeros(len(x)), gain=0.0)
        # The Hessian of -l along these directions. If it is not finite, the gain is unknown, and said to be infinite.
        observed = basis.T @ self.hessian(x, active)[np.ix_(coordinates, coordinates)] @ basis
        if not np.isfinite(observed).all():
            return LeastCurvature(least=np.inf, direction=np.zeros(len(x)), gain=np.inf)
        # Its least eigenvalue, with the direction in coordinates x.
        curvatures, vectors = np.linalg.eigh(observed)
        direction = np.zeros(len(x))
        direction[coordinates] = basis @ vectors[:, 0]
        # Gain of a Newton step for the gradient g and the Hessian H, g' |H|^-1 g / 2, in eigenvectors of H.
        slopes = vectors.T @ basis.T @ gradient
        gain = float(np.sum(slopes**2 / np.maximum(np.abs(curvatures), FLAT_EIGENVALUE)) / 2)
        return LeastCurvature(least=float(curvatures[0]), direction=direction, gain=gain)

    def find_profile_crossings(
        self,
        x: Float[np.ndarray, " p"],
        top: float,
        coordinate: int,
        first: Float[np.ndarray, " ends"],
        furthest: float,
        drop: float,
        active: Bool[np.ndarray, " p"],
    ) -> Float[np.ndarray, " ends"]:
        """Return the values of a coordinate at which the profile of the log-likelihood l has fallen by `drop`.

        The profile at a value is l with all other active coordinates at their best. Its fall is f = sqrt(2 (top - l)),
        linear in the distance t from the maximum where l is quadratic: so t is found by Newton's method for
        f(t) = sqrt(2 drop), kept between a distance known to be inside and one known to be outside.

        At most MOST_CUTS distances are tried. An end that is not found by then is the last one tried; one that lies
        beyond `furthest` is infinite. ACCURACY_OF_FALL is 1e-3, relative.

        Args:
            x: the maximum (p,).
            top: l there.
            coordinate: index of the coordinate whose profile is followed.
            first: signed distances at which to begin, one for each end that is sought (ends,).
            furthest: distance of an end that is taken for infinite: the profile has not fallen enough up to it.
            drop: fall of l at the ends, in nats.
            active: coordinates that are inside their domains (p,).

        Returns:
            The ends, one for each of `first` (ends,).
        """
        moving = np.repeat((active & (np.arange(len(x)) != coordinate))[None], len(first), axis=0)
        points = np.repeat(x[None], len(first), axis=0)  # where climbs of the other coordinates begin
        side, distance = np.sign(first), np.abs(first)
        target = np.sqrt(2 * drop)  # the fall f at an end
        inside = np.zeros(len(first))
        outside = np.full(len(first), np.inf)  # distances that bracket each end
        for _ in range(MOST_CUTS):
            # The profile at these distances: l with the other coordinates at their best.
            points[:, coordinate] = x[coordinate] + side * distance
            climbed = maximise_from_starts(self.evaluate, points, moving, domains=self.domains, close=CLOSE_ON_PROFILE)
            fall = _measure_fall(top, climbed.total)
            # Narrow the bracket: `inside` has not fallen to the target, `outside` has fallen further.
            is_beyond = fall > target
            inside = np.where(is_beyond, inside, distance)
            outside = np.where(is_beyond, distance, outside)
            points = np.where(is_beyond[:, None], points, climbed.x)
            # Done where the fall is the target, the bracket is closed, or the profile has not fallen at `furthest`.
            is_there = np.abs(fall - target) < ACCURACY_OF_FALL * target
            never_falls = ~is_beyond & (distance >= furthest)
            is_closed = outside - inside < ACCURACY_OF_FALL * ACCURACY_OF_FALL * outside
            done = is_there | never_falls | is_closed
            if done.all():
                return np.asarray(x[coordinate] + side * np.where(never_falls & ~is_there, np.inf, distance))
            # Newton's next distance: df/dt = -side dl/dx / f. The profile has the slope dl/dx of l, as the other
            # coordinates are at their best.
            with np.errstate(all="ignore"):
                newton = distance + (target - fall) * fall / (-side * climbed.gradient[:, coordinate])
            distance = np.where(done, distance, _choose_next_distances(newton, distance, inside, outside, furthest))
        return np.asarray(x[coordinate] + side * distance)  # the last points, after MOST_CUTS rounds


def _measure_fall(top: float, total: np.ndarray) -> np.ndarray:
    """Return sqrt(2 (top - l)) for log-likelihoods l (`total`); 0 where l is above the top, infinite where it is NaN.

    Where l is quadratic, this fall is proportional to the distance from its maximum.
    """
    with np.errstate(over="ignore"):  # of an infinite fall
        return np.asarray(np.sqrt(2 * np.maximum(top - np.nan_to_num(total, nan=-np.inf), 0.0)))


def _choose_next_distances(
    newton: np.ndarray, distance: np.ndarray, inside: np.ndarray, outside: np.ndarray, furthest: float
) -> np.ndarray:
    """Return the distances to look at next (ends,): Newton's if it lies inside the bracket, else the bracket's middle.

    Args:
        newton: distances that Newton's method proposes (ends,).
        distance: distances just looked at (ends,).
        inside: largest distances known to be nearer than the ends that are sought (ends,).
        outside: smallest known to be further, infinite where none is known yet (ends,). Then the bracket ends at three
            times `distance`, and this end is taken in place of the middle.
        furthest: no distance is above it.
    """
    is_closed = np.isfinite(outside)
    bracket_end = np.minimum(np.where(is_closed, outside, 3 * distance), furthest)
    is_within = np.isfinite(newton) & (newton > inside) & (newton < bracket_end)
    fallback = np.where(is_closed, (inside + bracket_end) / 2, bracket_end)
    return np.where(is_within, newton, fallback)


def _find_ends_at_infinity(parameter: Parameter) -> tuple[Bool[np.ndarray, " size"], Bool[np.ndarray, " size"]]:
    """Return which coordinates of a free number reach an end of its domain at minus infinity, and which at infinity.

    Logits (such as of probabilities) have both ends. Logarithms have the end at minus infinity; a covariance has them
    on its diagonal. A real number without ends has none. `domain.low`, `domain.high`: ends of an interval, infinite
    where it has none. A logarithm of the distance from either end has its end at minus infinity.
    """
    domain, none = parameter.domain, np.zeros(parameter.size, dtype=bool)
    if domain.kind == "simplex":
        return ~none, ~none
    if domain.kind == "covariance":
        is_diagonal = np.eye(len(parameter.start), dtype=bool)[np.tril_indices(len(parameter.start))]
        return is_diagonal, none
    has_end = np.isfinite([domain.low, domain.high])
    return none | has_end.any(), none | has_end.all()
