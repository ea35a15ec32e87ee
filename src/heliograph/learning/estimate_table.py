"""Table of estimates with intervals: of the maximum of one form of the likelihood, and what is at a limit or a ridge.

Free numbers have unconstrained coordinates: logarithms or logits of those whose domain has ends. A coordinate is
active if its number is not at such an end. A ridge is a direction in which the likelihood does not change.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from heliograph.learning.estimate_row import Row, make_unidentified_row
from heliograph.learning.free_parameters import Parameters, TableEntry
from heliograph.learning.likelihood.multistart import WAY_TO_END, HighestPoint
from heliograph.learning.likelihood.objective import Form
from heliograph.learning.likelihood.parameter_transforms import (
    from_unconstrained,
    slope_from_unconstrained,
    to_unconstrained,
)
from heliograph.learning.likelihood.surface import LikelihoodSurface
from heliograph.learning.long_run_covariance import (
    BOOTSTRAP_DRAWS,
    LEVEL,
    Method,
    Scores,
    bootstrap_block_sums,
    compute_sandwich_covariance,
    estimate_long_run_covariance,
    find_numbers_in_few_stretches,
    find_profile_drop,
    remove_predicted_scores,
    student_quantile,
)
from heliograph.learning.unidentified_directions import InformationRank, find_rank_of_late_rows
from heliograph.numerics.types import Bool, Float

WIDE_ERROR = 1.0  # standard error of a logarithm or a logit above which an interval is cut out of the likelihood
FURTHEST_LOGARITHM = 40.0  # steps of a logarithm or a logit to what cannot be told from the end of its domain
FURTHEST_REAL = 1000.0  # times two standard errors, to where a real number's likelihood does not fall at all
LARGEST_SHARE_ALONG_RIDGE = 1e-5  # share of a number's derivative that may lie along a ridge


@dataclass(frozen=True, repr=False)
class Solution:
    """Maximum of the likelihood in one form ("linear" or "conditional"), with the table of estimates.

    Args:
        surface: the likelihood as a function of the free numbers.
        top: where the search for its maximum ended.
        ridges: number of directions in which the likelihood does not change.
    """

    surface: LikelihoodSurface
    top: HighestPoint
    ridges: int
    _tables: dict[tuple[Method, float], tuple[Row, ...]] = field(default_factory=dict, repr=False, compare=False)

    def __repr__(self) -> str:
        """Return the form, the log-likelihood, whether the search converged, and the estimates, in one line."""
        numbers = dict(zip([entry.name for entry in self.parameters.entries],
                           self.parameters.entries_at(self.x).tolist(), strict=True))  # fmt: skip
        state = "converged" if self.converged else "not converged"
        values = ", ".join(f"{name} {value:.4g}" for name, value in numbers.items())
        return f"Solution({self.form}: log-likelihood {self.total:.6g}, {state}; {values})"

    @property
    def x(self) -> Float[np.ndarray, " p"]:
        """The maximum in unconstrained coordinates (p,): +-infinity where a number is at an end of its domain."""
        return self.top.limit

    @property
    def total(self) -> float:
        """Log-likelihood at the maximum, in nats."""
        return self.top.total

    @property
    def active(self) -> Bool[np.ndarray, " p"]:
        """Return which coordinates are not at a boundary (p,)."""
        return self.top.active

    @property
    def converged(self) -> bool:
        """True if the search came to a maximum."""
        return self.top.converged

    @property
    def steps(self) -> int:
        """Count of steps of the last climb to the maximum."""
        return self.top.steps

    @property
    def form(self) -> Form:
        """Name of the form of likelihood that was maximised."""
        return self.surface.objective.form

    @property
    def parameters(self) -> Parameters:
        """Free numbers of the model that was fitted."""
        return self.surface.objective.description.parameters

    @cached_property
    def scores(self) -> Scores:
        """For each recording the score of each row, the gradient of its log-likelihood (steps, active coordinates)."""
        score = self.surface.evaluate_rows(self.top.x[None]).score[0][..., self.active]
        return [s[:steps] for s, steps in zip(score, self.surface.data.lengths, strict=True)]

    @cached_property
    def rank(self) -> InformationRank:
        """Directions of active coordinates in which the likelihood is constant, as many as `ridges`, and all others."""
        information = self.surface.evaluations(self.top.x[None]).late[0]  # of the second half of the rows
        return find_rank_of_late_rows(information[np.ix_(self.active, self.active)], self.ridges)

    @cached_property
    def hessian(self) -> Float[np.ndarray, "r r"]:
        """Hessian of -l along the r identified directions, B' H B with B = `basis`.

        If it is not positive definite, as by rounding, the Gauss-Newton information takes its place. `basis` (active,
        r) has these directions as columns, in the coordinates of `active` numbers, those not at an end of their domain;
        `_project_on_identified` multiplies by it from both sides.
        """
        hessian_of_active = self.surface.hessian(self.top.x, self.active)[np.ix_(self.active, self.active)]
        hessian = self._project_on_identified(hessian_of_active)
        least_eigenvalue = np.linalg.eigvalsh(hessian)[:1].sum()  # 0 if there is no direction
        if least_eigenvalue > 0:
            return hessian
        information = self.surface.evaluations(self.top.x[None]).information[0]
        return self._project_on_identified(information[np.ix_(self.active, self.active)])

    @property
    def basis(self) -> Float[np.ndarray, "active r"]:
        """Directions of the active coordinates that the data identify, in columns.

        `rank.rest` has them in units of each coordinate's standard error, `rank.unit`.
        """
        return np.asarray(self.rank.unit[:, None] * self.rank.rest)

    def _project_on_identified(self, matrix: np.ndarray) -> np.ndarray:
        """Return a matrix of the active coordinates along the identified directions, B' A B."""
        return np.asarray(self.basis.T @ matrix @ self.basis)

    @cached_property
    def in_few_stretches(self) -> Bool[np.ndarray, " active"]:
        """Which active coordinates (active,) are real numbers that only a few stretches of the data inform of.

        The scores of such a number, as of a bias after a rare event, do not tell how far its estimate varies. Asked is
        only where the data identify all directions: `rank.flat` (p, directions) has those that they do not.
        """
        free = np.flatnonzero(self.active & self.surface.domains.free)
        in_few_stretches = np.zeros(len(self.active), dtype=bool)
        if len(free) and not self.rank.flat.size:
            in_few_stretches[free] = find_numbers_in_few_stretches(self.surface.information_by_row(self.top.x, free))
        return np.asarray(in_few_stretches[self.active])

    def covariance(self, method: Method = "cosines") -> tuple[Float[np.ndarray, "active active"], float]:
        """Return the covariance of the active coordinates along the identified directions, and its degrees of freedom.

        It is H^-1 J H^-1, with H the Hessian of -l and J the covariance of the sum of scores (gradients of l by row),
        estimated by `method`. Numbers whose information is in a few stretches of the data (`in_few_stretches`) have the
        model's J. `basis` (active, r): the identified directions; `scores` are cut to them, and the result brought
        back.
        """
        scores = self.scores
        by_model = np.zeros((len(self.in_few_stretches), len(self.in_few_stretches)))  # the part of J by the model
        if self.in_few_stretches.any():
            # Here all directions are identified, so that the Hessian can be brought back to the active coordinates.
            inverse = np.linalg.inv(self.basis)
            scores, by_model = remove_predicted_scores(
                scores, inverse.T @ self.hessian @ inverse, self.in_few_stretches
            )
        estimate = estimate_long_run_covariance(method, [s @ self.basis for s in scores], self.hessian)
        if method != "hessian":
            estimate = estimate._replace(covariance=estimate.covariance + self._project_on_identified(by_model))
        sandwich = compute_sandwich_covariance(self.hessian, estimate.covariance)
        return np.asarray(self.basis @ sandwich @ self.basis.T), estimate.freedom

    def rows(self, method: Method = "cosines", level: float = LEVEL) -> tuple[Row, ...]:
        """Return the table of estimates by this form, with intervals by a method; it is computed at the first call.

        Args:
            method: how intervals are computed: "cosines" and "bartlett" allow for scores that are correlated over time,
                "white" does not, "hessian" believes the model, "profile" cuts the likelihood, "bootstrap" draws blocks
                of scores.
            level: probability with which an interval holds the number.
        """
        key = method, level
        if key not in self._tables:
            self._tables[key] = self._make_rows(method, level)
        return self._tables[key]

    @property
    def has_rows(self) -> bool:
        """True if the default table was computed."""
        return ("cosines", LEVEL) in self._tables

    def describe_with_cheap_errors(self) -> list[str]:
        """Return a line for each number: its estimate, and an interval by the expected information at the maximum.

        A printed fit shows it where `rows` were not asked for: it needs no derivatives by row.

        `active`: coordinates that are not at an end of their domain. `slopes`: derivatives of each table entry's
        logarithm or logit by them (entries, active).
        """
        active, values = self.active, self.parameters.entries_at(self.x)
        # A number's variance is g' I^-1 g, with its derivative g, unconstrained too, by the active coordinates.
        information = self.surface.evaluations(self.top.x[None]).information[0][np.ix_(active, active)]
        inverse = np.linalg.pinv(information, hermitian=True)
        slopes = self.parameters.slopes(self.top.x)[:, active]
        errors = np.sqrt(np.maximum(np.einsum("ei,ij,ej->e", slopes, inverse, slopes), 0.0))
        width = max(len(entry.name) for entry in self.parameters.entries)
        return [
            f"{entry.name:{width}}  {self._describe_entry(entry, float(value), slope, float(error))}  ({self.form})"
            for entry, value, slope, error in zip(self.parameters.entries, values, slopes, errors, strict=True)
        ]

    def _describe_entry(self, entry: TableEntry, value: float, slope: np.ndarray, error: float) -> str:
        """Return in words an estimate `value` and its interval, symmetric in the unconstrained number (log or logit).

        Args:
            entry: the number, with its domain.
            value: its estimate.
            slope: derivative of the unconstrained number by the active coordinates, which shows whether it is
                identified.
            error: standard error of the unconstrained number.
        """
        if entry.coordinate is not None and not self.active[entry.coordinate]:
            return f"{value:>10.4g}  (at the end of its domain)"
        if not self.identifies(slope):
            return f"{value:>10.4g}  (not identified)"
        with np.errstate(divide="ignore"):  # rounding may put a value at the end of its domain
            center = float(to_unconstrained(entry.domain, value))
            half = student_quantile(np.inf) * error  # infinitely many degrees of freedom: the normal law
            row = self._make_row(entry, value, error, (center - half, center + half))
        return f"{row.value:>10}  (about {row.interval})"

    def _make_rows(self, method: Method, level: float) -> tuple[Row, ...]:
        """Return a row for each number of the table: at a boundary, not identified, or with an interval by `method`.

        `active` marks coordinates that are not at an end of their domain; `identifies` says whether the data tell a
        number with these slopes.

        Args:
            method: how intervals are computed, "cosines", "bartlett", "white", "hessian", "profile" or "bootstrap".
            level: probability with which an interval holds the number.
        """
        covariance, freedom = self.covariance("hessian" if method == "profile" else method)
        # Estimates at the maximum, and their derivatives by the active coordinates x (logarithms, logits or numbers).
        values = self.parameters.entries_at(self.x)
        slopes = self.parameters.slopes(self.top.x)[:, self.active]
        rows = []
        for entry, value, slope in zip(self.parameters.entries, values, slopes, strict=True):
            error = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
            if entry.coordinate is not None and not self.active[entry.coordinate]:
                rows.append(self._make_boundary_row(entry, float(value), level))
            elif not self.identifies(slope):
                rows.append(make_unidentified_row(entry, float(value), self.form))
            else:
                ends = self._compute_interval(entry, float(value), slope, error, freedom, method, level)
                rows.append(self._make_row(entry, float(value), error, ends))
        return tuple(rows)

    def _compute_interval(
        self,
        entry: TableEntry,
        value: float,
        slopes: np.ndarray,
        error: float,
        freedom: float,
        method: Method,
        level: float,
    ) -> tuple[float, float]:
        """Return the ends of the interval of a number of the table, unconstrained (the number, its log or logit).

        By `method`: estimate +- quantile x standard error, or quantiles of a bootstrap, or where the profile of the
        likelihood has fallen. A logarithm or a logit that is hardly known (by less than a factor of e) has no symmetric
        interval: it is cut out of the profile whatever the method.

        `self.surface.domains.single` marks coordinates with a profile of their own, `self.active` those that are not
        fixed, and `self.in_few_stretches` the active ones whose information is in a few stretches of the data.
        `_find_profile_ends` returns the two values at which the profile has fallen by what `level` asks,
        `_bootstrap_interval` quantiles of the estimate's error.

        Args:
            entry: the number.
            value: estimate of the number.
            slopes: its derivative, in its unconstrained coordinate, by each active (not fixed) coordinate (active,).
            error: its standard error in that coordinate.
            freedom: degrees of freedom with which the error is known.
            method: "bootstrap", "profile", or another one, for estimate +- quantile x standard error.
            level: probability with which the interval holds the number.
        """
        coordinate = entry.coordinate  # None of numbers of a simplex or a covariance, which have none of their own
        is_in_few_stretches = False
        if coordinate is not None:
            hardly_known = self.surface.domains.single[coordinate] and error > WIDE_ERROR
            if hardly_known or method == "profile":
                first = min(error, WIDE_ERROR) * np.array([-2.0, 2.0])  # where the search for either end begins
                low, high = self._find_profile_ends(coordinate, first, find_profile_drop(level))
                return low, high
            index_among_active = np.count_nonzero(self.active[:coordinate])
            is_in_few_stretches = bool(self.in_few_stretches[index_among_active])
        center = float(to_unconstrained(entry.domain, value))
        # Resampled blocks do not show how a number varies whose information is in a few stretches of the data.
        if method == "bootstrap" and not is_in_few_stretches:
            low, high = center + self._bootstrap_interval(slopes, level)
            return low, high
        half = student_quantile(freedom, level) * error
        return center - half, center + half

    def _make_row(self, entry: TableEntry, value: float, error: float, ends: tuple[float, float]) -> Row:
        """Return the row of an identified number.

        Args:
            entry: the number, with its name and domain.
            value: its estimate.
            error: standard error of its unconstrained coordinate (logarithm, logit or the number itself).
            ends: ends of its interval in that coordinate.
        """
        low, high = sorted(float(from_unconstrained(entry.domain, end)) for end in ends)
        slope = abs(float(slope_from_unconstrained(entry.domain, to_unconstrained(entry.domain, value))))
        return Row(
            name=entry.name,
            estimate=value,
            low=low,
            high=high,
            standard_error=error * slope,
            form=self.form,
            boundary=False,
            identified=True,
        )

    def identifies(self, slopes: Float[np.ndarray, " active"]) -> bool:
        """Return whether the data identify a function f of the numbers: f does not change where l does not (ridges).

        `slopes`: df/dx by the active coordinates x. Its component along ridges (`rank.flat`) is at most
        LARGEST_SHARE_ALONG_RIDGE |df/dx|. `rank.unit`: standard errors of the coordinates; columns of `rank.flat`:
        ridges, in units of these.
        """
        scaled_slopes = self.rank.unit * slopes  # in units of each coordinate's standard error
        size = np.linalg.norm(scaled_slopes)
        return bool(size > 0 and np.linalg.norm(scaled_slopes @ self.rank.flat) <= LARGEST_SHARE_ALONG_RIDGE * size)

    def _bootstrap_interval(self, slopes: np.ndarray, level: float) -> np.ndarray:
        """Return both ends of an interval, relative to the estimate, by a bootstrap of blocks of scores.

        A sum of scores moves the maximum by H^-1 times it. `basis`: the r identified directions (active, r), along
        which H is taken. The draws are sums of blocks of rows' scores, less their mean (draws, r).

        Args:
            slopes: derivatives of the number's unconstrained coordinate by the active coordinates (active,).
            level: probability with which the interval holds the number.
        """
        sums = bootstrap_block_sums([s @ self.basis for s in self.scores], draws=BOOTSTRAP_DRAWS, seed=0)
        moves = slopes @ self.basis @ np.linalg.solve(self.hessian, sums.T)
        return np.asarray(np.quantile(moves, [(1 - level) / 2, (1 + level) / 2]))

    def _make_boundary_row(self, entry: TableEntry, value: float, level: float) -> Row:
        """Return the row of a number at an end of its domain: its interval is from there to one point inside.

        At an end 2 * (fall of l) is chi-squared with probability 1/2 and else 0: P(fall > d) = P(chi2 > 2 d) / 2. So an
        interval of 95 % ends where an ordinary one of 90 % = 2 * 95 % - 1 does. The search for the other end of the
        interval begins WAY_TO_END inwards, in the coordinate (a logarithm or a logit).

        Args:
            entry: the number.
            value: its estimate, the end of its domain.
            level: probability with which the interval holds the number.
        """
        assert entry.coordinate is not None
        outward = self.top.ends[entry.coordinate]  # -1 or 1: the end lies at minus infinity or infinity
        first = np.array([-outward * WAY_TO_END])  # distance inwards at which the search begins
        drop = find_profile_drop(2 * level - 1)
        (end,) = self._find_profile_ends(entry.coordinate, first, drop)
        limit = float(from_unconstrained(entry.domain, end if np.isfinite(end) else -outward * np.inf))
        return Row(
            name=entry.name,
            estimate=value,
            low=min(value, limit),
            high=max(value, limit),
            standard_error=np.nan,
            form=self.form,
            boundary=True,
            identified=True,
        )

    def _find_profile_ends(self, coordinate: int, first: np.ndarray, drop: float) -> Float[np.ndarray, " sides"]:
        """Return where the profile likelihood of a coordinate is `drop` nats below its maximum, for each side searched.

        `first` (sides,): signed distances from the maximum at which searches begin; they end at `furthest`. A logarithm
        or logit is followed for FURTHEST_LOGARITHM (40) steps, a real number for FURTHEST_REAL (1000) times the first
        distance; an end not found by then is infinite.
        """
        furthest = FURTHEST_REAL * np.abs(first).max() if self.surface.domains.free[coordinate] else FURTHEST_LOGARITHM
        return self.surface.find_profile_crossings(
            self.top.x, self.total, coordinate=coordinate, first=first, furthest=furthest, drop=drop, active=self.active
        )
