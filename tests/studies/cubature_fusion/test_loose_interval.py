"""The bound of equation (11) as printed: the oracle's recursion, where it stands, and that it is a bound."""

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.cubature_fusion.setting import LooseInterval
from tests.filters.gaussian.test_gaussian import SETTINGS
from tests.filters.test_bounds import (
    FIXED,
    check_by_enumeration,
    check_extended,
    check_optimal_scalars,
    check_recursion,
    one_step,
)
from tests.oracles import cubature_fusion as oracle


@pytest.mark.parametrize("name", SETTINGS)
@pytest.mark.parametrize("fixed", [True, False])
def test_it_is_the_oracles_recursion(name, fixed):
    check_recursion(LooseInterval, oracle.printed_terms, name, fixed)


def test_the_extended_filter_takes_it():
    check_extended(LooseInterval(FIXED), oracle.printed_terms)


@pytest.mark.slow
def test_one_step_is_looser_than_the_right_sign():
    printed, tight = (one_step(rule(FIXED))[3] for rule in (LooseInterval, hg.filters.Interval))
    assert np.trace(printed) == pytest.approx(0.082413, abs=6e-7)  # six printed digits
    assert np.linalg.eigvalsh(printed - tight)[0] >= -1e-15


def test_optimal_scalars_beat_every_fixed_pair():
    check_optimal_scalars(LooseInterval)


@pytest.mark.slow
def test_theorem_1_holds_by_enumeration_where_no_mean_is_within_its_radius():
    """With a gain's radius above its mean the printed step fails."""
    check_by_enumeration(LooseInterval, lambda s: all(abs(v @ p) >= np.abs(v) @ r for v, p, r in (s["xi"], s["gamma"])))
