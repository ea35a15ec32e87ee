"""Times of the rows that a model steps over: whether they are in order, the same everywhere, and of equal steps."""

import inspect
import warnings
from collections.abc import Mapping, Sequence

import numpy as np

from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import fail
from heliograph.numerics.times.dates import unequal_steps
from heliograph.numerics.times.row_times import row_dates

ONE_STEP = "a plant without the input dt takes each for one; insert the rows that are missing, or give it dt"


def find_common_dates(tables: Mapping[str, object]) -> np.ndarray | None:
    """Return the dates in the tables' indices (datetime64[ns], UTC), which must agree, or None if there are none.

    Tables of measurements and inputs that belong together must have the same times in each row. Tables without dates
    are not checked.

    Args:
        tables: {name for errors: table of measurements or inputs}.

    Raises:
        ValueError: dates that are missing, that go backwards, or that differ from those of another table.
    """
    first_table, common_dates = "", None
    for name, rows in tables.items():
        dates = row_dates(name, rows)
        if dates is None:
            continue
        # The first table with dates sets them. The others must have the same kind of times, dates (NumPy's kind "M") or
        # spans of time, and the same values.
        if common_dates is None:
            first_table, common_dates = name, dates
        elif dates.dtype.kind != common_dates.dtype.kind:
            came, there = ("dates" if t.dtype.kind == "M" else "spans of time" for t in (dates, common_dates))
            raise fail(f"times of {name}", f"{there}, as {first_table} has", came)
        elif len(dates) == len(common_dates) and (dates != common_dates).any():
            # A table of another number of rows is refused where tables are read, by its number of rows.
            row = int(np.argmax(dates != common_dates))
            got = f"{dates[row]} in row {row + 1}, not {common_dates[row]}"
            raise fail(f"dates of {name}", f"those of {first_table}", got)
    return common_dates


def warn_of_unequal_steps(inputs: Sequence[str], clock: np.ndarray | None) -> None:
    """Warn if times are not equally spaced although the plant has no input dt, so that each row is one step to it.

    Args:
        inputs: names of the plant's inputs.
        clock: times of the rows, numbers or dates; None where they are not known.
    """
    if clock is None or TIME_STEP in inputs:
        return
    description = unequal_steps(clock)
    if description:
        warnings.warn(f"time: {description}: {ONE_STEP}", stacklevel=_count_frames_up_to_user())


def read_row_dates(inputs: Sequence[str], tables: Mapping[str, object]) -> np.ndarray | None:
    """Return the dates of the tables' rows; warn if they are not equally spaced and the plant has no input dt.

    Args:
        inputs: names of the plant's inputs.
        tables: tables of measurements and inputs, by their names for errors.

    Raises:
        ValueError: dates that are missing, that go backwards, or that differ from those of another table.
    """
    clock = find_common_dates(tables)
    warn_of_unequal_steps(inputs, clock)
    return clock


def _count_frames_up_to_user() -> int:
    """Return the `stacklevel` with which the caller's warning points at the user's line, outside this package.

    `stacklevel` is 1 for the caller itself, 2 for what called it, and so on. It is the number of frames of this package
    from here upwards: this function, which is not above the warning, stands for the user's frame.
    """
    package = __name__.split(".")[0]
    frame, frames_of_package = inspect.currentframe(), 0
    while frame is not None and frame.f_globals.get("__name__", "").split(".")[0] == package:
        frames_of_package += 1
        frame = frame.f_back
    return frames_of_package
