"""Plausibility of the events of a batch: an event is implausible if no filter of its node could use it."""

from collections.abc import Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.event import CheckedEvent
from heliograph.live.fleet import Fleet
from heliograph.live.plant import PlantState
from heliograph.live.sorted_rows import BEFORE, HeldRow
from heliograph.model.checks.faults import find_function_fault
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Float
from heliograph.simulation.description.wide_angles import WideAngles
from heliograph.simulation.network import Network
from heliograph.simulation.rows.columns import FilterColumns

TRIES = 10  # to find the function of a filter that returned no number
FLAGS = [Judgement._fields.index(name) for name in ("reason", "input")]


class Candidate(NamedTuple):
    """An event that was used and is to be judged: its message's number, its plant, itself, and the row it stands in."""

    number: int
    plant: PlantState
    event: CheckedEvent
    row: HeldRow


class JudgementReader:
    """Reader of the filters' judgements of the rows that were just stepped.

    A node's events are judged by its own filters; where it has none, by the central ones, which take all nodes'.
    """

    def __init__(self, fleet: Fleet):
        self.fleet, places = fleet, fleet.program.places
        central = _judgement_columns([output for output in places if output.node == Network.FUSED])
        # By index of a node the columns of the judgements on it; the nodes without a filter of their own.
        self._judgement_columns, self._judged_centrally = {}, set[int]()
        for index, name in enumerate(fleet.network.names):
            of_node = _judgement_columns(
                [output for output in places if output.node == name and _takes_measurements(fleet, output)]
            )
            self._judgement_columns[index] = of_node if len(of_node) else central
            if not len(of_node):
                self._judged_centrally.add(index)
        self._all_columns = _judgement_columns(places)
        # By node and filter: how often a faulty function was looked for, and the sentence that was found.
        self._faults: dict[tuple[str, str], tuple[int, str]] = {}

    def explain_implausible_inputs(
        self, plants: Sequence[PlantState | None], given: Float[np.ndarray, "plant given"]
    ) -> list[str | None]:
        """Return for each plant why its inputs are implausible, None where they are not.

        They are judged by the prediction over one step, or one unit of time, that they lead to.
        """
        if not plants:
            return []
        return [self.why_inputs(row) for row in self.fleet.predict_outputs(plants, given)]

    def why_inputs(self, outputs: Float[np.ndarray, " outputs"]) -> str | None:
        """Explain why the inputs that led to these outputs are implausible; None if they are not."""
        return Judgement.why_inputs(outputs[self._all_columns])

    def find_implausible(self, taken: Sequence[Candidate]) -> dict[int, str]:
        """Return the indices of the implausible candidates, each with the reason.

        Of a plant with implausible inputs only the first of these is returned: what comes after it was judged with it.
        Of several events of one node in one row only the largest is returned, since the row was judged as a whole; an
        event without numbers never is.
        """
        if not taken:
            return {}
        # Most rows raise no flag: look at the parts of a judgement only where one is raised.
        pool = self.fleet.pool
        slots = np.array([candidate.row.slot for candidate in taken])
        flagged = (pool.table[slots[:, None], pool.outputs.start + self._all_columns[:, FLAGS].ravel()] > 0).any(axis=1)
        # Reasons by candidate; by plant the first of its implausible inputs.
        reasons, first_inputs = dict[int, str](), dict[str, int]()
        for i in np.flatnonzero(flagged).tolist():
            plant, event, outputs = taken[i].plant, taken[i].event, pool.table[slots[i], pool.outputs]
            why = None
            if event.node_index < 0:
                why = self.why_inputs(outputs)
                if why:
                    first = first_inputs.setdefault(plant.name, i)
                    first_inputs[plant.name] = min(first, i, key=lambda j: taken[j].row.key)
            elif _largest_number(event) >= 0:
                why = Judgement.why_values(outputs[self._judgement_columns[event.node_index]])
            if why:
                reasons[i] = why
        self._drop_blameless(taken, reasons)
        # Of one node in one row the event with the largest number.
        largest: dict[tuple[int, int], int] = {}
        for i in reasons:
            node_of_row = taken[i].row.slot, taken[i].event.node_index
            largest[node_of_row] = max(largest.get(node_of_row, i), i, key=lambda j: _largest_number(taken[j].event))
        # What came after implausible inputs of its plant was judged with these: it may be all right without them.
        return {
            i: why + self._name_faulty_function(taken[i])
            for i, why in reasons.items()
            if i in largest.values() and first_inputs.get(taken[i].plant.name, i) == i
        }

    def _name_faulty_function(self, candidate: Candidate) -> str:
        """Name the function of a filter that returned no number in a row, after a semicolon; "" where none did.

        A filter's fault, once found, is repeated without another search. A filter is searched at most TRIES times, for
        a plant may send implausible events for ever.
        """
        # The event's row, what the filters said after it, and the row before it: the first that is held has no events.
        rows, event, row = candidate.plant.rows, candidate.event, candidate.row
        pool, before = self.fleet.pool, rows.held[rows.index(row.key) - 1]
        after = pool.table[row.slot, pool.outputs]
        for place in self.fleet.program.places:
            # Filters that judged this row to be no number, of the event's node or of all nodes.
            filter = filter_of(self.fleet, place)
            judged = place.judgement is not None and Judgement.is_spoilt(after[place.judgement.reason])
            concerned = event.node_index < 0 or place.node in (
                Network.FUSED,
                self.fleet.network.names[event.node_index],
            )
            if filter is None or not judged or not concerned:
                continue
            # Call the filter's functions from the estimate before the row: which of them returns no number?
            tried, said = self._faults.get((place.node, place.filter), (0, ""))
            if not said and tried < TRIES:
                inputs, step = pool.inputs_between(before.slot, row.slot)
                said = find_function_fault(filter, self._estimate_after(before, filter, place), inputs, step)
                self._faults[place.node, place.filter] = tried + 1, said
            if said:
                return f"; {said}"
        return ""

    def _estimate_after(self, row: HeldRow, filter: AbstractFilter, place: FilterColumns) -> Estimate:
        """Return what a filter estimated after a row, from its columns; before all events its initial estimate."""
        if row.key[1] == BEFORE:  # no estimate was computed there
            return filter.estimate(filter.init())
        n, outputs = len(filter.states), self.fleet.pool.table[row.slot, self.fleet.pool.outputs]
        covariance = outputs[place.covariance : place.covariance + n * n].reshape(n, n)
        return Estimate(outputs[place.mean : place.mean + n], covariance, place.claim)

    def _drop_blameless(self, taken: Sequence[Candidate], reasons: dict[int, str]) -> None:
        """Leave in `reasons`, of several nodes' events that a central filter judged together, only the one to blame.

        That is the first, from the largest on, without which the row is plausible; the largest if there is none.
        """
        # Events of nodes without a filter of their own, by row.
        by_row: dict[int, list[int]] = {}
        for i in reasons:
            if taken[i].event.node_index in self._judged_centrally:
                by_row.setdefault(taken[i].row.slot, []).append(i)
        for together in by_row.values():
            if len({taken[i].event.node_index for i in together}) > 1:
                culprit = Judgement.find_culprit(
                    together, lambda i: _largest_number(taken[i].event), lambda i: self._is_plausible_without(taken[i])
                )
                for i in together:
                    if i != culprit:
                        del reasons[i]

    def _is_plausible_without(self, candidate: Candidate) -> bool:
        """Return whether the candidate's row is plausible without all that it has of the candidate's node."""
        # A copy of the row in a slot of its own, with NaN for the node's numbers.
        event, row = candidate.event, candidate.row
        pool, rows = self.fleet.pool, candidate.plant.rows
        trial = HeldRow(row.key, pool.take(), self.fleet.width)
        trial.numbers = row.numbers.copy()
        columns = rows.places[event.node_index]
        trial.numbers[columns] = [nan] * (columns.stop - columns.start)
        # Stepped from the row before, judged, and let go.
        self.fleet.step_row(rows.held[rows.index(row.key) - 1], trial)
        judged = pool.table[trial.slot, pool.outputs][self._judgement_columns[event.node_index]]
        pool.give([trial.slot])
        return Judgement.why_values(judged) is None


def _largest_number(event: CheckedEvent) -> float:
    """Return the largest absolute number of an event, -1 if it has none."""
    return float(np.max(np.abs(event.values), initial=-1.0, where=~np.isnan(event.values)))


def _judgement_columns(outputs: Sequence[FilterColumns]) -> np.ndarray:
    """Return the columns of the judgements of these filters, of shape (filter, part)."""
    results = [list(output.judgement) for output in outputs if output.judgement is not None]
    return np.array(results, dtype=int).reshape(-1, len(Judgement._fields))


class FleetAngles:
    """Watch a fleet for angles that a filter knows less well than it can use, and for degrees; each is said once."""

    def __init__(self, fleet: Fleet):
        # Name, columns of the variances of its states in the table, and the angles among these, by filter.
        self._pool, self._watched = fleet.pool, list[tuple[str, np.ndarray, WideAngles]]()
        # The same by node of what it receives.
        self._received = list[tuple[str, np.ndarray, WideAngles]]()
        for place in fleet.program.places:
            filter = filter_of(fleet, place)
            if filter is not None and (angles := WideAngles(filter)).states:
                n = len(filter.states)
                variances = fleet.pool.outputs.start + place.covariance + np.arange(n) * (n + 1)
                self._watched.append((f"{place.node}/{place.filter}", variances, angles))
        # What each node receives, by a filter that takes it: its own, or one of all nodes; each column only once.
        watched = set[int]()
        for place in fleet.program.places:
            if (filter := filter_of(fleet, place)) is not None and filter.received:
                here = _list_received(fleet.network, place.node)
                angles = WideAngles(filter, list(here.values()))
                for i, column in enumerate(here):
                    if column in watched:
                        angles.received.pop(i, None)
                watched |= set(here)
                self._received.append((place.node, fleet.pool.numbers.start + np.array(list(here)), angles))

    def find_new(self, plants: Sequence[PlantState]) -> list[tuple[str, str]]:
        """Return (name of the plant, line) for each angle whose doubt shows in a newest row for the first time."""
        self._watched = [watched for watched in self._watched if watched[-1].states]
        self._received = [watched for watched in self._received if watched[-1].received]
        if not self._watched and not self._received:
            return []
        slots = np.array([plant.rows.held[-1].slot for plant in plants], dtype=int)
        wide = [
            (plants[row].name, f"{name}: {line}")
            for name, columns, angles in self._watched
            for row, line in angles.said_of(self._pool.table[slots[:, None], columns])
        ]
        return wide + [
            (plants[row].name, f"{name}: {line}")
            for name, columns, angles in self._received
            for row, line in angles.doubt_unit(self._pool.table[slots[:, None], columns])
        ]


def _list_received(network: Network, node: str) -> dict[int, str]:
    """Return {column of a row's measurements: name of what is received there} of a node, or of all for `FUSED`."""
    if node != Network.FUSED:
        return dict(zip(network.rows[node], network.nodes[node].received_names, strict=True))
    return {
        at: f"{name}: {what}"
        for name in network.names
        for at, what in zip(network.rows[name], network.nodes[name].received_names, strict=True)
    }


def filter_of(fleet: Fleet, output: FilterColumns) -> AbstractFilter | None:
    """Return the filter of these columns; None of a fusion rule."""
    if output.node == Network.FUSED:
        central = fleet.network.fused[output.filter]
        return central if isinstance(central, AbstractFilter) else None
    return fleet.network.nodes[output.node].filters.get(output.filter)


def _takes_measurements(fleet: Fleet, output: FilterColumns) -> bool:
    """Return whether these columns are of a filter of the node that takes measurements itself."""
    filter = fleet.network.nodes[output.node].filters.get(output.filter)  # a fusion between neighbours is none
    return filter is not None and bool(filter.received)
