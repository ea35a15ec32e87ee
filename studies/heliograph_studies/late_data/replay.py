"""Events played to timelines as time goes on, and what these say at each moment, of now and of a while ago."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.live.event import VERDICTS, Event
from heliograph.live.timeline import Timeline
from heliograph.model.estimate import Estimate
from heliograph.simulation.network import Network

WINDOW = 10.0  # s
LAGS = {"lag_2s": 2.0, "lag_10s": 10.0}
METHODS = ("used_as_current", "late_dropped", "rewound", *LAGS, "no_delay")


@dataclass(frozen=True)
class Estimated:
    """Estimates at moments, (moment, n) and (moment, n, n), and the moments that they are of."""

    time: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


def arrival_of(event: Event) -> float:
    """When an event was received."""
    return event.time if event.arrival is None else event.arrival


def every_method(
    network: Network,
    events: Sequence[Event],
    known: Sequence[Event],
    moments: np.ndarray,
    methods: Collection[str] = METHODS,
) -> tuple[dict[str, Estimated], dict[str, int]]:
    """What each of `methods` says at these moments, and the verdicts on the events where they are rewound.

    `events` come from the first node of the network, whose first filter is asked; in the order of their arrival.
    `known`, inputs, come at once.
    """
    first = {(event.sequence, event.time): event for event in reversed(events)}.values()  # copies have the same number
    now = [event._replace(time=arrival_of(event)) for event in first]
    at_once = [event._replace(arrival=event.time) for event in events]
    others = {"used_as_current": (now, WINDOW), "late_dropped": (events, 0.0), "no_delay": (at_once, WINDOW)}
    lags = {name: lag for name, lag in LAGS.items() if name in methods}
    result, counts = _played(network, [*known, *events], WINDOW, moments, lags)
    result["rewound"] = result.pop("now")
    for name, (coming, window) in others.items():
        if name in methods:
            result[name] = _played(network, [*known, *coming], window, moments)[0]["now"]
    return {name: result[name] for name in METHODS if name in methods}, counts


def _played(
    network: Network,
    events: Iterable[Event],
    window: float,
    moments: np.ndarray,
    lags: Mapping[str, float] | None = None,
) -> tuple[dict[str, Estimated], dict[str, int]]:
    """Estimates of now, and of `lags` before, at each moment; and the verdicts on what the first node sent."""
    timeline, expected = Timeline(network, window), {} if lags is None else lags
    coming = sorted(events, key=arrival_of)  # stable: else as they were received
    node, at = network.names[0], 0
    result: dict[str, list[tuple[float, Estimate]]] = {name: [] for name in ("now", *expected)}
    for moment in moments:
        while at < len(coming) and arrival_of(coming[at]) <= moment:
            timeline.push(*coming[at])
            at += 1
        timeline.advance(float(moment))
        result["now"].append((moment, _first(timeline.estimates()[node])))
        for name, lag in expected.items():
            if moment - lag >= 0:
                result[name].append((moment - lag, _first(timeline.lagged(lag)[node])))
    return {name: _stacked(part) for name, part in result.items()}, {v: timeline.counts[node][v] for v in VERDICTS}


def _first(filters: Mapping[str, Estimate]) -> Estimate:
    return next(iter(filters.values()))


def _stacked(parts: Sequence[tuple[float, Estimate]]) -> Estimated:
    means, spreads = np.array([e.mean for _, e in parts]), np.array([e.covariance for _, e in parts])
    return Estimated(np.array([time for time, _ in parts]), means, spreads)


def squared_errors(estimated: Estimated, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """|e|^2 and e' P^-1 e / 2 of the first two states at each moment; truth (moment, 2)."""
    place = estimated.mean[:, :2]
    return np.sum((place - truth) ** 2, axis=1), hg.nees(truth, place, estimated.covariance[:, :2, :2]) / 2
