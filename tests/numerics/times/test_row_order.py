"""Times that fall out of the order of the others."""

from itertools import combinations

import numpy as np
import pytest

from heliograph.numerics.times.row_order import find_astray, find_out_of_order


@pytest.mark.parametrize("seed", range(20))
def test_the_fewest_rows_are_out_of_order(seed):
    """Against all subsets of eight rows."""
    time = np.random.default_rng(seed).integers(0, 8, 8)
    out = find_out_of_order(time)
    assert np.all(np.diff(time[~out]) >= 0)
    longest = max(
        size for size in range(1, 9) for rows in combinations(time, size) if all(np.diff(np.array(rows)) >= 0)
    )
    assert np.sum(~out) == longest


def test_of_equally_few_rows_the_later_ones_are_out_of_order():
    assert find_out_of_order(np.array([0, 1, 2, 1.5, 3])).tolist() == [False, False, False, True, False]
    assert not find_out_of_order(np.array([0, 0, 1, 1])).any()


def test_a_number_of_seconds_that_leaps_for_more_than_a_year_and_back_is_astray():
    year = 365 * 86400.0
    assert find_astray(np.array([0, 1, 3e8, 2, 3]), year).tolist() == [False, False, True, False, False]
    assert not find_astray(np.array([0, 1, 3e8, 3e8 + 1, 3e8 + 2]), year).any()
