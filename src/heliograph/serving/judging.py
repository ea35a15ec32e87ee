"""Which events of a batch are implausible: those that no filter of their node could use."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.filters.plausibility import Judgement, why_inputs, why_values
from heliograph.live.event import Known
from heliograph.live.rows import HeldRow
from heliograph.numerics.types import Float
from heliograph.serving.fleet import Fleet
from heliograph.serving.lanes import Place
from heliograph.serving.plant import Plant
from heliograph.simulation.network import FUSED

FLAGS = [Judgement._fields.index(name) for name in ("reason", "input")]


class Candidate(NamedTuple):
    """An event that was used, of the message with this number, and its row."""

    message: int
    plant: Plant
    event: Known
    row: HeldRow


class Judges:
    """Reads the filters' judgements of the rows that were just stepped."""

    def __init__(self, fleet: Fleet):
        self.fleet, places = fleet, fleet.lanes.places
        central = _columns([place for place in places if place.node == FUSED])
        self._columns = {}
        for place, name in enumerate(fleet.network.names):
            local = _columns([single for single in places if single.node == name and _listens(fleet, single)])
            self._columns[place] = local if len(local) else central
        self._every = _columns(places)

    def implausible_inputs(
        self, plants: Sequence[Plant | None], given: Float[np.ndarray, "plant given"]
    ) -> list[str | None]:
        """Why inputs are implausible, by the prediction over one step or one unit of time that they lead to."""
        if not plants:
            return []
        outputs = self.fleet.trial(plants, given)
        return [why_inputs(row[self._every]) for row in outputs]

    def implausible(self, taken: Sequence[Candidate]) -> dict[int, str]:
        """Why each of these is implausible, by its place among them, those that are.

        Of a plant with inputs among these the first alone: what comes after it was judged with it. Of several events
        of one node in one row the largest alone, since the row was judged as a whole; one without numbers never.
        """
        if not taken:
            return {}
        pool = self.fleet.pool
        outputs = pool.table[[item.row.slot for item in taken], pool.outputs]
        flagged = (outputs[:, self._every[:, FLAGS]] > 0).any(axis=(1, 2))
        result, spoilt = dict[int, str](), dict[str, int]()
        for i in np.flatnonzero(flagged).tolist():
            item = taken[i]
            if item.event.place >= 0:
                why = why_values(outputs[i][self._columns[item.event.place]]) if _size(item.event) >= 0 else None
            elif why := why_inputs(outputs[i][self._every]):
                first = spoilt.setdefault(item.plant.name, i)
                spoilt[item.plant.name] = min(first, i, key=lambda j: taken[j].row.key)
            if why:
                result[i] = why
        largest: dict[tuple[int, int], int] = {}
        for i in result:
            place = taken[i].row.slot, taken[i].event.place
            largest[place] = max(largest.get(place, i), i, key=lambda j: _size(taken[j].event))
        first_of_plant = {i: why for i, why in result.items() if spoilt.get(taken[i].plant.name, i) == i}
        return {i: why for i, why in first_of_plant.items() if i in largest.values()}


def _size(event: Known) -> float:
    """The largest number of an event, -1 where it has none."""
    return float(np.max(np.abs(event.values), initial=-1.0, where=~np.isnan(event.values)))


def _columns(places: Sequence[Place]) -> np.ndarray:
    """Where the judgements of these filters stand, (filter, part)."""
    results = [list(place.judgement) for place in places if place.judgement is not None]
    return np.array(results, dtype=int).reshape(-1, len(Judgement._fields))


def _listens(fleet: Fleet, place: Place) -> bool:
    return bool(fleet.network.nodes[place.node].filters[place.filter].received)
