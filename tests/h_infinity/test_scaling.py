"""Designs in any units: the levels of the Riccati form, whatever states, outputs and disturbances are measured in."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.h_infinity import certify_level, horizon_design, known_channel_design, recursive_design

TURN = 0.95 * np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])


def system(initial, states=(1.0, 1.0), target=1.0, output=1.0, received=1.0):
    """A rotation, with every quantity in units of its own."""
    s = np.array(states)
    return hg.h_infinity.growth_system(
        6,
        s[:, None] * np.array([[0.2, 0.0], [0.0, 0.1]]),
        output * np.array([[0.0, 0.3]]),
        target * np.eye(2) / s,
        hg.hop(received / output, 0.04 * received**2),
        0.0,
        transition=s[:, None] * TURN / s,
        output=output * np.array([[1.0, 0.5]]) / s,
        initial_weight=initial * np.diag(np.tile(1 / s**2, 2)),
    )


def riccati_level(of):
    low, high = 1e-6, 1e6
    while high / low > 1 + 1e-7:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if known_channel_design(of, middle).feasible else (middle, high)
    return high


UNITS = {
    "plain": ((1.0, 1.0), 1.0, 1.0, 1.0),
    "each state its own": ((1e6, 1e-6), 1.0, 1e3, 1.0),
    "large states": ((1e6, 1e6), 1e-6, 1e-6, 1e6),
    "small states": ((1e-6, 1e-6), 1e3, 1e6, 1e-3),
}


@pytest.mark.slow
@pytest.mark.parametrize("initial", [5.0, 1e-6, 1e6])
def test_smallest_levels_are_the_riccati_forms_in_any_units(initial):
    """The margin of every inequality, 1e-7 of the level squared, and the solver's 1e-8 leave 1e-5."""
    expected = riccati_level(system(initial))
    for units in UNITS.values():
        scaled = system(initial, *units)
        design = horizon_design(scaled)
        np.testing.assert_allclose(design.level / units[1], expected, rtol=1e-5)
        result = certify_level(scaled, design.gains, design.weights, design.multipliers, design.level)
        assert result.certified and result.margin > 0
        step_by_step = recursive_design(scaled, 2 * design.level, search=False)
        assert step_by_step.feasible
        parts = step_by_step.gains, step_by_step.weights, step_by_step.multipliers, step_by_step.level
        assert certify_level(scaled, *parts).certified


def test_an_uninformative_start_needs_no_more_than_the_riccati_form_proves():
    of = hg.h_infinity.growth_system(
        10, [[1.0]], [[1.0]], [[1.0]], hg.hop(1.0, 0.01), 0.0, transition=[[0.5]], output=[[1.0]], initial_weight=1e-6
    )
    np.testing.assert_allclose(horizon_design(of).level, riccati_level(of), rtol=1e-5)


@pytest.mark.parametrize("size", [1e-6, 1e3, 1e6])
def test_a_system_known_by_growth_alone(size):
    def design(s):
        of = hg.h_infinity.growth_system(
            6, s * np.array([[0.05], [0.1]]), [[0.2]], np.eye(2) / s, hg.hop(hg.random_affine.bernoulli(0.8), 0.01),
            0.7, 0.0, output=np.array([[1.0, 0.5]]) / s, initial_weight=5.0 / s**2,
        )  # fmt: skip
        outcome = horizon_design(of)
        assert certify_level(of, outcome.gains, outcome.weights, outcome.multipliers, outcome.level).certified
        return outcome.level

    np.testing.assert_allclose(design(size), design(1.0), rtol=1e-4)


def test_the_start_is_the_largest_allowed_also_where_x_and_e_are_weighed_together():
    weight = np.array([[5.0, 3.0], [3.0, 4.0]])
    of = hg.h_infinity.growth_system(
        4, [[0.2]], [[0.1]], [[1.0]], hg.hop(1.0, 0.04), 0.0, transition=[[0.9]], output=[[1.0]], initial_weight=weight
    )
    design = horizon_design(of)
    np.testing.assert_allclose(design.weights[0], design.level**2 * weight, rtol=1e-6)
    parts = design.gains, design.weights, design.multipliers, design.level
    assert certify_level(of, *parts).certified
    recursive = recursive_design(of, 1.2 * design.level, search=False)
    np.testing.assert_allclose(recursive.weights[0], recursive.level**2 * weight, rtol=1e-6)
    assert certify_level(of, recursive.gains, recursive.weights, recursive.multipliers, recursive.level).certified


def test_noise_counts_in_the_units_of_each_output():
    """The noise of an output in units 1e8 times larger is none to the rounding of the others."""

    def measured_in(unit):
        link = hg.hop(1.0, np.diag([1.0, 0.04 * unit**2]))
        output, transition = np.diag([1.0, unit]), 0.9 * np.eye(2)
        given = {"transition": transition, "output": output, "initial_weight": 100.0}
        return hg.h_infinity.growth_system(5, [[0.1], [0.2]], np.zeros((2, 1)), np.eye(2), link, 0.0, **given)

    plain, fine = horizon_design(measured_in(1.0)), horizon_design(measured_in(1e-8))
    assert fine.level == pytest.approx(plain.level, rel=1e-5)  # the solver's
    unknown = certify_level(measured_in(1e-8), fine.gains, fine.weights, fine.multipliers, 0.9 * fine.level)
    assert not unknown.certified
