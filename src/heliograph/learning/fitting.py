"""`fit`: estimates of what is free in a network, with intervals, and sentences on what the data cannot tell."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.learning.estimate_table import Solution
from heliograph.learning.fit_result import Fit
from heliograph.learning.identifiability import identify_by_recording
from heliograph.learning.likelihood.climbs import ClimbEnds
from heliograph.learning.likelihood.data import gather_data
from heliograph.learning.likelihood.multistart import SPREAD_OF_LOGARITHMS, SPREAD_OF_REALS, MaximumSearch
from heliograph.learning.likelihood.objective import make_objectives
from heliograph.learning.likelihood.surface import LikelihoodSurface
from heliograph.learning.packet_losses.delay_law import Delays, learn_delays
from heliograph.learning.parametric_network import Build, describe
from heliograph.learning.sender_fit import SenderFit, fit_sender, has_deciding_sender
from heliograph.numerics.check import check_count, check_progress, check_seed, fail
from heliograph.numerics.types import ArrayLike, Float

Progress = TypeAliasType("Progress", Callable[[str], None])
Rows = TypeAliasType("Rows", ArrayLike | Sequence[ArrayLike])  # of one recording, or a list of one for each


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
    # `identified`: sentences on the numbers that the data do not tell apart, and `ridges`, the number of directions in
    # which the likelihood does not change; `or_sharper` takes the better known of two such results.
    identified = identify_by_recording(surfaces[-1], points[0], seed)
    # The maximum of each form, and the estimates and intervals in the sentences on what is identified.
    solutions, ends, stopped = _maximise_forms(surfaces, points, seed, identified.ridges, report)
    best = solutions[-1]
    try:
        if identified.sentences:  # far from the maximum rounding may hide what the data tell near it
            identified = identified.or_sharper(identify_by_recording(surfaces[-1], best.top.x, seed))
            solutions = [replace(solution, ridges=identified.ridges) for solution in solutions]
        identified = identified.at(solutions[-1])  # with estimates and intervals
    except KeyboardInterrupt:  # without these intervals the fit is whole
        stopped = True
    return Fit(description, tuple(solutions), identified, ends=ends, stopped=stopped, delays=delays)


class _FormMaxima(NamedTuple):
    """Maxima of the forms of the likelihood.

    Args:
        solutions: the maximum of each form, the one that counts last.
        ends: log-likelihoods at which the first form's climbs ended (starts,).
        stopped: whether Ctrl-C stopped the search; then the last solution is the best point so far.
    """

    solutions: list[Solution]
    ends: Float[np.ndarray, " starts"]
    stopped: bool


def _maximise_forms(
    surfaces: list[LikelihoodSurface], points: np.ndarray, seed: int, ridges: int, progress: Progress
) -> _FormMaxima:
    """Return the maximum of each form of the likelihood; the first is searched from all starts, the next from its best.

    Returns the solutions, one for each form that was searched; the log-likelihoods at which the climbs of the first
    form ended; and whether Ctrl-C stopped the search.

    Args:
        surfaces: the likelihood in each form: linear (of the best linear filter), conditional (sharper), or one alone.
        points: the starts (starts, p), each p free numbers as coordinates without bounds.
        seed: of further starts.
        ridges: number of directions in which the likelihood does not change.
        progress: called with a line of text at each step.

    Raises:
        KeyboardInterrupt: Ctrl-C before there was a first point; after it the best point so far is returned.
    """
    ends = np.zeros(0)
    solutions = list[Solution]()
    for surface in surfaces:
        # The search keeps its best point so far as `best`, and l at the end of each climb, the highest first, as
        # `ends`.
        search = MaximumSearch(surface, _make_climb_reporter(surface, progress))
        try:
            top, stopped = search.run(points, seed), False
        except KeyboardInterrupt:
            if search.best is None and not solutions:
                raise
            if search.best is None:  # the form before has the best so far
                return _FormMaxima(solutions, ends, stopped=True)
            top, stopped = search.best, True
        if not len(ends):
            ends = search.ends
        solutions.append(Solution(surface, top, ridges))
        if stopped:
            return _FormMaxima(solutions, ends, stopped=True)
        points = top.x[None]  # where the next form begins
    return _FormMaxima(solutions, ends, stopped=False)


def _convert_event_tables(recording: Any) -> tuple[object, dict[str, Delays]]:
    """Return the recordings with tables of events turned into rows, and the law of delays of each node in them.

    An event table (`heliograph.files.EventTable`) has messages with the times when they were measured and logged, from
    which delays are learned. Recordings of another kind stay as they are, and give no delays. `recording`: one
    recording, or a list of several.
    """
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
    """Return the starts of a search (starts, p): the given one, and others drawn around it.

    The likelihood is finite at all of them. Coordinates are unconstrained: logarithms, logits and real numbers.

    Args:
        surface: the likelihood over the free numbers, with the given start.
        count: number of starts.
        seed: of the random numbers.

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
    # Draw the others uniformly around it: logarithms and logits within SPREAD_OF_LOGARITHMS; real numbers within half
    # their size or SPREAD_OF_REALS standard errors, whichever is more, or within SPREAD_OF_LOGARITHMS if both are 0 (no
    # information gives no standard error).
    free, deviation = surface.domains.free, surface.standard_errors(start)
    far = np.maximum(np.abs(start) / 2, SPREAD_OF_REALS * np.where(np.isfinite(deviation), deviation, 0.0))
    drawn = rng.uniform(-1, 1, (count - 1, len(start))) * np.where(free & (far > 0), far, SPREAD_OF_LOGARITHMS)
    points = surface.move_to_finite_likelihood(start + np.concatenate([np.zeros((1, len(start))), drawn]), start)
    _require_information_on_each_number(surface, points)
    return points


def _require_information_on_each_number(surface: LikelihoodSurface, points: np.ndarray) -> None:
    """Raise ValueError for a free number of which the data have no information, or no derivative, at all points.

    The estimate of such a number could be anything. Each number of `own` is the information of one start on this number
    alone, (starts,).

    Args:
        surface: the likelihood over the free numbers.
        points: the starts of the search (starts, p).
    """
    information = np.diagonal(surface.evaluations(points).information, axis1=1, axis2=2)
    for name, own in zip(surface.objective.description.parameters.coordinates, information.T, strict=True):
        if np.all(np.isnan(own)):
            raise fail(f"free number {name!r}", "one by which the likelihood has a derivative", "NaN at every start")
        if not np.nanmax(own) > 0:
            raise fail(f"free number {name!r}", "one on which the likelihood depends", "one on which it does not")


def _make_climb_reporter(surface: LikelihoodSurface, say: Progress) -> Callable[[ClimbEnds], None]:
    """Return the function that reports, after each step of a search, how many climbs are done and how high they are.

    Args:
        surface: the likelihood that is climbed.
        say: called with a line of text.
    """
    form = surface.objective.form

    def report(climbs: ClimbEnds) -> None:
        """Say which step the climbs are at, how many have converged, and the highest log-likelihood so far.

        `form` is the form of the likelihood, and `say` takes the line of text.
        """
        best = np.nanmax(climbs.total)
        done = int(climbs.converged.sum())
        say(f"{form}: step {climbs.steps}, {done} of {len(climbs.x)} starts done, {best:.6g}")

    return report
