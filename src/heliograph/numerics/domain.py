"""Domains of numbers, and arrays that learn their domain from the check that they pass through."""

from collections.abc import Callable
from typing import Literal, NamedTuple

import numpy as np


class Domain(NamedTuple):
    """Numbers between two limits, positive ones that sum to one along the last axis, or a covariance matrix."""

    kind: Literal["interval", "simplex", "covariance"] = "interval"
    low: float = -np.inf
    high: float = np.inf


REAL, POSITIVE, PROBABILITY = Domain(), Domain(low=0.0), Domain(low=0.0, high=1.0)
SIMPLEX, COVARIANCE = Domain("simplex"), Domain("covariance")


class Marked(np.ndarray):
    """Array that reports the domain that a check requires of it; arrays computed from it report nothing."""

    report: Callable[[str, Domain], None] | None = None


def marked(value: object, report: Callable[[str, Domain], None]) -> Marked:
    """Return a copy of an array that calls `report(name, domain)` when it is checked."""
    result = np.array(value, dtype=np.float64).view(Marked)
    result.report = report
    return result


def tell(name: str, value: object, whole: Domain, entry: Domain | None = None) -> None:
    """Tell a marked value what it is for; in a list, marked entries that they are each an `entry`."""
    if isinstance(value, Marked):
        if value.report is not None:
            value.report(name, whole)
    elif isinstance(value, list | tuple):
        for item in value:
            if isinstance(item, Marked | list | tuple):
                tell(name, item, whole if entry is None else entry, entry)


def tell_covariance(name: str, value: object) -> None:
    """Tell a marked covariance or variance; in a list of rows, that those on the diagonal are variances."""
    if isinstance(value, Marked):
        tell(name, value, COVARIANCE if value.ndim else POSITIVE)
    elif isinstance(value, list | tuple):
        for i, row in enumerate(value):
            for j, item in enumerate(row if isinstance(row, list | tuple) else []):
                tell(name, item, POSITIVE if i == j else REAL)
