"""Signals of MDF4 files: the messages of a group are its samples."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from heliograph.files.logs.log_sources import LogSources
from heliograph.files.logs.vehicle_log import Log, MessageSeries, Wanted, merge_series
from heliograph.numerics.check import InputError, error_text, fail

if TYPE_CHECKING:
    from asammdf import MDF

RAW = "CAN_DataFrame"  # the signal that frames of a bus are recorded as


def open_mdf(path: Path, sources: LogSources, wanted: Wanted) -> Log:
    """Open an MDF4 file: channel groups, each with signals that are sampled together.

    A message is one sample of a group, and is named as the group's acquisition or "group N".

    Args:
        path: the file, a vehicle's log of signals by channel group.
        sources: say which signals are measurements of which node, and may have the date of the start.
        wanted: whether the messages of a name are to be read.

    Raises:
        ValueError: no MDF4 file, or frames of a bus without a database.
        ModuleNotFoundError: asammdf is not installed (extra "mdf").
    """
    from asammdf import MDF

    try:
        with MDF(path) as file:
            names = _name_groups(file)
            # Signals by group; raw frames of a bus cannot be read without the database that describes them.
            channels = {name: _list_channels(file, i) for i, name in enumerate(names)}
            if any(RAW in signals for signals in channels.values()):
                raise fail(str(path), "dbc= of LogSources, for its frames of CAN", "none")
            # Samples of the wanted groups, units of all signals, and the date from which the samples' times count.
            series = {name: _read_group(file, i, channels[name]) for i, name in enumerate(names) if wanted(name)}
            units = {
                name: {signal: file.get_channel_unit(group=i, index=index) or "" for signal, index in signals.items()}
                for i, (name, signals) in enumerate(channels.items())
            }
            begin = file.start_time.timestamp() if sources.start is None else sources.start
    except InputError:
        raise
    except Exception as error:  # whatever a damaged file makes a reader do
        raise fail(str(path), "an MDF4 file", error_text(error)) from None
    messages = merge_series(path, begin, series)  # of all groups, in order of time
    return Log(units, kinds=dict.fromkeys(names, "MDF4"), messages=messages, notes=[])


def _name_groups(file: "MDF") -> list[str]:
    """Return a distinct name for each channel group; the group's number is added if the name is missing or taken."""
    names = list[str]()
    groups: Any = file.groups
    for i, group in enumerate(groups):
        name = str(group.channel_group.acq_name or f"group {i}").strip()
        names.append(name if name not in names else f"{name} {i}")
    return names


def _list_channels(file: "MDF", group: int) -> dict[str, int]:
    """Return {name: index} of the signals of the group with this number, without its channel of times.

    If two signals have the same name, the index is added to the second's name.
    """
    index_of_times = file.masters_db.get(group)  # asammdf's {group: index of the channel with the samples' times}
    channels: Any = file.groups[group].channels
    indices = dict[str, int]()
    for index, channel in enumerate(channels):
        if index != index_of_times:
            indices[channel.name if channel.name not in indices else f"{channel.name} {index}"] = index
    return indices


def _read_group(file: "MDF", group: int, indices: dict[str, int]) -> MessageSeries:
    """Return the samples of a group: times in seconds from the file's start, and the values of each signal.

    `indices` maps the name of a signal to its index in the group. A sample that the file marks as invalid becomes None.
    A signal with several numbers per sample is left out. A `MessageSeries` is times and {signal: values}, (samples,)
    each.
    """
    time, values = np.zeros(0), dict[str, np.ndarray]()
    for name, index in indices.items():
        signal = file.get(group=group, index=index, ignore_invalidation_bits=True)
        time = np.asarray(signal.timestamps, dtype=np.float64)
        samples = np.asarray(signal.samples)
        if samples.ndim > 1 or samples.dtype.names:
            continue
        column = np.char.decode(samples, errors="replace") if samples.dtype.kind == "S" else samples
        if signal.invalidation_bits is not None:
            column = column.astype(object)
            column[np.asarray(signal.invalidation_bits, dtype=bool)] = None
        values[name] = column
    return MessageSeries(time, values)
