"""Which sensors, when, and how seldom: small cases by enumeration, and bounds below all of them."""

from itertools import combinations, product

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics.check import InputError
from heliograph.planning import Error, independent_paths, split_power
from heliograph_studies.network_design.theory import best_schedule, burst_sending, choose_sensors, relay_map
from heliograph_studies.network_design.theory.schedules import necklaces
from tests.planning.example import direct_paths, error_at, relayed_paths

PATHS = direct_paths()


def test_choices_are_the_best_by_enumeration():
    result = choose_sensors(PATHS, 3, 6.0)
    errors = {chosen: error_at(PATHS, [6.0 * (i in chosen) for i in range(6)]) for chosen in combinations(range(6), 3)}
    assert result.chosen == min(errors, key=errors.get) and result.exact
    assert result.error == pytest.approx(min(errors.values()), rel=1e-10)
    assert 0.6275 < result.bound < result.error
    assert choose_sensors(PATHS, 6, 6.0).bound == pytest.approx(error_at(PATHS, np.full(6, 6.0)), rel=1e-11)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_search_finds_here_what_enumeration_does(count):
    searched, result = choose_sensors(PATHS, count, 6.0, compared=0), choose_sensors(PATHS, count, 6.0)
    assert searched.chosen == result.chosen and not searched.exact and "nothing can be better" in searched.words


def test_schedules_of_periods_one_to_four_have_the_printed_errors():
    result = best_schedule(PATHS, 6.0, range(1, 5))
    assert [round(result.by_period[k], 3) for k in range(1, 5)] == [1.167, 1.043, 1.006, 1.012]
    assert (round(result.bound, 3), round(result.greedy, 3)) == (0.972, 1.024)
    assert result.exact == (1, 2, 3, 4) and len(result.steps) == 3


def test_a_search_of_schedules_stays_above_the_bound():
    exact, searched = best_schedule(PATHS, 6.0, [1, 3]), best_schedule(PATHS, 6.0, [1, 3], compared=1)
    assert exact.bound < exact.error <= searched.error and searched.exact == ()
    two = best_schedule(PATHS, 6.0, [1, 2], at_once=2)
    assert two.bound < two.error < exact.error and all(len(step) == 2 for step in two.steps)


@pytest.mark.parametrize(("letters", "length"), [(2, 6), (3, 4), (6, 2)])
def test_necklaces_stand_for_all_words(letters, length):
    result = set(necklaces(letters, length))
    rotations = {min(word[i:] + word[:i] for i in range(length)) for word in product(range(letters), repeat=length)}
    assert result == rotations


def test_bursts_beat_steady_sending_over_two_hops():
    far = independent_paths([[0.99]], [[0.02]], [[1.0]], [0.2], 1.0, [[2.0, 2.0]])
    result = burst_sending(far, split_power([2.0, 2.0], 1.0), range(1, 11))
    assert (result.every, round(result.errors[1], 4), round(result.error, 4)) == (8, 0.5235, 0.4026)
    assert result.bound < result.error and "23.1 % below" in result.words
    assert burst_sending(far, [0.5, 0.5], [1, 2, 4, 8], peak=2.0).every == 4
    assert burst_sending(far, [50.0, 50.0], [1, 2]).every == 1  # not at high power


def test_bursts_never_help_over_one_hop():
    result = burst_sending(PATHS, np.ravel(list(hg.design(PATHS, budget=2.0).powers.values())), [1, 2, 3])
    assert result.every == 1 and result.bound == pytest.approx(result.error, rel=1e-8)
    assert list(result.errors.values()) == sorted(result.errors.values())


def test_what_cannot_be_is_refused():
    with pytest.raises(InputError, match="sensors to choose: expected at most the 6 there are, got 7"):
        choose_sensors(PATHS, 7, 1.0)
    with pytest.raises(InputError, match="powers: expected one number or one for each of 12 hops"):
        choose_sensors(relayed_paths(), 2, [1.0, 2.0])
    with pytest.raises(InputError, match="paths to choose from: expected steady ones"):
        best_schedule(direct_paths(Error(period=2)), 1.0)
    with pytest.raises(InputError, match="periods: expected at least one"):
        best_schedule(PATHS, 1.0, [])
    with pytest.raises(InputError, match=r"steps between bursts: expected some of at most 0\.5"):
        burst_sending(PATHS, 1.0, peak=0.5)


def test_what_is_no_problem_is_named():
    with pytest.raises(ValueError, match="paths: expected Paths"):
        choose_sensors(3, 1, powers=1.0)
    with pytest.raises(ValueError, match="powers: expected finite numbers of at least zero"):
        choose_sensors(PATHS, 1, powers=-1.0)
    with pytest.raises(ValueError, match="scene: expected a RelayScene, got 3"):
        relay_map(3, 1.0, [0.0], [0.0])
