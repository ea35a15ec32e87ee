"""Events of a recording in columns: a few numbers each, whatever the messages weighed that they were read from."""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from heliograph.files.events.event_columns import NodeEvents, node_counts_losses
from heliograph.files.events.event_rows import (
    fill_forward,
    make_inputs_leading_to_rows,
    number_rows,
    put_values_in_rows,
)
from heliograph.files.events.event_verdicts import (
    USED,
    EventsByArrival,
    count_verdicts,
    judge_events,
    sort_by_arrival,
)
from heliograph.files.recordings.recording import Recording
from heliograph.files.sources.message_reading import Reading, Unread
from heliograph.learning.packet_losses.delay_law import Delays, learn_delays
from heliograph.live.event import AHEAD, INPUTS, Event, Verdict
from heliograph.model.checks.refusal_reasons import Reason
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail, instance, scalar
from heliograph.numerics.module import readable
from heliograph.numerics.times.timestamp_order import SECOND
from heliograph.numerics.types import Bool, Float, Int
from heliograph.simulation.network import Network

NONE = np.iinfo(np.int64).min  # of many readings: the one that has no time
MOST_STEPS = 10_000_000  # rows of a network that counts steps


@readable
class EventTable:
    """Events of a network, read from messages of a recording, each with the time when it was measured and when logged.

    Where the network counts steps, times are steps and events arrive at once; with the seconds of a `step` times are
    moments, each of the step that is nearest, counted from the first.

    An event is identified by its node, its time and its running count; without a count, events of equal time are
    distinguished by their order of arrival.

    Args:
        network: the network.
        step: seconds of a step of a network that counts steps; None where times are steps, or seconds.
        start: nanoseconds since 1970 of step 0; the first event's unless given.
        numbers: whether times are numbers in the network's unit, and not dates (default False).

    Attributes:
        notes: lines on what was read and what was left out.
        broken: where and why reading ended early; "" if it did not.
        refused: number of messages that could not be read.
        reasons: why, of the first of them.
    """

    def __init__(self, network: Network, step: float | None = None, start: int | None = None, numbers: bool = False):
        """Begin without events; `step`: seconds of a step; `start`: time of step 0; `numbers`: times are not dates."""
        instance("network", network, Network, "a Network")
        self.network, self.numbers, self.start = network, numbers, start
        self.steps = TIME_STEP not in network.inputs  # whether the network counts steps
        self.step = None if step is None else round(scalar("step", step, 1 / SECOND) * SECOND)  # in nanoseconds
        self._plants: dict[str, dict[str, NodeEvents]] = {}  # columns by plant and node
        # What is reported of the reading.
        self.notes, self.broken = list[str](), ""
        self.refused, self.reasons = 0, list[str]()

    def __len__(self) -> int:
        """Return how many events there are, of all plants and nodes and of inputs."""
        return sum(len(columns.time) for plant in self._plants.values() for columns in plant.values())

    @property
    def plants(self) -> list[str]:
        """Return the names of the plants, "" for a single one without a name."""
        return list(self._plants)

    def of(self, plant: str) -> "EventTable":
        """Return the events of one plant, as a table that shares its columns with this one.

        Args:
            plant: its name.

        Raises:
            ValueError: no such plant.
        """
        if plant not in self._plants:
            raise fail("plant", f"one of {', '.join(map(repr, self._plants)) or 'none'}", repr(plant))
        events = EventTable(self.network, step=None, start=self.start, numbers=self.numbers)
        events.step, events._plants = self.step, {plant: self._plants[plant]}
        events.notes, events.broken = self.notes, self.broken
        events.refused, events.reasons = self.refused, self.reasons
        return events

    @property
    def columns(self) -> dict[str, NodeEvents]:
        """Return the events of the single plant by node, its inputs under "inputs"; ValueError if there are more."""
        if len(self._plants) > 1:
            names = ", ".join(map(repr, list(self._plants)[:8]))
            raise fail("events", f"those of one plant, as events.of({next(iter(self._plants))!r}) has", names)
        return next(iter(self._plants.values()), {}) or self._columns_of_plant("")

    def _columns_of_plant(self, plant: str) -> dict[str, NodeEvents]:
        """Return the columns of a plant by node, and of its inputs without dt; empty ones where it is new."""
        if plant not in self._plants:
            sizes = {INPUTS: len(self.network.inputs) - (0 if self.steps else 1)}  # without dt
            sizes |= {name: self.network.nodes[name].received for name in self.network.names}
            self._plants[plant] = {name: NodeEvents(size, self.numbers) for name, size in sizes.items()}
        return self._plants[plant]

    def add(self, reading: Reading, arrival: float) -> None:
        """Append a reading that arrived at `arrival`, in nanoseconds since 1970 or in the unit of times.

        A reading without a time gets the time of its arrival. A reading without a running count gets -1.
        """
        columns = self._columns_of_plant(reading.plant)[reading.node]
        time = arrival if reading.time is None else reading.time
        columns.time.append(time)
        columns.arrival.append(time if self._times_are_steps else arrival)
        columns.sequence.append(-1 if reading.sequence is None else reading.sequence)
        columns.values.extend(reading.values.tolist())
        columns.period = reading.period

    def add_many(
        self,
        node: str,
        arrival: Int[np.ndarray, " events"],
        time: Int[np.ndarray, " events"],
        sequence: Int[np.ndarray, " events"],
        values: Float[np.ndarray, "events size"],
        period: int,
    ) -> None:
        """Append readings of a node, as `add` does with one; a time NONE means no time, a sequence -1 no count."""
        columns = self._columns_of_plant("")[node]
        time = np.where(time == NONE, arrival, time)
        for column, moments in ((columns.time, time), (columns.arrival, time if self._times_are_steps else arrival)):
            column.frombytes(moments.tobytes())
        columns.sequence.frombytes(sequence.tobytes())
        columns.values.frombytes(values.tobytes())
        columns.period = period

    def note_unread(self, unread: Unread, arrival: float | None) -> None:
        """Note the running count of a message that could not be read, and why, if its node is known."""
        if unread.counted is not None:
            self._columns_of_plant(unread.counted.plant)[unread.counted.node].note_unread(unread, arrival)

    @property
    def refusals(self) -> dict[str, Counter[Reason]]:
        """Return by node how many messages were refused for each reason; nodes without refusals are absent."""
        counts = dict[str, Counter[Reason]]()
        for node, columns in (item for columns_by_node in self._plants.values() for item in columns_by_node.items()):
            if columns.refused:
                counts.setdefault(node, Counter()).update(columns.refused)
        return counts

    def refuse(self, error: InputError, strict: bool) -> None:
        """Count a message that cannot be read, and keep the reasons of the first three.

        Raises:
            ValueError: this error, where reading is strict.
        """
        if strict:
            raise error
        self.refused += 1
        if len(self.reasons) < 3:
            self.reasons.append(str(error))

    def finish(self, source: str, strict: bool = False) -> None:
        """End the reading of a source: leave out events whose time stamp was not set, and note what was left out.

        A stamp more than a year before its arrival, or far from all others, counts as not set, unless most of a node's
        stamps are like that: then its clock is another one. Step numbers are no stamps, and not looked at.

        Args:
            source: name of what was read, for errors.
            strict: whether a stamp that was not set is an error.

        Raises:
            ValueError: no event, and a message that could not be read; a stamp that was not set.
        """
        by_node = [item for columns_by_node in self._plants.values() for item in columns_by_node.items()]
        if self.dated or not self.steps:
            for name, columns in by_node:
                self._leave_out_unset_stamps(f"{source}, {name}", columns, strict)
        # Nothing could be read: raise the first refused message's reason, or else why reading ended early.
        first_trouble = self.reasons[0] if self.reasons else self.broken
        if not len(self) and first_trouble:
            raise InputError(first_trouble)
        if not self.steps:
            self.notes += [line for name, columns in by_node for line in columns.list_lost_digits(f"{source}, {name}")]

    def _leave_out_unset_stamps(self, name: str, columns: NodeEvents, strict: bool) -> None:
        """Leave out a node's events whose time stamp was not set; count them as refused, and note what was doubtful.

        Raises:
            ValueError: there is such an event, where reading is strict.
        """
        unset = columns.drop_unset_stamps_in_place(name)
        if unset.note:
            self.notes.append(unset.note)
        self.notes += columns.describe_doubtful_count(name)
        if unset.reason:
            self.refuse(InputError(unset.reason), strict)
            self.refused += unset.removed - 1  # `refuse` has counted one

    @property
    def origin(self) -> int:
        """Return the nanoseconds since 1970 from which times of events count; 0 where these are steps or numbers.

        Raises:
            ValueError: no events.
        """
        return 0 if self.steps or self.numbers else self._find_first_moment()

    def _find_first_moment(self) -> int:
        """Return the time of step 0 if it is given, else the time of the first event, in the unit of the columns."""
        if self.start is not None:
            return self.start
        times = [min(columns.time) for columns in self.columns.values() if columns.time]
        if not times:
            raise fail("events", "at least one", "none")
        return int(min(times))

    @property
    def _times_are_steps(self) -> bool:
        """Return whether times are step numbers without a length in seconds, so that they give no time of arrival."""
        return self.steps and self.step is None and not self.numbers

    @property
    def _unit(self) -> int:
        """Return how many units of the columns make one unit of time: 10^9 nanoseconds a second, else 1."""
        return 1 if self.steps or self.numbers else SECOND

    @property
    def dated(self) -> bool:
        """Return whether times are dates, and neither numbers (`numbers`) nor steps without a length in seconds."""
        return not self._times_are_steps and not self.numbers

    @property
    def date(self) -> np.datetime64:
        """Return the date from which the times of the events count."""
        return np.datetime64(self._find_first_moment() if self.dated else 0, "ns")

    def sort_events(self) -> Iterator[Event]:
        """Yield events in order of arrival; times are seconds from the origin, steps, or numbers as they are."""
        events = self._sort_by_arrival()
        matrices = self._list_value_matrices()
        names = [*self.network.names, INPUTS]
        origin, unit = self.origin, self._unit
        # `event_index` counts the node's events. The times are integers, so that their differences are exact.
        for node, time, arrival, sequence, event_index in zip(*(column.tolist() for column in events), strict=True):
            values = matrices[node][event_index]
            yield Event(names[node], sequence, (time - origin) / unit, values, (arrival - origin) / unit)

    def lateness(self) -> dict[str, Float[np.ndarray, " events"]]:
        """Return for each node with events how long each took to arrive, in seconds or time's unit, sorted by time."""
        if self._times_are_steps:  # then nothing is known of arrivals
            return {}
        lateness, unit = {}, 1 if self.numbers else SECOND
        for name in self.network.names:
            time, arrival, _sequence = self.columns[name].arrays()
            if len(time):
                lateness[name] = ((arrival - time) / unit)[np.argsort(time, kind="stable")]
        return lateness

    def delays(self, step: float | None = None) -> dict[str, Delays]:
        """Return for each node the probabilities of its delays in steps, with intervals; others are absent.

        Args:
            step: seconds of a step; by default the table's, or else the median time between a node's measurements.

        Raises:
            ValueError: the step is not positive.
        """
        laws, unit = {}, 1 if self.numbers else SECOND
        for name, delays in self.lateness().items():  # from measuring to arrival, in seconds or the unit of time
            length = self.step / SECOND if step is None and self.step is not None else step
            if length is None:  # take the median interval; numbers of steps are 1 apart
                time, _arrival, _sequence = self.columns[name].arrays()
                intervals = np.diff(np.unique(time))
                counts_steps = self.numbers and self.steps
                length = float(np.median(intervals)) / unit if len(intervals) and not counts_steps else 1.0
            if np.any(delays > -length / 2):  # something arrived at or after its step
                laws[name] = learn_delays(delays, length)
        return laws

    def judge(
        self, window: float = np.inf, ahead: float = AHEAD
    ) -> tuple["dict[str, dict[Verdict, int]]", dict[str, int]]:
        """Count for each node what a timeline does with events (used, late, ...), and its missing messages.

        Args:
            window: how late an event may be, in seconds or steps (default any).
            ahead: how much later than its arrival the time of an event may be (default a tenth of a second).
        """
        events, verdicts = self._judge_events(window, ahead)
        names = [*self.network.names, INPUTS]
        counts = {names[node]: found for node, found in count_verdicts(events.node, verdicts).items()}
        lost = {name: self.columns[name].count_lost() for name in self.network.names}
        return counts, {name: count for name, count in lost.items() if count is not None}

    def count_absent(self, window: float = np.inf, ahead: float = AHEAD) -> dict[str, int]:
        """Count for each node the events that a timeline uses although they have no value, only a time.

        Args:
            window: how late an event may be, in seconds or steps (default any).
            ahead: how much later than its arrival the time of an event may be (default a tenth of a second).
        """
        events, verdicts = self._judge_events(window, ahead)
        counts = {}
        for node, name, matrix in self._number_value_matrices():
            used = events.event_index[(events.node == node) & (verdicts == USED)]
            counts[name] = int(np.sum(np.isnan(matrix[used]).all(axis=1)))
        return counts

    def recording(self, window: float = np.inf, ahead: float = AHEAD) -> Recording:
        """Return the events that a `live.Timeline` uses as rows in order of time; a repeated event counts once.

        If time counts steps, or if nodes share a channel, all events of a time are one row, else each is one. An input
        holds from its event to the next, and is 0 before the first. A row has the inputs of the interval up to it:
        those known after the row before it or, if time counts steps, those of its own step.

        Args:
            window: how late an event may be, in seconds or steps (default any).
            ahead: how much later than its arrival the time of an event may be (default a tenth of a second).

        Raises:
            ValueError: no events, several plants, steps beyond ten million.
        """
        recording, _has_message = self.rows(window, ahead)
        return recording

    def rows(self, window: float = np.inf, ahead: float = AHEAD) -> tuple[Recording, Bool[np.ndarray, " rows"]]:
        """Return the recording, and whether each of its rows has a message of a node: other rows have inputs alone.

        Args:
            window: how late an event may be, in seconds or steps (default any).
            ahead: how much later than its arrival the time of an event may be (default a tenth of a second).

        Raises:
            ValueError: what `recording` refuses.
        """
        events, verdicts = self._judge_events(window, ahead)  # what a timeline would do with each: USED, LATE, ...
        events = events.select(verdicts == USED)
        if not len(events.time):
            raise fail("events", "at least one that is used", "none")
        # In order of time; of one time the inputs, whose node number is -1, come first.
        events = events.select(np.lexsort((events.sequence, events.node, events.time)))
        if self.steps and events.time[-1] >= MOST_STEPS:  # each step is a row
            raise fail("time of an event", f"a step below {MOST_STEPS:,}", int(events.time[-1]))
        row, times = number_rows(events.time, self.steps, self._are_rows_joint)  # row of each event, time of each row
        tables = self._fill_tables(events, row, len(times))  # by node, and of the inputs: (rows, values), NaN if none
        inputs = fill_forward(tables.pop(INPUTS))
        if not self.steps:
            inputs = make_inputs_leading_to_rows(inputs, times, self._unit, self.network.inputs.index(TIME_STEP))
        time = times.astype(np.float64) if self.steps or self.numbers else (times - self.origin) / SECOND
        measured = np.zeros(len(times), dtype=bool)
        measured[row[events.node >= 0]] = True
        return Recording(tables, inputs, time), measured

    def _fill_tables(self, events: EventsByArrival, row: np.ndarray, count: int) -> dict[str, np.ndarray]:
        """Return tables (count, values) for each node and for the inputs, with NaN where no value arrived.

        `row`: number of each event's row.
        """
        tables = {}
        for node, name, matrix in self._number_value_matrices():
            of_node = events.node == node
            table = tables[name] = put_values_in_rows(matrix[events.event_index[of_node]], row[of_node], count)
            if node >= 0 and node_counts_losses(self.network, name):
                self.columns[name].write_losses_before_events(table, row[of_node], events.sequence[of_node])
        return tables

    @property
    def _are_rows_joint(self) -> bool:
        """Return whether all events of one time are one row: if time counts steps, or all nodes have one channel."""
        return self.steps or self.network.common is not None

    def _list_value_matrices(self) -> list[np.ndarray]:
        """Return the values of each node, (events, values), and last those of the inputs, whose number is -1."""
        return [self.columns[name].value_matrix() for name in (*self.network.names, INPUTS)]

    def _number_value_matrices(self) -> Iterator[tuple[int, str, np.ndarray]]:
        """Yield number, name and values (events, values) of each node, and last of the inputs, whose number is -1."""
        names = [*self.network.names, INPUTS]
        return zip((*range(len(names) - 1), -1), names, self._list_value_matrices(), strict=True)

    def _sort_by_arrival(self) -> EventsByArrival:
        """Return the events in order of arrival; where steps have a length, times are the nearest steps."""
        events = sort_by_arrival(self.columns)
        return events if self.step is None else events.convert_to_steps(self._find_first_moment(), self.step)

    def _judge_events(self, window: float, ahead: float) -> tuple[EventsByArrival, Int[np.ndarray, " events"]]:
        """Return the events in order of arrival, and what a timeline with these limits would do with each."""
        limits = [limit if limit == np.inf or self._unit == 1 else round(limit * SECOND) for limit in (window, ahead)]
        events = self._sort_by_arrival()
        return events, judge_events(events, self._list_value_matrices(), self._are_rows_joint, *limits)
