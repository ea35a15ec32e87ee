"""Rows in which a message was due: patterns that return are told from losses, and losses are never called a pattern."""

import numpy as np
import pytest

from heliograph.report.diagnosis.arrivals import Arrivals

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


@pytest.mark.slow
@pytest.mark.parametrize("count", [150, 3000])
def test_losses_at_random_are_neither_pattern_nor_rate(count):
    """Independent ones and bursts of any length, in 20 to 1,000 rows, each with a chance of 1e-4: none of 300; of 6,000
    at most 4, where Poisson's law of mean .6 has more with a chance of 4e-4."""
    found, rng = 0, np.random.default_rng(count)
    for _ in range(count):
        rows = int(np.exp(rng.uniform(np.log(20), np.log(1000))))
        independent = rng.random(rows) < rng.uniform(0.02, 0.99)
        for came in (independent, bursts(rows, *rng.uniform(0.01, 1, 2), rng)):
            link = arrivals(came)
            found += link.pattern is not None or link.rate is not None
    assert found <= (0 if count == 150 else 4)


def test_a_long_pattern_is_found_too():
    """Due in the first fifth of each 100 rows; of 5,000 rows."""
    due = np.resize(np.arange(100) < 20, 5000)
    link = arrivals(due & (RNG.random(5000) >= 0.05))
    assert link.due_in == "1 of 5 rows" or link.due == due.sum()


@pytest.mark.parametrize("period", [1.0517, 1.3337, np.e, 3.337, 40.3])
@pytest.mark.parametrize("lost", [0.0, 0.05])
def test_a_sender_whose_clock_is_not_that_of_the_rows_loses_what_it_loses(period, lost):
    """Its messages stand in the row that follows; of 5,000 rows."""
    due = np.zeros(5000, dtype=bool)
    due[np.floor(0.3 + period * np.arange(4998 / period)).astype(int)] = True
    came = due & (RNG.random(5000) >= lost)
    link = arrivals(came)
    assert link.rate is not None and link.period == pytest.approx(period, rel=1e-3)
    assert abs(link.due - due.sum()) <= 2 and link.share == pytest.approx(came.sum() / due.sum(), abs=0.003)
    assert np.all(np.diff(link.numbers) >= 1)


@pytest.mark.parametrize(("period", "rows"), [(1.00705, 3000), (1.0011, 20_000)])
def test_a_sender_hardly_slower_than_the_rows_loses_nothing(period, rows):
    """One row in 143 is empty, and one in 910."""
    came = np.zeros(rows, dtype=bool)
    came[np.floor(period * np.arange((rows - 1) / period)).astype(int)] = True
    link = arrivals(came)
    assert link.period == pytest.approx(period, rel=1e-5) and link.longest_gap == 0


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
    assert link.due_in == "not known" and link.due is None and not len(link.lost_times)


@pytest.mark.parametrize("dated", [False, True])
def test_what_a_slow_sender_lost_is_drawn_when_it_was_due(dated):
    """One each 0.5 among rows each 0.1: the lost ones lie between the others, and one behind the last."""
    time = np.arange(100) / 10
    came = np.zeros(100, dtype=bool)
    came[3::5] = True
    came[[23, 28, 98]] = False
    times = np.datetime64("2026-01-01T00:00:00", "ns") + (time * 1e9).astype("timedelta64[ns]") if dated else time
    link = Arrivals("a", "y", times, came, np.zeros(came.sum()), True, of_messages=True)
    lost = link.lost_times
    lost = (lost - times[0]) / np.timedelta64(1, "s") if dated else lost
    np.testing.assert_allclose(lost, [2.3, 2.8], atol=1e-6)  # the last interval is not over: less than a quarter late
