"""Best powers of paths of one hop: the semidefinite programme finds what `hg.design` does, and bounds it."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics.check import InputError
from heliograph.planning import Budget, Error, independent_paths
from heliograph_studies.network_design.theory import semidefinite_design
from tests.planning.example import direct_paths, paths_in_two_units, random_paths, relayed_paths, steady


@pytest.mark.parametrize("seed", range(3))
def test_programme_and_design_agree(seed):
    paths, total = random_paths(seed), 2.0 + seed
    result, programme = hg.design(paths, budget=total), semidefinite_design(paths, total)
    assert result.error == pytest.approx(programme.error, rel=1e-7)  # the solver's accuracy
    for bound in (result.bound, programme.bound):
        assert bound <= min(result.error, programme.error)


@pytest.mark.parametrize(
    ("error", "budget"),
    [
        (Error(period=3), Budget(3.0, peak=2.0)),
        (Error(horizon=4), Budget(2.0, per_transmitter=0.6, peak=1.5)),
        (Error(horizon=4, at_end=True), Budget(2.0, peak=1.5)),
        (Error({"x0": 1.0}), Budget(3.0, per_transmitter=1.0)),
    ],
    ids=["period", "horizon", "end", "one state"],
)
def test_programme_and_design_agree_over_time(error, budget):
    paths = random_paths(5, error=error, unstable=error.horizon is not None)
    result, programme = hg.design(paths, error=error, budget=budget), semidefinite_design(paths, budget, error)
    assert result.error == pytest.approx(programme.error, rel=1e-7)


def test_the_worst_direction_is_bounded_by_its_dual():
    paths, error = random_paths(7), Error(worst=True)
    result = semidefinite_design(paths, 3.0, error)
    assert result.bound <= result.error <= result.bound * (1 + 1e-6)
    assert result.error == pytest.approx(np.linalg.eigvalsh(steady(paths, result.powers[0]))[-1], rel=1e-9)
    least = semidefinite_design(paths, error=error, target_error=result.error)
    assert least.total == pytest.approx(3.0, rel=1e-6)
    assert least.bound <= 3.0 * (1 + 1e-9)
    # the descent smooths the largest eigenvalue: above the programme, and by no more than that leaves
    assert result.bound <= hg.design(paths, error=error, budget=3.0).error <= result.error * (1 + 4e-5)


def test_powers_in_other_units_and_least_power_are_the_same():
    paths = direct_paths()
    louder = paths._replace(alpha=1e6 * paths.alpha)
    assert semidefinite_design(louder, 2e6).error == pytest.approx(hg.design(paths, budget=2.0).error, rel=1e-7)
    least = hg.design(paths, target_error=0.6).total
    assert semidefinite_design(paths, target_error=0.6).total == pytest.approx(least, rel=1e-6)


def test_a_sensor_without_noise_and_a_hop_that_is_free():
    paths = independent_paths([[0.9]], [[0.3]], np.ones((3, 1)), [0.0, 0.1, 0.2], [1.0, 1.0, 1.1], [1.0, 2.0, 0.0])
    result, programme = hg.design(paths, budget=1.0), semidefinite_design(paths, 1.0)
    assert result.error == pytest.approx(programme.error, rel=1e-7) and result.bound <= programme.error


@pytest.mark.parametrize("seed", range(4))
def test_states_in_very_different_units_are_the_same_design(seed):
    """Units over eight decades, process noise of rank one: the optimum and its bound do not mind."""
    plain, scaled, units = paths_in_two_units(seed)
    for worst in (False, True):
        error = Error(np.diag(units**-2.0), worst=worst)
        result, again = semidefinite_design(plain, 2.0, Error(worst=worst)), semidefinite_design(scaled, 2.0, error)
        assert again.error == pytest.approx(result.error, rel=1e-6)  # the solver's accuracy
        assert again.bound <= again.error <= again.bound * (1 + 1e-5)


def test_several_hops_are_refused():
    with pytest.raises(InputError, match="semidefinite programme: expected one hop each, got 12 hops of 6 paths"):
        semidefinite_design(relayed_paths(), 1.0)
