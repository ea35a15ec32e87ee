"""Observation of running services: estimates with their bands, links, running tests of covariances, and warnings."""

import math
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from time import monotonic
from typing import Any, NamedTuple, TypeVar

from prometheus_client import CollectorRegistry, Histogram
from pydantic_core import from_json

from heliograph.disk.quoting import join_names
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.checks.refusals import OF_NODES, WORDS
from heliograph.model.estimate import Claim
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.types import unit_of, units_in
from heliograph.report.outputs import RecentOutputs, make_output_row
from heliograph.serving.count_totals import FIELDS, CountTotals, counts_of
from heliograph.serving.observation.last_answers import LastAnswers
from heliograph.serving.observation.overview import PlantTroubles, TroubleOverview
from heliograph.serving.observation.running_nis import MEMORY, RunningNis, read_nis
from heliograph.serving.observed_service import BatchTimes, ObservedService, WatchableService, WatchedPlant
from heliograph.serving.output import Output
from heliograph.simulation.network import Network

T = TypeVar("T")
PLANTS = 200  # plants with estimates in memory, those with the newest messages
TESTED = 20_000  # plants whose claims are tested, those with the newest messages
POINTS = 800  # estimates remembered of each, final ones and those that are not yet
LISTED = 1000  # plants that can be chosen from
WARNINGS = 50  # lines
APART = 3  # nodes that have a warning each; more of the same kind have one together
REFUSED = "late", "future", "implausible", "conflict"
LAGS = (0.01, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0, 3600.0, 86400.0)  # s, edges of the histogram
COUNTED: dict[str, str] = {  # of a node's messages
    "late": "came too late to be used; a longer --window would hold what they change",
    "future": "of a time that is not yet, refused; its clock is wrong",
    "implausible": "implausible and refused; the refused lines say why",
    **{reason: f"refused, {WORDS[reason]}" for reason in OF_NODES},
    "held": "times equal for longer than its noise allows: it is stuck, or has no noise",
    "timeouts": "times silent for longer than its timeout, and back",
    "conflict": "came again with other values; the first stayed",
}


class EstimatePoint(NamedTuple):
    """Estimates of a plant at one time: means and standard deviations by node and filter. `number` counts the points.

    A final point replaces the provisional ones of its time.
    """

    number: int
    time: float | str
    final: bool
    estimates: dict[str, dict[str, dict[str, object]]]


class ServiceAnswers(NamedTuple):
    """What services answer between batches: names of all plants, one plant's counts by node, and counts of all."""

    names: list[str]
    links: dict[str, dict[str, int]]
    malformed: int
    wrong: int


class Watch:
    """Observer of any number of services of one network; a call from another thread waits for the current batch.

    Args:
        states: names of the states; a name with a `unit` has it on the axes.
        title: name of the network.
        time_unit: unit of times that are numbers.
        fused: by the name of a fusion its claim, and the (node, filter) that it fuses, by which it is judged.
        names: names of the received numbers by node and filter.
        uncounted: nodes whose messages carry no count: how many are lost is not known, and None.
    """

    def __init__(
        self,
        states: Sequence[str],
        title: str = "",
        time_unit: str = "",
        fused: Mapping[str, tuple[Claim, Sequence[tuple[str, str]]]] | None = None,
        names: Mapping[tuple[str, str], Sequence[str]] | None = None,
        uncounted: Collection[str] = (),
    ):
        self.states, self.title, self.time_unit = list(states), title, time_unit
        self.fused, self.uncounted = dict(fused or {}), uncounted
        self.lock, self._count = threading.Lock(), 0  # held while a batch is taken; number of points so far
        self._noting = threading.Lock()  # held while outputs are recorded
        self._service_answers = LastAnswers(self.lock, self._ask_services, ServiceAnswers([], {}, 0, 0), PLANTS)
        # Of all plants together.
        self.services: list[WatchableService] = []
        self.nis: dict[tuple[str, str], RunningNis] = {}
        self.outputs = RecentOutputs(MEMORY, names or {})
        self._batch_started: float | None = None  # of the batch that is being taken
        # By plant, the oldest forgotten first: weighed outputs, tests, points, crossings of thresholds, senders.
        self._outputs: OrderedDict[str, RecentOutputs] = OrderedDict()
        self._tests: OrderedDict[str, dict[tuple[str, str], RunningNis]] = OrderedDict()
        self._points: OrderedDict[str, deque[EstimatePoint]] = OrderedDict()
        self.totals, self._overview, self._dead_senders = CountTotals(), TroubleOverview(), dict[str, list[str]]()
        self._crossings: OrderedDict[str, dict[tuple[str, ...], Mapping[str, float]]] = OrderedDict()
        self._senders: OrderedDict[str, dict[str, dict[str, Any]]] = OrderedDict()
        # Metrics that are counted here; the page adds others to the registry.
        self.registry = CollectorRegistry()
        self.took = Histogram("heliograph_batch_seconds", "From messages to what is published.", registry=self.registry)
        what = "From when the oldest message of a batch was measured, where it has a date, to what is published."
        self.lag = Histogram("heliograph_lag_seconds", what, buckets=LAGS, registry=self.registry)
        self.committed = Histogram("heliograph_commit_seconds", "Of it, to commit.", registry=self.registry)

    def wrap(self, service: WatchableService) -> "ObservedService":
        """Wrap a service so that its batches are observed."""
        self.services.append(service)
        return ObservedService(service, self)

    @contextmanager
    def taking_batch(self) -> Iterator[None]:
        """Hold the lock while a batch is taken, so that no page sees half of it; note when it began, for `busy`."""
        with self.lock:
            self._batch_started = monotonic()
            try:
                yield
            finally:
                self._batch_started = None

    def note(self, outputs: Sequence[Output], last: BatchTimes | None) -> None:
        """Record the outputs and statistics of a batch, `last`; None where nothing came."""
        with self._noting:
            self._record(outputs, last)

    def _record(self, outputs: Sequence[Output], last: BatchTimes | None) -> None:
        """Update times, counts, points and tests by a batch's outputs; call it with `_noting` held."""
        if last is not None:
            self.took.observe(last.took)
            self.committed.observe(last.committed)
            self.lag.observe(last.lag)
        plants = {output.plant for output in outputs}
        for name, plant in self._iterate_plants(plants):
            self.totals.add(name, plant.links)
        for name in plants:
            self._overview.touch(name)
        for output in outputs:
            if output.kind in ("provisional", "final"):
                message = from_json(output.body)
                self._keep_point(output.plant, message)
                if message["kind"] == "provisional":
                    self._keep_crossings(output.plant, message.get("forecast", []))
                if output.kind == "final":
                    self._test_claims(output.plant, message["estimates"])

    def _test_claims(self, plant: str, estimates: Mapping[str, Mapping[str, Any]]) -> None:
        """Add the NIS of a plant's newest estimates to the running tests, and weighed outputs to the recent ones."""
        of_plant = _move_to_newest(self._tests, plant, dict, TESTED)
        recent = self.outputs, _move_to_newest(self._outputs, plant, lambda: RecentOutputs(MEMORY, self.outputs.names))
        for node, filters in estimates.items():
            for name, message in filters.items():
                squared, received = read_nis(message)
                if squared is not None:
                    for tests in (self.nis, of_plant):
                        test = tests.setdefault((node, name), RunningNis(message["claim"]))
                        test.add(squared, received)
                if message.get("outputs") and message.get("received"):
                    for outputs in recent:
                        outputs.add(node, name, message["outputs"])

    def _keep_point(self, plant: str, message: Mapping[str, Any]) -> None:
        """Keep a plant's newest estimates as a point of its chart."""
        self._count += 1
        estimates = {
            node: {name: _means_and_deviations(estimate) for name, estimate in filters.items()}
            for node, filters in message["estimates"].items()
        }
        points = _move_to_newest(self._points, plant, lambda: deque(maxlen=POINTS))
        points.append(EstimatePoint(self._count, message["time"], message["kind"] == "final", estimates))
        if message.get("senders"):
            _move_to_newest(self._senders, plant, dict).update(message["senders"])
            self._dead_senders[plant] = [node for node, sender in message["senders"].items() if sender["dead"]]
            if not self._dead_senders[plant]:
                del self._dead_senders[plant]

    def _keep_crossings(self, plant: str, horizons: Sequence[Mapping[str, Any]]) -> None:
        """Keep the probabilities that a plant's thresholds are crossed, as its newest forecast has them."""
        crossings = dict[tuple[str, ...], Mapping[str, float]]()  # by node, filter, threshold, how far ahead
        for horizon in horizons:
            for node, filters in horizon["estimates"].items():
                for name, body in filters.items():
                    for level, probabilities in body.get("thresholds", {}).items():
                        crossings[node, name, level, f"{horizon['ahead']:g}"] = probabilities
        self._crossings.pop(plant, None)
        if crossings:
            _move_to_newest(self._crossings, plant, dict).update(crossings)

    def crossings(self, most: int) -> list[tuple[tuple[str, ...], float]]:
        """Return ((plant, node, filter, threshold, how far ahead), probability that it is crossed by then).

        Of `most` plants at most, those in which a crossing is most probable.
        """
        with self._noting:
            largest = {plant: max(p["by"] for p in levels.values()) for plant, levels in self._crossings.items()}
            first = sorted(largest, key=lambda plant: -largest[plant])[:most]
            return [((plant, *key), p["by"]) for plant in first for key, p in self._crossings[plant].items()]

    def plants(self) -> Iterator[tuple[str, WatchedPlant]]:
        """Yield all plants of all services."""
        for service in self.services:
            yield from service.plants.items()

    def _iterate_plants(self, names: Collection[str]) -> Iterator[tuple[str, WatchedPlant]]:
        """Yield the plants of these names."""
        for service in self.services:
            yield from ((name, service.plants[name]) for name in names if name in service.plants)

    def links(self) -> dict[str, dict[str, int | None]]:
        """Sum the counts over all plants, by node: messages by verdict, lost ones, and what was refused.

        Also of plants that have left the memory.
        """
        return self._hide_uncounted(self.totals.as_table())

    def _hide_uncounted(self, links: Mapping[str, dict[str, int]]) -> dict[str, dict[str, int | None]]:
        """Return counts by node with None for the lost messages of nodes that do not count theirs."""
        return {node: tally | ({"lost": None} if node in self.uncounted else {}) for node, tally in links.items()}

    def worst(self) -> list[PlantTroubles]:
        """Return the plants with something wrong, the worst first."""
        refused = dict[str, str]()
        for name, plant in self._iterate_plants(self._overview.touched):
            counts = [
                (node, verdict, getattr(link, verdict)) for node, link in plant.links.items() for verdict in REFUSED
            ]
            refused[name] = "; ".join(f"{node}: {count:,} {verdict}" for node, verdict, count in counts if count)
        return self._overview.worst(self._tests, self._dead_senders, refused)

    def tests(self, plant: str) -> Mapping[tuple[str, str], RunningNis]:
        """Return the tests of a plant's claims."""
        return self._tests.get(plant, {})

    def busy(self) -> float:
        """Return for how many seconds the present batch is being taken; 0 where there is none."""
        begun = self._batch_started
        return 0.0 if begun is None else monotonic() - begun

    def dead_senders(self) -> Mapping[str, int]:
        """Count the plants that have a dead sender, by node with a trigger, over all services."""
        total = Counter[str]()
        for service in self.services:
            total.update(service.dead_senders())  # adds, and holds zeros
        return total

    def remarks(self) -> Mapping[tuple[str, str], int]:
        """Count how often filters changed a state as users should know, by node and filter, over all services."""
        total = Counter[tuple[str, str]]()
        for service in self.services:
            total.update(service.remarks())
        return total

    def view(self, plant: str | None, since: int = 0) -> dict[str, Any]:
        """Return the data of the page for a plant (None: the one with the newest message), after the point `since`.

        While a batch is being taken, as where programs compile, the counts are those before it.
        """
        with self._noting:
            name = next(reversed(self._points), "") if plant is None else plant
        answers = self._service_answers.ask(name)
        with self._noting:
            points = [point for point in self._points.get(name, ()) if point.number > since]
            tests, senders = self._tests.get(name, {}), self._senders.get(name, {})
            health = self._outputs[name].summarise_outputs() if name in self._outputs else []
            # One JSON object; lists are bounded, so that its size does not grow with the plants.
            return {
                "title": self.title,
                "count": len(answers.names),
                "plants": answers.names[:LISTED],
                "plant": name,
                "states": self.states,
                "units": [unit_of(state) for state in self.states],
                "time_unit": self.time_unit,
                "since": since,
                "newest": self._count,
                "points": [point._asdict() for point in points],
                "links": self._hide_uncounted(answers.links),
                "senders": senders,
                "tests": [_make_test_row(*key, test) for key, test in tests.items()] + self.judge_fusions(tests),
                "outputs": [make_output_row(output) for output in health],
                "levels": [
                    {**dict(zip(("node", "filter", "level", "ahead"), key, strict=True)), **said}
                    for key, said in self._crossings.get(name, {}).items()
                ],
                "warnings": list(self._yield_warnings(answers.links, tests, senders))[:WARNINGS],
                "malformed": answers.malformed,
                "all": self.links(),
                "wrong": answers.wrong,
            }

    def _ask_services(self, plant: str) -> ServiceAnswers:
        """Ask the services, between two batches, for their plants, and for the counts of one, summed over them."""
        every = list(self.plants())
        return ServiceAnswers(
            sorted(name for name, _ in every),
            _add_counts([status for name, status in every if name == plant]),
            sum(service.malformed for service in self.services),
            len(self.worst()),
        )

    def judge_fusions(self, tests: Mapping[tuple[str, str], RunningNis]) -> list[dict[str, object]]:
        """Return a row for each fusion without a NIS test of its own: in doubt if that of any estimate it fuses is.

        `by` names the estimates that are in doubt, else all that were tested.
        """
        rows: list[dict[str, object]] = []
        for name, (claim, parts) in self.fused.items():
            tested = [(source, tests[source]) for source in parts if source in tests]
            if not tested or (Network.FUSED, name) in tests:
                continue
            doubted = ["/".join(source) for source, test in tested if test.doubt()]
            numbers = {"ratio": None, "low": None, "high": None, "numbers": sum(test.numbers for _, test in tested)}
            judged = {"doubt": bool(doubted), "by": doubted or ["/".join(source) for source, _ in tested]}
            rows.append({"node": Network.FUSED, "filter": name, "claim": claim, **numbers, **judged})
        return rows

    def _yield_warnings(
        self,
        links: Mapping[str, Mapping[str, int]],
        tests: Mapping[tuple[str, str], RunningNis],
        senders: Mapping[str, Mapping[str, Any]],
    ) -> Iterator[str]:
        """Yield what is wrong with a plant, a line each: doubted filters, dead senders, then messages by count."""
        for (node, filter_name), test in tests.items():
            if doubt := test.doubt():
                yield f"{node}/{filter_name}: {doubt}"
        for node, sender in senders.items():
            if sender["dead"]:
                yield f"{node}: its sender is dead: {sender['reason']}"
        for name, words in COUNTED.items():
            counted = sorted(node for node in links if links[node][name])
            # A line for each node, or one for many.
            for nodes in [counted] if len(counted) > APART else [[node] for node in counted]:
                yield f"{join_names(nodes)}: {sum(links[node][name] for node in nodes):,} {words}"


def _move_to_newest(newest: OrderedDict[str, T], plant: str, make: Callable[[], T], most: int = PLANTS) -> T:
    """Return the entry of a plant, made if needed, as the newest; drop the oldest entry beyond so many."""
    if plant not in newest:
        newest[plant] = make()
        if len(newest) > most:
            newest.popitem(last=False)
    newest.move_to_end(plant)
    return newest[plant]


def _means_and_deviations(message: Mapping[str, Any]) -> dict[str, object]:
    """Return means, standard deviations where the filter claims a covariance, and the modes' probabilities if any."""
    rows = message["covariance"]
    claimed = rows and [_deviation_of(row[i]) for i, row in enumerate(rows)]
    modes = {"modes": message["modes"]} if message.get("modes") is not None else {}
    return {"mean": message["mean"], "deviation": claimed, "claim": message["claim"], **modes}


def _deviation_of(variance: float | None) -> float | None:
    """Return the standard deviation of a variance; None where it has none."""
    return None if variance is None else math.sqrt(max(variance, 0.0))


def _add_counts(plants: Sequence[WatchedPlant]) -> dict[str, dict[str, int]]:
    """Sum the counts of several plants, by node."""
    results: dict[str, dict[str, int]] = {}
    for plant in plants:
        for node, link in plant.links.items():
            tally = results.setdefault(node, dict.fromkeys(FIELDS, 0))
            for name, count in counts_of(link).items():
                tally[name] += count
    return results


def _make_test_row(node: str, filter_name: str, test: RunningNis) -> dict[str, object]:
    """Return one row of the page's table of tests."""
    low, high = test.band()
    names = {"node": node, "filter": filter_name, "claim": test.claim, "doubt": test.doubt() is not None, "by": []}
    return names | {"ratio": test.ratio, "low": low, "high": high, "numbers": test.numbers}


def watch_of(network: Network, title: str, uncounted: Collection[str] = ()) -> Watch:
    """Return the observer of services of a network, whose name is `title`; `uncounted` as of a `Watch`."""
    claims = network.claims()
    fused = {
        name: (claims[Network.FUSED][name], [(node, fusion.filter) for node in network.nodes_with(fusion.filter)])
        for name, fusion in network.fused.items()
        if isinstance(fusion, Fusion)
    }
    names: dict[tuple[str, str], Sequence[str]] = {
        (node, name): receiver.received_names for node, receiver in network.nodes.items() for name in receiver.filters
    }
    all_names = [f"{node}: {name}" for node, receiver in network.nodes.items() for name in receiver.received_names]
    names |= {(Network.FUSED, name): all_names for name in network.fused}
    unit = units_in(network.inputs).get(TIME_STEP, "s") if TIME_STEP in network.inputs else "steps"
    return Watch(network.states, title, unit, fused, names, uncounted)
