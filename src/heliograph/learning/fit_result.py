"""Result of a fit: the network with its estimates, a table with intervals, tests, and sentences."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from heliograph.learning.arviz_inference_data import make_inference_data
from heliograph.learning.estimate_row import Row
from heliograph.learning.estimate_table import Solution
from heliograph.learning.fit_sentences import describe_boundaries, describe_form_conflict, describe_unfinished_climbs
from heliograph.learning.hypothesis_tests import FitTest, Values, compare_likelihoods, compute_criteria, wald_test
from heliograph.learning.identifiability import Identifiability
from heliograph.learning.likelihood.objective import Form
from heliograph.learning.long_run_covariance import LEVEL, METHODS, Method
from heliograph.learning.packet_losses.delay_law import DelaysByNode
from heliograph.learning.parametric_network import Description
from heliograph.numerics.check import fail, instance, scalar, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network

CHEAP_ERRORS = "Errors by the expected information; `rows()` has intervals by the scores, and at the ends of domains."


@readable
@dataclass(frozen=True)
class Fit:
    """Result of a fit: a network that runs, a table of estimates with intervals, a covariance, and sentences.

    Args:
        description: the network with its free numbers.
        solutions: maxima of the likelihood by form; the one that counts is last.
        identified: what the data can identify.
        ends: log-likelihood at which each start ended, best first (starts,).
        stopped: true if the search was interrupted, so that this is the best so far.
        delays: by node the law of its delays, of a recording that is a table of events.
    """

    description: Description
    solutions: tuple[Solution, ...]
    identified: Identifiability
    ends: Float[np.ndarray, " starts"]
    stopped: bool
    delays: DelaysByNode = field(default_factory=dict)

    @property
    def best(self) -> Solution:
        """Maximum that predictions use: of the conditional likelihood if it was maximised, else of the linear one."""
        return self.solutions[-1]

    @property
    def network(self) -> Network:
        """Network with the estimates in their places."""
        return self.description.at_point(self.best.x)

    @property
    def values(self) -> dict[str, float | np.ndarray]:
        """Estimates by name."""
        return self.description.parameters.known(self.best.x)

    @property
    def converged(self) -> bool:
        """True if every form came to its maximum."""
        return all(solution.converged for solution in self.solutions)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood at the maximum of the form that counts, in nats."""
        return self.best.total

    @property
    def log_likelihoods(self) -> dict[str, float]:
        """Log-likelihood at the maximum, by form, in nats."""
        return {solution.form: solution.total for solution in self.solutions}

    @property
    def observations(self) -> int:
        """Number of values that arrived, or of known true states if the fit learns from these."""
        data = self.best.surface.data
        counted = data.measurements if data.truth is None else data.truth
        return int(np.sum(~np.isnan(counted)))

    @property
    def free_numbers(self) -> int:
        """Number of free numbers, less the directions in which the likelihood does not change (ridges)."""
        return self.description.parameters.size - self.best.ridges

    @property
    def aic(self) -> float:
        """Akaike's information criterion, 2 k - 2 l; the smaller the better."""
        return compute_criteria(self.log_likelihood, self.free_numbers, self.observations).aic

    @property
    def aicc(self) -> float:
        """Akaike's criterion for few data: + 2 k (k + 1) / (n - k - 1)."""
        return compute_criteria(self.log_likelihood, self.free_numbers, self.observations).aicc

    @property
    def bic(self) -> float:
        """Schwarz's criterion, k log n - 2 l."""
        return compute_criteria(self.log_likelihood, self.free_numbers, self.observations).bic

    def likelihood_ratio(self, smaller: "Fit") -> FitTest:
        """Test a smaller model with some of the free numbers fixed: 2 (l - l_0) is chi-square if it is true.

        l and l_0 are the log-likelihoods of this fit and the smaller one. If a number is fixed at the end of its domain
        (a variance at 0), the p-value is too large, by a factor of two for one number. `best` is the fit in the form
        that counts, `observations` the number of values that arrived.

        Args:
            smaller: the fit of the smaller model.

        Raises:
            ValueError: a fit of other data or of another form, no fewer free numbers, a larger likelihood.

        Source: Wilks (1938); Self and Liang (1987) for ends of domains.
        """
        other = instance("smaller model", smaller, Fit, "what hg.fit returns")
        if (other.best.form, other.observations) != (self.best.form, self.observations):
            expected = f"a fit of the same {self.observations} values in the {self.best.form} form"
            raise fail("smaller model", expected, f"{other.observations} in the {other.best.form} form")
        return compare_likelihoods(self.log_likelihood, other.log_likelihood, self.free_numbers - other.free_numbers)

    def wald(self, values: Values) -> FitTest:
        """Test that some numbers have given values: for the difference d of covariance C, d' C^-1 d is chi-square.

        Args:
            values: the values by the names of the table.

        Raises:
            ValueError: no values, an unknown name, a number that is at a boundary or not identified.

        Source: Wald (1943).
        """
        names = [entry.name for entry in self.description.parameters.entries]
        estimates = self.description.parameters.entries_at(self.best.x).tolist()
        return wald_test(dict(zip(names, estimates, strict=True)), self.covariance, values)

    @property
    def table(self) -> tuple[Row, ...]:
        """Row for each number and form, the form that counts first, with intervals as `rows("cosines")`."""
        return tuple(row for solution in reversed(self.solutions) for row in solution.rows())

    def rows(self, method: Method = "cosines", form: Form | None = None, level: float = LEVEL) -> tuple[Row, ...]:
        """Return the table of estimates by one form of the likelihood, with intervals by one method.

        Args:
            method: "cosines" (the default) and "bartlett" allow for scores that are correlated over time, as with
                random gains; "white" does not. "hessian" also believes the model. "profile" cuts the likelihood for
                numbers with a coordinate of their own, others are as by "hessian". "bootstrap" draws blocks of scores.
            form: "linear" (moments before data) or "conditional" (given them); by default that of the best solution.
            level: probability with which an interval holds the number, 0.95 by default.

        With every method, a number whose logarithm (or logit) is known to a factor of e or worse has its interval by
        "profile", down to the end of its domain if the likelihood is hardly lower there.

        Raises:
            ValueError: an unknown method, a level that is not between 0.5 and 1, or a form that was not fitted.
        """
        if method not in METHODS:
            raise fail("method of intervals", f"one of {', '.join(METHODS)}", show_value(method))
        known = {solution.form: solution for solution in self.solutions}
        if form is not None and form not in known:
            raise fail("form", f"one of {', '.join(known)}", show_value(form))
        probability = scalar("level of intervals", level, 0.5, 1.0)
        if probability in (0.5, 1.0):
            raise fail("level of intervals", "a probability between 0.5 and 1", level)
        return known[self.best.form if form is None else form].rows(method, float(probability))

    @property
    def covariance(self) -> Float[np.ndarray, "entries entries"]:
        """Covariance of the estimates in the order of `rows()`, by cosines; NaN if not identified, or at a boundary."""
        # Cov(v) = J Cov(x) J' with J = dv/dx, for numbers v and the coordinates x that are not at ends of domains.
        best = self.best
        of_coordinates, _ = best.covariance()
        jacobian = self.description.parameters.jacobian(best.x)[:, best.active]
        covariance = jacobian @ of_coordinates @ jacobian.T
        unknown = np.array([row.boundary or not row.identified for row in best.rows()])
        covariance[unknown] = covariance[:, unknown] = np.nan
        return np.asarray(covariance)

    def to_arviz(self, draws: int = 500, seed: int = 0) -> Any:
        """Return draws of the numbers and the log-likelihood of each row, as ArviZ compares models by them.

        The draws are of the Laplace approximation: the normal law of the curvature of the likelihood at its maximum, on
        unconstrained coordinates, with no prior. `log_likelihood` has log p(z_k | z_1 ... z_k-1) of
        each row in which something arrived, by the form of the likelihood that counts; `sample_stats` has its sum, lp.

        Args:
            draws: number of draws, 2 at least (default 500).
            seed: seed of the draws (default 0).

        Returns:
            An `arviz.InferenceData`, from ArviZ 1.0 on an `xarray.DataTree`, of one chain.

        Raises:
            ValueError: a number at an end of its domain, or that the data do not identify.
            ModuleNotFoundError: without ArviZ (extra "arviz").
        """
        return make_inference_data(self.best, draws, seed)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on starts, boundaries, forms that disagree, and numbers that the data cannot identify.

        `solutions`: the maximum of each form of the likelihood; `ends`: log-likelihood at which the climb from each
        start ended; `identified`: what the data tell of the free numbers, in words.
        """
        return (
            *describe_unfinished_climbs(self.solutions, self.ends, self.stopped),
            *describe_boundaries(self.best),
            *describe_form_conflict(self.solutions),
            *self.identified.sentences,
        )

    def __str__(self) -> str:
        """Return the table of estimates: with intervals if `rows` computed them, else with cheap standard errors."""
        delay_lines = [f"{node}: {delays}" for node, delays in self.delays.items()]
        if not self.best.has_rows:
            # Give only the sentences that need no intervals.
            sentences = describe_unfinished_climbs(self.solutions, self.ends, self.stopped)
            sentences = [*sentences, *self.identified.sentences]
            return "\n".join([*self.best.describe_with_cheap_errors(), *delay_lines, *sentences, CHEAP_ERRORS])
        width = max(len(row.name) for row in self.table)
        lines = [f"{row.name:{width}}  {row.value:>10}  ({row.interval})  ({row.form})" for row in self.table]
        return "\n".join([*lines, *delay_lines, *self.sentences])
