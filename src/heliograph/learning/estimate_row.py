"""Row of the table of a fit: a number, its estimate and its interval, in numbers and in words."""

from typing import NamedTuple

import numpy as np

from heliograph.learning.free_parameters import TableEntry
from heliograph.learning.likelihood.objective import Form
from heliograph.numerics.module import readable


@readable
class Row(NamedTuple):
    """Row of the table of a fit: a free number by one form of the likelihood.

    Args:
        name: the number's name.
        estimate: the estimate.
        low: lower end of the interval (95 % unless another level is given); NaN if not identified.
        high: upper end.
        standard_error: standard error of the estimate; NaN at a boundary or if not identified.
        form: "linear" or "conditional".
        boundary: true if the estimate is the end of the number's domain; the interval is from there to the other end.
        identified: true if the data identify this number without knowledge of the others.
    """

    name: str
    estimate: float
    low: float
    high: float
    standard_error: float
    form: Form
    boundary: bool
    identified: bool

    @property
    def interval(self) -> str:
        """The interval in words, to two digits of its width: "0.12 to 0.31", "below 0.3" or "not identified"."""
        if not self.identified:
            return "not identified"
        low, high = (round_to_width(end, self.high - self.low) for end in (self.low, self.high))
        if self.boundary:
            return f"below {high}" if self.high > self.estimate else f"above {low}"
        return f"{low} to {high}"

    @property
    def value(self) -> str:
        """Estimate in words, with two digits of the interval's width."""
        return round_to_width(self.estimate, self.high - self.low)


def round_to_width(value: float, width: float) -> str:
    """Return a number rounded to two digits of its interval's width, at least 2 and at most 8 digits of its own.

    If there is no width, it is rounded to four of its own digits.
    """
    if not np.isfinite(value) or value == 0 or not np.isfinite(width) or width <= 0:
        return f"{value:.4g}"
    # From the first digit of the value to the second digit of the width.
    digits = int(np.floor(np.log10(abs(value)))) - int(np.floor(np.log10(width))) + 2
    return f"{value:.{min(max(digits, 2), 8)}g}"


def make_unidentified_row(entry: TableEntry, value: float, form: Form) -> Row:
    """Return the row of a number that the data do not identify: where the search ended, without an interval.

    Args:
        entry: the number, with its name.
        value: where the search ended.
        form: form of the likelihood that was maximised.
    """
    return Row(
        name=entry.name,
        estimate=value,
        low=np.nan,
        high=np.nan,
        standard_error=np.nan,
        form=form,
        boundary=False,
        identified=False,
    )
