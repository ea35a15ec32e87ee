"""What services do, for somebody who looks: estimates with their bands, links, tests, and what is doubtful."""

import math
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

from prometheus_client import CollectorRegistry, Histogram
from pydantic_core import from_json

from heliograph.live.event import VERDICTS
from heliograph.serving.loop import Takes
from heliograph.serving.output import Output
from heliograph.serving.running_nis import RunningNis

T = TypeVar("T")
PLANTS = 200  # plants whose estimates are remembered, those that were heard last
POINTS = 800  # estimates remembered of each, final ones and those that are not yet
LISTED = 1000  # plants that can be chosen from
WARNINGS = 50
LAGS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3600.0, 86400.0)  # s, edges of the histogram


class Link(Protocol):
    """Numbers of messages of a node: by verdict; `lost`: gaps in its counts; `dropped`: values beyond limits."""

    lost: int
    dropped: int
    used: int
    duplicate: int
    conflict: int
    late: int
    future: int
    implausible: int


class Plant(Protocol):
    """A plant's links, by node."""

    @property
    def links(self) -> Mapping[str, Link]:
        """By node."""


class Taken(Protocol):
    """What the last batch was."""

    @property
    def took(self) -> float:
        """Seconds, in all."""

    @property
    def committed(self) -> float:
        """Seconds of it, to commit."""

    @property
    def lag(self) -> float:
        """Seconds since the oldest message was measured, where that is known; else as many as it took."""


class Serves(Takes, Protocol):
    """A service as it is watched."""

    @property
    def plants(self) -> Mapping[str, Plant]:
        """Plants in memory, by name."""

    @property
    def malformed(self) -> int:
        """Messages that could not be read."""

    @property
    def last(self) -> Taken:
        """What the last batch was."""


class Point(NamedTuple):
    """A plant's estimates at a time: by node and filter means and deviations. `number` counts the points.

    A final one comes after the provisional ones of its time, and takes their place.
    """

    number: int
    time: float | str
    estimates: dict[str, dict[str, dict[str, object]]]


class Watch:
    """Looks at any number of services of one network; asked from another thread it waits for the batch at work."""

    def __init__(self, states: Sequence[str]):
        self.states = list(states)
        self.lock = threading.Lock()
        self.services: list[Serves] = []
        self.surprises: dict[tuple[str, str], RunningNis] = {}
        self._tests: OrderedDict[str, dict[tuple[str, str], RunningNis]] = OrderedDict()
        self._points: OrderedDict[str, deque[Point]] = OrderedDict()
        self._count = 0
        self.registry = CollectorRegistry()
        self.took = Histogram("heliograph_batch_seconds", "From messages to what is published.", registry=self.registry)
        what = "From when the oldest message of a batch was measured, where it has a date, to what is published."
        self.lag = Histogram("heliograph_lag_seconds", what, buckets=LAGS, registry=self.registry)
        self.committed = Histogram("heliograph_commit_seconds", "Of it, to commit.", registry=self.registry)

    def over(self, service: Serves) -> "Watched":
        """The service, watched."""
        self.services.append(service)
        return Watched(service, self)

    def note(self, outputs: Sequence[Output], last: Taken) -> None:
        """Remember what is worth a look."""
        self.took.observe(last.took)
        self.committed.observe(last.committed)
        self.lag.observe(last.lag)
        for output in outputs:
            if output.kind != "refused":
                message = from_json(output.body)
                self._keep(output.plant, message)
                if output.kind == "final":
                    self._test(output.plant, message["estimates"])

    def _test(self, plant: str, estimates: Mapping[str, Mapping[str, Any]]) -> None:
        local = _newest(self._tests, plant, dict)
        for node, filters in estimates.items():
            for name, message in filters.items():
                if message.get("nis") is not None:
                    for item in (self.surprises, local):
                        single = item.setdefault((node, name), RunningNis(message["claim"]))
                        single.add(message["nis"], message["received"])

    def _keep(self, plant: str, message: Mapping[str, Any]) -> None:
        self._count += 1
        estimates = {
            node: {name: _band(filter_) for name, filter_ in filters.items()}
            for node, filters in message["estimates"].items()
        }
        points = _newest(self._points, plant, lambda: deque(maxlen=POINTS))
        points.append(Point(self._count, message["time"], estimates))

    def plants(self) -> Iterator[tuple[str, Plant]]:
        """All plants of all services."""
        for service in self.services:
            yield from service.plants.items()

    def links(self) -> dict[str, dict[str, int]]:
        """By node, over all plants: numbers of messages by verdict, lost ones, and values beyond limits."""
        return _added(plant for _, plant in self.plants())

    def view(self, plant: str | None, since: int = 0) -> dict[str, Any]:
        """What the page shows of a plant (None: of the one heard last): estimates after the point `since`."""
        with self.lock:
            name = next(reversed(self._points), "") if plant is None else plant
            results = [item for known, item in self.plants() if known == name]
            points = [point for point in self._points.get(name, ()) if point.number > since]
            tests = self._tests.get(name, {})
            names = sorted(known for known, _ in self.plants())
            return {
                "count": len(names),
                "plants": names[:LISTED],
                "plant": name,
                "states": self.states,
                "since": since,
                "newest": self._count,
                "points": [point._asdict() for point in points],
                "links": _added(results),
                "tests": [_test_row(node, filter_, test) for (node, filter_), test in tests.items()],
                "warnings": list(self._warnings(results, tests))[:WARNINGS],
                "malformed": sum(service.malformed for service in self.services),
                "all": _added(item for _, item in self.plants()),
            }

    def _warnings(self, plants: Sequence[Plant], tests: Mapping[tuple[str, str], RunningNis]) -> Iterator[str]:
        for (node, filter_), test in tests.items():
            if doubt := test.doubt():
                yield f"{node}/{filter_}: {doubt}"
        for node, link in _added(plants).items():
            if link["late"]:
                yield f"{node}: {link['late']} came too late to be used; a longer --window would hold what they change"
            if link["future"]:
                yield f"{node}: {link['future']} are later than they can be; its clock is wrong"
            if link["implausible"]:
                yield f"{node}: {link['implausible']} are implausible and were refused; their lines say why"
            if link["dropped"]:
                yield f"{node}: {link['dropped']} values are beyond its limits, or codes, and count as not arrived"
            if link["conflict"]:
                yield f"{node}: {link['conflict']} came again with other values; the first stayed"


class Watched:
    """A service that somebody looks at; to whoever runs it, it is the service."""

    def __init__(self, service: Serves, watch: Watch):
        self.service, self.watch = service, watch

    def unpublished(self) -> list[Output]:
        """As the service says."""
        return self.service.unpublished()

    def take(self, payloads: Sequence[bytes]) -> list[Output]:
        """As the service does, and remember what is worth a look."""
        with self.watch.lock:
            outputs = self.service.take(payloads)
            self.watch.note(outputs, self.service.last)
        return outputs

    def published(self, outputs: Sequence[Output]) -> None:
        """As the service does."""
        self.service.published(outputs)

    def finish(self, ended: bool) -> list[Output]:
        """As the service does."""
        with self.watch.lock:
            return self.service.finish(ended)


def _newest(result: OrderedDict[str, T], plant: str, make: Callable[[], T]) -> T:
    """What is kept of a plant, which is the newest now; the oldest goes."""
    if plant not in result:
        result[plant] = make()
        if len(result) > PLANTS:
            result.popitem(last=False)
    result.move_to_end(plant)
    return result[plant]


def _band(message: Mapping[str, Any]) -> dict[str, object]:
    """Means, and deviations where the filter claims any."""
    rows = message["covariance"]
    claimed = None if rows is None else [_root(row[i]) for i, row in enumerate(rows)]
    return {"mean": message["mean"], "deviation": claimed, "claim": message["claim"]}


def _root(variance: float | None) -> float | None:
    return None if variance is None else math.sqrt(max(variance, 0.0))


def _added(plants: Iterator[Plant] | Sequence[Plant]) -> dict[str, dict[str, int]]:
    """Tallies of several plants, by node."""
    results: dict[str, dict[str, int]] = {}
    for plant in plants:
        for node, link in plant.links.items():
            tally = results.setdefault(node, dict.fromkeys((*VERDICTS, "lost", "dropped"), 0))
            for name in tally:
                tally[name] += getattr(link, name)
    return results


def _test_row(node: str, filter_: str, item: RunningNis) -> dict[str, object]:
    low, high = item.band()
    numbers = {"ratio": item.ratio, "low": low, "high": high, "numbers": item.numbers}
    return {"node": node, "filter": filter_, "claim": item.claim, **numbers, "doubt": item.doubt() is not None}
