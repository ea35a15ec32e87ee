"""`fit`: estimates of what is free in a network, with intervals, and sentences on what the data cannot tell."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.learning.description import Build, Description, describe
from heliograph.learning.identification import Identifiability, identified_by
from heliograph.learning.intervals import METHODS, Method
from heliograph.learning.likelihood.data import gathered
from heliograph.learning.likelihood.maximise import Maximum
from heliograph.learning.likelihood.objective import Form, objectives
from heliograph.learning.likelihood.surface import StoppedError, Surface
from heliograph.learning.losses.delays import Delays, DelaysByNode, learn_delays
from heliograph.learning.senders import SenderFit, decides, fit_sender
from heliograph.learning.solution import Row, Solution
from heliograph.numerics.check import check_count, check_seed, fail, shown
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network

SPREAD = 1.5  # of the starts, in each coordinate that is a logarithm or a logit
ELSEWHERE = 0.01  # of the log-likelihood: a start that ends so far below the best ended elsewhere
INVISIBLE = 0.01  # information of a logarithm below which its number may as well be the limit
APART = 3.0  # standard errors between the two forms that suggest an error of the model

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
        """Maximum that counts: of the conditional form where there is one."""
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
    def log_likelihood(self) -> dict[str, float]:
        """Log-likelihood at the maximum, by form, in nats."""
        return {solution.form: solution.total for solution in self.solutions}

    @property
    def table(self) -> tuple[Row, ...]:
        """Row for each number and form, the form that counts first, with intervals as `rows("cosines")`."""
        return tuple(row for solution in reversed(self.solutions) for row in solution.rows())

    def rows(self, method: Method = "cosines", form: Form | None = None) -> tuple[Row, ...]:
        """Table of one form with intervals by another method.

        Args:
            method: "cosines" (the default) and "bartlett" allow for scores that are correlated over time, as they are
                behind random gains; "white" does not; "hessian" believes the model besides; "profile" cuts the
                likelihood (numbers that have a coordinate to themselves; the others as "hessian"); "bootstrap" draws
                blocks of scores.
            form: "linear" or "conditional"; the one that counts unless given.

        Raises:
            ValueError: an unknown method, or a form that was not fitted.
        """
        if method not in METHODS:
            raise fail("method of intervals", f"one of {', '.join(METHODS)}", shown(method))
        known = {solution.form: solution for solution in self.solutions}
        if form is not None and form not in known:
            raise fail("form", f"one of {', '.join(known)}", shown(form))
        return known[self.best.form if form is None else form].rows(method)

    @property
    def covariance(self) -> Float[np.ndarray, "entries entries"]:
        """Covariance of the estimates in the order of `rows()`, by cosines; NaN if not identified, or at a boundary."""
        best = self.best
        inner, _ = best.covariance()
        turned = self.description.parameters.jacobian(best.x)[:, best.active]
        rotated = turned @ inner @ turned.T
        lost = np.array([row.boundary or not row.identified for row in best.rows()])
        rotated[lost] = rotated[:, lost] = np.nan
        return np.asarray(rotated)

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences on starts, boundaries, forms that disagree, and what the data cannot identify."""
        return (*_of_climb(self), *_of_boundaries(self.best), *_of_forms(self.solutions), *self.identified.sentences)

    def __str__(self) -> str:
        """Table and sentences as text."""
        width = max(len(row.name) for row in self.table)
        lines = [f"{row.name:{width}}  {_number(row)}  ({row.form})" for row in self.table]
        late = [f"{node}: {delays}" for node, delays in self.delays.items()]
        return "\n".join([*lines, *late, *self.sentences])


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
    filter, its rule and its claim included: for errors that are correlated from row to row, of which the likelihood of
    the measurements takes the small difference between rows for the whole.

    Of an `EventTable`, a bag for example, the rows are in the order of measuring, and `delays` of the result has the
    law of each node's delays: the likelihood of stamps and values is a product, so that each part is learned apart.

    Args:
        network: a function that returns a Network in which numbers are marked by `hg.free`.
        recording: what `hg.run` takes, measurements (steps, received) by node, NaN where one did not arrive, or of the
            one node alone; a `Recording`; a `Record` with all its runs; an `EventTable`; or a list of these.
        inputs: inputs of the plant (steps, inputs), or a list of one array for each recording if they differ (default
            none).
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
    description = describe(network)
    recording, delays = _rows_and_delays(recording)
    if decides(description.start):
        if truth is not False:
            raise fail("truth", "none behind a sender that decides when to send", "one")
        return replace(fit_sender(description, recording, inputs, starts, check_seed("seed", seed)), delays=delays)
    data = gathered(description.start, recording, inputs, description.parameters.size, truth)
    # each form's likelihood over the free numbers, and the starts
    surfaces = [Surface(objective, data) for objective in objectives(description, truth is not False)]
    say: Progress = progress or (lambda line: None)
    points = _starts(surfaces[0], starts, check_seed("seed", seed))
    stopped, ends, solutions = False, np.zeros(0), []
    identified = identified_by(surfaces[-1], points[0], seed)
    # climb each form from the best end of the one before
    for surface in surfaces:
        climbed, stopped = _climbed(surface, points, say)
        order = np.argsort(-np.nan_to_num(climbed.total, nan=-np.inf))
        ends = climbed.total[order] if not len(ends) else ends
        solutions.append(_solution(surface, climbed, int(order[0]), identified.ridges, say))
        if stopped:
            break
        points = climbed.x[order[:1]]
    return Fit(description, tuple(solutions), identified.at(solutions[-1]), ends, stopped, delays)


def _rows_and_delays(recording: Any) -> tuple[object, dict[str, Delays]]:
    """Rows of tables of events, and the laws of their delays by node; other recordings are rows."""
    several = recording if isinstance(recording, list) else [recording]
    tables = [table for table in several if hasattr(table, "lateness")]
    if not tables:
        return recording, {}
    # Of several tables the measurements of a node are counted together, in steps of the first that has any.
    steps = {name: law.step for table in reversed(tables) for name, law in table.delays().items()}
    late = [table.lateness() for table in tables]
    delays = {name: learn_delays(np.concatenate([lateness[name] for lateness in late if name in lateness]), step)
              for name, step in steps.items()}  # fmt: skip
    return [table.recording() if table in tables else table for table in several], delays


def _starts(surface: Surface, count: int, seed: int) -> Float[np.ndarray, "starts p"]:
    """Starts at which the likelihood is finite: the given one, and others around it.

    Raises:
        ValueError: a start that is impossible, or a number on which nothing depends.
    """
    parameters = surface.objective.description.parameters
    start, rng = parameters.start, np.random.default_rng(seed)
    first = surface.evaluations(start[None])
    if not np.isfinite(first.total[0]):
        step = int(np.argmax(~np.isfinite(first.density[0].sum(axis=0))))
        raise fail("start of the fit", "numbers under which the recording is possible",
                   f"a log-likelihood of {first.total[0]} from step {step} on")  # fmt: skip
    # spread: 1.5 of a logarithm or logit, half the size of an unbounded number
    information = np.diag(first.information[0])
    spread = np.full(len(start), SPREAD)
    for entry in parameters.entries:
        if entry.coordinate is not None and np.isinf([entry.domain.low, entry.domain.high]).all():
            at = abs(start[entry.coordinate])
            spread[entry.coordinate] = at / 2 if at else 3 / np.sqrt(max(information[entry.coordinate], 1e-300))
    points: np.ndarray = start + np.concatenate(
        [np.zeros((1, len(start))), rng.uniform(-1, 1, (count - 1, len(start))) * spread]
    )
    # starts at which the recording is impossible move halfway to the given one
    for _ in range(6):
        wrong = ~np.isfinite(surface.evaluations(points).total)
        if not wrong.any():
            break
        points[wrong] = (points[wrong] + start) / 2
    _check_dependence(surface, points, information)
    return points


def _check_dependence(surface: Surface, points: np.ndarray, information: np.ndarray) -> None:
    """Check that the likelihood depends on every free number somewhere."""
    if np.all(information > 0):
        return
    seen = np.nanmax(np.diagonal(surface.evaluations(points).information, axis1=1, axis2=2), axis=0)
    names = surface.objective.description.parameters.coordinates
    lost = [name for name, size in zip(names, seen, strict=True) if not size > 0]
    if lost:
        raise fail(f"free number {lost[0]!r}", "one on which the measurements depend", "one on which nothing does")


def _climbed(surface: Surface, points: np.ndarray, say: Progress) -> tuple[Maximum, bool]:
    """Climb to the top, or as far as the user lets it; return the maximum and whether it was stopped."""
    form = surface.objective.form

    def watch(now: Maximum) -> None:
        best = np.nanmax(now.total)
        say(f"{form}: step {now.steps}, {int(now.converged.sum())} of {len(now.x)} starts done, {best:.6g}")

    try:
        return surface.climb(points, np.ones(points.shape, dtype=bool), watch), False
    except StoppedError as stopped:
        return stopped.best, True


def _solution(surface: Surface, maximum: Maximum, lane: int, ridges: int, say: Progress) -> Solution:
    """Solution at the best of the ends, with numbers at a limit put there and the others climbed again."""
    x, total, active = maximum.x[lane].copy(), float(maximum.total[lane]), np.ones(maximum.x.shape[1], dtype=bool)
    converged, steps = bool(maximum.converged[lane]), maximum.steps
    # a number that the data hardly see goes to its limit if the likelihood does not fall
    for index in _invisible(surface, x):
        moved = x.copy()
        moved[index] = np.inf if x[index] > 0 and _two_sided(surface, index) else -np.inf
        at_limit = surface.evaluations(moved[None])
        if np.isfinite(at_limit.gradient[0][active]).all() and at_limit.total[0] > total - ELSEWHERE:
            x, active[index] = moved, False
    # climb again in the other numbers
    if not active.all():
        say(f"{surface.objective.form}: again without {int((~active).sum())} at a limit")
        try:
            again = surface.climb(x[None], active[None], lambda now: None)
        except StoppedError as stopped:
            again = stopped.best
        x, total, converged = again.x[0], float(again.total[0]), bool(again.converged[0])
    return Solution(surface, x, total, active, converged, steps, ridges)


def _invisible(surface: Surface, x: np.ndarray) -> list[int]:
    """List the coordinates of bounded numbers whose information is too small to tell them from the limit."""
    information = np.diag(surface.evaluations(x[None]).information[0])
    entries = surface.objective.description.parameters.entries
    return [
        entry.coordinate
        for entry in entries
        if entry.coordinate is not None
        and np.isfinite([entry.domain.low, entry.domain.high]).any()
        and information[entry.coordinate] < INVISIBLE
    ]


def _two_sided(surface: Surface, coordinate: int) -> bool:
    entry = next(e for e in surface.objective.description.parameters.entries if e.coordinate == coordinate)
    return bool(np.isfinite([entry.domain.low, entry.domain.high]).all())


def _of_climb(fitted: Fit) -> list[str]:
    sentences = []
    if fitted.stopped:
        sentences.append("Stopped before the end: this is the best so far.")
    elif not fitted.converged:
        sentences.append("The climb did not converge: the estimates are the best points found.")
    below = fitted.ends[0] - fitted.ends[1:]
    elsewhere = np.count_nonzero(~(below < ELSEWHERE))
    if elsewhere and not fitted.stopped:
        lost = np.nanmin(np.where(below < ELSEWHERE, np.nan, below))
        sentences.append(
            f"{elsewhere} of {len(fitted.ends)} starts ended elsewhere, {lost:.3g} or more below the best."
        )
    return sentences


def _of_boundaries(best: Solution) -> list[str]:
    return [
        f"{row.name}: {row.estimate:.4g}, {'below' if row.high > row.estimate else 'above'} "
        f"{row.high if row.high > row.estimate else row.low:.3g} (95 %)."
        for row in best.rows()
        if row.boundary
    ]


def _of_forms(solutions: tuple[Solution, ...]) -> list[str]:
    if len(solutions) < 2:
        return []
    sentences = []
    for a, b in zip(*(solution.rows() for solution in solutions), strict=True):
        size = abs(a.estimate - b.estimate) / max(a.standard_error, b.standard_error)
        if np.isfinite(size) and size > APART:
            sentences.append(
                f"{a.name}: the two forms of the likelihood disagree by {size:.1f} standard errors "
                f"({a.estimate:.4g} and {b.estimate:.4g}), so that the model is in doubt."
            )
    return sentences


def _number(row: Row) -> str:
    if not row.identified:
        return f"{row.estimate:10.4g}  (not identified)"
    if row.boundary:
        return f"{row.estimate:10.4g}  (limit; {row.low:.4g} .. {row.high:.4g})"
    return f"{row.estimate:10.4g}  ({row.low:.4g} .. {row.high:.4g})"
