"""Functions of vectors are within 2 units of rounding of the true value, and special values are JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from straightline.vectors.elementary_functions import FUNCTIONS, SCALAR
from tests.straightline.compiled import Compiled

LONG = np.longdouble
SPECIAL = np.array(
    [0.0, -0.0, 1.0, -1.0, 0.5, -0.5, 2.0, -2.0, np.inf, -np.inf, np.nan, 1e308, -1e308, 3e-308, 3.7, -3.7]
)
ROUNDED = np.finfo(LONG).nmant >= 60  # a longer number is there to compare with
WIDE = 10.0 ** np.linspace(-307, 307, 20_001)
NEAR_0 = np.concatenate([10.0 ** np.linspace(-20, 0, 4001), -(10.0 ** np.linspace(-20, 0, 4001))])
NEAR_1 = 1 + NEAR_0 / 10
UNIT = np.linspace(-1, 1, 20_001)
PLAIN = np.linspace(-9, 9, 20_001)
TURNS = np.concatenate(
    [PLAIN, NEAR_0, np.arange(1, 2001) * np.pi / 2, np.linspace(-1.1e6, 1.1e6, 20_001), -WIDE[10_000:]]
)
RANGES = {
    "exp": [np.linspace(-708, 709.7, 20_001), NEAR_0],
    "exp2": [np.linspace(-1021, 1023.9, 20_001), NEAR_0],
    "expm1": [np.linspace(-80, 709.7, 20_001), NEAR_0, UNIT],
    "log": [WIDE, NEAR_1, np.linspace(0.01, 4, 20_001)],
    "log1p": [WIDE, NEAR_0[:4001], -NEAR_0[:4000], UNIT[1:]],
    "tanh": [PLAIN, NEAR_0, 10 * PLAIN],
    "sin": [TURNS],
    "cos": [TURNS],
    "tan": [TURNS],
    "atan": [PLAIN, NEAR_0, WIDE, -WIDE],
    "asin": [UNIT, NEAR_0, np.clip(NEAR_1, -1, 1)],
    "acos": [UNIT, NEAR_0, np.clip(NEAR_1, -1, 1)],
    "erf": [PLAIN, NEAR_0],
    "erfc": [PLAIN, NEAR_0, np.linspace(0, 26.5, 20_001)],
}


@pytest.fixture(scope="module")
def compiled() -> Compiled:
    return Compiled([*FUNCTIONS, *SCALAR])


@pytest.fixture(scope="module")
def of_floats() -> Compiled:
    return Compiled([*FUNCTIONS, *SCALAR], single=True)


def _erf(x: np.ndarray) -> np.ndarray:
    """2 / sqrt(pi) e^(-x^2) sum of 2^n x^(2n+1) / (1 3 ... (2n+1)): all terms of one sign."""
    size = np.minimum(np.abs(x), 6)
    term, total = size.copy(), size.copy()
    for n in range(1, 200):
        term = term * 2 * size * size / (2 * n + 1)
        total = total + term
    return np.sign(x) * 2 / np.sqrt(np.arccos(LONG(-1))) * np.exp(-size * size) * total


def _erfc(x: np.ndarray) -> np.ndarray:
    """1 - erf x; beyond 1.5, the continued fraction e^(-x^2) / sqrt(pi) / (x + (1/2)/(x + 1/(x + (3/2)/(x + ..."""
    size = np.maximum(x, LONG(1.5))
    below = size
    for n in range(600, 0, -1):
        below = size + LONG(n) / 2 / below
    return np.where(x < 1.5, 1 - _erf(x), np.exp(-size * size) / np.sqrt(np.arccos(LONG(-1))) / below)


TRUE = {
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "erf": _erf, "erfc": _erfc,
}  # fmt: skip


def _units(result: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Differences in units of rounding of the true value."""
    return np.abs(result - true) / np.spacing(np.abs(true.astype(float)))


@pytest.mark.skipif(not ROUNDED, reason="this machine has no number longer than a double to compare with")
@pytest.mark.parametrize("name", RANGES)
def test_a_function_is_within_two_units_of_rounding(compiled: Compiled, name: str) -> None:
    for x in RANGES[name]:
        true = TRUE.get(name, getattr(np, name, None))(x.astype(LONG))
        worst = _units(compiled(name, x), true)
        assert worst.max() <= 2, f"{worst.max()} at {x[worst.argmax()]}"


@pytest.mark.skipif(not ROUNDED, reason="this machine has no number longer than a double to compare with")
def test_the_angle_of_a_point_is_within_two_units_of_rounding(compiled: Compiled) -> None:
    draws = np.random.default_rng(1)
    y, x = draws.normal(size=(2, 20_000)) * 10.0 ** draws.integers(-9, 9, (2, 20_000))
    assert _units(compiled("atan2", y, x), np.arctan2(y.astype(LONG), x.astype(LONG))).max() <= 2


@pytest.mark.skipif(not ROUNDED, reason="this machine has no number longer than a double to compare with")
@given(st.lists(st.floats(allow_nan=False, allow_infinity=False), min_size=1, max_size=20))
def test_numbers_of_any_size(compiled: Compiled, numbers: list[float]) -> None:
    x = np.array(numbers)
    for name, domain in (("exp", (-708, 709)), ("log", (2.0**-1022, np.inf)), ("sin", (-1e300, 1e300)),
                         ("atan", (-np.inf, np.inf)), ("expm1", (-np.inf, 709))):  # fmt: skip
        here = x[(x >= domain[0]) & (x <= domain[1]) & ((x == 0) | (abs(x) > 1e-300))]
        if len(here):
            true = TRUE.get(name, getattr(np, name, None))(here.astype(LONG))
            assert _units(compiled(name, here), true).max() <= 2


SMALL = {"exp": (-87.0, 88.7), "exp2": (-126.0, 127.9), "expm1": (-80.0, 88.7), "erfc": (-9.0, 9.0)}


@pytest.mark.parametrize("name", RANGES)
def test_a_function_of_floats_is_within_two_units_of_rounding(of_floats: Compiled, name: str) -> None:
    """Beside the doubles that are right to their last digits."""
    for numbers in RANGES[name]:
        with np.errstate(over="ignore"):
            x = numbers.astype(np.float32)
        low, high = SMALL.get(name, (-np.inf, np.inf))
        x = x[np.isfinite(x) & (x >= low) & (x <= high) & ((x == 0) | (np.abs(x) > 1e-37))]
        with np.errstate(divide="ignore"):
            true = np.asarray(TRUE.get(name, getattr(np, name, None))(x.astype(LONG)), float)
        x, true = x[np.isfinite(true)], true[np.isfinite(true)]  # without log of a number that was rounded to zero
        units = np.abs(of_floats(name, x) - true) / np.spacing(np.abs(true).astype(np.float32))
        assert units.max() <= 2, f"{units.max()} at {x[units.argmax()]}"


def test_the_inverse_of_erf_of_floats_is_that_of_xla(of_floats: Compiled) -> None:
    x = np.concatenate([np.random.default_rng(2).uniform(-1, 1, 300_000), 1 - 10.0 ** np.linspace(-7, -3, 30_000)])
    x = np.clip(x.astype(np.float32), -0.99999994, 0.99999994)
    expected = np.asarray(jax.jit(jax.lax.erf_inv)(x))
    units = np.abs(of_floats("erf_inv", x) - expected) / np.spacing(np.abs(expected))
    # Beyond 0.999 a unit of rounding of the logarithm counts for several of the result.
    assert units[np.abs(x) < 0.999].max() <= 2
    assert units.max() <= 8
    assert np.mean(units == 0) > 0.9


@pytest.mark.parametrize("name", [name for name in (*FUNCTIONS, *SCALAR) if name not in ("atan2", "pow")])
def test_special_values_of_floats_are_those_of_jax(of_floats: Compiled, name: str) -> None:
    with np.errstate(over="ignore"):
        special = SPECIAL.astype(np.float32)
    expected = np.asarray(jax.jit(getattr(jax.lax, name))(special))
    result = of_floats(name, special)
    np.testing.assert_allclose(result, expected, rtol=2e-5, atol=1e-6 if name == "lgamma" else 1e-37)
    zero = (result == 0) & (expected == 0)
    np.testing.assert_array_equal(np.signbit(result[zero]), np.signbit(expected[zero]))


@pytest.mark.parametrize("name", ["atan2", "pow"])
def test_special_pairs_of_floats_are_those_of_jax(of_floats: Compiled, name: str) -> None:
    with np.errstate(over="ignore"):
        y, x = (a.ravel().astype(np.float32) for a in np.meshgrid(SPECIAL, SPECIAL))
    expected = np.asarray(jax.jit(getattr(jnp, {"atan2": "arctan2", "pow": "power"}[name]))(y, x))
    result = of_floats(name, y, x)
    np.testing.assert_allclose(result, expected, rtol=2e-5, atol=1e-37)


def test_denormal_floats(of_floats: Compiled) -> None:
    small = np.array([1e-45, 1e-42, 2e-39, -3e-40], np.float32)
    for name in ("sin", "tan", "atan", "asin", "tanh", "expm1", "log1p"):
        np.testing.assert_array_equal(of_floats(name, small), small)
    np.testing.assert_allclose(of_floats("log", small[:3]), np.log(small[:3].astype(float)), rtol=1.2e-7)
    below = np.array([-87.5, -95.0, -103.5, -104.0], np.float32)
    np.testing.assert_allclose(of_floats("exp", below), np.exp(below.astype(float)), rtol=0, atol=1.5e-45)


@pytest.mark.parametrize("name", [name for name in (*FUNCTIONS, *SCALAR) if name not in ("atan2", "pow")])
def test_special_values_are_those_of_jax(compiled: Compiled, name: str) -> None:
    with jax.enable_x64(True):
        expected = np.asarray(jax.jit(getattr(jax.lax, name))(SPECIAL))
    result = compiled(name, SPECIAL)
    # JAX's functions are a few units off, its lgamma(2) is 9e-16; here zeros, signs, infinities and NaN count.
    np.testing.assert_allclose(result, expected, rtol=1e-13, atol=1e-15 if name == "lgamma" else 1e-307)
    zero = (result == 0) & (expected == 0)
    np.testing.assert_array_equal(np.signbit(result[zero]), np.signbit(expected[zero]))


@pytest.mark.parametrize("name", ["atan2", "pow"])
def test_special_pairs_are_those_of_jax(compiled: Compiled, name: str) -> None:
    y, x = (a.ravel() for a in np.meshgrid(SPECIAL, SPECIAL))
    with jax.enable_x64(True):
        expected = np.asarray(jax.jit(getattr(jnp, {"atan2": "arctan2", "pow": "power"}[name]))(y, x))
    result = compiled(name, y, x)
    np.testing.assert_allclose(result, expected, rtol=1e-13, atol=1e-307)
    np.testing.assert_array_equal(np.signbit(result[result == 0]), np.signbit(expected[result == 0]))


def test_denormal_numbers(compiled: Compiled) -> None:
    small = np.array([5e-324, 1e-320, 2e-310, -3e-315])
    for name in ("sin", "tan", "atan", "asin", "tanh", "expm1", "log1p"):
        np.testing.assert_array_equal(compiled(name, small), small)
    # One unit of rounding of log, and of a denormal number.
    np.testing.assert_allclose(compiled("log", small[:3]), np.log(small[:3]), rtol=2.3e-16)
    below = np.array([-708.5, -720.0, -744.0, -745.2])
    np.testing.assert_allclose(compiled("exp", below), np.exp(below), rtol=0, atol=5e-324)


def test_the_inverse_of_erf_is_that_of_xla(compiled: Compiled) -> None:
    draws = np.random.default_rng(2).uniform(-1, 1, 1_000_000)
    outer = np.concatenate([1 - 10.0 ** np.linspace(-15.9, -3, 100_000), [np.nextafter(1, 0), np.nextafter(-1, 0)]])
    # Beyond 0.999 a unit of rounding of the logarithm counts for two of the result.
    for x, most in ((draws, 2), (outer, 4)):
        with jax.enable_x64(True):
            expected = np.asarray(jax.jit(jax.lax.erf_inv)(x))
        units = np.abs(compiled("erf_inv", x) - expected) / np.spacing(np.abs(expected))
        assert units.max() <= most
        assert np.mean(units == 0) > 0.9


@pytest.mark.skipif(not ROUNDED, reason="this machine has no number longer than a double to compare with")
def test_the_inverse_of_erf_undoes_it(compiled: Compiled) -> None:
    x = np.linspace(-0.999, 0.999, 20_001)
    y = compiled("erf_inv", x).astype(LONG)
    slope = 2 / np.sqrt(np.arccos(LONG(-1))) * np.exp(-y * y)
    # XLA's logarithm, 53 units off near x = 0.64, moves the inverse by 21.
    np.testing.assert_allclose(((_erf(y) - x) / slope).astype(float), 0, atol=25 * 2.3e-16)
