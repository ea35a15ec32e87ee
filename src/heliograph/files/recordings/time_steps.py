"""A table's column of time steps beside its times: what they say of one another."""

import warnings

import numpy as np

from heliograph.model.plant import TIME_STEP
from heliograph.numerics.times.dates import seconds_between

SAME_STEP = 1e-3  # share by which a time step may differ from the difference of two times, which are rounded


def compare_steps_with_times(dt: np.ndarray, time: np.ndarray, numbers: np.ndarray, source: str) -> np.ndarray:
    """Return the time steps; behind rows that were refused, whose own steps are lost, the time since the row before.

    A warning is given where the steps of the other rows are not the differences of their times, which tells nothing of
    those that were refused; and of a row that says a step quite other than the time that has passed. `numbers` are
    those of the rows in the table. `dt`, `time`: the column dt and the times of all rows (rows,). `source`: name of the
    table, for warnings.
    """
    # SAME_STEP: a relative difference of 1e-3, as of rounded times.
    is_behind_refused = np.diff(numbers, prepend=numbers[:1]) > 1
    since_row_before = seconds_between(time)
    others = np.flatnonzero(~is_behind_refused)[1:]  # the first row's step is not in the table's times
    if np.allclose(dt[others], since_row_before[others], rtol=SAME_STEP, atol=0.0):
        return np.where(is_behind_refused, since_row_before, dt)
    if is_behind_refused.any():
        row = numbers[np.argmax(is_behind_refused)]
        warnings.warn(
            f"{source}, row {row}, column {TIME_STEP!r}: the steps of the rows refused before it are left out, since "
            "steps are not the differences of times here",
            stacklevel=6,
        )
    _warn_of_other_steps(dt[others], since_row_before[others], numbers[others], source)
    return dt


def _warn_of_other_steps(dt: np.ndarray, passed: np.ndarray, numbers: np.ndarray, source: str) -> None:
    """Warn of a row whose step is off by more than half from the time that passed since the row before.

    So it is where rows were taken out of a table, whose column `dt` is of the table before. `passed` is in the unit of
    the times, which may be another than that of `dt`; times that count rows tell nothing. All of shape (rows,).
    """
    both = (dt > 0) & (passed > 0)
    if both.sum() < 3 or np.ptp(passed) <= SAME_STEP * passed.max():
        return
    unit = np.median(passed[both] / dt[both])  # of dt, in that of the times
    is_other = np.abs(passed / unit - dt) > dt / 2
    if is_other.any():
        first = np.argmax(is_other)
        warnings.warn(
            f"{source}, row {numbers[first]}, column {TIME_STEP!r}: {dt[first]:g}, where {passed[first] / unit:.6g} "
            f"has passed by the times; the column is used; so in {is_other.sum()} of {len(dt)} rows",
            stacklevel=7,
        )
