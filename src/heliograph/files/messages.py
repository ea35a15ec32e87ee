"""Messages of a recording, a bag or a CSV file of someone else's making, to events by the sources of a network."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from heliograph.files.bag import Progress, is_bag, read_bag
from heliograph.files.event_table import EventTable
from heliograph.files.sources import Sources, nanoseconds
from heliograph.files.table import csv_header, csv_lines
from heliograph.numerics.check import InputError, fail, file_path, instance, shown
from heliograph.simulation.network import Network

TOPIC, PAYLOAD, ARRIVAL = "topic", "payload", "arrival"  # columns of a log of messages


def read_messages(path: str | Path, network: Network, sources: object, progress: Progress | None = None) -> EventTable:
    """Read the events of a network from a bag, or from a CSV file that is mapped by sources.

    A bag is a file of MCAP, SQLite (.db3) or ROS 1 (.bag), or a folder of ROS 2; each event has the time of its
    source and the time when it was logged. In a CSV file each row is a message and its columns are the fields: of the
    topic in a column `topic` (whose `payload` is JSON, if there is such a column), else of the topic named as the file.
    It arrives at the time in a column `arrival`, else at its own time.

    A message that cannot be read ends the reading: what came before stays, and `broken` of the result says where.

    Args:
        path: the bag or the file.
        network: the network.
        sources: sources by topic, as `json_field` makes them.
        progress: called with the numbers of messages read and to be read (default none).

    Raises:
        ValueError: no such file, no bag, sources that do not fit the network or the file, nothing that can be read.
        ModuleNotFoundError: a bag without rosbags (extra "bags").
    """
    path = file_path("recording", path)
    instance("network", network, Network, "a Network")
    if is_bag(path):
        return read_bag(path, network, sources, progress)
    return _read_csv(path, network, Sources(sources, network))


def is_mapped(path: Path, sources: object) -> bool:
    """Return whether a recording is read by sources: a bag, or a CSV file with a topic for its rows."""
    if is_bag(path):
        return True
    if path.suffix.lower() != ".csv" or not isinstance(sources, Mapping) or not path.is_file():
        return False
    return path.name in sources or TOPIC in csv_header(path)


def _read_csv(path: Path, network: Network, sources: Sources) -> EventTable:
    events = EventTable(network, sources.step)
    try:
        for number, row in _rows(path):
            where = f"{path}, row {number}"
            topic = str(row.get(TOPIC, path.name))
            message = _payload(row[PAYLOAD], where) if PAYLOAD in row else row
            # A row without a time of arrival arrives as it is measured.
            logged = nanoseconds(row[ARRIVAL], "s", f"{where}, column {ARRIVAL!r}") if row.get(ARRIVAL) else None
            for reading in sources.read(topic, message, where):
                arrival = reading.time if logged is None else logged
                if arrival is None:
                    raise fail(f"{where}, {topic}", f"a time field (time=...), or a column {ARRIVAL!r}", "neither")
                events.add(reading, arrival)
    except InputError as error:
        if not len(events):
            raise
        events.broken = f"{error}; what was read before it stays"
    if sources.unknown.total():
        counts = ", ".join(f"{topic} ({count})" for topic, count in sources.unknown.items() if count)
        events.notes.append(f"{path}: not among the sources: {counts}")
    return events


def _rows(path: Path) -> Iterator[tuple[int, dict[str, Any]]]:
    """Yield the rows from 1, with numbers as numbers and empty cells as None."""
    with csv_lines(path) as lines:
        header = [name.strip() for name in next(lines, [])]
        for number, line in enumerate(lines, 1):
            if len(line) != len(header):
                raise fail(f"{path}, row {number}", f"{len(header)} cells, one for each column", len(line))
            cells = [(name, cell.strip()) for name, cell in zip(header, line, strict=True)]
            yield number, {name: cell if name == PAYLOAD else _cell(cell) for name, cell in cells}


def _cell(cell: str) -> float | int | str | None:
    """Convert a cell to a number where it is one; whole numbers keep every digit."""
    if not cell:
        return None
    for kind in (int, float) if "_" not in cell else ():
        try:
            return kind(cell)
        except ValueError:
            continue
    return cell


def _payload(text: str, where: str) -> object:
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        raise fail(f"{where}, column {PAYLOAD!r}", "JSON", shown(text)) from None
