"""Replay of recorded events through a timeline: final estimates, and those of each moment a lag later."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from heapq import heappop, heappush

import numpy as np

from heliograph.live.event import INPUTS, Event, Verdict
from heliograph.live.timeline import Timeline
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record


@dataclass(frozen=True)
class ReplayResult:
    """Results of a replay.

    Attributes:
        final: final estimates, one entry a row.
        lagged: smoothed estimates of each moment with a measurement, given the events up to a lag later; None without a
            lag.
        counts: numbers of events by node and verdict.
        forced: number of rows that became final early, for lack of room.
    """

    final: Record
    lagged: Record | None
    counts: dict[str, dict[Verdict, int]]
    forced: int


def replay_events(
    network: Network,
    events: Iterable[Event],
    window: float,
    lag: float | None = None,
    start: float = 0.0,
    ahead: float = 0.0,
    capacity: int = 1000,
) -> ReplayResult:
    """Push events in order of arrival, and advance the time until all are final.

    A sequence is put in that order; an iterator, which need not fit into memory, has to be in it already.

    Args:
        network: the network that the events belong to.
        events: at least one event: a sequence in any order, or an iterator in order of arrival.
        window: how late an event may be, in the unit of time of the network.
        lag: fixed lag of the smoothed estimates, at most `window`; None for no smoothing.
        start: start of continuous time (default 0).
        ahead: how much later than its arrival the time of an event may be (default 0).
        capacity: greatest number of rows held (default 1000); beyond it the oldest become final.

    Raises:
        ValueError: no events, a lag beyond the window, and what `Timeline` refuses.
    """
    if lag is not None and not 0 <= lag <= window:
        raise fail("lag", f"a number from 0 to the window, {window:g}", lag)
    timeline = Timeline(network, window, start, ahead, capacity)
    # Order of arrival; without an arrival time an event arrives when it is measured.
    in_order = sorted(events, key=_arrival_of) if isinstance(events, Sequence) else events
    smoother = None if lag is None else _LaggedSmoother(timeline, lag)
    # The timeline keeps a bounded number of final rows: they are collected before it would drop any.
    finals: list[Record] = []
    count = 0  # of events so far; it stays 0 if there are none
    for count, event in enumerate(in_order, 1):
        if smoother is not None:
            smoother.smooth_until(_arrival_of(event))
        verdict = timeline.push(*event)
        if smoother is not None and verdict == "used" and event.node != INPUTS:
            smoother.note_moment(event.time)
        if count % timeline.capacity == 0:
            finals.append(timeline.final())
    if not count:
        raise fail("events", "at least one", "none")
    if smoother is not None:
        smoother.smooth_until(np.inf)
    # The rest becomes final: what is older than the window does, and so all is once that has passed, and a bit more.
    timeline.advance(timeline.now + window + 1.0)
    finals.append(timeline.final())
    lagged = None if smoother is None else _make_record(network, smoother.smoothed)
    return ReplayResult(_join_records(finals), lagged, timeline.counts, timeline.forced)


class _LaggedSmoother:
    """Smooths the estimates of each moment with a measurement as soon as a fixed lag has passed since.

    Attributes:
        smoothed: (moment, estimates there by node and filter), in order of time.
    """

    def __init__(self, timeline: Timeline, lag: float):
        """Begin without moments.

        Args:
            timeline: the timeline that gets the events; `smooth_until` advances its time.
            lag: how long after each moment its estimates are smoothed, by all events until then.
        """
        self.smoothed: list[tuple[float, Mapping[str, Mapping[str, Estimate]]]] = []
        self._timeline, self._lag = timeline, lag
        self._waiting: list[float] = []  # a heap of moments whose lag has not passed

    def note_moment(self, moment: float) -> None:
        """Note that something was measured at a moment, which will be smoothed unless its lag has passed already."""
        if self._timeline.now <= moment + self._lag:
            heappush(self._waiting, moment)

    def smooth_until(self, arrival: float) -> None:
        """Smooth each noted moment whose lag ends before `arrival`, since later messages can no longer change it.

        `_waiting` is a heap of the moments to smooth, the earliest first. `window` is the timeline's longest lag.
        """
        timeline, smoothed = self._timeline, self.smoothed
        while self._waiting and self._waiting[0] + self._lag < arrival:
            moment = heappop(self._waiting)
            newest_smoothed = smoothed[-1][0] if smoothed else None
            is_done = newest_smoothed == moment  # two nodes measured at this moment
            is_of_wrong_clock = moment > timeline.now  # the clock's leap in time was taken back since
            if is_done or is_of_wrong_clock:
                continue
            timeline.advance(moment + self._lag)
            lag = min(timeline.now - moment, timeline.window)
            smoothed.append((moment, timeline.lagged(lag)))


def _arrival_of(event: Event) -> float:
    """Return when an event arrived: its arrival, else its own time."""
    return event.time if event.arrival is None else event.arrival


def _join_records(records: Sequence[Record]) -> Record:
    """Return one record of several that follow one another in time, with the same nodes and filters."""
    estimates = {
        node: {
            filter: _stack_estimates([record.estimates[node][filter] for record in records], np.concatenate)
            for filter in filters
        }
        for node, filters in records[0].estimates.items()
    }
    time = np.concatenate([record.time for record in records])
    return Record(time=time, states=records[0].states, truth=None, measurements={}, estimates=estimates)


def _make_record(network: Network, moments: Sequence[tuple[float, Mapping[str, Mapping[str, Estimate]]]]) -> Record:
    """Return the record of several moments; each is (time, estimates at this time by node and filter), in order."""
    filters_by_node = moments[0][1] if moments else {}  # of the first moment: all have the same nodes and filters
    estimates = {
        node: {
            filter: _stack_estimates([estimates_then[node][filter] for _, estimates_then in moments], np.stack)
            for filter in filters
        }
        for node, filters in filters_by_node.items()
    }
    time = np.array([time for time, _ in moments])
    return Record(time=time, states=network.states, truth=None, measurements={}, estimates=estimates)


def _stack_estimates(estimates: Sequence[Estimate], join: Callable[[list[np.ndarray]], np.ndarray]) -> Estimate:
    """Return one filter's estimates at several times as one estimate whose arrays have a leading axis of times.

    `join` is `np.stack` if each estimate is of one time, and `np.concatenate` if each has an axis of times already. All
    have the same claim and the same `attitude` (which states are rotations).
    """
    mean = join([np.asarray(estimate.mean) for estimate in estimates])
    covariance = join([np.asarray(estimate.covariance) for estimate in estimates])
    oldest = estimates[0]
    modes = None if oldest.modes is None else join([np.asarray(estimate.modes) for estimate in estimates])
    return Estimate(mean, covariance, oldest.claim, modes, oldest.attitude)
