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
Wanted = Callable[[str], bool]


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
    """Yield the messages of several series in order of time.

    Args:
        path: the log, for the messages' places.
        begin: when it begins, in seconds since 1970.
        series: by name of their messages.
    """
    # All messages one series after another: time, number of the series, and row in it.
    names = list(series)
    times = np.concatenate([np.zeros(0), *(each.time for each in series.values())])
    sizes = [len(each.time) for each in series.values()]
    series_numbers = np.repeat(np.arange(len(names)), sizes)
    rows = np.concatenate([np.zeros(0, dtype=int), *(np.arange(size) for size in sizes)])
    # By series the names of its signals, and their values.
    fields = [list(each.values) for each in series.values()]
    columns = [[values.tolist() for values in each.values.values()] for each in series.values()]
    for number, index in enumerate(np.argsort(times, kind="stable").tolist(), 1):
        of, row = series_numbers[index], rows[index]
        moment = round(begin + float(times[index]), DIGITS)
        content = {name: column[row] for name, column in zip(fields[of], columns[of], strict=True)}
        yield FileMessage(f"{path}, message {number}", names[of], {STAMP: moment, **content}, moment)
