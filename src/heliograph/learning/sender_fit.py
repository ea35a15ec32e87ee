"""Numbers of a sender that decides when to send, learned from what came and from what did not."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize

from heliograph.filters.base import AbstractFilter
from heliograph.filters.event.factory import event_filter
from heliograph.learning.estimate_row import Row
from heliograph.learning.likelihood.data import gather_data
from heliograph.learning.long_run_covariance import LEVEL, find_profile_drop
from heliograph.learning.packet_losses.delay_law import DelaysByNode
from heliograph.learning.parametric_network import Description
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.likelihood import log_likelihood
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

IMPOSSIBLE_LIKELIHOOD = -1e300  # log-likelihood of impossible recordings: a search needs a number
FIRST_REACH = 0.05  # from the maximum towards an end of an interval, in unconstrained coordinates
LARGEST_SIMPLEX = 0.2  # edges of a first simplex, in unconstrained coordinates
MOST_EVALUATIONS = 200  # of a search, for each coordinate
NORMAL_QUANTILE = 1.96  # deviations of a normal law on either side, between which 95 % lie
FURTHEST_END = (
    4.0  # in unconstrained coordinates, in logarithms and logits: an interval that reaches so far has no end there
)
BISECTIONS = 12
SIMPLEX_ACCURACY = 1e-4  # of an unconstrained coordinate
END_ACCURACY = 1e-3  # of the ends of an interval, and of what is searched for them

Likelihood = Callable[[Float[np.ndarray, " p"]], float]


@readable
@dataclass(frozen=True)
class SenderFit:
    """Result of a fit behind a sender that decides: as `Fit`, with intervals by the profile of the likelihood.

    Args:
        description: the network with free numbers.
        x: the maximum in unconstrained coordinates, (p,).
        total: log-likelihood of the maximum, in nats.
        table: a row for each number.
        converged: True if the search for the maximum converged.
        stopped: true if it was interrupted, so that this is the best so far; an interval that was not searched is NaN.
        delays: by node the law of its delays, of a recording that is a table of events.
    """

    description: Description
    x: Float[np.ndarray, " p"]
    total: float
    table: tuple[Row, ...]
    converged: bool
    stopped: bool = False
    delays: DelaysByNode = field(default_factory=dict)

    @property
    def network(self) -> Network:
        """The network with the estimates in their places."""
        return self.description.at_point(self.x)

    @property
    def values(self) -> dict[str, float | np.ndarray]:
        """Estimates of the free numbers, by name."""
        return self.description.parameters.known(self.x)

    @property
    def log_likelihood(self) -> float:
        """Log-likelihood at the maximum, in nats."""
        return self.total

    @property
    def log_likelihoods(self) -> dict[str, float]:
        """Log-likelihood at the maximum, in nats, by its form."""
        return {"conditional": self.total}

    def rows(self) -> tuple[Row, ...]:
        """Return the rows of the table of estimates, one for each number."""
        return self.table

    @property
    def sentences(self) -> tuple[str, ...]:
        """Remarks on the fit; there are none if the search converged."""
        if self.stopped:
            return ("Stopped before the end: this is the best so far.",)
        return () if self.converged else ("The search did not converge: the estimates are the best points found.",)

    def __str__(self) -> str:
        """Return the table and the sentences."""
        width = max(len(row.name) for row in self.table)
        lines = []
        for row in self.table:
            interval = "" if np.isnan(row.low) else f"  ({row.interval})"
            lines.append(f"{row.name:{width}}  {row.value:>10}{interval}")
        delay_lines = [f"{node}: {delays}" for node, delays in self.delays.items()]
        return "\n".join([*lines, *delay_lines, *self.sentences])


def has_deciding_sender(network: Network) -> bool:
    """Return True if a sender of the network decides when to send."""
    return any(isinstance(node, Node) and node.trigger is not None for node in network.nodes.values())


def fit_sender(
    description: Description,
    recording: object,
    inputs: ArrayLike | Sequence[ArrayLike] | None,
    starts: int,
    seed: int,
    say: Callable[[str], None],
) -> SenderFit:
    """Return the estimates of a sender's free numbers by the likelihood of `event_filter`, which counts silence too.

    In delta, the threshold of the sender, the likelihood has steps, where a value that came would have been silent: so
    it is searched without derivatives (Nelder and Mead), from the start and from others around it. The interval of a
    number is where twice the log-likelihood, largest over all others, is within 3.84 of its maximum. Ctrl-C returns the
    best so far.

    Args:
        description: the network with its free numbers.
        recording: one recording or several, as `hg.fit` takes them.
        inputs: of the plant (steps, inputs), or a list of one array for each recording; None if there are none.
        starts: number of starts of the search.
        seed: seed of those that are drawn.
        say: called with a line of text at each search and interval.

    Raises:
        KeyboardInterrupt: before there was a first point.
        ValueError: more than one node; numbers with no coordinate of their own; recordings that do not fit.
    """
    parameters = description.parameters
    if len(description.start.names) != 1:
        raise fail("network whose sender decides", "one node, to be learned", list(description.start.names))
    if any(entry.coordinate is None for entry in parameters.entries):
        raise fail(
            "free numbers of a sender that decides", "numbers with limits of their own", "a simplex or covariance"
        )
    data = gather_data(description.start, recording, inputs, parameters.size)

    def likelihood(x: Float[np.ndarray, " p"]) -> float:
        """Return the log-likelihood of all recordings at unconstrained coordinates x (p,).

        `data`: recordings side by side; the first `lengths` rows of each count. IMPOSSIBLE_LIKELIHOOD: a very low
        number that replaces -inf and NaN, since the search needs numbers. `description` builds the network from the
        free numbers.
        """
        filter = make_event_filter(description.at_point(x))
        recordings = zip(data.measurements, data.inputs, data.lengths, strict=True)
        total = sum(float(log_likelihood(filter, z[:steps], u[:steps])) for z, u, steps in recordings)
        return total if np.isfinite(total) else IMPOSSIBLE_LIKELIHOOD

    # The maximum: from the start, and from others drawn within one unit of each logarithm or logit.
    random = np.random.default_rng(seed)
    points = [parameters.start, *(parameters.start + random.uniform(-1, 1, (starts - 1, len(parameters.start))))]
    top = _search_from_starts(likelihood, points, say)
    rows, stopped = _make_rows(description, likelihood, top, say)
    return SenderFit(description, top.x, top.total, tuple(rows), top.converged, stopped)


def _make_rows(
    description: Description, likelihood: Likelihood, top: "_BestPoint", say: Callable[[str], None]
) -> tuple[list[Row], bool]:
    """Return a row with an interval for each number of the table, and whether the search was stopped.

    After Ctrl-C, rows have no intervals.

    Args:
        description: the network with its free numbers.
        likelihood: log-likelihood at a point in unconstrained coordinates.
        top: the maximum.
        say: called with a line of text at each interval.
    """
    rows, stopped = list[Row](), top.stopped
    for i, entry in enumerate(description.parameters.entries):
        say(f"interval of {entry.name}")
        row = _make_row_without_interval(description, top.x, i)
        try:
            rows.append(row if stopped else _add_interval(row, description, likelihood, top, i))
        except KeyboardInterrupt:
            stopped = True
            rows.append(row)
    return rows, stopped


def _search_from_starts(
    likelihood: Likelihood, points: Sequence[Float[np.ndarray, " p"]], say: Callable[[str], None]
) -> "_BestPoint":
    """Return the best end of searches from several starts; after Ctrl-C the best point at which the likelihood was.

    The likelihood may have several maxima, so that several searches are made, by the simplex method.

    Args:
        likelihood: the log-likelihood at a point (p,), whose coordinates are unbounded.
        points: starts of the searches, (p,) each.
        say: called with a line of text after each search.

    Raises:
        KeyboardInterrupt: before there was a first point.
    """
    best: _BestPoint | None = None  # of all evaluations

    def evaluate(x: Float[np.ndarray, " p"]) -> float:
        """Return the log-likelihood at a point, and keep the best point so far in `best`.

        It is kept as not converged, to be returned if the search is stopped. `x`: the point (p,).
        """
        nonlocal best
        total = likelihood(x)
        if best is None or total > best.total:
            best = _BestPoint(x.copy(), total, converged=False, stopped=True)
        return total

    ends = list[_BestPoint]()  # of the searches
    try:
        for point in points:
            ends.append(_climb_simplex(evaluate, np.asarray(point)))
            say(f"{len(ends)} of {len(points)} starts done, {max(end.total for end in ends):.6g}")
    except KeyboardInterrupt:
        if best is None:
            raise
        return best
    return max(ends, key=lambda end: end.total)


def make_event_filter(network: Network) -> AbstractFilter:
    """Return the event filter of the network's only node; its likelihood is maximised in a fit.

    An event filter also uses that nothing came: the sender then decided not to send, or the packet was lost.

    Raises:
        ValueError: a node without a trigger, whose sender sends in each step.
    """
    (node,) = network.nodes.values()
    if not isinstance(node, Node) or node.trigger is None:
        raise fail("node to be learned", "one whose sender decides", type(node).__name__)
    return event_filter(network.plant, node.sensor, node.channel, node.trigger)


def _climb_simplex(
    likelihood: Likelihood,
    start: Float[np.ndarray, " p"],
    enough: float = np.inf,
    size: float = LARGEST_SIMPLEX,
    digits: float = SIMPLEX_ACCURACY,
) -> "_BestPoint":
    """Return the best point of a search by Nelder and Mead from `start`.

    Args:
        likelihood: the log-likelihood at a point, which is maximised.
        start: the first corner of the simplex, (p,).
        enough: log-likelihood above which any point will do: the search ends at the first one.
        size: edges of the first simplex.
        digits: edges at which the simplex is small enough; values at its corners then differ by ten times as much.
    """
    at_start = likelihood(start)
    if not len(start) or at_start > enough:  # nothing to search, or nothing to improve
        return _BestPoint(start, at_start, converged=True, stopped=False)
    # First simplex (p + 1, p): the start, and a step of `size` along each coordinate.
    simplex = start + size * np.concatenate([np.zeros((1, len(start))), np.eye(len(start))])
    most = MOST_EVALUATIONS * len(start)
    # `minimize` takes -l, and stops by size of the simplex, by values, or after too many evaluations.
    options: Any = {"initial_simplex": simplex, "xatol": digits, "fatol": 10 * digits, "maxfev": most}
    climb: Any = minimize  # its types do not know an initial simplex

    def stop_above_enough(intermediate_result: Any) -> None:
        """Stop the search once its best point is above `enough`: SciPy calls this after each step."""
        if -intermediate_result.fun > enough:
            raise StopIteration

    def negative_likelihood(x: Float[np.ndarray, " p"]) -> float:
        """Return minus the log-likelihood, which is minimised; at the start it is known already."""
        return -at_start if np.array_equal(x, start) else -likelihood(x)

    optimum = climb(negative_likelihood, start, method="Nelder-Mead", options=options, callback=stop_above_enough)
    return _BestPoint(np.asarray(optimum.x), -float(optimum.fun), converged=bool(optimum.success), stopped=False)


def _make_row_without_interval(description: Description, x: Float[np.ndarray, " p"], index: int) -> Row:
    """Return the table's row for free number `index` at the maximum x (p,), without interval and standard error.

    Args:
        description: the network with its free numbers.
        x: unconstrained coordinates of the maximum (p,).
        index: number of the entry of the table.
    """
    return Row(
        name=description.parameters.entries[index].name,
        estimate=float(description.parameters.entries_at(x)[index]),
        low=np.nan,
        high=np.nan,
        standard_error=np.nan,
        form="conditional",
        boundary=False,
        identified=True,
    )


def _add_interval(row: Row, description: Description, likelihood: Likelihood, top: "_BestPoint", index: int) -> Row:
    """Return the row of an estimate with its interval, and a standard error that fits the interval's width.

    The profile is the log-likelihood maximised over all other coordinates. The interval ends where the profile has
    fallen to a level. NORMAL_QUANTILE: a 95 % interval reaches 1.96 standard errors to either side.

    Args:
        row: the row without an interval.
        description: the network with its free numbers.
        likelihood: log-likelihood at a point in unconstrained coordinates.
        top: the maximum.
        index: number of the entry of the table.
    """
    entry = description.parameters.entries[index]
    coordinate = index if entry.coordinate is None else entry.coordinate
    profile = _Profile(likelihood, coordinate, top.total - find_profile_drop(LEVEL))
    ends = []
    for side in (-1.0, 1.0):
        # An end of the interval is the value of the entry where its coordinate is at the end.
        point = top.x.copy()
        point[coordinate] += side * profile.find_distance_to_level(top.x, side)
        ends.append(float(description.parameters.entries_at(point)[index]))
    low, high = sorted(ends)
    return row._replace(low=low, high=high, standard_error=(high - low) / (2 * NORMAL_QUANTILE))


class _BestPoint(NamedTuple):
    """Best point of a search: x in unconstrained coordinates (p,), its log-likelihood, and how the search ended."""

    x: Float[np.ndarray, " p"]
    total: float
    converged: bool
    stopped: bool


class _ProfilePoint(NamedTuple):
    """Point of a profile: the value of its coordinate, and the others where the likelihood was best."""

    value: float
    others: Float[np.ndarray, " others"]


class _Profile(NamedTuple):
    """Profile of one coordinate of the free numbers: its value against the log-likelihood, largest over all others.

    Args:
        likelihood: log-likelihood at a point in unconstrained coordinates (p,).
        coordinate: index of the coordinate.
        level: log-likelihood down to which a value belongs to the interval of the coordinate.
    """

    likelihood: Likelihood
    coordinate: int
    level: float

    def find_distance_to_level(self, top: Float[np.ndarray, " p"], side: float) -> float:
        """Return how far from the maximum `top` (p,) the profile falls to the level, to one side (-1.0 or 1.0).

        The distance is doubled until the profile is below the level, or beyond FURTHEST_END, where an interval counts
        as without an end; then it is found by bisection, to END_ACCURACY.
        """
        # distances at which the profile is above and below the level
        inside = 0.0
        outside = FIRST_REACH
        nearby = _ProfilePoint(top[self.coordinate], np.delete(top, self.coordinate))
        while outside < FURTHEST_END:
            is_above, nearby = self.is_above_level(top[self.coordinate] + side * outside, nearby)
            if not is_above:
                break
            inside, outside = outside, 2 * outside
        for _ in range(BISECTIONS):
            middle = (inside + outside) / 2
            is_above, nearby = self.is_above_level(top[self.coordinate] + side * middle, nearby)
            inside, outside = (middle, outside) if is_above else (inside, middle)
            if outside - inside < END_ACCURACY:
                break
        return outside

    def is_above_level(self, value: float, nearby: _ProfilePoint) -> tuple[bool, _ProfilePoint]:
        """Return whether the profile at `value` is above the level, and its point there, searched from a nearby one.

        The profile is the log-likelihood with this coordinate held at `value`, maximised over the others. The search
        stops as soon as it is above `self.level`, since only that is asked. Its first simplex is as large as the two
        values are apart, up to LARGEST_SIMPLEX.

        Args:
            value: value of the coordinate.
            nearby: another point of the profile, whose other coordinates begin the search.
        """
        size = float(np.clip(abs(value - nearby.value), 10 * END_ACCURACY, LARGEST_SIMPLEX))
        best = _climb_simplex(
            lambda others: self.likelihood(np.insert(others, self.coordinate, value)),
            nearby.others,
            enough=self.level,
            size=size,
            digits=END_ACCURACY,
        )
        return best.total > self.level, _ProfilePoint(value, best.x)
