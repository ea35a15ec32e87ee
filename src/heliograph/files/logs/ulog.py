"""Topics of ULog, as PX4 writes it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from heliograph.files.logs.log_sources import STAMP, LogSources
from heliograph.files.logs.vehicle_log import Log, MessageSeries, Wanted, merge_series
from heliograph.numerics.check import error_text, fail

if TYPE_CHECKING:
    from pyulog import ULog

MICROSECOND = 1e-6
CLOCKS = "vehicle_gps_position", "sensor_gps"  # topics of which a field is the date
DATE = "time_utc_usec"


def open_ulog(path: Path, sources: LogSources, wanted: Wanted) -> Log:
    """Return a ULog file as a log; a further instance of a topic is named with its number, "sensor_baro.1".

    ULog is the format of the flight controller PX4. Its times count from when the device began to run; their date is
    found from the first fix of its satellite receiver.

    Args:
        path: the file.
        sources: the user's sources; `sources.start` is the date at which the log began, None if it is not given.
        wanted: says of the name of a topic whether its values are read.

    Raises:
        ValueError: no ULog file.
        ModuleNotFoundError: pyulog is not installed (extra "ulog").
    """
    from pyulog import ULog

    try:
        with path.open("rb") as opened:
            file = ULog(opened)
    except Exception as error:  # whatever a damaged file makes a reader do
        raise fail(str(path), "a ULog file", error_text(error)) from None
    topics = {data.name if data.multi_id == 0 else f"{data.name}.{data.multi_id}": data for data in file.data_list}
    # STAMP is the field with the microseconds since the start. Units of the fields by topic, all "" since a ULog file
    # does not have them; of wanted topics also the values of the fields over time.
    units = {name: dict.fromkeys((field for field in data.data if field != STAMP), "") for name, data in topics.items()}
    series = {
        name: MessageSeries(data.data[STAMP] * MICROSECOND, {field: data.data[field] for field in units[name]})
        for name, data in topics.items()
        if wanted(name)
    }
    # When the device began to run, in seconds since 1970. The user may give the date when the log began; the log says
    # how many microseconds after the start of the device that was.
    begin = _find_start_date(file)
    if sources.start is not None:
        begin = sources.start - file.start_timestamp * MICROSECOND
    notes = list[str]()
    if file.dropouts:
        notes.append(f"{path}: the device lost {len(file.dropouts)} times what it should have logged")
    if file.file_corruption:
        notes.append(f"{path}: damaged; what could be read is used")
    messages = merge_series(path, begin, series)  # of all topics, in order of time
    return Log(units, kinds=dict.fromkeys(topics, "ULog"), messages=messages, notes=notes)


def _find_start_date(file: "ULog") -> float:
    """Return the date at which the device began to run, in seconds since 1970, or 0 if the log does not say it.

    CLOCKS are topics of satellite receivers. Their field DATE holds the date in microseconds, 0 until it is known.
    Their field STAMP holds the microseconds since the device began to run.
    """
    for data in file.data_list:
        if data.name in CLOCKS and DATE in data.data and len(known := np.flatnonzero(data.data[DATE])):
            # In the first message with a date, subtract the time since the start.
            first = known[0]
            return (int(data.data[DATE][first]) - int(data.data[STAMP][first])) * MICROSECOND
    return 0.0
