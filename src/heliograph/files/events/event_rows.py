"""Rows of a recording from events: which row each event is in, and the values and inputs of each row."""

import numpy as np

from heliograph.numerics.types import Float, Int


def number_rows(time: np.ndarray, steps: bool, joint: bool) -> tuple[Int[np.ndarray, " events"], np.ndarray]:
    """Return the number of the row of each event, from 0, and the times of the rows.

    Args:
        time: times of the events, in order, at least one.
        steps: whether times are numbers of steps; every step is then a row, even without an event.
        joint: whether all events of one time are one row.
    """
    if steps:
        return time.astype(np.int64), np.arange(int(time[-1]) + 1)
    begins_row = np.ones(len(time), dtype=bool)
    begins_row[1:] = time[1:] != time[:-1] if joint else True
    return np.cumsum(begins_row) - 1, time[begins_row]


def put_values_in_rows(
    values: Float[np.ndarray, "events size"], row: Int[np.ndarray, " events"], count: int
) -> Float[np.ndarray, "rows size"]:
    """Return a table (count, size) with the values of events in their rows, and NaN where no value arrived.

    If a row has several events, each component takes its last value that is not NaN.
    """
    table = np.full((count, values.shape[1]), np.nan)
    for i in range(values.shape[1]):
        present = ~np.isnan(values[:, i])
        table[row[present], i] = values[present, i]
    return table


def fill_forward(values: Float[np.ndarray, "rows given"]) -> Float[np.ndarray, "rows given"]:
    """Return each column with every NaN replaced by the last value before it, or by 0 if there is none."""
    own_row = np.where(np.isnan(values), -1, np.arange(len(values))[:, None])  # -1: no value in this row
    last_row = np.maximum.accumulate(own_row, axis=0) if len(values) else own_row
    return np.asarray(np.where(last_row < 0, 0.0, np.take_along_axis(values, np.maximum(last_row, 0), axis=0)))


def make_inputs_leading_to_rows(
    held: Float[np.ndarray, "rows given"], times: np.ndarray, unit: int, time_index: int
) -> Float[np.ndarray, "rows inputs"]:
    """Return the inputs that lead to each row in continuous time: the previous row's inputs, and the time since it.

    Args:
        held: inputs that were set last, at each row; before the first row they are 0.
        times: times of the rows, in whole parts of the unit of time, such as nanoseconds.
        unit: how many of these parts are one unit of time.
        time_index: index among the inputs of dt, the time since the previous row.
    """
    inputs_of_row_before = np.vstack([np.zeros((1, held.shape[1])), held[:-1]])
    dt = np.diff(times, prepend=times[:1]) / unit
    return np.insert(inputs_of_row_before, time_index, dt, axis=1)
