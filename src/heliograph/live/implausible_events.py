"""Plausibility of the events of a batch: an event is implausible if no filter of its node could use it."""

from collections.abc import Sequence
from math import nan
from typing import TypeAlias

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.live.event import Known
from heliograph.live.fleet import Fleet
from heliograph.live.plant import PlantState
from heliograph.live.rows import BEFORE, HeldRow
from heliograph.model.checks.faults import find_function_fault
from heliograph.model.estimate import Estimate
from heliograph.numerics.types import Float
from heliograph.simulation.description.wide_angles import WideAngles
from heliograph.simulation.network import Network
from heliograph.simulation.rows.columns import FilterColumns

TRIES = 10  # to find the function of a filter that returned no number
FLAGS = [Judgement._fields.index(name) for name in ("reason", "input")]


Candidate: TypeAlias = tuple[
    int, PlantState, Known, HeldRow
]  # an event that was used, its message's number, and its row


class Judges:
    """Reader of the filters' judgements of the rows that were just stepped."""

    def __init__(self, fleet: Fleet):
        self.fleet, places = fleet, fleet.program.places
        central = _judgement_columns([output for output in places if output.node == Network.FUSED])
        self._judgement_columns, self._central = {}, set[int]()  # nodes without a filter of their own
        for index, name in enumerate(fleet.network.names):
            of_node = _judgement_columns(
                [output for output in places if output.node == name and _has_sender(fleet, output)]
            )
            self._judgement_columns[index] = of_node if len(of_node) else central
            if not len(of_node):
                self._central.add(index)
        self._every = _judgement_columns(places)
        self._faults: dict[tuple[str, str], tuple[int, str]] = {}  # by node and filter: how often tried, what was found

    def implausible_inputs(
        self, plants: Sequence[PlantState | None], given: Float[np.ndarray, "plant given"]
    ) -> list[str | None]:
        """Explain which inputs are implausible, by the prediction over one step or unit of time that they lead to."""
        if not plants:
            return []
        return [self.why_inputs(row) for row in self.fleet.trial(plants, given)]

    def why_inputs(self, outputs: Float[np.ndarray, " outputs"]) -> str | None:
        """Explain why the inputs that led to these outputs are implausible; None if they are not."""
        return Judgement.why_inputs(outputs[self._every])

    def implausible(self, taken: Sequence[Candidate]) -> dict[int, str]:
        """Return the indices of the implausible candidates, each with the reason.

        Of a plant with implausible inputs only the first of these is returned: what comes after it was judged with it.
        Of several events of one node in one row only the largest is returned, since the row was judged as a whole; an
        event without numbers never is.
        """
        if not taken:
            return {}
        # Most rows raise no flag: look at the parts of a judgement only where one is raised.
        pool = self.fleet.pool
        slots = np.array([row.slot for *_, row in taken])
        flagged = (pool.table[slots[:, None], pool.outputs.start + self._every[:, FLAGS].ravel()] > 0).any(axis=1)
        # Reasons by candidate; by plant the first of its implausible inputs.
        reasons, spoilt = dict[int, str](), dict[str, int]()
        for i in np.flatnonzero(flagged).tolist():
            (_, plant, event, _), outputs = taken[i], pool.table[slots[i], pool.outputs]
            if event.node_index >= 0:
                why = (
                    Judgement.why_values(outputs[self._judgement_columns[event.node_index]])
                    if _largest_number(event) >= 0
                    else None
                )
            elif why := self.why_inputs(outputs):
                first = spoilt.setdefault(plant.name, i)
                spoilt[plant.name] = min(first, i, key=lambda j: taken[j][-1].key)
            if why:
                reasons[i] = why
        self._pick_blamed(taken, reasons)
        # Of one node in one row the event with the largest number.
        largest: dict[tuple[int, int], int] = {}
        for i in reasons:
            _, _, event, row = taken[i]
            node_of_row = row.slot, event.node_index
            largest[node_of_row] = max(largest.get(node_of_row, i), i, key=lambda j: _largest_number(taken[j][2]))
        first_of_plant = {i: why for i, why in reasons.items() if spoilt.get(taken[i][1].name, i) == i}
        return {
            i: why + self._name_faulty_function(taken[i]) for i, why in first_of_plant.items() if i in largest.values()
        }

    def _name_faulty_function(self, candidate: Candidate) -> str:
        """Name the function of a filter that returned no number in a row, after a semicolon; "" where none did.

        What was found of a filter is said again, and none is tried more than TRIES times: a plant may send for ever.
        """
        # The row, the one before it, and what the filters estimated there.
        _, plant, event, row = candidate
        pool, index = self.fleet.pool, plant.rows.index(row.key)
        before, after = plant.rows.held[index - 1], pool.table[row.slot, pool.outputs]
        known = pool.table[before.slot, pool.outputs]
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
                n = len(filter.states)
                mean = known[place.mean : place.mean + n]
                covariance = known[place.covariance : place.covariance + n * n].reshape(n, n)
                estimate = Estimate(mean, covariance, place.claim)
                begun = before.key[1] != BEFORE
                said = find_function_fault(filter, estimate if begun else filter.estimate(filter.init()),
                                      *pool.led(before.slot, row.slot))  # fmt: skip
                self._faults[place.node, place.filter] = tried + 1, said
            if said:
                return f"; {said}"
        return ""

    def _pick_blamed(self, taken: Sequence[Candidate], reasons: dict[int, str]) -> None:
        """Leave of the events of several nodes in one row, which a central filter judged together, the one to blame.

        That is the first, from the largest on, without which the row is plausible; the largest if there is none.
        """
        # Events of nodes without a filter of their own, by row.
        rows: dict[int, list[int]] = {}
        for i in reasons:
            if taken[i][2].node_index in self._central:
                rows.setdefault(taken[i][-1].slot, []).append(i)
        # Of several nodes' events in a row keep the one without which the row is plausible.
        for those in rows.values():
            if len({taken[i][2].node_index for i in those}) > 1:
                one = Judgement.find_culprit(
                    those, lambda i: _largest_number(taken[i][2]), lambda i: self._plausible_without(taken[i])
                )
                for i in those:
                    if i != one:
                        del reasons[i]

    def _plausible_without(self, candidate: Candidate) -> bool:
        """Step a row without what it has of a node; is it plausible then?"""
        # A copy of the row in a slot of its own, with NaN for the node's numbers.
        _, plant, event, row = candidate
        pool, rows = self.fleet.pool, plant.rows
        there = HeldRow(row.key, pool.take(), self.fleet.width)
        there.numbers = row.numbers.copy()
        at = rows.places[event.node_index]
        there.numbers[at] = [nan] * (at.stop - at.start)
        # Stepped from the row before, judged, and let go.
        self.fleet.step_row(rows.held[rows.index(row.key) - 1], there)
        plausible = (
            Judgement.why_values(pool.table[there.slot, pool.outputs][self._judgement_columns[event.node_index]])
            is None
        )
        pool.give([there.slot])
        return plausible


def _largest_number(event: Known) -> float:
    """Return the largest absolute number of an event, -1 if it has none."""
    return float(np.max(np.abs(event.values), initial=-1.0, where=~np.isnan(event.values)))


def _judgement_columns(outputs: Sequence[FilterColumns]) -> np.ndarray:
    """Return the columns of the judgements of these filters, of shape (filter, part)."""
    results = [list(output.judgement) for output in outputs if output.judgement is not None]
    return np.array(results, dtype=int).reshape(-1, len(Judgement._fields))


class FleetAngles:
    """Watch a fleet for angles that a filter knows less well than it can use, and for degrees; each is said once."""

    def __init__(self, fleet: Fleet):
        self._pool, self._watched = fleet.pool, list[tuple[str, np.ndarray, WideAngles]]()
        self._received = list[tuple[str, np.ndarray, WideAngles]]()
        for place in fleet.program.places:
            filter = filter_of(fleet, place)
            if filter is not None and (angles := WideAngles(filter)).states:
                n = len(filter.states)
                variances = fleet.pool.outputs.start + place.covariance + np.arange(n) * (n + 1)
                self._watched.append((f"{place.node}/{place.filter}", variances, angles))
        # What each node receives, by a filter that takes it: its own, or one of all nodes.
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

    def said_of(self, plants: Sequence[PlantState]) -> list[tuple[str, str]]:
        """Return the name of a plant and a line for each angle that is wide in a newest row for the first time."""
        self._watched = [watched for watched in self._watched if watched[-1].states]
        self._received = [watched for watched in self._received if watched[-1].received]
        if not self._watched and not self._received:
            return []
        slots = np.array([plant.rows.held[-1].slot for plant in plants], dtype=int)
        wide = [
            (plants[row].name, f"{of}: {line}")
            for of, columns, angles in self._watched
            for row, line in angles.said_of(self._pool.table[slots[:, None], columns])
        ]
        return wide + [
            (plants[row].name, f"{of}: {line}")
            for of, columns, angles in self._received
            for row, line in angles.doubt_unit(self._pool.table[slots[:, None], columns])
        ]


def _list_received(network: Network, node: str) -> dict[int, str]:
    """Return the names of what a node receives, by their places in a row; of what all do where they are fused."""
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


def _has_sender(fleet: Fleet, output: FilterColumns) -> bool:
    """Test whether the filter of these columns knows a sender that decides when to send."""
    filter = fleet.network.nodes[output.node].filters.get(output.filter)  # a fusion between neighbours is none
    return filter is not None and bool(filter.received)
