import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from heliograph.filters.gaussian.moment_transforms import Cubature, Linearization, PolynomialMoments
from heliograph.numerics import continue_angles, wrap_angles, wrap_near

TURN = 2 * np.pi
ANGLE = st.floats(-1e3, 1e3)


@given(ANGLE, ANGLE)
def test_the_same_angle_within_half_a_turn(value, reference):
    result = wrap_near(np.array([value, value]), np.array([reference, reference]), (1,))
    assert result[0] == value  # no angle, no change
    assert abs(result[1] - reference) <= TURN / 2 * (1 + 1e-9)
    turns = (result[1] - value) / TURN
    assert abs(turns - round(turns)) < 1e-9  # 1e3 radians know a turn to 1e-13


def test_what_is_in_range_keeps_every_bit_and_what_is_missing_stays_missing():
    x = np.array([3.14, -3.14, np.nan, 0.1])
    np.testing.assert_array_equal(wrap_angles(x, (0, 1, 2, 3)), x)
    np.testing.assert_array_equal(wrap_near(np.array([7.0]), np.array([np.nan]), (0,)), [7.0])


def test_names_are_checked():
    def angles(circular):
        return hg.LinearPlant(np.eye(2), 0.1, [0.0, 0.0], 1.0, states=["a", "b"], circular=circular).angles

    assert angles(["b"]) == (1,)
    for wrong in (["c"], ["a", "a"], "a"):
        with pytest.raises(ValueError, match="circular states: expected"):
            angles(wrong)


def heading(x: jax.Array) -> jax.Array:
    """A turn by 3 from a heading, given between -pi and pi."""
    y = x[0] + 3.0 + 0.1 * x[1]
    return jnp.stack([jnp.arctan2(jnp.sin(y), jnp.cos(y)), x[1]])


@pytest.mark.slow
@pytest.mark.parametrize("rule", [Cubature(), Linearization(), PolynomialMoments(2), PolynomialMoments(1)])
@pytest.mark.parametrize("deviation", [0.1, 3.0, 30.0])
def test_an_angle_that_follows_another_has_exact_moments_however_wide(rule, deviation):
    """But for the jumps the function is affine, and moments of affine functions are exact."""
    covariance = np.array([[deviation**2, 0.1 * deviation], [0.1 * deviation, 0.5]])
    slope = np.array([[1.0, 0.1], [0.0, 1.0]])
    with jax.enable_x64(True):
        mean = jnp.array([0.2, 0.3])
        result = rule.apply(continue_angles(heading, mean, (0,), (0,)), mean, jnp.asarray(covariance))
    near = wrap_near(np.asarray(result.mean), np.array([3.23, 0.3]), (0,))
    np.testing.assert_allclose(near, [3.23, 0.3], rtol=0, atol=1e-10)
    # 1e-9: points at 1e2 radians, of which turns are taken off
    np.testing.assert_allclose(result.covariance, slope @ covariance @ slope.T, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(result.cross, covariance @ slope.T, rtol=1e-9, atol=1e-9)


def test_a_bearing_across_the_cut_is_the_one_away_from_it_turned():
    def bearing(x):
        return jnp.stack([jnp.arctan2(x[1], x[0])])

    @jax.jit
    def image(mean):
        return Cubature().apply(continue_angles(bearing, mean, (), (0,)), mean, jnp.diag(jnp.array([1.0, 4.0])))

    with jax.enable_x64(True):
        east, west = (image(np.array(mean)) for mean in ([10.0, 0.5], [-10.0, -0.5]))
    turned = np.asarray(west.mean) - np.asarray(east.mean)
    np.testing.assert_allclose(wrap_angles(turned - np.pi, (0,)), 0.0, atol=1e-12)
    np.testing.assert_allclose(west.covariance, east.covariance, rtol=1e-12)
    np.testing.assert_allclose(west.cross, -np.asarray(east.cross), rtol=1e-12, atol=1e-15)
