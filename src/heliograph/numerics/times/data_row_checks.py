"""Rows of data as a user gives them: an array of numbers, one row a step."""

from collections.abc import Sequence

import jax
import numpy as np

from heliograph.numerics.check import REAL, check_columns, check_numbers, fail, report_domain, show_value
from heliograph.numerics.masked_arrays import fill_masked, holds_texts_or_dates
from heliograph.numerics.types import Array, ArrayLike, Float


def check_rows(
    name: str, value: ArrayLike | None, steps: int | None, length: int | None, missing: bool, names: Sequence[str] = ()
) -> Float[Array, "steps n"]:
    """Return an array of `length` numbers a step, one axis standing for one number; NaN where `missing` is allowed.

    It is the caller's own where that has the form: only read. Columns of a table that have `names` have their order.
    """
    if isinstance(value, jax.core.Tracer):
        return value
    if value is None:
        raise fail(name, f"shape ({steps}, {length})", "none")
    check_columns(name, value, names)
    try:
        values = np.asarray(fill_masked(value))
        if holds_texts_or_dates(values):
            raise ValueError
        values = values.astype(np.float64, copy=False)
    except (TypeError, ValueError, OverflowError):
        raise fail(name, "an array of numbers", show_value(value)) from None
    values = values[:, None] if values.ndim == 1 and length in (1, None) else values
    report_domain(name, values, REAL)
    table: Float[Array, "steps n"] = check_numbers(name, values, (steps, length), missing=missing)
    return table
