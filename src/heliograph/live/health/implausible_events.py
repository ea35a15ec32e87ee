"""Plausibility of the events of a batch: an event is implausible if no filter of its node could use it."""

from collections.abc import Iterable, Sequence
from math import nan
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.event import CheckedEvent
from heliograph.live.fleet import Fleet
from heliograph.live.plant_state import PlantState
from heliograph.live.sorted_rows import BEFORE, HeldRow
from heliograph.model.checks.non_finite_results import describe_non_finite_function
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Float
from heliograph.simulation.description.angle_doubts import WideAngles
from heliograph.simulation.network import Network
from heliograph.simulation.rows.output_columns import FilterColumns

TRIES = 10  # so often the function of a filter that returned no number is looked for
# Fields of a judgement that are above 0 if the filter objects: to a measurement (reason), to inputs (input).
FLAGS = [Judgement._fields.index(name) for name in ("reason", "input")]


class CandidateEvent(NamedTuple):
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
        """Find, for each node, the columns of a row's outputs that say whether its events were plausible.

        A step computes estimates and judgements as the outputs of a row. A node's events are judged by its own filters;
        where it has none, by the central ones, which take the measurements of all nodes.
        """
        self.fleet = fleet
        all_filters = fleet.program.filter_columns  # for each filter the columns of its outputs
        # Arrays of columns, (filter, field of `Judgement`): of all filters, and of the central ones.
        self._all_columns = _find_judgement_columns(all_filters)
        central = _find_judgement_columns([each for each in all_filters if each.node == Network.FUSED])
        # {index of a node: such columns of the filters that judge its events}; nodes that central filters judge.
        self._judgement_columns, self._judged_centrally = dict[int, np.ndarray](), set[int]()
        for index, name in enumerate(fleet.network.names):
            of_node = [each for each in all_filters if each.node == name and _takes_measurements(fleet, each)]
            own = _find_judgement_columns(of_node)
            if len(own):
                self._judgement_columns[index] = own
            else:
                self._judgement_columns[index] = central
                self._judged_centrally.add(index)
        # {(node, filter): (how often its functions were searched for a faulty one, the sentence found or "")}.
        self._faults: dict[tuple[str, str], tuple[int, str]] = {}

    def explain_implausible_inputs(
        self, plants: Sequence[PlantState | None], given: Float[np.ndarray, "plant given"]
    ) -> list[str | None]:
        """Return for each plant why its inputs are implausible, or None if they are not.

        Inputs are judged by the prediction that they lead to, over one step or one unit of time.
        """
        if not plants:
            return []
        return [self.explain_inputs(row) for row in self.fleet.predict_outputs(plants, given)]

    def explain_inputs(self, outputs: Float[np.ndarray, " outputs"]) -> str | None:
        """Return why the inputs that led to these outputs of a row are implausible; None if they are not."""
        return Judgement.why_inputs(outputs[self._all_columns])

    def find_implausible(self, taken: Sequence[CandidateEvent]) -> dict[int, str]:
        """Return {index of an implausible candidate: the reason}, by the rows that were just stepped.

        The filters judged each row (time step) of a plant as a whole, so that one wrong event may spoil others. If
        inputs of a plant are implausible, only the first such inputs are returned: later rows were judged with them. Of
        several events of one node in one row only that with the largest number is returned; the caller refuses the
        returned events, computes anew, and asks again. An event without numbers is never returned.

        Args:
            taken: the events that were used since the last question, each with its plant and row.
        """
        if not taken:
            return {}
        # Below, i and j are indices of candidates in `taken`.
        flagged = self._find_flagged(taken)
        reasons = {i: why for i in flagged if (why := self._explain_event(taken[i]))}
        # Of several nodes' events that were judged together only the one to blame stays in `reasons`.
        self._drop_blameless(taken, reasons)
        # The largest event of its node in its row; but of a plant with implausible inputs only the first of these.
        largest, first_inputs = _find_largest_events(taken, reasons), _find_first_inputs(taken, reasons)
        to_refuse = [i for i in reasons if i in largest and first_inputs.get(taken[i].plant.name, i) == i]
        return {i: reasons[i] + self._name_faulty_function(taken[i]) for i in to_refuse}

    def _find_flagged(self, taken: Sequence[CandidateEvent]) -> list[int]:
        """Return the indices of the candidates in whose rows some filter objects to a measurement or to inputs."""
        state_table = self.fleet.state_table
        slots = np.array([candidate.row.slot for candidate in taken])  # a row's line in the table
        columns = state_table.outputs.start + self._all_columns[:, FLAGS].ravel()  # of the flags of all filters
        flags = state_table.table[slots[:, None], columns]  # (candidate, flag); above 0 if a filter objects
        flagged: list[int] = np.flatnonzero((flags > 0).any(axis=1)).tolist()
        return flagged

    def _explain_event(self, candidate: CandidateEvent) -> str | None:
        """Return why a candidate is implausible by its row's judgements, or None if it is not or holds no number."""
        event, state_table = candidate.event, self.fleet.state_table
        outputs = state_table.table[candidate.row.slot, state_table.outputs]
        if event.is_inputs:
            return self.explain_inputs(outputs)
        # Without any number, nothing can be implausible.
        if _find_largest_number(event) < 0:
            return None
        return Judgement.why_values(outputs[self._judgement_columns[event.node_index]])

    def _name_faulty_function(self, candidate: CandidateEvent) -> str:
        """Return the name of a filter's function that returned no number in a row, after "; "; "" where none did.

        A filter whose function returns NaN or infinity judges every event to be no number; the name of the function
        tells the user what to mend. A fault, once found, is repeated without another search. A filter is searched at
        most TRIES times, for a plant may send implausible events for ever.
        """
        event, row = candidate.event, candidate.row
        row_before = self._find_row_before(candidate)
        outputs = self.fleet.state_table.table[row.slot, self.fleet.state_table.outputs]
        # Filters that take the event: of its node, or of all nodes. Inputs concern every filter.
        concerned = None if event.is_inputs else (Network.FUSED, self.fleet.network.names[event.node_index])
        for columns in self.fleet.program.filter_columns:
            filter = find_filter_of_columns(self.fleet, columns)
            if filter is None or (concerned is not None and columns.node not in concerned):
                continue
            # Only those that judged the row to be no number.
            if columns.judgement is None or not Judgement.is_spoilt(outputs[columns.judgement.reason]):
                continue
            # Call the filter's functions from its estimate before the row: which of them returns no number?
            tries, sentence = self._faults.get((columns.node, columns.filter), (0, ""))
            if not sentence and tries < TRIES:
                inputs, step = self.fleet.state_table.inputs_between(row_before.slot, row.slot)
                estimate = self._estimate_after(row_before, filter, columns)
                sentence = describe_non_finite_function(filter, estimate, inputs, step)
                self._faults[columns.node, columns.filter] = tries + 1, sentence
            if sentence:
                return f"; {sentence}"
        return ""

    def _find_row_before(self, candidate: CandidateEvent) -> HeldRow:
        """Return the row before the candidate's: there is one, since the first row of a plant never takes an event."""
        rows = candidate.plant.rows
        return rows.held[rows.find_index(candidate.row.key) - 1]

    def _estimate_after(self, row: HeldRow, filter: AbstractFilter, columns: FilterColumns) -> Estimate:
        """Return a filter's estimate after a row; for the row before all events this is the initial estimate.

        `columns` says where the mean and the covariance begin among the row's outputs.
        """
        _time, node, _count = row.key
        if node == BEFORE:  # the row before all events, where no estimate was computed
            return filter.estimate(filter.init())
        n, outputs = len(filter.states), self.fleet.state_table.table[row.slot, self.fleet.state_table.outputs]
        covariance = outputs[columns.covariance : columns.covariance + n * n].reshape(n, n)
        return Estimate(outputs[columns.mean : columns.mean + n], covariance, columns.claim)

    def _drop_blameless(self, taken: Sequence[CandidateEvent], reasons: dict[int, str]) -> None:
        """Leave in `reasons`, of several nodes' events that a central filter judged together, only the one to blame.

        That is the first, from the largest on, without which the row is plausible; the largest if there is none.
        """
        # {slot of a row: indices of the row's events that central filters judged}.
        by_row: dict[int, list[int]] = {}
        for i in reasons:
            if taken[i].event.node_index in self._judged_centrally:
                by_row.setdefault(taken[i].row.slot, []).append(i)
        for together in by_row.values():
            if len({taken[i].event.node_index for i in together}) > 1:
                # Among several nodes' events: tried from the largest number on, until the row is plausible without.
                culprit = Judgement.find_culprit(
                    together,
                    lambda i: _find_largest_number(taken[i].event),
                    lambda i: self._is_plausible_without(taken[i]),
                )
                for i in together:
                    if i != culprit:
                        del reasons[i]

    def _is_plausible_without(self, candidate: CandidateEvent) -> bool:
        """Return whether the candidate's row is plausible without the numbers of the candidate's node."""
        # Copy the row to a slot of its own, with NaN for the node's numbers.
        event, row = candidate.event, candidate.row
        state_table, rows = self.fleet.state_table, candidate.plant.rows
        trial = HeldRow(row.key, state_table.take_slot(), self.fleet.layout.width)
        trial.numbers = row.numbers.copy()
        columns = rows.columns_by_node[event.node_index]
        trial.numbers[columns] = [nan] * (columns.stop - columns.start)
        # Step from the previous row to the copy, read its judgement, and free its slot.
        self.fleet.step_row(self._find_row_before(candidate), trial)
        outputs = state_table.table[trial.slot, state_table.outputs]
        judgements = outputs[self._judgement_columns[event.node_index]]
        state_table.free_slots([trial.slot])
        return Judgement.why_values(judgements) is None


def _find_largest_events(taken: Sequence[CandidateEvent], indices: Iterable[int]) -> set[int]:
    """Return, of the candidates with these indices, those of the event with the largest number of its node and row."""
    largest: dict[tuple[int, int], int] = {}  # {(row, node): index of the event with the largest number so far}
    for i in indices:
        row_and_node = taken[i].row.slot, taken[i].event.node_index
        before = largest.get(row_and_node, i)
        largest[row_and_node] = max(before, i, key=lambda j: _find_largest_number(taken[j].event))
    return set(largest.values())


def _find_first_inputs(taken: Sequence[CandidateEvent], indices: Iterable[int]) -> dict[str, int]:
    """Return {plant: which of the candidates with these indices has its first inputs}, of plants with inputs there."""
    first_inputs: dict[str, int] = {}
    for i in indices:
        if taken[i].event.is_inputs:
            first = first_inputs.setdefault(taken[i].plant.name, i)
            first_inputs[taken[i].plant.name] = min(first, i, key=lambda j: taken[j].row.key)  # by time first
    return first_inputs


def _find_largest_number(event: CheckedEvent) -> float:
    """Return the largest absolute number of an event; -1 if all its values are NaN."""
    return float(np.max(np.abs(event.values), initial=-1.0, where=~np.isnan(event.values)))


def _find_judgement_columns(outputs: Sequence[FilterColumns]) -> np.ndarray:
    """Return in which columns of a row's outputs these filters' judgements stand: (filter, field of `Judgement`).

    Filters that judge nothing are left out.
    """
    results = [list(output.judgement) for output in outputs if output.judgement is not None]
    return np.array(results, dtype=int).reshape(-1, len(Judgement._fields))


class WatchedAngles(NamedTuple):
    """Angles to watch in rows of the table, which are removed from `angles` once they were said.

    Attributes:
        name: name before what is said: "node/filter" of states, the node of what it receives.
        columns: columns of the table, of the variances of the filter's states or of the received numbers.
        angles: which of these numbers are angles, and what to say of them.
    """

    name: str
    columns: np.ndarray
    angles: WideAngles


class AngleWatch:
    """Watch a fleet for angles that a filter knows less well than it can use, and for degrees; each is said once."""

    def __init__(self, fleet: Fleet):
        """List the angles that the fleet's filters estimate and that its nodes receive."""
        self._state_table = fleet.state_table
        self._states = _watch_states(fleet)
        self._received = _watch_received(fleet)

    def find_new(self, plants: Sequence[PlantState]) -> list[tuple[str, str]]:
        """Return (name of the plant, line) for each angle whose doubt shows in a newest row for the first time."""
        # `angles.states` and `angles.received` lose each angle that was reported; one without any needs no watch.
        self._states = [watched for watched in self._states if watched.angles.states]
        self._received = [watched for watched in self._received if watched.angles.received]
        if not self._states and not self._received:
            return []
        # Lines of the table with the newest rows: the numbers of one plant's angles are a line of the arrays below.
        slots = np.array([plant.rows.held[-1].slot for plant in plants], dtype=int)
        wide = [
            (plants[row].name, f"{name}: {line}")
            for name, columns, angles in self._states
            for row, line in angles.said_of(self._state_table.table[slots[:, None], columns])
        ]
        return wide + [
            (plants[row].name, f"{name}: {line}")
            for name, columns, angles in self._received
            for row, line in angles.doubt_unit(self._state_table.table[slots[:, None], columns])
        ]


def _watch_states(fleet: Fleet) -> list[WatchedAngles]:
    """Return for each filter with angles among its states the columns of its states' variances, to be watched."""
    watched = list[WatchedAngles]()
    for columns in fleet.program.filter_columns:
        filter = find_filter_of_columns(fleet, columns)
        if filter is None:
            continue
        angles = WideAngles(filter)
        if angles.states:
            # The covariance (n, n) stands row by row, so that entries of the diagonal are n + 1 columns apart.
            n = len(filter.states)
            variance_columns = fleet.state_table.outputs.start + columns.covariance + np.arange(n) * (n + 1)
            watched.append(WatchedAngles(f"{columns.node}/{columns.filter}", variance_columns, angles))
    return watched


def _watch_received(fleet: Fleet) -> list[WatchedAngles]:
    """Return the received angles to watch, for degrees where the filter takes radians.

    The filter that takes a measurement knows which of its numbers are angles: the node's own, or one of all nodes. A
    number that several filters take is watched only once.
    """
    watched, seen = list[WatchedAngles](), set[int]()
    for columns in fleet.program.filter_columns:
        filter = find_filter_of_columns(fleet, columns)
        if filter is None or not filter.received:
            continue
        names = _list_received(fleet.network, columns.node)
        angles = WideAngles(filter, list(names.values()))
        for i, column in enumerate(names):
            if column in seen:
                angles.received.pop(i, None)
        seen |= set(names)
        watched.append(WatchedAngles(columns.node, fleet.state_table.numbers.start + np.array(list(names)), angles))
    return watched


def _list_received(network: Network, node: str) -> dict[int, str]:
    """Return {column among the measurements of all nodes: name of its output} for a node, or for all if it is FUSED.

    `network.rows` holds for each node the columns of what it receives.
    """
    if node != Network.FUSED:
        return dict(zip(network.rows[node], network.nodes[node].received_names, strict=True))
    return {
        column: f"{name}: {output}"
        for name in network.names
        for column, output in zip(network.rows[name], network.nodes[name].received_names, strict=True)
    }


def find_filter_of_columns(fleet: Fleet, columns: FilterColumns) -> AbstractFilter | None:
    """Return the filter whose estimate stands in these columns of a row, or None if it is a fusion rule.

    The name FUSED stands for both: central filters, which get everything that is received, and fusion rules.
    """
    if columns.node == Network.FUSED:
        filter_or_rule = fleet.network.fused[columns.filter]
        return filter_or_rule if isinstance(filter_or_rule, AbstractFilter) else None
    return fleet.network.nodes[columns.node].filters.get(columns.filter)


def _takes_measurements(fleet: Fleet, output: FilterColumns) -> bool:
    """Return whether a column belongs to a filter of measurements, and not to a fusion of neighbours' estimates."""
    filter = fleet.network.nodes[output.node].filters.get(output.filter)  # None of a fusion
    return filter is not None and bool(filter.received)
