"""Complex baseband as pairs: phases that are left, and what a sum of such links has for gains."""

import numpy as np
import pytest

import heliograph as hg


def link(deviation, scale=0.8):
    real = hg.random_affine.known([[1.0], [0.0]])
    fading = hg.hop(hg.Rayleigh(scale), 0.0, dimension=2)
    return hg.random_affine.Series([real, fading, hg.random_affine.Rotation(deviation)])


def test_a_phase_error_shortens_the_mean_and_turns_power_away():
    """E cos = exp(-s^2 / 2), E cos^2 = (1 + exp(-2 s^2)) / 2, E sin^2 the rest."""
    s, power = 0.4, 2 * 0.8**2
    moments = link(s).moments(2)
    np.testing.assert_allclose(moments.mean[:2, 0], [0.8 * np.sqrt(np.pi / 2) * np.exp(-(s**2) / 2), 0], atol=1e-15)
    real, mixed, imaginary = (moments.matrix[row, 0] for row in (0, 1, 3))
    assert real == pytest.approx(power * (1 + np.exp(-2 * s**2)) / 2, rel=1e-14)
    assert imaginary == pytest.approx(power * (1 - np.exp(-2 * s**2)) / 2, rel=1e-13)
    assert mixed == pytest.approx(0.0, abs=1e-15)


def test_phases_that_nobody_compensates_leave_no_mean():
    channel = hg.superposed([link(10.0), link(10.0)], 0.05 * np.eye(2))
    described = hg.random_affine.second_order(channel)
    np.testing.assert_allclose(described.mean_gain, 0.0, atol=1e-15)
    # Each part of the power of a gain lies in one direction.
    np.testing.assert_allclose(np.diagonal(described.spread.center[0, 0]), [0.64, 0.64, 0.05], rtol=1e-12)


def test_a_rotation_turns_by_the_drawn_angle():
    """Powers of w = a + i b: E[w^4] = w^4 exp(-8 s^2), |w|^4 stays."""
    s, (a, b) = 0.3, (0.7, -0.4)
    moments = hg.random_affine.Rotation(s).moments(4)
    from heliograph.random_affine.moments import evaluate_monomials, list_exponents

    expected = dict(zip(list_exponents(3, 4), moments.expect(evaluate_monomials(np.array([a, b]), 4)), strict=True))
    fourth = expected[4, 0, 0] - 6 * expected[2, 2, 0] + expected[0, 4, 0]
    assert fourth == pytest.approx(((a + 1j * b) ** 4).real * np.exp(-8 * s**2), rel=1e-12)
    size = expected[4, 0, 0] + 2 * expected[2, 2, 0] + expected[0, 4, 0]
    assert size == pytest.approx((a**2 + b**2) ** 2, rel=1e-12)


def test_a_negative_deviation_is_refused():
    with pytest.raises(ValueError, match="deviation of a phase"):
        hg.random_affine.Rotation(-0.1)
