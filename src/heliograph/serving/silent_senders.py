"""Silence of senders, told by the clock: it follows from the last commit, and is not committed."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from math import floor, inf
from time import monotonic
from typing import NamedTuple

import numpy as np

from heliograph.live.fleet import Fleet
from heliograph.live.plant_state import PlantState
from heliograph.live.sorted_rows import HeldRow
from heliograph.serving.settings import SHORTEST

MOVED = 0.1  # deviations by which a mean has to move to be published again, and share by which a deviation has to
GRACE = 10.0  # seconds after a start in which messages that waited come first


class PublishedEstimate(NamedTuple):
    """The newest estimate of a plant that was published.

    Attributes:
        outputs: outputs of all filters, (outputs,).
        dead: nodes whose senders were dead then.
        time: the row's, in steps or in the unit of dt.
    """

    outputs: np.ndarray
    dead: tuple[str, ...]
    time: float


class SilenceWatch:
    """Finds silent plants whose steps have dates, and which of their estimates are worth publishing.

    An estimate is published where a mean has moved by a tenth of its deviation since the last one published, a
    deviation by a tenth of itself, or a sender is dead now, or is not any more; and every so many seconds if asked for.

    Args:
        fleet: the plants of the network.
        every: seconds after which an estimate is published although it has hardly changed; None for never.
    """

    def __init__(self, fleet: Fleet, every: float | None):
        """Begin with nothing published.

        Args:
            fleet: the plants of the network.
            every: seconds after which an estimate is published again although it has hardly changed; None for never.
        """
        self.fleet, self.every = fleet, every
        # By the monotonic clock: when the service started, and when timeouts were last looked for.
        self._begun, self._looked = monotonic(), -inf
        self._published: dict[str, PublishedEstimate] = {}  # by plant, its newest published estimate
        self._resumed = set[str]()  # plants that were stored before this start: messages for them may wait at a broker
        # Where a row's outputs have the numbers whose changes count: columns (filter, state) of the filters' means, and
        # of their variances. Each filter's mean (n,) and covariance (n, n), row by row, begin at a column.
        n, filters = len(fleet.network.states), fleet.program.filter_columns
        self._means = np.array([[each.mean + i for i in range(n)] for each in filters], dtype=int)
        self._variances = np.array([[each.covariance + i * (n + 1) for i in range(n)] for each in filters], dtype=int)

    def resume(self, names: Iterable[str]) -> None:
        """Note plants that a service goes on with, of which messages may wait somewhere."""
        self._resumed.update(names)

    def find_plants_due(self, plants: Iterable[PlantState], now: datetime) -> list[tuple[PlantState, float]]:
        """Return pairs of a plant in which a new step has begun without a message, and the step's number.

        There are none unless steps have a length and some senders decide when to send: only then silence informs.
        """
        step, due = self.fleet.options.step, list[tuple[PlantState, float]]()
        if step is None or not self.fleet.deciding:
            return due
        for plant, origin in self._iterate_dated_plants(plants):
            present_step = min((now - origin) // timedelta(seconds=step), self.fleet.end_step)
            # A leap is a jump in time that only one sender's clock shows. The time here can confirm or contradict it.
            leap = plant.leap
            has_open_leap = leap is not None and leap.now > -inf and not leap.believed
            has_new_step = present_step > plant.rows.held[-1].key[0]
            if present_step > plant.confirmed and (has_open_leap or has_new_step):
                due.append((plant, float(present_step)))
        return due

    def find_plants_overdue(self, plants: Iterable[PlantState], now: datetime) -> list[tuple[PlantState, float]]:
        """Return pairs of a plant in which a sender has newly timed out, and the present moment.

        A sender has newly timed out if it was not dead in the plant's last published estimate. The moment counts from
        the plant's origin, in steps or, if time is continuous, in seconds.
        """
        if self.fleet.shortest_timeout == inf:
            return []
        self._looked = monotonic()
        step, overdue = self.fleet.options.step, list[tuple[PlantState, float]]()
        for plant, origin in self._iterate_dated_plants(plants):
            moment = (now - origin) / timedelta(seconds=step or 1.0)
            moment = moment if step is None else min(floor(moment), self.fleet.end_step)
            newly_dead = set(self._dead_senders(plant, moment)) - set(self._published_dead_senders(plant))
            if moment > plant.now and newly_dead:
                overdue.append((plant, float(moment)))
        return overdue

    def looks_between_batches(self, lag: float) -> bool:
        """Return whether to look for timeouts after a batch: at most once in SHORTEST, and if messages are in time.

        `lag`: age of the batch's oldest message in seconds. If messages wait longer than a timeout, a sender only seems
        silent. Without any timeout (inf) there is nothing to look for.
        """
        timeout = self.fleet.shortest_timeout * (self.fleet.options.step or 1.0)  # seconds
        are_messages_in_time = lag < timeout < inf
        return are_messages_in_time and monotonic() > self._looked + SHORTEST

    def _iterate_dated_plants(self, plants: Iterable[PlantState]) -> Iterator[tuple[PlantState, datetime]]:
        """Yield (plant, origin) for plants whose times are dates, unless their messages may still wait at a broker.

        Messages may wait for plants from before this start (`_resumed`), for GRACE seconds or until a message comes.
        """
        if self._resumed and monotonic() > self._begun + GRACE:
            self._resumed.clear()
        for plant in plants:
            if plant.origin is not None and plant.name not in self._resumed:
                yield plant, plant.origin

    def note_published(self, rows: Sequence[tuple[PlantState, HeldRow]]) -> None:
        """Note the published estimates after these rows (outputs, dead senders, time), to compare with later ones."""
        if self.fleet.watched:
            outputs = self.fleet.outputs([row.slot for _, row in rows])
            for (plant, row), output in zip(rows, outputs, strict=True):
                self._published[plant.name] = PublishedEstimate(output, self._dead_senders(plant), row.key[0])
                self._resumed.discard(plant.name)

    def forget_plant(self, name: str) -> None:
        """Forget a plant that leaves the memory."""
        self._published.pop(name, None)

    def select_for_publication(self, rows: Sequence[tuple[PlantState, HeldRow]]) -> list[tuple[PlantState, HeldRow]]:
        """Return the rows whose estimates differ from what was published, or which are due again."""
        outputs = self.fleet.outputs([row.slot for _, row in rows])
        return [pair for pair, output in zip(rows, outputs, strict=True) if self._is_worth_publishing(*pair, output)]

    def _is_worth_publishing(self, plant: PlantState, row: HeldRow, output: np.ndarray) -> bool:
        """Return whether a plant's estimate has changed so much that it is worth publishing.

        It has if a sender died or came back, if the time `every` is over, or if a mean or a deviation has moved by more
        than MOVED, a tenth, of the deviation that was published.

        Args:
            plant: the plant.
            row: its row, predicted without measurements.
            output: the row's outputs: all filters' estimates.
        """
        published = self._published.get(plant.name)
        if published is None or published.dead != self._dead_senders(plant):
            return True
        step = self.fleet.options.step or 1.0
        if self.every is not None and (row.key[0] - published.time) * step >= self.every:
            return True
        # Changes of means and deviations (filter, state), compared with the deviations before.
        deviation_before = np.sqrt(np.maximum(published.outputs[self._variances], 0.0))
        deviation_now = np.sqrt(np.maximum(output[self._variances], 0.0))
        mean_change = np.abs(output[self._means] - published.outputs[self._means])
        deviation_change = np.abs(deviation_now - deviation_before)
        enough = MOVED * deviation_before
        return bool(((mean_change > enough) | (deviation_change > enough)).any())

    def _dead_senders(self, plant: PlantState, now: float = -inf) -> tuple[str, ...]:
        """Return the senders of a plant that have been silent for longer than they may, by `now` or its newest row."""
        return tuple(name for name, status in self.fleet.find_sender_status(plant, now).items() if status.dead)

    def _published_dead_senders(self, plant: PlantState) -> tuple[str, ...]:
        """Return the senders of a plant that its last published estimate named as dead; () if none was published."""
        return self._published[plant.name].dead if plant.name in self._published else ()


def find_dead_senders(fleet: Fleet, plants: Mapping[str, PlantState]) -> dict[str, list[str]]:
    """Return {plant: nodes whose sender is dead}: it has been silent longer than its rule or timeout allows.

    Plants without dead senders are left out. If silence has no meaning for any node (`watched`), the answer is {}.
    """
    dead = {
        name: [node for node, status in fleet.find_sender_status(plant).items() if status.dead]
        for name, plant in (plants.items() if fleet.watched else ())
    }
    return {name: nodes for name, nodes in dead.items() if nodes}
