import numpy as np
import pytest

import heliograph as hg


def listed(fates):
    return [part.tolist() for part in fates]


def test_gaps_are_losses_copies_are_dropped_and_restarts_begin_anew():
    result = hg.learning.fates_of_sequence([4, 5, 5, 8, 300, 302, 301 - 300, 2])
    assert listed(result) == [[0, 0, 1, 1, 0], [0, 1, 0], [0, 0]]


def test_a_leap_of_just_under_the_limit_is_a_long_outage():
    assert sum(hg.learning.fates_of_sequence([0, 199])[0]) == 198
    assert listed(hg.learning.fates_of_sequence([0, 200])) == [[0], [0]]
    assert listed(hg.learning.fates_of_sequence([0, 5], jump=5)) == [[0], [0]]


def test_times_of_sending_put_overtaken_packets_in_order():
    numbers, sent = [5, 7, 6, 6, 9, 0, 2], [0.0, 2.0, 1.0, 1.0, 4.0, 5.0, 7.0]
    assert listed(hg.learning.fates_of_sequence(numbers, sent)) == [[0, 0, 0, 1, 0], [0, 1, 0]]
    assert len(hg.learning.fates_of_sequence(numbers)) == 3  # without them one looks like a restart


def test_each_sender_counts_for_itself():
    result = hg.learning.fates_by_node(["a", "b", "a", "b"], [1, 10, 3, 11])
    assert {name: listed(part) for name, part in result.items()} == {"a": [[0, 1, 0]], "b": [[0, 0]]}


def test_a_hop_is_judged_by_what_reached_it():
    result = hg.learning.fates_by_hop({"up": [1, 1, 0, 1], "down": [1, 0, 0, 1]})
    assert listed(result["up"]) == [[0, 0, 1, 0]]
    np.testing.assert_equal(result["down"][0], [0, 1, np.nan, 0])
    with pytest.raises(ValueError, match="arrivals behind 'down': expected packets that passed the hop before"):
        hg.learning.fates_by_hop({"up": [0, 1], "down": [1, 1]})


def test_components_that_come_together_are_one_packet():
    nan = np.nan
    result = hg.learning.fates_of_measurements({
        "near": [[1.0, 2.0], [nan, nan]], "far": [[1.0, nan, nan], [2.0, 3.0, nan]], "one": [nan, 1.0],
    })  # fmt: skip
    assert {name: listed(part) for name, part in result.items()} == {
        "near": [[0, 1]], "far.0": [[0, 0]], "far.1": [[1, 0]], "one": [[1, 0]],
    }  # fmt: skip


@pytest.mark.parametrize("numbers", [[], [1.5]])
def test_numbers_must_be_whole(numbers):
    with pytest.raises(ValueError, match="sequence numbers: expected whole numbers, at least one"):
        hg.learning.fates_of_sequence(numbers)


@pytest.mark.parametrize("fates", [[0.5], [[0.0], [2.0]], [np.nan], []])
def test_fates_are_checked(fates):
    with pytest.raises(ValueError, match="fates: expected"):
        hg.learning.learn_losses(fates)
