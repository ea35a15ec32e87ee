"""Maximum of one form of the likelihood: where it is, what is at a limit or a ridge, and how well it is known."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from heliograph.learning.intervals import DRAWS, LEVEL, Method, Scores, block_sums, long_run, quantile, sandwich
from heliograph.learning.likelihood.objective import Form
from heliograph.learning.likelihood.surface import REACH, Surface
from heliograph.learning.likelihood.transforms import link, unlink
from heliograph.learning.parameters import Entry, Parameters
from heliograph.learning.ridges import Rank, rank_of
from heliograph.numerics.module import readable
from heliograph.numerics.types import Bool, Float

ONE_SIDED = 1.3528  # half the 90 % point of chi-square with one degree of freedom: 95 % on one side
TWO_SIDED = 1.9207  # half its 95 % point
ALONG = 1e-5  # share of a number's derivative that may lie along a ridge


@readable
class Row(NamedTuple):
    """Row of the table of a fit: a free number by one form of the likelihood.

    Args:
        name: the number's name.
        estimate: the estimate.
        low: lower end of the 95 % interval; NaN if not identified.
        high: upper end.
        standard_error: standard error of the estimate; NaN at a boundary or if not identified.
        form: "linear" or "conditional".
        boundary: true if the estimate is the end of the number's domain; the interval is from there to the other end.
        identified: true if the data identify this number without knowledge of the others.
    """

    name: str
    estimate: float
    low: float
    high: float
    standard_error: float
    form: Form
    boundary: bool
    identified: bool


@dataclass(frozen=True)
class Solution:
    """Maximum of the likelihood in one form.

    Args:
        surface: the likelihood.
        x: the maximum on the line (p,).
        total: log-likelihood there, in nats.
        active: which coordinates are not at a boundary (p,).
        converged: true if the climb came to a maximum.
        steps: steps of the climb.
        ridges: number of directions in which the likelihood does not change.
    """

    surface: Surface
    x: Float[np.ndarray, " p"]
    total: float
    active: Bool[np.ndarray, " p"]
    converged: bool
    steps: int
    ridges: int

    @property
    def form(self) -> Form:
        """Form of the likelihood."""
        return self.surface.objective.form

    @property
    def parameters(self) -> Parameters:
        """Free numbers."""
        return self.surface.objective.description.parameters

    @cached_property
    def scores(self) -> Scores:
        """Scores of each step, by recording, among active coordinates."""
        score = self.surface.evaluations(self.x[None]).score[0][..., self.active]
        return [s[:steps] for s, steps in zip(score, self.surface.data.lengths, strict=True)]

    @cached_property
    def rank(self) -> Rank:
        """Flat directions at the maximum, among active coordinates, as many as the ridges."""
        return cut(self.surface.evaluations(self.x[None]).late[0][np.ix_(self.active, self.active)], self.ridges)

    @cached_property
    def hessian(self) -> Float[np.ndarray, "r r"]:
        """Hessian of -l along the identified directions."""
        observed = self.surface.hessian(self.x, self.active)[np.ix_(self.active, self.active)]
        reduced = self._reduced(observed)
        if np.linalg.eigvalsh(reduced)[:1].sum() > 0:
            return reduced
        information = self.surface.evaluations(self.x[None]).information[0]
        return self._reduced(information[np.ix_(self.active, self.active)])

    @property
    def basis(self) -> Float[np.ndarray, "active r"]:
        """Identified directions, in columns."""
        return np.asarray(self.rank.unit[:, None] * self.rank.rest)

    def _reduced(self, matrix: np.ndarray) -> np.ndarray:
        return np.asarray(self.basis.T @ matrix @ self.basis)

    def covariance(self, method: Method = "cosines") -> tuple[Float[np.ndarray, "active active"], float]:
        """Covariance of the active coordinates along the identified directions, and degrees of freedom."""
        scores = [s @ self.basis for s in self.scores]
        if method == "bootstrap":
            drawn = np.linalg.solve(self.hessian, block_sums(scores, DRAWS, 0).T)
            return np.asarray(self.basis @ np.cov(drawn).reshape(len(drawn), -1) @ self.basis.T), np.inf
        estimate = long_run(method, scores, self.hessian)
        return np.asarray(self.basis @ sandwich(self.hessian, estimate.covariance) @ self.basis.T), estimate.freedom

    def rows(self, method: Method = "cosines") -> tuple[Row, ...]:
        """Table by this form."""
        covariance, freedom = self.covariance("hessian" if method == "profile" else method)
        values, slopes = self.parameters.entries_at(self.x), self.parameters.slopes(self.x)[:, self.active]
        return tuple(
            self._row(entry, float(value), row, covariance, freedom, method)
            for entry, value, row in zip(self.parameters.entries, values, slopes, strict=True)
        )

    def _row(
        self, entry: Entry, value: float, slopes: np.ndarray, covariance: np.ndarray, freedom: float, method: Method
    ) -> Row:
        if entry.coordinate is not None and not self.active[entry.coordinate]:
            return self._at_boundary(entry, value)
        if not self.identifies(slopes):
            return Row(entry.name, value, np.nan, np.nan, np.nan, self.form, False, False)
        error = float(np.sqrt(max(slopes @ covariance @ slopes, 0.0)))
        center = link(entry.domain, value)
        if method == "profile" and entry.coordinate is not None:
            low, high = self._profile(entry.coordinate, error)
        elif method == "bootstrap":
            low, high = center + self._drawn(slopes)
        else:
            low, high = center + quantile(freedom) * error * np.array([-1.0, 1.0])
        least, most = sorted(float(unlink(entry.domain, end)) for end in (low, high))
        width = abs(float(unlink(entry.domain, center + 1e-6) - unlink(entry.domain, center - 1e-6))) / 2e-6
        return Row(entry.name, value, least, most, error * width, self.form, False, True)

    def identifies(self, slopes: Float[np.ndarray, " active"]) -> bool:
        """Decide whether the data identify a function of the coordinates with this derivative."""
        along = self.rank.unit * slopes
        size = np.linalg.norm(along)
        return bool(size > 0 and np.linalg.norm(along @ self.rank.flat) <= ALONG * size)

    def _drawn(self, slopes: np.ndarray) -> np.ndarray:
        """Ends of an interval by blocks of scores drawn anew, less the estimate."""
        drawn = np.linalg.solve(self.hessian, block_sums([s @ self.basis for s in self.scores], DRAWS, 0).T)
        ends: np.ndarray = np.quantile(slopes @ self.basis @ drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
        return ends

    def _profile(self, coordinate: int, error: float) -> tuple[float, float]:
        here = self.x[coordinate]
        low, high = (
            self.surface.crossing(self.x, self.total, coordinate, here + sign * error * REACH, TWO_SIDED, self.active)
            for sign in (-1.0, 1.0)
        )
        return low, high

    def _at_boundary(self, entry: Entry, value: float) -> Row:
        """Row of a number at a limit: from there to where the profile has fallen so far that 95 % are below."""
        assert entry.coordinate is not None
        outward = -1.0 if self.x[entry.coordinate] < 0 else 1.0
        points = np.repeat(self.x[None], 33, axis=0)
        points[:, entry.coordinate] = reach = -outward * np.linspace(-24.0, 8.0, 33)
        totals = self.surface.evaluations(points).total
        fallen = np.flatnonzero(~(totals > self.total - ONE_SIDED))
        last = int(fallen[0]) if len(fallen) else len(reach) - 1
        ends = reach[max(last - 1, 0)] + np.array([0.0, 0.4, 0.8, 1.2, 1.6, 2.0, 3.0, 5.0]) * -outward
        end = self.surface.crossing(self.x, self.total, entry.coordinate, ends, ONE_SIDED, self.active)
        limit = float(unlink(entry.domain, end)) if np.isfinite(end) else float(unlink(entry.domain, -outward * np.inf))
        return Row(entry.name, value, min(value, limit), max(value, limit), np.nan, self.form, True, True)


def cut(late: Float[np.ndarray, "p p"], ridges: int) -> Rank:
    """Rank of the second half's information, with as many flat directions as there are ridges.

    What is known before the first step pins a ridge weakly; that does not grow with the data, and is not used.
    """
    rank = rank_of(late)
    if rank.flat.shape[1] == ridges:
        return rank
    diagonal = np.diag(late)
    unit = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
    _, vectors = np.linalg.eigh(late * unit[:, None] * unit)
    return rank._replace(flat=vectors[:, :ridges], rest=vectors[:, ridges:], unit=unit)
