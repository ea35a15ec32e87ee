"""Messages in files of tables and of lines: rows of CSV and Parquet, JSON lines, logs of MQTT clients; also packed."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from heliograph.files.sources.message_fields import decode_items, decode_json, fail_of_doubled, parse_number
from heliograph.files.text.csv_dialects import FLAGS, check_distinct
from heliograph.files.text.csv_text import CsvRow, read_csv_header, read_csv_rows
from heliograph.files.text.text_file import find_extension, is_valid_text, open_text, yield_until_cut_off
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.times.dates import parse_instant

TOPIC, PAYLOAD = "topic", "payload"  # of a message in a log
ARRIVALS = ("arrival", "tst")  # fields that say when a message of a log arrived; `mosquitto_sub -F %j` has the second
CLOCKS = ("timestamp", "time", "ts")  # the same, where they are dates with a zone or seconds, beside a payload
YEARS = 1e9, 1e10  # seconds since 1970 of the years 2001 and 2286
LINES = (".jsonl", ".ndjson", ".json", ".log", ".txt")
# A date or seconds, a topic and a payload, as `mosquitto_sub -F "%I %t %p"` and `mosquitto_sub -v` print them.
LOGGED = re.compile(r"(?:(?P<arrival>\d{4}-\d\d-\d\dT\S+|\d+(?:\.\d+)?) )?(?P<topic>[^\s{}\[\]\",]+) (?P<payload>.*)")


class FileMessage(NamedTuple):
    """Message of a file.

    Attributes:
        where: its place, for errors.
        topic: its topic; None for that of its file.
        content: the message, decoded; of a log its payload, as text where it is text there.
        arrival: when it arrived, as the file says it; None if it does not.
        stored: whether the broker had stored it for new subscribers.
    """

    where: str
    topic: str | None
    content: Any
    arrival: Any
    stored: bool = False


def is_message_file(path: Path) -> bool:
    """Return whether a file has lines of messages, by its name."""
    return find_extension(path) in LINES


def make_default_topic(path: Path) -> str:
    """Return the topic of the messages of a file that name none: its name, without .gz."""
    return path.name.removesuffix(".gz")


def table_has_topics(path: Path) -> bool:
    """Return whether a table is a log of messages: it has a column `topic`."""
    kind = find_extension(path)
    if kind == ".parquet" and path.is_file():
        return TOPIC in read_parquet_names(path)
    return kind == ".csv" and path.is_file() and TOPIC in read_csv_header(path)


def read_parquet_names(path: Path) -> list[str]:
    """Return the names of a Parquet file's columns, or [] if the file does not exist or is not Parquet."""
    import pyarrow.parquet as pq

    try:
        return list(pq.ParquetFile(path).schema_arrow.names)
    except (ValueError, OSError):  # whoever reads the file will report the error
        return []


def read_message_file(path: Path) -> Iterator[FileMessage | InputError]:
    """Yield the messages of a file in its order; an error stands in place of a message that cannot be read.

    If the file is damaged or was cut off, the last item is a `CutOffError`. Files with an extension in LINES hold JSON
    or the output of MQTT clients. Other files are CSV or Parquet.

    Raises:
        ValueError: the file cannot be read at all.
    """
    kind = find_extension(path)
    if not path.is_file():
        raise fail(str(path), "a file", "a folder" if path.is_dir() else "nothing of that name")
    if kind == ".parquet":
        yield from (make_message_of_row(where, row) for where, row in _read_parquet_rows(path))
    else:
        yield from yield_until_cut_off(_read_json_messages(path) if kind in LINES else _read_csv_messages(path))


def parse_log_line(text: str) -> tuple[str, str, str | None] | None:
    """Return (topic, payload, arrival) of a line that an MQTT client printed; None for any other line.

    The arrival, a date or seconds, is None if the line has none. LOGGED is the pattern of such a line.
    """
    match = LOGGED.fullmatch(text.strip())
    return None if match is None else (match["topic"], match["payload"], match["arrival"])


def read_log_entry(content: object) -> tuple[str, Any, Any, bool] | None:
    """Return (topic, payload, arrival, was_stored) of a message that a log holds in JSON, or None for other content.

    `was_stored`: the broker had stored the message (MQTT's flag "retain"). TOPIC and PAYLOAD are the fields `topic` and
    `payload`.
    """
    if not isinstance(content, dict) or not isinstance(content.get(TOPIC), str) or PAYLOAD not in content:
        return None
    return content[TOPIC], content[PAYLOAD], find_arrival_time(content), bool(content.get("retain"))


def find_arrival_time(logged: Mapping[str, Any]) -> Any:
    """Return when a message with a payload was logged, in the log's own form, or None if the log does not say it.

    Fields in ARRIVALS always hold this time. Fields in CLOCKS, such as "time", hold it if their value is a date or
    seconds since 1970.
    """
    arrivals = [logged[name] for name in ARRIVALS if logged.get(name) is not None]
    arrivals += [logged[name] for name in CLOCKS if _is_moment(logged.get(name))]
    return arrivals[0] if arrivals else None


def _is_moment(value: object) -> bool:
    """Return whether a value, possibly a text, is a date with a zone, or seconds since 1970 in YEARS, 2001 to 2286."""
    number = parse_number(value) if isinstance(value, str) else value
    if isinstance(number, str):
        try:
            parse_instant(number)
        except ValueError:
            return False
        return True
    return isinstance(number, int | float) and YEARS[0] <= number < YEARS[1]


def make_message_of_row(where: str, row: Mapping[str, Any]) -> FileMessage:
    """Return the message of a row of a table.

    The content is the column `payload`, or the whole row if there is no column `topic` or no payload. In a row with a
    payload, columns such as `time` say when it was logged. In any other row they are fields of the message.
    """
    arrival = find_arrival_time(row) if PAYLOAD in row else row.get("arrival")
    if TOPIC not in row:
        return FileMessage(where, None, row, arrival)
    payload = row.get(PAYLOAD, row)
    return FileMessage(where, str(row[TOPIC]), payload, arrival)


def _read_json_messages(path: Path) -> Iterator[FileMessage | InputError]:
    """Yield the messages of a JSON file, one document or a message on each line; errors replace bad messages."""
    with open_text(path) as file:
        if find_extension(path) == ".json":  # try it as one document, and else read it line by line
            text = file.read()
            try:
                yield from parse_message_document(text, str(path))
                return
            except InputError:
                lines = enumerate(text.splitlines(), 1)
        else:
            lines = enumerate(file, 1)
        for number, line in lines:
            if line.strip():
                yield from parse_message_line(f"{path}, line {number}", line)


def parse_message_document(text: str | bytes, name: str) -> list[FileMessage | InputError]:
    """Return the messages of a JSON document, which may be nested lists; an error stands in place of a bad message.

    `decode_items` yields each item of the document with the name of a field that occurs twice in it, or None: such an
    item is an error.

    Raises:
        ValueError: the text is not JSON.
    """
    return [
        _make_message_of_json(f"{name}, message {n}", item, doubled)
        for n, (item, doubled) in enumerate(decode_items(text, name), 1)
    ]


def parse_message_line(where: str, line: str) -> list[FileMessage | InputError]:
    """Return the messages of a line, or the reason why it cannot be read.

    The line is JSON: a message or a list of messages. Otherwise it may be a topic and a payload, as MQTT clients print
    them. `parse_log_line` returns topic, payload and time of such a line, None if it is none.
    """
    line = line.strip()
    if not is_valid_text(line):
        return [fail(where, "a text in UTF-8", show_value(line))]
    try:
        return [_make_message_of_json(where, *item) for item in decode_items(line, where)]
    except InputError as error:
        parts = parse_log_line(line)
        return [error if parts is None else FileMessage(where, *parts)]


def _make_message_of_json(where: str, content: object, doubled: str | None) -> FileMessage | InputError:
    """Return the message of decoded JSON; its topic is None unless the content is a log's entry, which names it.

    `doubled` is the name of a field that occurs twice, for which an error is returned; None if there is no such field.
    """
    if doubled is not None:
        return fail_of_doubled(where, doubled)
    logged = read_log_entry(content)
    if logged is None:
        return FileMessage(where, None, content, content.get("arrival") if isinstance(content, dict) else None)
    topic, payload, arrival, stored = logged
    return FileMessage(where, topic, payload, arrival, stored)


def _read_csv_messages(path: Path) -> Iterator[FileMessage | InputError]:
    """Yield the message of each row of a CSV file; an error stands in place of a row that cannot be read."""
    for row in read_csv_rows(path, marked=True):
        yield row if isinstance(row, InputError) else make_message_of_row(row.where, convert_cells(row))


def convert_cells(row: CsvRow) -> dict[str, Any]:
    """Return {name: value} for the cells of a row: numbers, flags (true, False), None for empty cells, and texts.

    Integers keep every digit. A payload stays a text. FLAGS are the words true and false; `parse_number` returns a text
    that is no number as it is.
    """
    results: dict[str, Any] = {}
    for name, cell in zip(row.header, row.cells, strict=True):
        if name == PAYLOAD:
            results[name] = cell
        else:
            results[name] = FLAGS.get(cell.lower(), parse_number(cell)) if cell else None
    return results


def _read_parquet_rows(path: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield the place and the cells of each row of a Parquet file; rows are counted from 1.

    Timestamps become dates in ISO 8601. Without a zone they are taken as UTC.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    names = table.column_names
    check_distinct(path, names)
    for i, column in enumerate(table.columns):
        if pa.types.is_timestamp(column.type):
            nanoseconds = column.cast(pa.timestamp("ns", "UTC")).cast(pa.int64()).to_pylist()
            texts = [None if moment is None else _format_moment(moment) for moment in nanoseconds]
            table = table.set_column(i, names[i], pa.chunked_array([pa.array(texts, pa.string())]))
    for number, row in enumerate(table.to_pylist(), 1):
        yield f"{path}, row {number}", row


def _format_moment(nanoseconds: int) -> str:
    """Return nanoseconds since 1970 as a date of ISO 8601."""
    import numpy as np

    return f"{np.datetime64(nanoseconds, 'ns')}Z"


def decode_message_content(message: FileMessage) -> object:
    """Return the content of a message; a text, the payload in a log, is decoded from JSON.

    Raises:
        ValueError: the text is not JSON, or a field occurs twice.
    """
    if not isinstance(message.content, str):
        return message.content
    return decode_json(message.content, f"{message.where}, {PAYLOAD!r}")
