"""A vehicle's log of any kind: its signals with their units, and its messages in order of time."""

from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from heliograph.files.logs.log_sources import STAMP
from heliograph.files.messages.message_files import FileMessage
from heliograph.files.text.text_file import CANDUMP, find_extension
from heliograph.numerics.check import InputError
from heliograph.numerics.types import Float

FRAMES, MDF, ULOG = (".blf", ".asc", CANDUMP), (".mf4",), (".ulg",)
LOGS = (*FRAMES, *MDF, *ULOG)
PACKAGES = {**dict.fromkeys(FRAMES, ("can", "cantools")), ".mf4": ("asammdf",), ".ulg": ("pyulog",)}
DIGITS = 6  # of a second: doubles of our years tell microseconds apart
Wanted = Callable[[str], bool]  # from the name of a message, whether it is to be decoded


class Log(NamedTuple):
    """A vehicle's log.

    Attributes:
        units: unit of each signal by message, "" where the file names none.
        kinds: what each message is, such as "CAN 0x1a0".
        messages: those that are wanted, in order of time, and why others cannot be read; may raise ValueError.
        bits: bits of the signals that are whole numbers without a unit, by message, where the file says them.
        notes: lines on what was left out, complete when the messages were read.
    """

    units: dict[str, dict[str, str]]
    kinds: dict[str, str]
    messages: Iterator[FileMessage | InputError]
    notes: list[str]
    bits: Mapping[str, Mapping[str, int]] = MappingProxyType({})


class MessageSeries(NamedTuple):
    """Messages of one name: seconds from the log's begin, and the values of each signal; all of shape (messages,)."""

    time: Float[np.ndarray, " messages"]
    values: Mapping[str, np.ndarray]


def is_log(path: Path) -> bool:
    """Return whether a path is that of a vehicle's log or of a folder with logs, by name or by how a .log begins."""
    return bool(list_logs(path))


def list_logs(path: Path) -> list[Path]:
    """Return the logs at a path: those in a folder, sorted by name, or the file itself if it is of a log's kind."""
    if path.is_dir():
        return sorted(part for part in path.iterdir() if part.is_file() and find_extension(part) in LOGS)
    return [path] if find_extension(path) in LOGS else []


def merge_series(path: Path, begin: float, series: Mapping[str, MessageSeries]) -> Iterator[FileMessage]:
    """Yield the messages of several series in order of time; each gets its time as the field STAMP.

    A `FileMessage` has place, topic, content and time of arrival.

    Args:
        path: the log, for the places of messages in errors.
        begin: moment from which the times of the series count, in seconds since 1970.
        series: {name of the messages: their times and values}.
    """
    # All messages, one series after another: time, index of the series, and row in it.
    names = list(series)
    sizes = [len(each.time) for each in series.values()]
    times = np.concatenate([np.zeros(0), *(each.time for each in series.values())])
    series_of_message = np.repeat(np.arange(len(names)), sizes)
    row_of_message = np.concatenate([np.zeros(0, dtype=int), *(np.arange(size) for size in sizes)])
    # Of each series {signal: its values as a list}.
    columns = [{name: values.tolist() for name, values in each.values.items()} for each in series.values()]
    for number, index in enumerate(np.argsort(times, kind="stable").tolist(), 1):
        which, row = series_of_message[index], row_of_message[index]
        moment = round(begin + float(times[index]), DIGITS)
        signals = {name: column[row] for name, column in columns[which].items()}
        yield FileMessage(f"{path}, message {number}", names[which], {STAMP: moment, **signals}, moment)
