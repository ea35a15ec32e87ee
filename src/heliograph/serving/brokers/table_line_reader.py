"""Lines of a table of CSV that come through a pipe, to messages: rows of time, events, and rows that sources map."""

import json
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from heliograph.files.messages.message_files import PAYLOAD, TOPIC, convert_cells, make_message_of_row
from heliograph.files.messages.own_format import NODE, OWN, SEQUENCE, HeliographMessageReader
from heliograph.files.recordings.recording import RowReader
from heliograph.files.recordings.recording_rows import RecordingRows, join_recording_rows
from heliograph.files.sources.message_reading import Reading, Unread
from heliograph.files.tables.csv_columns import CsvColumnReader
from heliograph.files.text.csv_dialects import COMMENTS, guess_names_in_header
from heliograph.files.text.csv_text import ANNOTATIONS, CsvReader, CsvRow
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import InputError
from heliograph.serving.brokers.replay import check_time_steps, encode_event, events_of_recording, row_events
from heliograph.serving.brokers.source_translator import Translator, convert_nanoseconds_to_date
from heliograph.serving.brokers.transport import LOG
from heliograph.serving.message import Message, Payload, UnreadMessage
from heliograph.simulation.network import Network

SECOND = np.timedelta64(1_000_000_000, "ns")


class TableLineReader:
    """Reads lines of a table of CSV as messages; its header says what the rows are, as in a file.

    Args:
        network: the network.
        translator: the sources of the network's file; None if it has none.
        path: the file that is redirected, whose name may be a topic; None of any other pipe.
        ignore_unknown: whether columns that the network does not know are left out.
    """

    def __init__(self, network: Network, translator: Translator | None, path: Path | None, ignore_unknown: bool):
        """Begin before the header, which decides how rows are read. The arguments are the class's."""
        self._network, self._translator, self._path, self._ignore = network, translator, path, ignore_unknown
        self._source = "standard input" if path is None else str(path)
        self._text = CsvReader(self._source, path, marked=translator is not None)
        self._reader: IndependentRowReader | TimeRowReader | None = None
        self._own = HeliographMessageReader(network, self._source, ignore_unknown, table=True)

    @property
    def local(self) -> bool:
        """Return whether dates came without a zone, which are taken as UTC and may be local time."""
        return self._own.local or (isinstance(self._reader, TimeRowReader) and self._reader.local)

    def names_columns(self, line: str) -> bool:
        """Return whether a line is a table's header: it names a column that the network or its sources know."""
        text = line.strip()
        if not text or text[0] in "[{" or not (names := guess_names_in_header(text)):
            return False
        if text.startswith(ANNOTATIONS):  # lines above the names that only tables have
            return True
        rows = RowReader(self._network, self._source, strict=False, ignore_unknown=False)
        known = {*OWN, TOPIC, PAYLOAD, *rows.names}
        fields = set() if self._translator is None else self._translator.sources.columns
        # A single word may be anything. It names a table's only column if a comment sign stands before it.
        is_header = len(names) > 1 or text.startswith(COMMENTS)
        return is_header and bool(names & (known | fields))

    def read(self, lines: Sequence[str]) -> list[Payload]:
        """Return the messages of lines.

        Raises:
            ValueError: a header that names no columns, or others than expected; one line.
        """
        return self._read_rows([row for line in lines for row in self._text.add(f"{line}\n")])

    def end(self) -> list[Payload]:
        """Return the messages of the last row, if it is not ended, and of the rows of a file, held until its end."""
        rest = self._read_rows(self._text.end())
        return rest + (self._reader.end() if isinstance(self._reader, TimeRowReader) else [])

    def _read_rows(self, rows: list[CsvRow | InputError]) -> list[Payload]:
        """Return the messages of rows of text, [] before the header; the header chooses the rows' reader."""
        if self._reader is None and self._text.header:
            self._reader = self._choose_reader(self._text.header)
        return [] if self._reader is None or not rows else self._reader.read(rows)

    def _choose_reader(self, header: list[str]) -> "IndependentRowReader | TimeRowReader":
        """Return the reader of rows with these columns, of one of three kinds.

        They are events in heliograph's own form (of one node, with its name and count), rows that sources map, or rows
        of times with the measurements of all nodes.
        """
        if {NODE, SEQUENCE} <= set(header):  # events
            return IndependentRowReader(lambda row: read_own_event(self._own, row.where, convert_cells(row)))
        translator = self._translator
        if translator is not None:
            topic = translator.topic_of_rows(self._path, header)  # None: the rows name their topics, or none is known
            if topic is not None or TOPIC in header:
                return IndependentRowReader(
                    lambda row: translator.decode(make_message_of_row(row.where, convert_cells(row)), topic)
                )
        return TimeRowReader(self._network, header, self._text, self._ignore)


class IndependentRowReader:
    """Reads rows by themselves: each is a message, or several, in our own form or by the sources' map."""

    def __init__(self, decode: Callable[[CsvRow], Sequence[Payload]]):
        """Hold `decode`, which returns the messages of one row, or texts in place of those that are refused."""
        self._decode = decode

    def read(self, rows: Sequence[CsvRow | InputError]) -> list[Payload]:
        """Return the messages of all rows in order; a text with the reason replaces a row that cannot be read."""
        payloads = list[Payload]()
        for row in rows:
            payloads += [str(row)] if isinstance(row, InputError) else self._decode(row)
        return payloads


class TimeRowReader:
    """Reads rows of time, each with the measurements of all nodes, as `heliograph run` reads them.

    Those of a pipe are messages at once; those of a file at its end, when all rows can be put in order.
    """

    def __init__(self, network: Network, header: list[str], text: CsvReader, ignore_unknown: bool):
        """Prepare to read rows of a table.

        Args:
            network: the network.
            header: the names of the table's columns.
            text: reads the table's text; its path is None if it is a pipe.
            ignore_unknown: whether columns that the network does not know are left out.
        """
        self._network, self._steps = network, TIME_STEP not in network.inputs  # `_steps`: whether time counts steps
        self._rows = RowReader(network, text.source, strict=False, ignore_unknown=ignore_unknown)
        self._columns = CsvColumnReader(text.source, text.path, self._rows.only, strict=False)
        self._columns.header = header
        self._given = [name for name in network.inputs if name != TIME_STEP]
        self._origin: np.datetime64 | None = None  # date of the first row, from which times are counted
        self._before: float | None = None  # time of the previous row
        self._is_file = text.path is not None
        self._cells = list[RecordingRows]()  # the rows of a file, until it ends

    @property
    def local(self) -> bool:
        """Return whether dates came without a zone."""
        return self._columns.local

    def read(self, rows: Sequence[CsvRow | InputError]) -> list[Payload]:
        """Return the messages of rows, the same as a replay of these rows makes, and the errors of refused rows.

        Rows of a pipe become messages at once. Rows of a file are only collected here, since they can be put in order
        at its end (`end`): then the errors alone are returned.
        """
        cells = self._rows.read_cells(self._columns.read(rows))  # columns by name, of the rows that are not refused
        errors = self._take_errors()
        if not len(cells.numbers):
            return errors
        if self._is_file:
            self._cells.append(cells)
            return errors
        return [*self._make_messages(cells), *errors]

    def _take_errors(self) -> list[Payload]:
        """Return why rows were refused since the last call, as texts that stand for their messages."""
        errors = [str(error) for error in self._rows.refused]
        self._rows.refused = []
        return [*errors]

    def _make_messages(self, cells: RecordingRows) -> list[Payload]:
        """Return the messages of rows of a pipe, lines of JSON; the next rows follow these."""
        count = len(cells.numbers)
        time = self._time_of_messages(cells.time, cells.numbers)
        if TIME_STEP in cells.inputs:
            self._check_time_steps(cells, time)
        inputs = np.stack([cells.inputs[name] for name in self._given], axis=1) if self._given else np.zeros((count, 0))
        numbers_from_0 = cells.numbers - 1
        events = row_events(numbers_from_0, time, inputs, cells.measurements, self._before, self._steps)
        lines = [json.dumps(encode_event(event, "", self._origin)).encode() for event in events]
        self._before = float(time[-1])
        return [*lines]

    def _check_time_steps(self, cells: RecordingRows, time: np.ndarray) -> None:
        """Raise ValueError if a row's time step is not the time since the previous row; `time` holds the rows' times.

        If there was a row before these, the first step is checked too. The check does not use that row's own step and
        number, so those of the first row stand in their place.
        """
        steps, numbers = cells.inputs[TIME_STEP], cells.numbers
        if self._before is not None:
            steps = np.concatenate([steps[:1], steps])
            time = np.concatenate([[self._before], time])
            numbers = np.concatenate([numbers[:1], numbers])
        check_time_steps(steps, time, numbers, self._rows.source)

    def end(self) -> list[Payload]:
        """Return the messages of a file's rows, after all have come, and then why rows were refused.

        Messages are lines of JSON. Warnings about the rows are logged.
        """
        if not self._cells:
            return []
        with warnings.catch_warnings(record=True) as caught_warnings:
            warnings.simplefilter("always", UserWarning)
            recording, self._cells = self._rows.arrange_recording(join_recording_rows(self._cells)), []
        for line in [*self._rows.notes, *(str(warning.message) for warning in caught_warnings)]:
            LOG.warning("%s", line)
        events, origin = events_of_recording(recording, self._network)
        lines = [json.dumps(encode_event(event, "", origin)).encode() for event in events]
        return [*lines, *(str(error) for error in self._rows.refused)]

    def _time_of_messages(self, time: np.ndarray, numbers: np.ndarray) -> np.ndarray:
        """Return the times in the unit of messages: steps, numbers, or seconds since the first date.

        `numbers`: the rows' numbers, from 1. If time counts steps, each row is a step.
        """
        if self._steps:
            return np.asarray(numbers - 1.0)
        if time.dtype.kind != "M":
            return np.asarray(time, dtype=float)
        self._origin = time[0] if self._origin is None else self._origin
        return np.asarray((time - self._origin) / SECOND)


def read_own_event(reader: HeliographMessageReader, where: str, content: dict[str, object]) -> list[Payload]:
    """Return the messages of an event in heliograph's own form: its measurement, and its inputs if it has any.

    In the place of one that cannot be read its error is returned: with its node, count and time if these are known,
    else as a text.
    """
    try:
        readings_and_arrivals = reader.read(where, content)
    except InputError as error:
        return [str(error)]
    payloads = list[Payload]()
    for reading, arrival in readings_and_arrivals:
        if not isinstance(reading, Unread):
            payloads.append(_make_message(reader, reading, arrival))
        elif reading.counted is not None:
            payloads.append(UnreadMessage(_make_message(reader, reading.counted, arrival), str(reading.error)))
        else:
            payloads.append(str(reading.error))
    return payloads


def _make_message(reader: HeliographMessageReader, reading: Reading, arrival: float) -> Message:
    """Return the message of an event; it has no arrival where that is the time of the measurement."""
    assert reading.time is not None
    time = reading.time if reader.numbers else convert_nanoseconds_to_date(int(reading.time))
    stated_arrival = None
    if arrival != reading.time:
        stated_arrival = arrival if reader.numbers else convert_nanoseconds_to_date(int(arrival))
    return Message.model_construct(
        plant=reading.plant,
        node=reading.node,
        sequence=reading.sequence,
        time=time,
        values=[None if value != value else value for value in reading.values.tolist()],
        inputs=None,
        arrival=stated_arrival,
    )
