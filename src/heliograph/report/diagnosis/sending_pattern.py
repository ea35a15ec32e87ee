"""Periodic patterns of rows in which a sender is due: tested against random losses, which seldom make a pattern."""

from math import comb, exp, log
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float, Int

SHORT = 32  # rows of a pattern up to which each is looked at
LONGEST = 256  # rows after which a pattern returns, at most
CHANCE = 1e-4  # that losses at random are taken for a pattern, at most


class SendingPattern(NamedTuple):
    """A periodic pattern of rows in which a sender's message is due: `due` of each `length` rows."""

    due: int
    length: int
    rows: Bool[np.ndarray, " time"]  # mask of the due rows of the table


def find_pattern(arrived: Bool[np.ndarray, " time"]) -> SendingPattern | None:
    """Return the pattern of rows in which a message is due, or None if random losses could have left it.

    Messages are due in `due` of each `length` rows, and all other rows are empty. The due rows may have a pattern
    themselves (`finer`, a mask over len(finer) due rows), and so on: the result is the finest one. `rows` of the result
    marks the due rows of the recording.
    """
    rows, due, length = np.ones(len(arrived), dtype=bool), 1, 1  # at first each row is due
    finer = _find_least_probable_rows(arrived[rows])
    while finer is not None:
        # Only the rows of `finer` among the due rows are due. Both patterns together repeat after some repetitions of
        # the first: the fewest for which repetitions * due is a multiple of len(finer).
        repetitions = len(finer) // np.gcd(due, len(finer))
        due = int(finer.sum()) * due * repetitions // len(finer)
        length = length * repetitions
        rows[rows] = np.resize(finer, int(rows.sum()))  # the finer pattern, repeated over the rows that were due so far
        finer = _find_least_probable_rows(arrived[rows])
    return None if length == 1 else SendingPattern(due, length, rows)


def _find_least_probable_rows(arrived: Bool[np.ndarray, " rows"]) -> Bool[np.ndarray, " length"] | None:
    """Return the pattern that random losses would make with the least probability; None if all are likely enough.

    A sender may be due in some rows only, as every third one; then the other rows are no losses. A pattern is a mask of
    the due rows (length,), which repeats. Of each length the smallest pattern is tried: rows in which a message came.
    Probabilities are bounds, times the number of patterns that might have been found instead; `least` is the logarithm
    of the least one so far, from CHANCE on. `arrived`: whether a message came in each row (rows,). `_bound_log_chance`
    bounds the log probability that losses in bursts let nothing arrive outside a pattern. CHANCE is 1e-4; up to SHORT
    (32) rows bursts are looked at in each pattern. Patterns of more than LONGEST (256) rows are not tried.
    """
    # Losses at random, in bursts: a law fitted to the intervals between arrivals.
    arrivals = np.flatnonzero(arrived)
    intervals = np.diff(arrivals)
    if not len(intervals):
        return None
    law = BurstLossLaw.fit_to_intervals(intervals)
    least, found = np.log(CHANCE), None
    for length in range(2, min(LONGEST, len(arrived) // 2) + 1):
        pattern = np.bincount(arrivals % length, minlength=length) > 0
        if pattern.all():
            continue
        # log of the number of patterns: any set of as many rows, and any length, would have been taken. Weights
        # 1 / (length (length - 1)) of lengths add up to 1.
        log_patterns = log(comb(length, int(pattern.sum()))) + log(length * (length - 1))
        # Independent losses leave all n arrivals in d of `length` rows with probability (d / length)^n: if that is no
        # less than the least, bursts need not be looked at.
        if length > SHORT and len(arrivals) * log(length / pattern.sum()) < log_patterns - least:
            continue
        chance = _bound_log_chance(pattern, law, len(intervals)) + log_patterns
        if chance < least:
            least, found = chance, pattern
    return found


class BurstLossLaw(NamedTuple):
    """Law of the intervals between arrivals where losses come in bursts.

    Losses in bursts (a Markov chain of two states; those independent of each other are a case of it) make intervals
    between arrivals independent: 1 with probability `follows`, else k > 1 with (1 - follows) ends (1 - ends)^(k - 2).
    """

    follows: float
    ends: float

    @staticmethod
    def fit_to_intervals(intervals: Int[np.ndarray, " arrivals"]) -> "BurstLossLaw":
        """Return the law of greatest likelihood for these intervals between arrivals, in rows.

        `follows` is the share of arrivals that are in the row after an arrival (intervals of 1), and `ends` the share
        of losses that end a burst. An interval of k > 1 has k - 1 losses, and the last of them ends the burst.
        """
        losses = intervals[intervals > 1] - 1
        return BurstLossLaw(
            follows=1 - len(losses) / max(len(intervals), 1),
            ends=len(losses) / losses.sum() if len(losses) else 1.0,
        )

    def log_chance_within(self, due: Bool[np.ndarray, " rows"], count: int) -> float:
        """Return an upper bound of the log probability that the `count` arrivals after a first one are all in due rows.

        stay(r) = E[z^(number of later arrivals) 1{all in due rows}] given an arrival in row r. By Chernoff's bound the
        probability is at most stay(first) / z^count for any z > 0; the least of several z counts. With due(r) 0 or 1,
        stay(r) = z (follows due(r + 1) stay(r + 1) + (1 - follows) later(r)), where `follows` is the probability of an
        arrival in the next row; later(r) = ends due(r + 2) stay(r + 2) + (1 - ends) later(r + 1), where `ends` is the
        probability that a burst of losses ends. Both are 1 after the last row. `_log_mean_of_powers` computes
        log(stay(first) / z^count) for one z.
        """
        # z = share^-exponent with the share of due rows, which is at least 1 / n, so that z is finite.
        share = max(float(np.mean(due)), 1 / len(due))
        return min(self._log_mean_of_powers(due, -exponent * log(share), count) for exponent in (0.0, 0.5, 1.0))

    def _log_mean_of_powers(self, due: Bool[np.ndarray, " rows"], log_z: float, count: int) -> float:
        """Return log(stay(first) / z^count), computed backward over the rows r, first the last but one.

        stay(r) = z (follows due(r + 1) stay(r + 1) + (1 - follows) later(r)) and
        later(r) = ends due(r + 2) stay(r + 2) + (1 - ends) later(r + 1). Given an arrival in row r, stay(r) is
        E[z^(number of later arrivals) 1{all in due rows}]. All numbers are divided by exp(log_scale), to be near 1.
        """
        z, log_scale = exp(log_z), 0.0
        # due(r + 1) stay(r + 1), due(r + 2) stay(r + 2) and later(r + 1).
        stay_1, stay_2, later = 1.0, 1.0, 1.0
        for is_due in due[-2::-1].tolist():
            later = self.ends * stay_2 + (1 - self.ends) * later
            stay = z * (self.follows * stay_1 + (1 - self.follows) * later)
            stay_1, stay_2 = stay if is_due else 0.0, stay_1
            scale = max(stay_1, stay_2, later)
            if not 1e-100 < scale < 1e100:
                if scale == 0:
                    return -np.inf
                log_scale += log(scale)
                stay = stay / scale
                stay_1 = stay_1 / scale
                stay_2 = stay_2 / scale
                later = later / scale
        return log_scale + (log(stay) if stay > 0 else -np.inf) - count * log_z


def _bound_log_chance(pattern: Bool[np.ndarray, " length"], law: BurstLossLaw, count: int) -> float:
    """Return an upper bound of the log probability that losses in bursts let nothing arrive outside these rows.

    The row of an arrival, modulo the pattern's length, is a Markov chain. The probability that N moves all end in
    `pattern` is at most the largest row sum of M^N, where M holds the probabilities of moves between these rows.

    Args:
        pattern: which rows of the pattern are due.
        law: the distribution of the intervals between arrivals.
        count: N, how many intervals were seen.
    """
    length = len(pattern)
    # P(interval = 1) = follows, and P(interval = k) = (1 - follows) ends (1 - ends)^(k - 2) for k = 2, 3, ... The
    # intervals k, k + length, ... are the same move, whose probability is a geometric series of (1 - ends)^length.
    interval = np.arange(2, length + 2)
    move_probabilities: Float[np.ndarray, " length"] = np.zeros(length)
    series = 1 / (1 - (1 - law.ends) ** length)
    move_probabilities[interval % length] = (1 - law.follows) * law.ends * (1 - law.ends) ** (interval - 2) * series
    move_probabilities[1 % length] += law.follows
    due_rows = np.flatnonzero(pattern)
    moves = (due_rows[None, :] - due_rows[:, None]) % length  # from each due row to each
    return _compute_log_row_sum(move_probabilities[moves], count)


def _compute_log_row_sum(matrix: Float[np.ndarray, "n n"], exponent: int) -> float:
    """Return the logarithm of the largest row sum of M^exponent, by repeated squaring, scaled against underflow.

    `sums` exp(logarithm) are the row sums of the powers taken so far, and `matrix` exp(scale) is M^(2^k).
    """
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
