"""Rows in which a sender is due, where these return as a pattern: told from losses by how seldom chance makes one."""

from math import comb
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int

LONGEST = 32  # rows after which a pattern returns, at most
CHANCE = 1e-4  # that losses at random are taken for a pattern, at most


class Pattern(NamedTuple):
    """A sender that is due in `due` of `length` rows, in `rows` (time,) of the table."""

    due: int
    length: int
    rows: Bool[np.ndarray, " time"]


def find_pattern(arrived: Bool[np.ndarray, " time"]) -> Pattern | None:
    """Return the pattern of rows in which a message is due, if losses at random would hardly leave it; else None.

    What is due in some of each `length` rows leaves the other rows empty for ever. Of the messages that are due some
    may be lost: what arrives in the due rows is looked at again, so that the pattern is the finest that can be told.
    """
    rows, due, length = np.ones(len(arrived), dtype=bool), 1, 1
    while (places := _least_probable_rows(arrived[rows])) is not None:
        # A pattern among `due` of each `length` rows: both as far as the whole returns.
        turns = len(places) // np.gcd(due, len(places))
        due, length = int(places.sum()) * due * turns // len(places), length * turns
        rows[rows] = np.resize(places, int(rows.sum()))
    return None if length == 1 else Pattern(due, length, rows)


def _least_probable_rows(arrived: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " length"] | None:
    """Return which of the first rows are due, of the pattern that chance makes least; None of what chance may make."""
    came = np.flatnonzero(arrived)
    intervals = np.diff(came)
    least, found = np.log(CHANCE), None
    for length in range(2, min(LONGEST, len(arrived) // 2) + 1 if len(intervals) else 0):
        places = np.bincount(came % length, minlength=length) > 0
        if places.all():
            continue
        # Any set of as many places, and any length, would have been taken: 1 / (length (length - 1)) add up to 1.
        tried = comb(length, int(places.sum())) * length * (length - 1)
        chance = _log_chance(places, intervals) + np.log(tried)
        if chance < least:
            least, found = chance, places
    return found


def _log_chance(places: Bool[np.ndarray, " length"], intervals: Int[np.ndarray, " arrivals"]) -> float:
    """Bound the probability, by its logarithm, that losses in bursts let nothing arrive outside of these places.

    Losses in bursts (a Markov chain of two states; those independent of each other are a case of it) make intervals
    between arrivals independent: 1 with probability a, else k > 1 with (1 - a) r (1 - r)^(k - 2). A place then moves as
    a Markov chain on the rows of one pattern, and the probability that it has left none after N intervals is at most
    the largest row sum of M^N, where M are the probabilities between the places.
    """
    length = len(places)
    gaps = intervals[intervals > 1] - 1
    follows = 1 - len(gaps) / len(intervals)
    ends = len(gaps) / gaps.sum() if len(gaps) else 1.0
    # Probability of each interval modulo the length: a geometric law, all turns of it added up.
    interval = np.arange(2, length + 2)
    step: Float[np.ndarray, " length"] = np.zeros(length)
    step[interval % length] = (1 - follows) * ends * (1 - ends) ** (interval - 2) / (1 - (1 - ends) ** length)
    step[1 % length] += follows
    at = np.flatnonzero(places)
    return _log_sum_of_power(step[(at[None, :] - at[:, None]) % length], len(intervals))


def _log_sum_of_power(matrix: Float[np.ndarray, "n n"], exponent: int) -> float:
    """Return the logarithm of the largest row sum of M^exponent, by squares that are scaled to a sum of 1."""
    sums, logarithm, scale = np.ones(len(matrix)), 0.0, 0.0
    while exponent:
        if exponent % 2:
            sums = matrix @ sums
            total = sums.max()
            if total == 0:
                return -np.inf
            sums, logarithm = sums / total, logarithm + scale + np.log(total)
        matrix, exponent = matrix @ matrix, exponent // 2
        largest = max(matrix.max(), np.finfo(float).tiny)
        matrix, scale = matrix / largest, 2 * scale + np.log(largest)
    return logarithm
