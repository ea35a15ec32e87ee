"""Rows in which a message was due: patterns that return are told from losses, and losses are never called a pattern."""

import numpy as np
import pytest

from heliograph.report.arrivals import Arrivals

RNG = np.random.default_rng(0)


def arrivals(came, **how):
    return Arrivals("a", "y", np.arange(float(len(came))), came, np.zeros(came.sum()), True, **how)


def bursts(rows, begins, ends, rng):
    """Losses in bursts, as of a Markov chain: whether a message arrived in each row."""
    came, last = np.empty(rows, dtype=bool), True
    for k, chance in enumerate(rng.random(rows)):
        last = chance >= begins if last else chance < ends
        came[k] = last
    return came


@pytest.mark.parametrize("pattern", ["1110", "110", "10100", "11100", "1110101", "11010010"])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_rows_that_a_pattern_leaves_out_are_not_lost(pattern, lost):
    """Of 1,000 rows; of what is due a fifth is lost, or nothing."""
    due = np.resize([c == "1" for c in pattern], 1000)
    came = due & (RNG.random(1000) >= lost)
    link = arrivals(came)
    assert link.due_in == f"{pattern.count('1')} of {len(pattern)} rows"
    assert link.due == due.sum() and link.share == came.sum() / due.sum()
    first = np.argmax(came)
    np.testing.assert_array_equal(link.numbers, (np.cumsum(due) - np.cumsum(due)[first])[came])
    assert (link.longest_gap == 0) == (lost == 0)


def test_forty_rows_without_a_loss_are_enough():
    assert arrivals(np.resize([True, True, True, False], 40)).due_in == "3 of 4 rows"


def test_losses_at_random_are_no_pattern():
    """Independent ones and bursts of any length, in 20 to 1,000 rows: none of 1,500, each with a chance of 1e-4."""
    for _ in range(750):
        rows = int(np.exp(RNG.uniform(np.log(20), np.log(1000))))
        independent = RNG.random(rows) < RNG.uniform(0.02, 0.99)
        for came in (independent, bursts(rows, *RNG.uniform(0.01, 1, 2), RNG)):
            assert arrivals(came).pattern is None


def test_a_pattern_is_judged_against_the_stated_share_by_what_was_due():
    due = np.resize([True, True, True, False], 400)
    assert arrivals(due, stated_share=0.75).contradicts(0.01)  # all arrived that was due
    assert not arrivals(due & (RNG.random(400) < 0.75), stated_share=0.75).contradicts(0.01)


def test_a_sender_slower_than_the_rows_has_a_pattern_too():
    """Each second row, but for the last of each four: due in 300 of 800 rows, of which two in a row are lost."""
    rows = np.arange(800)
    came = (rows % 2 == 0) & (rows % 8 != 6)
    link = arrivals(came & (rows != 320) & (rows != 322))
    assert (link.due_in, link.due, link.longest_gap) == ("3 of 4, each 2", 300, 2)
    assert link.share == 298 / 300


def test_nobody_knows_when_messages_of_others_are_rows():
    came = np.zeros(400, dtype=bool)
    came[np.cumsum(RNG.integers(1, 6, 100))] = True
    link = arrivals(came, of_messages=True)
    assert link.due_in == "not known" and link.due is None and not link.lost_rows.any()
