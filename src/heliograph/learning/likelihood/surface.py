"""Likelihood of recordings over the free numbers: climbed, cut along one of them, and measured at its top."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from heliograph.learning.likelihood.data import LikelihoodData
from heliograph.learning.likelihood.evaluation import Evaluation, evaluate_at_points
from heliograph.learning.likelihood.objective import Objective
from heliograph.learning.likelihood.trust_region import Evaluated, OpenEnds, maximise
from heliograph.learning.likelihood.trust_region_step import FLAT
from heliograph.learning.parameters import Parameter
from heliograph.numerics.types import Bool, Float

DIFFERENCE = 1e-3  # standard errors over which scores are differenced
CUTS = 40  # of a profile at most
EXACT = 1e-3  # of the root of a fall
ENOUGH = 1e-6  # nats that may remain to be gained on a profile
HALVINGS = 8  # of the way to a possible point
FIRST = 1 << 14  # rows of a long recording that say where climbs from drawn starts begin
LONG = 1 << 17  # rows
TINY = 1e-300


class Curvature(NamedTuple):
    """Least eigenvalue of the Hessian of -l in standard errors, its direction (p,), and g' |H|^-1 g / 2."""

    least: float
    direction: Float[np.ndarray, " p"]
    gain: float


@dataclass(frozen=True)
class LikelihoodSurface:
    """The likelihood of all recordings as a function of the free numbers; the last evaluation is cached for reuse."""

    objective: Objective
    data: LikelihoodData
    _last: list[tuple[np.ndarray, Evaluation]] = field(default_factory=list, repr=False, compare=False)

    @cached_property
    def domains(self) -> OpenEnds:
        """Return which coordinates are logarithms and logits, and at which side their domains end."""
        every = self.objective.description.parameters.every
        low, high = (np.concatenate(column) for column in zip(*map(_find_ends_at_infinity, every), strict=True))
        single = np.concatenate([np.full(number.size, number.domain.kind == "interval") for number in every])
        return OpenEnds(low, high, single & (low | high))

    def of_first_rows(self) -> "LikelihoodSurface | None":
        """Return the likelihood of the first rows of long recordings alone; None where they are not long."""
        data = self.data
        if data.measurements.shape[1] < LONG:
            return None
        truth = None if data.truth is None else data.truth[:, :FIRST]
        lengths = tuple(min(length, FIRST) for length in data.lengths)
        return LikelihoodSurface(
            self.objective, LikelihoodData(data.measurements[:, :FIRST], data.inputs[:, :FIRST], lengths, truth)
        )

    def evaluations(self, x: Float[np.ndarray, "points p"]) -> Evaluation:
        """Return value, score and information at each point; those of the last points are kept."""
        if not (self._last and np.array_equal(self._last[0][0], x)):
            self._last[:] = [(np.array(x), evaluate_at_points(self.objective, np.asarray(x), self.data))]
        return self._last[0][1]

    def evaluate_rows(self, x: Float[np.ndarray, "points p"]) -> Evaluation:
        """Return the evaluation at points with densities and scores by row, which are not cached of long recordings."""
        whole = self.evaluations(x)
        if whole.density.shape[2] == self.data.measurements.shape[1]:
            return whole
        return evaluate_at_points(self.objective, np.asarray(x), self.data, by_row=True)

    def evaluate(self, x: Float[np.ndarray, "points p"]) -> Evaluated:
        """Return the likelihood, gradient and information at points."""
        evaluation = self.evaluations(x)
        return evaluation.total, evaluation.gradient, evaluation.information

    def hessian(self, x: Float[np.ndarray, " p"], active: Bool[np.ndarray, " p"]) -> Float[np.ndarray, "p p"]:
        """Return the Hessian of -l, by central differences of scores; the information for coordinates not active."""
        information: np.ndarray = self.evaluations(x[None]).information[0]
        diagonal = np.diag(information)
        width = np.where(diagonal > 0, DIFFERENCE / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 0.0)
        moving = np.flatnonzero(active & (diagonal > 0))
        shifts = np.zeros((len(moving), len(x)))
        shifts[np.arange(len(moving)), moving] = width[moving]
        if not len(moving):
            return information
        gradient = self.evaluations(np.concatenate([x + shifts, x - shifts])).gradient
        hessian: np.ndarray = information.copy()
        forward, backward = gradient[: len(moving)], gradient[len(moving) :]
        block = (-(forward - backward) / (2 * width[moving][:, None]))[:, moving]
        hessian[np.ix_(moving, moving)] = (block + block.T) / 2
        return hessian

    def information_by_row(self, x: Float[np.ndarray, " p"], places: np.ndarray) -> list[Float[np.ndarray, "steps k"]]:
        """Return for each recording the information of each row on some coordinates, -ds_k/dx_k, (steps, k).

        By central differences; `places`: the coordinates.
        """
        deviation = self.standard_errors(x)[places]
        width = DIFFERENCE * np.where(np.isfinite(deviation), deviation, 0.0)
        shifts = np.zeros((len(places), len(x)))
        shifts[np.arange(len(places)), places] = width
        score = self.evaluate_rows(np.concatenate([x + shifts, x - shifts])).score
        # Of the point moved along coordinate k the scores in k, (recordings, steps, k).
        forward, backward = (
            np.stack([scores[..., k] for scores, k in zip(half, places, strict=True)], axis=-1)
            for half in (score[: len(places)], score[len(places) :])
        )
        information = (backward - forward) / np.where(width > 0, 2 * width, 1.0)
        return [rows[:steps] for rows, steps in zip(information, self.data.lengths, strict=True)]

    def standard_errors(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " p"]:
        """Return the standard error of each number at a point, were the others known; infinite if nothing tells it."""
        information: np.ndarray = np.diag(self.evaluations(x[None]).information[0])
        return np.where(information > 0, 1 / np.sqrt(np.where(information > 0, information, 1.0)), np.inf)

    def possible(
        self, points: Float[np.ndarray, "points p"], near: Float[np.ndarray, " p"]
    ) -> Float[np.ndarray, "points p"]:
        """Return the points; those where the likelihood is not finite halfway to `near`, where it is, and so on."""
        points = points.copy()
        for _ in range(HALVINGS):
            wrong = ~np.isfinite(self.evaluations(points).total)
            if not wrong.any():
                break
            points[wrong] = (points[wrong] + near) / 2
        return points

    def curvature(self, x: Float[np.ndarray, " p"], active: Bool[np.ndarray, " p"]) -> Curvature:
        """Return the curvature of -l along the directions that are identified, in standard errors, at a point (p,)."""
        evaluation, places = self.evaluations(x[None]), np.flatnonzero(active)
        information = evaluation.information[0][np.ix_(places, places)]
        gradient = evaluation.gradient[0][places]
        # Directions in which the information, in units of standard errors, is above zero, in columns.
        unit = np.where(np.diag(information) > 0, 1 / np.sqrt(np.maximum(np.diag(information), TINY)), 0.0)
        eigenvalues, directions = np.linalg.eigh(information * unit[:, None] * unit)
        basis = unit[:, None] * directions[:, eigenvalues > FLAT]
        if not basis.size:
            return Curvature(least=np.inf, direction=np.zeros(len(x)), gain=0.0)
        observed = basis.T @ self.hessian(x, active)[np.ix_(places, places)] @ basis
        if not np.isfinite(observed).all():
            return Curvature(least=np.inf, direction=np.zeros(len(x)), gain=np.inf)
        values, vectors = np.linalg.eigh(observed)
        direction = np.zeros(len(x))
        direction[places] = basis @ vectors[:, 0]
        slopes = vectors.T @ basis.T @ gradient
        gain = float(np.sum(slopes**2 / np.maximum(np.abs(values), FLAT)) / 2)
        return Curvature(float(values[0]), direction, gain)

    def crossings(
        self,
        x: Float[np.ndarray, " p"],
        top: float,
        coordinate: int,
        first: Float[np.ndarray, " lanes"],
        furthest: float,
        drop: float,
        active: Bool[np.ndarray, " p"],
    ) -> Float[np.ndarray, " lanes"]:
        """Return where the log-likelihood, with its other active coordinates at their best, is `drop` below `top`.

        Newton's method for h = sqrt(2 (top - l)), which is linear where l is quadratic, between what is known to be
        inside and outside; dl/dx of the profile is the score of the coordinate alone.

        Args:
            x: the maximum (p,).
            top: the log-likelihood there.
            coordinate: the one that is cut.
            first: signed distances at which to begin, to either side.
            furthest: distance at which a likelihood that has not fallen is taken never to: the end is infinite.
            drop: fall at the ends.
            active: coordinates that are inside their domains (p,).
        """
        others = active & (np.arange(len(x)) != coordinate)
        moving, points = np.repeat(others[None], len(first), axis=0), np.repeat(x[None], len(first), axis=0)
        side, target, at = np.sign(first), np.sqrt(2 * drop), np.abs(first)
        inside, outside = np.zeros(len(first)), np.full(len(first), np.inf)
        # Distances `inside` where the likelihood has not fallen so far, and `outside` where it has fallen further.
        for _ in range(CUTS):
            points[:, coordinate] = x[coordinate] + side * at
            climbed = maximise(self.evaluate, points, moving, None, self.domains, ENOUGH)
            # dh/dt = -side dl/dx / h for the distance t, so that Newton's t+ is t + (target - h) h / (-side dl/dx).
            with np.errstate(all="ignore"):
                fallen = np.sqrt(2 * np.maximum(top - np.nan_to_num(climbed.total, nan=-np.inf), 0.0))
                newton = at + (target - fallen) * fallen / (-side * climbed.gradient[:, coordinate])
            is_there = np.abs(fallen - target) < EXACT * target
            beyond = fallen > target
            inside, outside = np.where(beyond, inside, at), np.where(beyond, at, outside)
            points = np.where(beyond[:, None], points, climbed.x)
            never_falls = ~beyond & (at >= furthest)
            done = is_there | never_falls | (outside - inside < EXACT * EXACT * outside)
            if done.all():
                return np.asarray(x[coordinate] + side * np.where(never_falls & ~is_there, np.inf, at))
            # Within the bracket; where nothing is outside yet, at most three times as far.
            most = np.minimum(np.where(np.isfinite(outside), outside, 3 * at), furthest)
            within = np.isfinite(newton) & (newton > inside) & (newton < most)
            middle = np.where(np.isfinite(outside), (inside + most) / 2, most)
            at = np.where(done, at, np.where(within, newton, middle))
        return np.asarray(x[coordinate] + side * at)  # the last points, after CUTS rounds


def _find_ends_at_infinity(parameter: Parameter) -> tuple[Bool[np.ndarray, " size"], Bool[np.ndarray, " size"]]:
    """Return which coordinates of a number have an end of its domain at minus infinity, and which at infinity."""
    domain, none = parameter.domain, np.zeros(parameter.size, dtype=bool)
    if domain.kind == "simplex":
        return ~none, ~none
    if domain.kind == "covariance":
        return np.eye(len(parameter.start), dtype=bool)[np.tril_indices(len(parameter.start))], none
    sides = np.isfinite([domain.low, domain.high])
    return none | sides.any(), none | sides.all()
