"""What an observer remembers of each plant with a new message, and the times of all batches."""

import math
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, TypeVar

from prometheus_client import CollectorRegistry, Histogram

from heliograph.report.diagnosis.sensor_output_health import RecentInnovations
from heliograph.serving.observation.running_nis import MEMORY, RunningNis
from heliograph.serving.observed_service import BatchTimes

T = TypeVar("T")
PLANTS = 200  # plants with estimates in memory, those with the newest messages
TESTED = 20_000  # plants whose claims are tested, those with the newest messages
POINTS = 800  # estimates remembered of each, final ones and those that are not yet
LAGS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3600.0, 86400.0)  # s, edges of the histogram


class ChartPoint(NamedTuple):
    """Estimates of a plant at one time: means and standard deviations by node and filter. `number` counts the points.

    A final point replaces the provisional ones of its time.
    """

    number: int
    time: float | str
    final: bool
    estimates: dict[str, dict[str, dict[str, object]]]


class RememberedPlants:
    """What is remembered of the plants with the newest messages, by plant, the oldest forgotten first.

    Attributes:
        count: number of points so far, of all plants.
        points: the newest estimates.
        outputs: the newest weighed outputs.
        tests: running tests of claims, by node and filter.
        crossings: by (node, filter, threshold, how far ahead) the probabilities that the threshold is crossed.
        senders: what the silence of each node's sender means.
        dead_senders: nodes whose sender is dead, of plants that have one.
    """

    def __init__(self, names: Mapping[tuple[str, str], Sequence[str]]):
        """Begin without plants; `names` has the names of the received numbers by (node, filter)."""
        self.count, self._names = 0, names  # `count`: how many points of charts came so far
        # Each of these is by plant, and the plant with the newest message is last.
        self.points: OrderedDict[str, deque[ChartPoint]] = OrderedDict()
        self.outputs: OrderedDict[str, RecentInnovations] = OrderedDict()
        self.tests: OrderedDict[str, dict[tuple[str, str], RunningNis]] = OrderedDict()
        self.crossings: OrderedDict[str, dict[tuple[str, ...], Mapping[str, float]]] = OrderedDict()
        self.senders: OrderedDict[str, dict[str, dict[str, Any]]] = OrderedDict()
        self.dead_senders = dict[str, list[str]]()

    @property
    def newest_plant(self) -> str:
        """Return the plant with the newest point; "" before the first."""
        return next(reversed(self.points), "")

    def tests_of(self, plant: str) -> dict[tuple[str, str], RunningNis]:
        """Return a plant's running tests by node and filter, made if needed, as the newest."""
        return _move_to_newest(self.tests, plant, dict, TESTED)

    def outputs_of(self, plant: str) -> RecentInnovations:
        """Return a plant's newest weighed outputs, made if needed, as the newest."""
        return _move_to_newest(self.outputs, plant, lambda: RecentInnovations(MEMORY, self._names))

    def keep_point(self, plant: str, message: Mapping[str, Any]) -> None:
        """Keep a plant's newest estimates as a point of its chart, and the status of its senders.

        `message` is an output of the service, read from JSON. A sender is dead if it is silent for longer than it may.
        """
        self.count += 1
        estimates = {
            node: {name: _means_and_deviations(estimate) for name, estimate in filters.items()}
            for node, filters in message["estimates"].items()
        }
        points = _move_to_newest(self.points, plant, lambda: deque(maxlen=POINTS))
        points.append(ChartPoint(self.count, message["time"], message["kind"] == "final", estimates))
        if message.get("senders"):
            _move_to_newest(self.senders, plant, dict).update(message["senders"])
            dead = [node for node, sender in message["senders"].items() if sender["dead"]]
            self.dead_senders.pop(plant, None)
            if dead:
                self.dead_senders[plant] = dead

    def keep_crossings(self, plant: str, horizons: Sequence[Mapping[str, Any]]) -> None:
        """Keep the probabilities that a plant's thresholds are crossed, in place of the earlier ones.

        `horizons` is its newest forecast, as it is published: for each horizon, how far ahead it is, and what each
        filter says by node and filter.
        """
        crossings = dict[tuple[str, ...], Mapping[str, float]]()  # by node, filter, threshold, how far ahead
        for horizon in horizons:
            for node, filters in horizon["estimates"].items():
                for name, body in filters.items():
                    for level, probabilities in body.get("thresholds", {}).items():
                        crossings[node, name, level, f"{horizon['ahead']:g}"] = probabilities
        self.crossings.pop(plant, None)
        if crossings:
            _move_to_newest(self.crossings, plant, dict).update(crossings)

    def list_crossings(self, most: int) -> list[tuple[tuple[str, ...], float]]:
        """Return pairs ((plant, node, filter, threshold, how far ahead), probability that it is crossed by then).

        They are of at most `most` plants, those in which a crossing is most probable.
        """
        # Among the probabilities, "by" is that of a crossing at any time up to the horizon.
        largest = {plant: max(p["by"] for p in crossings.values()) for plant, crossings in self.crossings.items()}
        most_probable = sorted(largest, key=lambda plant: -largest[plant])[:most]
        return [((plant, *key), p["by"]) for plant in most_probable for key, p in self.crossings[plant].items()]


class BatchHistograms:
    """Histograms of batches, in a registry of metrics: how long each took, and how old its messages were."""

    def __init__(self) -> None:
        """Register the histograms, all empty."""
        registry = self.registry = CollectorRegistry()
        self._took = Histogram("heliograph_batch_seconds", "From messages to what is published.", registry=registry)
        what = "From when the oldest message of a batch was measured, where it has a date, to what is published."
        self._lag = Histogram("heliograph_lag_seconds", what, buckets=LAGS, registry=registry)
        self._committed = Histogram("heliograph_commit_seconds", "Of it, to commit.", registry=registry)

    def observe(self, batch: BatchTimes) -> None:
        """Add a batch's times to the histograms: in all, for the commit, and its oldest message's age, in s."""
        self._took.observe(batch.took)
        self._committed.observe(batch.committed)
        self._lag.observe(batch.lag)


def _move_to_newest(newest: OrderedDict[str, T], plant: str, make: Callable[[], T], most: int = PLANTS) -> T:
    """Return the entry of a plant, made if needed, as the newest; drop the oldest entry beyond `most`."""
    if plant not in newest:
        newest[plant] = make()
        if len(newest) > most:
            newest.popitem(last=False)
    newest.move_to_end(plant)
    return newest[plant]


def _means_and_deviations(message: Mapping[str, Any]) -> dict[str, object]:
    """Return a filter's means, standard deviations, claim, and probabilities of modes if any, from its message.

    The deviations are None if the filter claims no covariance.
    """
    covariance = message["covariance"]  # rows, or null
    deviations = covariance and [_deviation_of(row[i]) for i, row in enumerate(covariance)]
    modes = {"modes": message["modes"]} if message.get("modes") is not None else {}
    return {"mean": message["mean"], "deviation": deviations, "claim": message["claim"], **modes}


def _deviation_of(variance: float | None) -> float | None:
    """Return the standard deviation of a variance; None where it has none."""
    return None if variance is None else math.sqrt(max(variance, 0.0))
