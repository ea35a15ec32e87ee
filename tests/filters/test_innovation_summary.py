"""Summaries of innovations: counts, intervals that cover, and the output to blame."""

import numpy as np
import pytest

from heliograph.filters import InnovationSummary, Weighed


def drawn(rng, steps, correlation=0.0, weight=None):
    e = rng.standard_normal((steps, 2))
    for k in range(1, steps):
        e[k] = correlation * e[k - 1] + np.sqrt(1 - correlation**2) * e[k]
    return Weighed(e, np.ones((steps, 2)), np.ones((steps, 2)) if weight is None else weight)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_the_interval_of_the_bias_covers_zero(correlation):
    """Of 400 intervals of 95 % at least 93 % cover: three standard errors of the count below; correlated ones too."""
    rng = np.random.default_rng(0)
    summaries = [s for _ in range(200) for s in drawn(rng, 200, correlation).summarise()]
    assert np.mean([s.bias_low <= 0 <= s.bias_high for s in summaries]) > 0.95 - 3 * np.sqrt(0.95 * 0.05 / 400)
    # The mean square of 200 values has a deviation of sqrt(2 / 200), more where they are correlated; over 400 of them.
    assert np.mean([s.squared for s in summaries]) == pytest.approx(1.0, abs=0.05)


def test_missing_values_are_no_values_and_the_line_says_what_was_found():
    weight = np.ones((200, 2))
    weight[::30, 0] = 0.1  # 7 rows, apart
    innovation = drawn(np.random.default_rng(1), 200, weight=weight)
    innovation.value[150:, 1] = np.nan
    first, second = innovation.summarise()
    assert (first.received, first.down_weighted, second.received) == (200, 7, 150)
    assert str(first).startswith("7 of 200 down-weighted (1.7 % to 7 %), bias ")
    assert second.share.low == 0.0 and InnovationSummary.find_outlying((first, second)) == [0]


def test_an_output_that_never_arrived_is_said_to_be_silent():
    innovation = drawn(np.random.default_rng(2), 5)
    innovation.value[:, 1] = np.nan
    _, second = innovation.summarise()
    assert str(second) == "received 0 of 5"
    assert InnovationSummary.find_outlying(innovation.summarise()) == []


def in_runs(rng, shares, length=3, steps=1000):
    """Weights of outputs whose outliers come in runs, as behind a mean over some readings; white innovations."""
    starts = rng.random((steps, len(shares))) < np.array(shares) / length
    down = np.any([np.roll(starts, i, axis=0) for i in range(length)], axis=0)
    return Weighed(rng.standard_normal(down.shape), np.ones(down.shape), np.where(down, 0.1, 1.0))


def test_outliers_in_runs_are_one_event_each():
    """Intervals of the share cover in 95 % at least, counting rows as independent in 75 %; the innocent go free.

    300 recordings of four outputs that are alike: 3 of 100 outputs are named, so that less than 5 (four standard
    errors) are. With three times the outliers one is named in most.
    """
    rng = np.random.default_rng(3)
    alike = [in_runs(rng, [0.05] * 4).summarise() for _ in range(300)]
    assert np.mean([s.share.low <= 0.05 <= s.share.high for part in alike for s in part]) > 0.95
    blamed = [len(InnovationSummary.find_outlying(part)) / 4 for part in alike]
    assert np.mean(blamed) < 0.03 + 4 * np.sqrt(0.03 * 0.97 / 1200)
    guilty = [InnovationSummary.find_outlying(in_runs(rng, [0.15, 0.05, 0.05, 0.05]).summarise()) for _ in range(50)]
    assert np.mean([0 in part for part in guilty]) > 0.9
