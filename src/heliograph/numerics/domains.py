"""Domains of numbers, which checks report of the arrays that ask for it: so a free number learns what it may be."""

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


class DomainReportingArray(np.ndarray):
    """Array that reports the domain that a check requires of it; arrays computed from it report nothing."""

    report: Callable[[str, Domain], None] | None = None


def mark_checked(value: object, report: Callable[[str, Domain], None]) -> DomainReportingArray:
    """Return a copy of an array that calls `report(name, domain)` when it is checked, with the numbers it may hold."""
    copy = np.array(value, dtype=np.float64).view(DomainReportingArray)
    copy.report = report
    return copy


def report_domain(name: str, value: object, whole: Domain, entry: Domain | None = None) -> None:
    """Report what numbers an array marked by `mark_checked` may hold; of any other value nothing happens.

    Checks call it with every value that they check: so a free number of a model, which is marked, learns its domain.

    Args:
        name: name of the value, as in an error.
        value: what is checked: an array, or a list with arrays in it.
        whole: the domain if the value itself is marked.
        entry: the domain of entries of a list that are marked; `whole` by default.
    """
    if isinstance(value, DomainReportingArray):
        if value.report is not None:
            value.report(name, whole)
    elif isinstance(value, list | tuple):
        for element in value:
            if isinstance(element, DomainReportingArray | list | tuple):
                report_domain(name, element, whole if entry is None else entry, entry)


def report_covariance(name: str, value: object) -> None:
    """Report that an array marked by `mark_checked` is a covariance, or a variance if it is a single number.

    In a list of rows, marked numbers on the diagonal are variances, and those off it any real numbers.
    """
    if isinstance(value, DomainReportingArray):
        report_domain(name, value, COVARIANCE if value.ndim else POSITIVE)
    elif isinstance(value, list | tuple):
        for i, row in enumerate(value):
            for j, element in enumerate(row if isinstance(row, list | tuple) else []):
                report_domain(name, element, POSITIVE if i == j else REAL)
