"""Which sensors, when, and how seldom: small cases by enumeration, and bounds below all of them."""

from itertools import combinations, product

import numpy as np
import pytest
from scipy.optimize import minimize

import heliograph as hg
from heliograph.planning import Error, independent_paths, split_power
from heliograph.planning.multihop_paths.model import compute_path_information
from heliograph_studies.theory.sending import (
    best_schedule,
    burst_sending,
    choose_sensors,
    necklaces,
    steady_error,
)
from tests.planning.example import direct_paths, error_at, relayed_paths

PATHS = direct_paths()


def test_choices_are_the_best_by_enumeration():
    result = choose_sensors(PATHS, 3, 6.0)
    errors = {chosen: error_at(PATHS, [6.0 * (i in chosen) for i in range(6)]) for chosen in combinations(range(6), 3)}
    assert result.chosen == min(errors, key=errors.get)
    assert result.error == pytest.approx(min(errors.values()), rel=1e-10)
    assert 0.6275 < result.bound < result.error
    assert choose_sensors(PATHS, 6, 6.0).bound == pytest.approx(error_at(PATHS, np.full(6, 6.0)), rel=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2, 3])
def test_the_bound_of_a_choice_is_the_least_error_of_shares(count):
    """By a plain descent in the shares, which knows no paths whose powers are shares."""
    information = compute_path_information(PATHS, np.full((1, 6), 6.0)).information
    descent = minimize(
        lambda shares: steady_error(PATHS, shares * information),
        np.full(6, count / 6),
        bounds=[(0.0, 1.0)] * 6,
        constraints={"type": "eq", "fun": lambda shares: shares.sum() - count},
        options={"ftol": 1e-13},
    )
    bound = choose_sensors(PATHS, count, 6.0).bound
    assert bound <= descent.fun * (1 + 1e-14)
    assert bound == pytest.approx(descent.fun, rel=1e-6)  # slopes by differences leave 1e-8 in a share


@pytest.mark.slow
def test_sensors_that_tell_nothing_are_no_worse_than_their_bound():
    """Without power all that is left is the plant's own covariance; a sensor of no row cannot help either."""
    plain = choose_sensors(PATHS, 2, 0.0)
    assert plain.bound == plain.error == pytest.approx(PATHS.signal[0, :3].sum(), rel=1e-10)
    rows, signal = PATHS.rows.copy(), PATHS.signal.copy()
    rows[0, 4], signal[0, 4] = 0.0, 0.0
    blind = choose_sensors(PATHS._replace(rows=rows, signal=signal), 1, 6.0)
    # The sender that is left out is in neither choice: bounds are equal, to the rounding of two programs.
    assert 4 not in blind.chosen and blind.bound >= choose_sensors(PATHS, 1, 6.0).bound * (1 - 1e-12)


def test_schedules_of_periods_one_to_four_have_the_printed_errors():
    result = best_schedule(PATHS, 6.0, range(1, 5))
    assert [round(result.by_period[k], 3) for k in range(1, 5)] == [1.167, 1.043, 1.006, 1.012]
    assert (round(result.bound, 3), round(result.greedy, 3)) == (0.972, 1.024)
    assert len(result.steps) == 3 and result.bound < result.error <= result.greedy


@pytest.mark.parametrize(("letters", "length"), [(2, 6), (3, 4), (6, 2)])
def test_necklaces_stand_for_all_words(letters, length):
    result = set(necklaces(letters, length))
    rotations = {min(word[i:] + word[:i] for i in range(length)) for word in product(range(letters), repeat=length)}
    assert result == rotations


def test_bursts_beat_steady_sending_over_two_hops():
    far = independent_paths([[0.99]], [[0.02]], [[1.0]], [0.2], 1.0, [[2.0, 2.0]])
    result = burst_sending(far, split_power([2.0, 2.0], 1.0), range(1, 11))
    assert (result.every, round(result.errors[1], 4), round(result.error, 4)) == (8, 0.5235, 0.4026)
    assert result.bound < result.error
    assert burst_sending(far, [50.0, 50.0], [1, 2]).every == 1  # not at high power


def test_no_powers_over_time_come_below_the_bound_of_bursts():
    """Three paths of two hops, a period of four, powers and splits drawn at the same mean of each path."""
    paths = independent_paths(
        [[0.95, 0.2], [0.0, 0.9]], 0.1 * np.eye(2), [[1, 0], [0, 1], [1, 1]], [0.2] * 3, 1.02, [[2, 1], [3, 2], [1, 4]]
    )
    mean, draw = np.array([0.6, 0.9, 0.5]), np.random.default_rng(0)
    bound = burst_sending(paths, np.repeat(mean / 2, 2)).bound
    errors = []
    for _ in range(300):
        over_time = 4 * mean * draw.dirichlet(np.full(4, 0.3), 3).T  # (4, 3)
        share = draw.uniform(0.2, 0.8, (4, 3))
        hops = np.stack([over_time * share, over_time * (1 - share)], axis=-1).reshape(4, 6)
        information = np.concatenate([compute_path_information(paths, p[None]).information for p in hops])
        errors.append(steady_error(paths, information))
    assert bound < min(errors) < 1.3 * bound  # or the draws would say little


def test_bursts_never_help_over_one_hop():
    result = burst_sending(PATHS, np.ravel(list(hg.design(PATHS, budget=2.0).powers.values())), [1, 2, 3])
    assert result.every == 1 and result.bound == pytest.approx(result.error, rel=1e-8)
    assert list(result.errors.values()) == sorted(result.errors.values())


def test_what_cannot_be_is_refused():
    with pytest.raises(hg.InputError, match="sensors to choose: expected at most the 6 there are, got 7"):
        choose_sensors(PATHS, 7, 1.0)
    with pytest.raises(hg.InputError, match="powers: expected one number or one for each of 12 hops"):
        choose_sensors(relayed_paths(), 2, [1.0, 2.0])
    with pytest.raises(hg.InputError, match="powers: expected one number or one for each of 6 hops, of at least zero"):
        choose_sensors(PATHS, 1, -1.0)
    with pytest.raises(hg.InputError, match="paths: expected steady ones"):
        best_schedule(direct_paths(Error(period=2)), 1.0)
    with pytest.raises(hg.InputError, match="periods: expected at least one"):
        best_schedule(PATHS, 1.0, [])
    with pytest.raises(hg.InputError, match="steps between bursts: expected at least one"):
        burst_sending(PATHS, 1.0, [])
    with pytest.raises(hg.InputError, match="paths: expected Paths"):
        choose_sensors(3, 1, powers=1.0)
