"""`fit`: estimates of what is free in a network, with intervals, and sentences on what the data cannot tell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.learning.arviz_inference_data import make_inference_data
from heliograph.learning.estimate_table import Row, Solution
from heliograph.learning.fit_sentences import describe_boundaries, describe_form_conflict, describe_unfinished_climbs
from heliograph.learning.hypothesis_tests import FitTest, Values, compare_likelihoods, compute_criteria, wald_test
from heliograph.learning.identifiability import Identifiability, identify_by_recording
from heliograph.learning.likelihood.data import gather_data
from heliograph.learning.likelihood.multistart import AWAY, SPREAD, MaximumSearch
from heliograph.learning.likelihood.objective import Form, make_objectives
from heliograph.learning.likelihood.surface import LikelihoodSurface
from heliograph.learning.likelihood.trust_region import ClimbEnds
from heliograph.learning.long_run_covariance import LEVEL, METHODS, Method
from heliograph.learning.packet_losses.delay_law import Delays, DelaysByNode, learn_delays
from heliograph.learning.parametric_network import Build, Description, describe
from heliograph.learning.sender_fit import SenderFit, fit_sender, has_deciding_sender
from heliograph.numerics.check import check_count, check_progress, check_seed, fail, instance, scalar, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network

CHEAP_ERRORS = "Errors by the expected information; `rows()` has intervals by the scores, and at the ends of domains."

Progress = TypeAliasType("Progress", Callable[[str], None])
Rows = TypeAliasType("Rows", ArrayLike | Sequence[ArrayLike])  # of one recording, or a list of one for each


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
        (a variance at 0), the p-value is too large, by a factor of two for one number.

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
        the line on which the numbers are unbounded, with no prior. `log_likelihood` has log p(z_k | z_1 ... z_k-1) of
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
        """Sentences on starts, boundaries, forms that disagree, and numbers that the data cannot identify."""
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


def fit(
    network: Build,
    recording: object,
    inputs: Rows | None = None,
    starts: int = 6,
    seed: int = 0,
    progress: Progress | None = None,
    truth: Rows | bool = False,
) -> Fit | SenderFit:
    """Learn what is free in a network from one recording or several.

    The likelihood is that of all nodes together. For linear plants the linear form comes first, which is right whatever
    the laws; from there the conditional one, which is sharper. Ctrl-C returns the best so far.

    Behind a sender that decides when to send (`trigger` of a node) the likelihood is that of `event_filter`, silence
    included; delta and losses are free numbers like others. A heartbeat is a whole number: fit with each that may be,
    and compare `log_likelihood`. The result is a `SenderFit`.

    With `truth` what is maximised is the log density of the true states under the estimates of the network's one
    filter, its rule and its claim included. Use it where errors are correlated from row to row: the likelihood of the
    measurements sees how little they change between rows, and takes that for the whole error.

    Of an `EventTable`, a bag for example, the rows are in the order of measuring, and `delays` of the result has the
    law of each node's delays: the likelihood of stamps and values is a product, so that each part is learned apart.

    Args:
        network: a function that returns a Network in which numbers are marked by `hg.free`.
        recording: what `hg.run` takes, measurements (steps, received) by node, or rows of the one node alone, NaN for
            what did not arrive; a `Recording`; a `Record` with all its runs; an `EventTable`; or a list of these.
            Readings that a node refuses count as not arrived.
        inputs: inputs of the plant (steps, inputs), or a list of one array for each recording (default none).
        starts: number of starts: the given one, and others drawn around it (default 6).
        seed: seed of the starts that are drawn (default 0).
        progress: called with a line of text at each step (default none).
        truth: true states (steps, n), NaN where one is not known, or a list of one array for each recording; True takes
            those that the recordings hold (default False).

    Raises:
        ValueError: a network in which nothing is free or whose likelihood no filter knows; recordings that do not fit
            it, are too short or constant; a free number on which nothing depends; a start that is impossible; truth
            and not one filter, of all that arrives.
    Source: Schweppe (1965) for the likelihood; Huber (1967) for intervals where it is not the true one.
    """
    check_count("starts", starts)
    check_progress(progress, "a line of text")
    seed = check_seed("seed", seed)
    description = describe(network)
    report = progress or (lambda line: None)
    recording, delays = _convert_event_tables(recording)
    if has_deciding_sender(description.start):
        if truth is not False:
            raise fail("truth", "none behind a sender that decides when to send", "one")
        sender = fit_sender(description, recording, inputs, starts, seed, report)
        return replace(sender, delays=delays)
    data = gather_data(description.start, recording, inputs, description.parameters.size, truth)
    # The likelihood over the free numbers in each form, where to begin, and what the data identify at all.
    surfaces = [LikelihoodSurface(objective, data) for objective in make_objectives(description, truth is not False)]
    points = _choose_starts(surfaces[0], starts, seed)
    identified = identify_by_recording(surfaces[-1], points[0], seed)
    # The maximum of each form, and the estimates and intervals in the sentences on what is identified.
    solutions, ends, stopped = _maximise_forms(surfaces, points, seed, identified.ridges, report)
    try:
        if identified.sentences:  # far from the maximum rounding may hide what the data tell near it
            identified = identified.or_sharper(identify_by_recording(surfaces[-1], solutions[-1].top.x, seed))
            solutions = [replace(solution, ridges=identified.ridges) for solution in solutions]
        identified = identified.at(solutions[-1])
    except KeyboardInterrupt:  # without these intervals the fit is whole
        stopped = True
    return Fit(description, tuple(solutions), identified, ends=ends, stopped=stopped, delays=delays)


def _maximise_forms(
    surfaces: list[LikelihoodSurface], points: np.ndarray, seed: int, ridges: int, progress: Progress
) -> tuple[list[Solution], Float[np.ndarray, " starts"], bool]:
    """Return the maximum of each form of the likelihood; the first is searched from all starts, the next from its best.

    Args:
        surfaces: the likelihood in each form: linear (of the best linear filter), conditional (sharper), or one alone.
        points: the starts (starts, p), each p free numbers as coordinates without bounds.
        seed: of further starts.
        ridges: number of directions in which the likelihood does not change.
        progress: called with a line of text at each step.

    Returns:
        The solutions, log-likelihoods at the ends of the first form's climbs, and whether Ctrl-C stopped the search:
        then the last solution is the best point so far. Before there is one, KeyboardInterrupt is raised.
    """
    ends, solutions = np.zeros(0), list[Solution]()
    for surface in surfaces:
        search = MaximumSearch(surface, _make_climb_reporter(surface, progress))
        try:
            top, stopped = search.run(points, seed), False
        except KeyboardInterrupt:
            if search.best is None and not solutions:
                raise
            if search.best is None:  # the form before has the best so far
                return solutions, ends, True
            top, stopped = search.best, True
        if not len(ends):
            ends = search.ends
        solutions.append(Solution(surface, top, ridges))
        if stopped:
            return solutions, ends, True
        points = top.x[None]  # where the next form begins
    return solutions, ends, False


def _convert_event_tables(recording: Any) -> tuple[object, dict[str, Delays]]:
    """Return the recordings with tables of events turned into rows, and the law of delays of each node in them."""
    recordings = recording if isinstance(recording, list) else [recording]
    tables = [table for table in recordings if hasattr(table, "lateness")]  # only these know how late a message came
    if not tables:
        return recording, {}
    # A node's measurements in all tables are counted together, in steps of the first table that has the node.
    step_of_node = {name: law.step for table in reversed(tables) for name, law in table.delays().items()}
    lateness_of_tables = [table.lateness() for table in tables]  # for each table, seconds by node
    delays = {}
    for name, step in step_of_node.items():
        lateness = [lateness_by_node[name] for lateness_by_node in lateness_of_tables if name in lateness_by_node]
        delays[name] = learn_delays(np.concatenate(lateness), step)
    return [table.recording() if table in tables else table for table in recordings], delays


def _choose_starts(surface: LikelihoodSurface, count: int, seed: int) -> Float[np.ndarray, "starts p"]:
    """Return `count` starts at which the likelihood is finite: the given one, and others drawn around it.

    Raises:
        ValueError: a start that is impossible, or a number on which nothing depends.
    """
    parameters = surface.objective.description.parameters
    start, rng = parameters.start, np.random.default_rng(seed)
    total = surface.evaluations(start[None]).total[0]
    if not np.isfinite(total):
        by_row = surface.evaluate_rows(start[None]).density[0].sum(axis=0)
        step = int(np.argmax(~np.isfinite(by_row)))
        expected = "numbers under which the recording is possible"
        raise fail("start of the fit", expected, f"a log-likelihood of {total} from step {step} on")
    # Draw the others uniformly around it: logarithms and logits within SPREAD; real numbers within half their size or
    # AWAY standard errors, whichever is more, or within SPREAD if both are 0 (no information gives no standard error).
    free, deviation = surface.domains.free, surface.standard_errors(start)
    far = np.maximum(np.abs(start) / 2, AWAY * np.where(np.isfinite(deviation), deviation, 0.0))
    drawn = rng.uniform(-1, 1, (count - 1, len(start))) * np.where(free & (far > 0), far, SPREAD)
    points = surface.move_to_finite_likelihood(start + np.concatenate([np.zeros((1, len(start))), drawn]), start)
    _require_information_on_each_number(surface, points)
    return points


def _require_information_on_each_number(surface: LikelihoodSurface, points: np.ndarray) -> None:
    """Raise ValueError for a free number of which the data have no information, or no derivative, at all points."""
    information = np.diagonal(surface.evaluations(points).information, axis1=1, axis2=2)
    for name, own in zip(surface.objective.description.parameters.coordinates, information.T, strict=True):
        if np.all(np.isnan(own)):
            raise fail(f"free number {name!r}", "one by which the likelihood has a derivative", "NaN at every start")
        if not np.nanmax(own) > 0:
            raise fail(f"free number {name!r}", "one on which the likelihood depends", "one on which it does not")


def _make_climb_reporter(surface: LikelihoodSurface, say: Progress) -> Callable[[ClimbEnds], None]:
    """Return the function that reports, after each step of a search, how many climbs are done and how high they are."""
    form = surface.objective.form

    def report(climbs: ClimbEnds) -> None:
        """Say which step the climbs are at, how many have converged, and the highest log-likelihood so far."""
        best, done = np.nanmax(climbs.total), int(climbs.converged.sum())
        say(f"{form}: step {climbs.steps}, {done} of {len(climbs.x)} starts done, {best:.6g}")

    return report
