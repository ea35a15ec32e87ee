"""Observation of running services: estimates with their bands, links, running tests of covariances, and warnings."""

import threading
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from time import monotonic
from typing import Any, NamedTuple

from prometheus_client import CollectorRegistry
from pydantic_core import from_json

from heliograph.disk.quoted_text import join_names
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.checks.refusal_reasons import OF_NODES, WORDS
from heliograph.model.estimate import Claim
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.types import unit_of, units_in
from heliograph.report.diagnosis.sensor_output_health import RecentInnovations, make_output_row
from heliograph.serving.count_totals import FIELDS, CountTotals, list_counts_of_link
from heliograph.serving.observation.answers_between_batches import LastAnswers
from heliograph.serving.observation.remembered_plants import PLANTS, BatchHistograms, RememberedPlants
from heliograph.serving.observation.running_nis import MEMORY, RunningNis, read_nis
from heliograph.serving.observation.trouble_overview import PlantTroubles, TroubleOverview
from heliograph.serving.observed_service import BatchTimes, ObservedService, WatchableService, WatchedPlant
from heliograph.serving.output import Output
from heliograph.simulation.network import Network

LISTED = 1000  # plants that can be chosen from
WARNINGS = 50  # lines
APART = 3  # nodes that have a warning each; more of the same kind have one together
REFUSED = "late", "future", "implausible", "conflict"
COUNTED: dict[str, str] = {  # of a node's messages
    "late": "came too late to be used; a longer --window would hold what they change",
    "future": "of a time that is not yet, refused; its clock is wrong",
    "implausible": "implausible and refused; the refused lines say why",
    **{reason: f"refused, {WORDS[reason]}" for reason in OF_NODES},
    "held": "times equal for longer than its noise allows: it is stuck, or has no noise",
    "timeouts": "times silent for longer than its timeout, and back",
    "conflict": "came again with other values; the first stayed",
}


class ServiceAnswers(NamedTuple):
    """What services answer between batches: names of all plants, one plant's counts by node, and counts of all."""

    names: list[str]
    links: dict[str, dict[str, int]]
    malformed: int
    wrong: int


class ServiceWatch:
    """Observer of any number of services of one network; a call from another thread waits for the current batch.

    Args:
        states: names of the states; a name with a `unit` has it on the axes.
        title: name of the network.
        time_unit: unit of times that are numbers.
        fused: by the name of a fusion its claim, and the (node, filter) pairs that it fuses, by which it is judged.
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
        """Begin without a service; `wrap` adds one. The arguments are the class's.

        The watch collects what pages and metrics show of running services.
        """
        self.states, self.title, self.time_unit = list(states), title, time_unit
        self.fused, self.uncounted = dict(fused or {}), uncounted
        self.services: list[WatchableService] = []
        # `lock` is held while a batch of messages is taken, `_noting` while its outputs are recorded. `_batch_started`:
        # when the batch that is being taken began.
        self.lock, self._noting = threading.Lock(), threading.Lock()
        self._batch_started: float | None = None
        # Over all plants: tests of the filters' covariances by (node, filter), the newest innovations of filters that
        # weigh outputs, counts of messages, durations of batches.
        self.nis: dict[tuple[str, str], RunningNis] = {}
        self.outputs = RecentInnovations(MEMORY, names or {})
        self.totals = CountTotals()
        self._batches = BatchHistograms()
        # Of each plant: what is wrong with it; and, of those with new messages, the points of charts and tests.
        self._overview = TroubleOverview()
        self._memory = RememberedPlants(names or {})
        # What the services themselves are asked, between two batches; the last answers stand while one is taken.
        no_answers = ServiceAnswers(names=[], links={}, malformed=0, wrong=0)
        self._service_answers = LastAnswers(self.lock, self._ask_services, no_answers, PLANTS)

    @property
    def registry(self) -> CollectorRegistry:
        """Return the registry of the metrics that are counted here, to which the page adds others."""
        return self._batches.registry

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
            self._record_batch(outputs, last)

    def _record_batch(self, outputs: Sequence[Output], last: BatchTimes | None) -> None:
        """Update times, counts, points of charts, and tests by a batch's outputs; call it with `_noting` held.

        `last` has the times of the batch; None where nothing came.
        """
        if last is not None:
            self._batches.observe(last)
        plants = {output.plant for output in outputs}
        for name, plant in self._iterate_plants(plants):
            self.totals.add_plant(name, plant.links)
        for name in plants:
            self._overview.note_change(name)
        for output in outputs:
            if output.kind in ("provisional", "final"):
                message = from_json(output.body)
                self._memory.keep_point(output.plant, message)
                if output.kind == "provisional":
                    self._memory.keep_crossings(output.plant, message.get("forecast", []))
                else:
                    self._test_claims(output.plant, message["estimates"])

    def _test_claims(self, plant: str, estimates: Mapping[str, Mapping[str, Any]]) -> None:
        """Add a plant's newest estimates to the running tests of what filters claim of their covariances.

        A filter's NIS (normalised innovation squared) goes to its test, and of a filter that weighs what it receives
        each number's innovation to the recent ones. Both go to the plant's own statistics and to those of all plants.

        Args:
            plant: name of the plant.
            estimates: published estimates by node and filter.
        """
        tests_of_plant, outputs_of_plant = self._memory.tests_of(plant), self._memory.outputs_of(plant)
        for node, filters in estimates.items():
            for name, message in filters.items():
                nis, received = read_nis(message)
                if nis is not None:
                    for tests in (self.nis, tests_of_plant):
                        tests.setdefault((node, name), RunningNis(message["claim"])).add(nis, received)
                if message.get("outputs") and message.get("received"):
                    for outputs in (self.outputs, outputs_of_plant):
                        outputs.add(node, name, message["outputs"])

    def crossings(self, most: int) -> list[tuple[tuple[str, ...], float]]:
        """Return pairs ((plant, node, filter, threshold, how far ahead), probability that it is crossed by then).

        They are of at most `most` plants, those in which a crossing is most probable.
        """
        with self._noting:  # nothing is recorded meanwhile
            return self._memory.list_crossings(most)

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

    def list_worst_plants(self) -> list[PlantTroubles]:
        """Return the plants with something wrong, the worst first: doubted filters, dead senders, refused messages.

        Refusals are counted again only for plants that had a message since the last call (`touched`).
        """
        refused = dict[str, str]()
        for name, plant in self._iterate_plants(self._overview.touched):
            refusals = [
                f"{node}: {getattr(link, verdict):,} {verdict}"
                for node, link in plant.links.items()
                for verdict in REFUSED
                if getattr(link, verdict)
            ]
            refused[name] = "; ".join(refusals)
        return self._overview.list_worst_plants(self._memory.tests, self._memory.dead_senders, refused)

    def tests(self, plant: str) -> Mapping[tuple[str, str], RunningNis]:
        """Return the running tests of a plant's claims, by node and filter; none of a plant that is forgotten."""
        return self._memory.tests.get(plant, {})

    def busy(self) -> float:
        """Return for how many seconds the present batch is being taken; 0 where there is none."""
        begun = self._batch_started
        return 0.0 if begun is None else monotonic() - begun

    def dead_senders(self) -> Mapping[str, int]:
        """Return for each node in how many plants its sender is dead (silent for too long), over all services."""
        total = Counter[str]()
        for service in self.services:
            total.update(service.dead_senders())  # adds the counts, and keeps zeros
        return total

    def remarks(self) -> Mapping[tuple[str, str], int]:
        """Return how often filters made a remark, such as that a gate gave in, by (node, filter), over all services."""
        total = Counter[tuple[str, str]]()
        for service in self.services:
            total.update(service.remarks())
        return total

    def make_page_data(self, plant: str | None, since: int = 0) -> dict[str, Any]:
        """Return the data that the page of a plant shows, which its script draws.

        While a batch is being taken, as where programs compile, the counts are those before it.

        Args:
            plant: name of the plant; None for the one with the newest message.
            since: number of the newest point that the page has already; later points of the charts are returned.
        """
        with self._noting:
            name = self._memory.newest_plant if plant is None else plant
        # Asked without holding `_noting`, since it may take the other lock: never both, which could block for ever.
        answers = self._service_answers.ask(name)
        with self._noting:
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
                "malformed": answers.malformed,
                "all": self.links(),  # counts by node, over all plants
                "wrong": answers.wrong,  # how many plants have something wrong
            } | self._describe_plant(name, since, answers.links)

    def _describe_plant(self, plant: str, since: int, links: Mapping[str, dict[str, int]]) -> dict[str, Any]:
        """Return what the page says of one plant, which is empty where nothing of it is remembered.

        Args:
            plant: name of the plant.
            since: number of a point of its charts: only later points are returned.
            links: counts of its messages, by node.
        """
        memory = self._memory
        tests, senders = memory.tests.get(plant, {}), memory.senders.get(plant, {})
        health = memory.outputs[plant].summarise_outputs() if plant in memory.outputs else []
        return {
            "newest": memory.count,
            "points": [point._asdict() for point in memory.points.get(plant, ()) if point.number > since],
            "links": self._hide_uncounted(links),
            "senders": senders,
            "tests": [_make_test_row(*key, test) for key, test in tests.items()] + self.judge_fusions(tests),
            "outputs": [make_output_row(output) for output in health],
            "levels": [
                {**dict(zip(("node", "filter", "level", "ahead"), key, strict=True)), **probabilities}
                for key, probabilities in memory.crossings.get(plant, {}).items()
            ],
            "warnings": list(self._yield_warnings(links, tests, senders))[:WARNINGS],
        }

    def _ask_services(self, plant: str) -> ServiceAnswers:
        """Return the names of all plants, the message counts of one plant, and how many plants have something wrong.

        The services are asked between two batches. The counts are by node, over all services that have the plant.
        """
        plants = list(self.plants())
        return ServiceAnswers(
            names=sorted(name for name, _ in plants),
            links=_add_counts([status for name, status in plants if name == plant]),
            malformed=sum(service.malformed for service in self.services),
            wrong=len(self.list_worst_plants()),
        )

    def judge_fusions(self, tests: Mapping[tuple[str, str], RunningNis]) -> list[dict[str, object]]:
        """Return a row for each fusion without its own NIS test; it is doubted if any estimate that it fuses is.

        A fusion takes the estimates of several filters (`parts`) and no data, so it has no NIS (normalised innovation
        squared). "by" names the doubted estimates, or if there are none all that were tested.
        """
        rows: list[dict[str, object]] = []
        for name, (claim, parts) in self.fused.items():
            tested = [(source, tests[source]) for source in parts if source in tests]
            has_own_test = (Network.FUSED, name) in tests
            if not tested or has_own_test:
                continue
            doubted = ["/".join(source) for source, test in tested if test.explain_doubt()]
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
            if doubt := test.explain_doubt():
                yield f"{node}/{filter_name}: {doubt}"
        for node, sender in senders.items():
            if sender["dead"]:
                yield f"{node}: its sender is dead: {sender['reason']}"
        for name, words in COUNTED.items():
            counted = sorted(node for node in links if links[node][name])
            # A line for each node, or one for many.
            for nodes in [counted] if len(counted) > APART else [[node] for node in counted]:
                yield f"{join_names(nodes)}: {sum(links[node][name] for node in nodes):,} {words}"


def _add_counts(plants: Sequence[WatchedPlant]) -> dict[str, dict[str, int]]:
    """Return the sums over several plants of their counts of messages, by node and kind of count."""
    results: dict[str, dict[str, int]] = {}
    for plant in plants:
        for node, link in plant.links.items():
            tally = results.setdefault(node, dict.fromkeys(FIELDS, 0))
            for name, count in list_counts_of_link(link).items():
                tally[name] += count
    return results


def _make_test_row(node: str, filter_name: str, test: RunningNis) -> dict[str, object]:
    """Return one row of the page's table of tests: the ratio of a filter's NIS to its expectation, with its band."""
    low, high = test.band()
    names = {
        "node": node,
        "filter": filter_name,
        "claim": test.claim,
        "doubt": test.explain_doubt() is not None,
        "by": [],
    }
    return names | {"ratio": test.ratio, "low": low, "high": high, "numbers": test.numbers}


def watch_of(network: Network, title: str, uncounted: Collection[str] = ()) -> ServiceWatch:
    """Return the observer of services of a network, whose name is `title`.

    `uncounted`: nodes whose messages carry no count, so that it is not known how many are lost.
    """
    claims = network.claims()
    # Fusions of estimates: {name: (its claim, the (node, filter) pairs that it fuses)}.
    fused = {
        name: (claims[Network.FUSED][name], [(node, fusion.filter) for node in network.nodes_with(fusion.filter)])
        for name, fusion in network.fused.items()
        if isinstance(fusion, Fusion)
    }
    # Names of the received numbers by (node, filter); central filters receive those of all nodes.
    names: dict[tuple[str, str], Sequence[str]] = {
        (node, name): receiver.received_names for node, receiver in network.nodes.items() for name in receiver.filters
    }
    all_names = [f"{node}: {name}" for node, receiver in network.nodes.items() for name in receiver.received_names]
    names |= {(Network.FUSED, name): all_names for name in network.fused}
    unit = units_in(network.inputs).get(TIME_STEP, "s") if TIME_STEP in network.inputs else "steps"
    return ServiceWatch(network.states, title, time_unit=unit, fused=fused, names=names, uncounted=uncounted)
