"""Messages in the format of heliograph itself, in tables and lines: a node, its running count, a time, and values.

Text and errors call it "our own form", in contrast to messages of other makers, which a source has to describe.
"""

from collections.abc import Mapping, Sequence, Set
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.files.events.event_columns import node_counts_losses
from heliograph.files.events.event_table import EventTable
from heliograph.files.messages.message_files import FileMessage, read_parquet_names
from heliograph.files.sources.message_fields import convert_name
from heliograph.files.sources.message_reading import Reading, Unread
from heliograph.files.text.csv_dialects import NO_VALUE
from heliograph.files.text.csv_text import read_csv_header
from heliograph.files.text.text_file import CutOffError, find_extension
from heliograph.live.event import INPUTS, OF_STEPS, check_63_bits
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.times.dates import looks_like_date, parse_moment
from heliograph.numerics.times.row_times import (
    describe_clock_set_forward,
    fail_of_clock_set_back,
    is_mix_of_units,
)
from heliograph.numerics.times.timestamp_order import find_clock_set_back, find_clock_set_forward
from heliograph.simulation.network import Network

EXACT = 2**53  # up to here doubles hold every whole number
MOST_REASONS = 3  # that are kept of messages that could not be read
NODE, SEQUENCE, TIME, ARRIVAL, VALUES, PLANT = "node", "sequence", "time", "arrival", "values", "plant"
NOTHING = np.zeros(0)  # values of a message that could not be read
OWN = (NODE, SEQUENCE, TIME, ARRIVAL, VALUES, INPUTS, PLANT)


def holds_events(path: str | Path) -> bool:
    """Return whether a CSV or Parquet file has events instead of rows: it has the columns `node` and `sequence`."""
    path = Path(path)
    if not path.is_file() or not is_table_file(path):
        return False
    columns = read_parquet_names(path) if find_extension(path) == ".parquet" else read_csv_header(path)
    return {NODE, SEQUENCE} <= set(columns)


def is_table_file(path: Path) -> bool:
    """Return whether a file is a table, by the extension of its name."""
    return find_extension(path) in (".csv", ".parquet")


def is_own_message(content: object) -> bool:
    """Return whether a decoded message is in our own form: it has a node, and a running count, values or inputs."""
    return isinstance(content, Mapping) and NODE in content and bool({SEQUENCE, VALUES, INPUTS} & content.keys())


class OwnMessageCollector:
    """Collects messages in our own form in a table of their events, and counts those that cannot be read.

    Args:
        network: the network that the names belong to.
        source: the file, or what else prints as its name.
        table: whether it has rows, of which all have the same columns.
        ignore_unknown: whether columns that nobody knows are left out.
    """

    def __init__(self, network: Network, source: object, table: bool, ignore_unknown: bool):
        """Begin without messages; `source` is named in errors, and `table` says whether messages are rows of a table.

        `used` and `refused` count messages. `reasons` says why the first ones were refused, and `broken` where the file
        was cut off.
        """
        self.source = source
        self._reader = HeliographMessageReader(network, str(source), ignore_unknown, table)
        self._table: EventTable | None = None  # made with the first event, which shows the kind of the times
        self.used, self.refused = 0, 0
        self.reasons, self.broken = list[str](), ""

    def add(self, message: FileMessage | InputError, strict: bool) -> None:
        """Append the events of a message; an error in its place, or one in reading it, is counted.

        Raises:
            ValueError: missing or unknown columns of a table; if `strict`, any message that cannot be read.
        """
        try:
            if isinstance(message, InputError):
                raise message
            self._add_message(message)
            self.used += 1
        except HeaderError:
            raise
        except InputError as error:
            if strict:
                raise
            if isinstance(error, CutOffError):
                self.broken = str(error)
                return
            self.refused += 1
            if len(self.reasons) < MOST_REASONS:
                self.reasons.append(str(error))

    def events(self) -> EventTable:
        """Return the events that were read, with notes for the user on doubtful times and counts of what was refused.

        Call it once, after the last message.

        Raises:
            ValueError: no event could be read (the error of the first message), or a local clock was set back.
        """
        table, reader = self._table, self._reader
        if table is None:
            raise InputError(self.reasons[0]) if self.reasons else fail(str(self.source), "at least one row", "none")
        # Integers too large for doubles, such as nanoseconds, are counted from the first one.
        if reader.zero:
            table.notes.append(f"{self.source}: times are counted from {reader.zero}")
        # Some are so far from the first one that even the difference is no exact double.
        if reader.rounded is not None:
            digits = f"from {reader.rounded} on times are rounded to the nearest double"
            table.notes.append(f"{self.source}: {digits}, as the first, counted from, is far from them")
        # The least and the greatest time differ by a factor like 1000.
        if is_mix_of_units(reader.least, reader.most):
            span = f"from {reader.least:.14g} to {reader.most:.14g}"
            table.notes.append(f"{self.source}: times {span}: seconds and milliseconds, or such, in one column")
        if reader.local:
            self._check_local_time(table)
        table.refused = self.refused
        table.reasons = self.reasons
        table.broken = self.broken
        return table

    def _check_local_time(self, table: EventTable) -> None:
        """Note where a node's dates, which have no zone, jump forward by an hour, as local time does in spring.

        `columns` has the events of one node of one plant, in the order in which they came.

        Raises:
            ValueError: a node's dates go back by an hour, as in autumn: sorted by time, messages of two hours would be
                mixed.
        """
        events = [(plant, *item) for plant in table.plants for item in table.of(plant).columns.items()]
        for plant, node, columns in events:
            time, _, sequence = columns.arrays()
            time = time.astype(np.int64).view("datetime64[ns]")
            where = f"{self.source}, {f'plant {plant!r}, ' if plant else ''}{node}, column {TIME!r}"
            # Times in the order in which messages came, and in the order in which they were sent.
            for clock in (time, time[np.argsort(sequence, kind="stable")]):
                if (row := find_clock_set_back(clock)) is not None:
                    raise fail_of_clock_set_back(where, clock, row)
            if (row := find_clock_set_forward(np.sort(time))) is not None:
                table.notes.append(f"{where}: {describe_clock_set_forward(np.sort(time), row)}")

    def _add_message(self, message: FileMessage) -> None:
        """Add the event of one message to the table, and an event of the inputs if the message holds inputs.

        Of a message whose values cannot be read the running count is noted, and the error is raised. The reader returns
        a list of (event or `Unread`, arrival).
        """
        readings_and_arrivals = self._reader.read(message.where, message.content)
        if self._table is None:
            self._table = EventTable(self._reader.network, numbers=bool(self._reader.numbers))
        for reading, arrival in readings_and_arrivals:
            if isinstance(reading, Unread):
                self._table.note_unread(reading, arrival)
                raise reading.error
            self._table.add(reading, arrival)


class HeliographMessageReader:
    """Reader of messages in our own form.

    Fields: `node` (a name, or "inputs"), `sequence`, `time`, `arrival` (optional: at once), `plant` (optional), and the
    values: one field for each component, named as the sensor's outputs or the plant's inputs, or `values` with all of
    the node's numbers, as a list or separated by spaces. What is empty did not arrive. Times are numbers or dates of
    ISO 8601, all with a time zone or all without. A sequence keeps every digit.

    Args:
        network: the network that the names belong to.
        source: where the messages are from, for errors.
        ignore_unknown: whether fields that nobody knows are left out.
        table: whether the messages are rows of a table, whose columns all have.

    Attributes:
        numbers: whether times are numbers, and not dates; None before the first.
        zero: the first time, if it is an integer too large for doubles: later ones are counted from it; else 0 or None.
        rounded: the first integer time whose distance from `zero` is no exact double; None if there is none.
        least: the least time that is a number.
        most: the largest one.
    """

    def __init__(self, network: Network, source: str, ignore_unknown: bool, table: bool):
        """Prepare to read messages in heliograph's own format; nothing is known yet of their times and columns.

        `source` is named in errors. `ignore_unknown`: whether columns that the network does not know are left out.
        `table`: whether messages are rows of a table. Of the times, `numbers` says whether they are numbers and not
        dates, `zero` is the integer from which they are counted, `rounded` the first one that is no exact double then,
        `least` and `most` are the ends of their range.
        """
        self.network, self.source = network, source
        self._ignore, self._table = ignore_unknown, table
        # Names of each node's values, and of the inputs besides the time step.
        self.components = {name: tuple(node.received_names) for name, node in network.nodes.items()}
        self.components[INPUTS] = tuple(name for name in network.inputs if name != TIME_STEP)
        self.steps = TIME_STEP not in network.inputs  # whether times are numbers of steps
        # Nodes whose last value is how many messages were lost, which a message may leave out.
        self._numbered = [name for name in network.names if node_counts_losses(network, name)]
        # Of the times: not known before the first one.
        self.numbers: bool | None = None
        self.zero: int | None = None
        self.rounded: int | None = None
        self.least, self.most = np.inf, -np.inf
        self._zoned: bool | None = None  # whether dates have a zone
        self._columns: Set[str] = frozenset()  # names of columns that were checked already

    def read(self, where: str, row: Mapping[str, Any]) -> list[tuple[Reading | Unread, Any]]:
        """Return (event, arrival) for each event of a message: that of its inputs if it has any, then the node's.

        A message in our own form has a node, a count, a time and values; the time of arrival, the plant and inputs that
        were set may be in it too. An event is a `Reading` of a node's values, or of inputs. Where the values cannot be
        read, one `Unread` with node, count and time stands for the events, so that the message does not count as lost.
        Names in capitals are the fields: NODE is "node", INPUTS "inputs", and so on; an event of inputs has INPUTS as
        its node. NOTHING is an empty array.

        Args:
            where: place of the message, for errors.
            row: its fields.

        Raises:
            HeaderError: missing or unknown columns of a table.
            ValueError: a message that cannot be read; one line.
        """
        self._check_columns(where, row)
        node = row[NODE]
        if node not in self.components:
            raise fail(f"{where}, column {NODE!r}", f"one of {', '.join(self.components)}", show_value(node))
        sequence = _parse_whole_number(row[SEQUENCE], f"{where}, column {SEQUENCE!r}")
        # Without an arrival it arrived when it was measured. A table has the column or not: an empty cell is an error.
        time, dated = self._read_time(row[TIME], where, TIME)
        arrival = time
        if ARRIVAL in row and (row[ARRIVAL] is not None or self._table):
            arrival, _ = self._read_time(row[ARRIVAL], where, ARRIVAL)
        plant = "" if row.get(PLANT) is None else convert_name(row[PLANT], f"{where}, column {PLANT!r}")
        self.numbers = not dated  # whether times are numbers rather than dates
        try:
            values = _read_event_values(row, self.components[node], where, node in self._numbered)
        except InputError as error:
            return [(Unread(error, Reading(plant, node, sequence, time, NOTHING)), arrival)]
        events: list[tuple[Reading | Unread, Any]] = []
        # A message of a node may bring the inputs that were set then: an event of their own.
        if isinstance(row.get(INPUTS), list) and node != INPUTS:
            inputs = _read_event_values({VALUES: row[INPUTS]}, self.components[INPUTS], where)
            events.append((Reading(plant, INPUTS, sequence, time, inputs), arrival))
        return [*events, (Reading(plant, node, sequence, time, values), arrival)]

    @property
    def local(self) -> bool:
        """Return whether times are dates without a zone, which are taken as UTC and may be local time."""
        return self._zoned is False

    def _check_columns(self, where: str, row: Mapping[str, Any]) -> None:
        """Raise ValueError if a column is unknown, and so most likely misspelt, or if a required one is missing.

        Rows with the same columns as the row before are not checked again. OWN are the fields of our own form, such as
        `node` (NODE), `sequence` and `time`; the others are named as components.
        """
        if row.keys() == self._columns:
            return
        # The columns of a table are those of its header: an error of all of it.
        position = f"{self.source}, header" if self._table else where
        error_type = HeaderError if self._table else InputError
        known = [*OWN, *(name for names in self.components.values() for name in names)]
        for name in row:
            if name not in known and not self._ignore:
                listed = ", ".join(dict.fromkeys(known))
                raise error_type(str(fail(position, f"only the columns {listed}", repr(name))))
        for name in (NODE, SEQUENCE, TIME):
            if name not in row:
                raise error_type(str(fail(position, f"a column {name!r}", f"only {', '.join(row)}")))
        self._columns = row.keys()

    def _read_time(self, cell: Any, where: str, column: str) -> tuple[Any, bool]:
        """Return a time and whether it is a date; raise ValueError unless all times are of one kind.

        A date is returned in nanoseconds since 1970, another time as a number. `self.numbers` says whether the times so
        far were numbers, `self._zoned` whether dates had a zone; None before the first. `self.steps`: the network
        counts steps.
        """
        name = f"{where}, column {column!r}"
        dated = isinstance(cell, str) and looks_like_date(cell)
        if self.numbers is not None and dated != (not self.numbers):
            expected = "a number, as the times before" if dated else "a date, as the times before"
            raise fail(name, expected, show_value(cell))
        if not dated:
            return self._read_number_of_time(cell, name, is_step=self.steps and column == TIME), False
        if self.steps:
            raise fail(name, "a step, a whole number from 0", f"{show_value(cell)} ({OF_STEPS})")
        moment, zoned = parse_moment(cell, name)
        self._zoned = zoned if self._zoned is None else self._zoned
        if zoned != self._zoned:
            raise fail(name, "a zone with every date or with none", show_value(cell))
        return moment, True

    def _read_number_of_time(self, cell: Any, name: str, is_step: bool) -> float:
        """Return a time that is a number; a step (`is_step`) must be an integer from 0 on.

        If the first integer is too large for a double (EXACT, 2^53), such as nanoseconds, all times are counted from it
        (`self.zero`). `self.rounded` is the first time whose difference from it is no exact double. `cell`: the time as
        it came. `name`: its place, for errors.
        """
        number = _parse_number(cell, name)
        if isinstance(cell, int):
            if self.zero is None:
                self.zero = cell if abs(cell) >= EXACT else 0
            number = float(cell - self.zero)
            if self.rounded is None and int(number) != cell - self.zero:  # the difference is no exact double
                self.rounded = cell
        if is_step and not (number >= 0 and number.is_integer()):
            raise fail(name, "a step, a whole number from 0", f"{cell} ({OF_STEPS})")
        self.least = min(self.least, number)
        self.most = max(self.most, number)
        return number


class HeaderError(InputError):
    """The columns of a table are not those of our own form, so that none of its rows can be read."""


def _read_event_values(row: Mapping[str, Any], names: Sequence[str], where: str, numbered: bool = False) -> np.ndarray:
    """Return the values of one event, (values,), with NaN for a value that did not arrive.

    Args:
        row: fields of the message. The values stand in the field `values`, as a list or a text, or each in a field of
            its own name.
        names: names of the values, in the order of the result.
        where: place of the message, for errors.
        numbered: whether the last value is the number of lost messages. It may be missing in the field `values`, since
            the running count also tells it, and is NaN then.
    """
    if row.get(VALUES) not in (None, ""):
        cell = row[VALUES]
        column = f"{where}, column {VALUES!r}"
        is_text = isinstance(row[VALUES], str)
        items: list[Any] = cell.replace(";", " ").split() if is_text else _list_cell_items(cell)
        if numbered and len(items) == len(names) - 1:
            items.append("nan" if is_text else np.nan)
        if len(items) != len(names):
            raise fail(column, f"{len(names)} numbers, {' '.join(names)}", show_value(cell))
        return np.array([_parse_number(item, column, may_be_empty=True, text=is_text) for item in items])
    return np.array([_parse_number(row.get(name), f"{where}, column {name!r}", may_be_empty=True) for name in names])


def _list_cell_items(cell: Any) -> list[Any]:
    """Return the items of a list, tuple or array; anything else becomes a list of one item."""
    return list(cell) if isinstance(cell, list | tuple | np.ndarray) else [cell]


def _parse_whole_number(cell: Any, name: str) -> int:
    """Return a cell as an integer with every digit; a float must be an exact integer below EXACT (2^53)."""
    if isinstance(cell, float) and cell.is_integer() and abs(cell) < EXACT:
        return check_63_bits(name, int(cell))
    if not isinstance(cell, int):
        _parse_number(cell, name)
    return check_63_bits(name, cell)


def _parse_number(cell: Any, name: str, may_be_empty: bool = False, text: bool = False) -> float:
    """Return the number in a cell; NaN if it is empty and may be; raise ValueError for anything else.

    Args:
        cell: the cell.
        name: its place, for errors.
        may_be_empty: whether it may be empty, or a word of that meaning; else that is an error.
        text: whether a text such as "1.5" counts as a number; else it is an error.
    """
    if may_be_empty and (cell is None or cell == "" or (isinstance(cell, str) and NO_VALUE.fullmatch(cell))):
        return np.nan
    expected = "a number or an empty cell" if may_be_empty else "a number"
    if isinstance(cell, str) and not text:
        raise fail(name, expected, f"text, {show_value(cell)}")
    try:
        if isinstance(cell, str) and "_" in cell:  # Python's own way to write a number, and nobody else's
            raise ValueError
        number = float(cell)
    except (TypeError, ValueError, OverflowError):
        number = np.inf
    if np.isinf(number) or (np.isnan(number) and not may_be_empty):
        raise fail(name, expected, "an empty cell" if cell is None else show_value(cell))
    return number
