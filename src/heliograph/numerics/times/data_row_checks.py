"""Rows of data as a user gives them: an array of numbers, one row a step."""

from collections.abc import Sequence

import jax
import numpy as np

from heliograph.numerics.check import check_columns, check_numbers, fail, show_value
from heliograph.numerics.domains import REAL, report_domain
from heliograph.numerics.masked_arrays import fill_masked, holds_texts_or_dates
from heliograph.numerics.types import Array, ArrayLike, Float


def check_rows(
    name: str, value: ArrayLike | None, steps: int | None, length: int | None, missing: bool, names: Sequence[str] = ()
) -> Float[Array, "steps n"]:
    """Return rows of data as a checked float64 array (steps, length).

    Args:
        name: what the rows are, for errors.
        value: the rows; an array of one axis if each row is one number.
        steps: number of rows, or None for any.
        length: numbers in a row, or None for any.
        missing: whether NaN is allowed, for a number that did not arrive.
        names: names of the columns; a table with just these names must have them in this order.

    The result may be the caller's own array, so it must not be changed.

    Raises:
        ValueError: None, other sizes, columns in another order, numbers that are not finite.
    """
    if isinstance(value, jax.core.Tracer):
        return value
    if value is None:
        raise fail(name, f"shape ({steps}, {length})", "none")
    # Names of columns first. Then the values as doubles: masked ones become NaN, texts and dates are refused.
    check_columns(name, value, names)
    try:
        values = np.asarray(fill_masked(value))
        if holds_texts_or_dates(values) or values.dtype.kind == "c":
            raise ValueError
        values = values.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise fail(name, "an array of numbers", show_value(value)) from None
    values = values[:, None] if values.ndim == 1 and length in (1, None) else values
    report_domain(name, values, REAL)
    table: Float[Array, "steps n"] = check_numbers(name, values, (steps, length), missing=missing)
    return table
