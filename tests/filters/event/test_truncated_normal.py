"""Truncated moments against quadrature in extended digits and closed forms that lose none."""

from decimal import Decimal, getcontext

import jax
import numpy as np
import pytest

from heliograph.filters.event import upper_tail
from heliograph.filters.event.truncated_normal import truncated_normal
from heliograph.numerics import compile_in_float64

moments = compile_in_float64(truncated_normal)
# Of a Gauss-Legendre rule with 40 nodes over 17 deviations or less: 1.2e-13 is what 1,500 random intervals showed.
ACCURATE = 1e-12


def reference(lower: float, upper: float) -> tuple[float, float, float]:
    """log Z + t^2 / 2, the mean and the variance by Gauss-Legendre in 60 digits on pieces, from the end nearer 0."""
    getcontext().prec = 60
    a, b = Decimal(lower), Decimal(upper)
    t = a if a > 0 else b if b < 0 else Decimal(0)
    reach = (t * t + 300).sqrt()
    a, b = max(a, -reach), min(b, reach)
    pieces, total = 400, [Decimal(0)] * 3
    step = (b - a) / pieces
    for i in range(pieces):
        for node, weight in LEGENDRE:
            u = (a - t) + step * (i + node)
            density = weight * step * (-(u * (u / 2 + t))).exp()
            for power in range(3):
                total[power] += density * u**power
    mean = total[1] / total[0]
    return float(total[0].ln()), float(t + mean), float(total[2] / total[0] - mean * mean)


def _legendre(count: int) -> list[tuple[Decimal, Decimal]]:
    """Nodes and weights on (0, 1), by Newton's method in 60 digits."""
    getcontext().prec = 60
    results = []
    for start in np.polynomial.legendre.leggauss(count)[0]:
        x = Decimal(float(start))
        for _ in range(6):
            before, now = Decimal(1), x
            for n in range(2, count + 1):
                before, now = now, ((2 * n - 1) * x * now - (n - 1) * before) / n
            slope = count * (x * now - before) / (x * x - 1)
            x -= now / slope
        results.append(((x + 1) / 2, 1 / ((1 - x * x) * slope * slope)))
    return results


LEGENDRE = _legendre(10)


@pytest.mark.parametrize(
    ("lower", "upper"),
    [(-1.0, 1.0), (-0.3, 2.0), (0.2, 0.2 + 1e-6), (40.0, 40.0 + 1e-6), (40.0, 41.0), (-7.0, -6.5), (3.0, 90.0),
     (-5.0, 40.0), (1e-9, 1e-3), (-1e-9, 2e-9), (200.0, 1e6), (-1e3, 1e-3), (1e4, 1e5), (-1.0, 1.0 + 1e-12)],
)  # fmt: skip
def test_moments_have_twelve_digits_wherever_the_interval_lies(lower, upper):
    log_mass, mean, variance = reference(lower, upper)
    result = moments(np.asarray(lower), np.asarray(upper))
    t = max(lower, -upper, 0.0)
    assert result.log_mass == pytest.approx(log_mass - t**2 / 2 - np.log(2 * np.pi) / 2, rel=ACCURATE, abs=ACCURATE)
    assert result.mean == pytest.approx(mean, rel=ACCURATE, abs=1e-50)  # the reference has 60 digits
    assert result.variance == pytest.approx(variance, rel=ACCURATE, abs=0)


def test_no_variance_is_negative_and_no_moment_is_no_number():
    random = np.random.default_rng(0)
    lower = random.normal(size=20_000) * 10 ** random.uniform(-8, 8, 20_000)
    upper = lower + 10 ** random.uniform(-9, 9, 20_000)
    ends = np.where(random.random((2, 20_000)) < 0.1, np.inf, [-lower, upper])
    lower, upper = -ends[0], ends[1]
    keep = lower < upper
    log_mass, mean, variance = moments(lower[keep], upper[keep])
    assert np.all(np.isfinite(mean)) and np.all(~np.isnan(log_mass)) and np.all(log_mass <= 1e-13)
    assert np.all(variance > 0) and np.all(variance <= 1 + 1e-12)
    assert np.all(mean >= lower[keep] - 1e-12 * np.abs(lower[keep]))
    assert np.all(mean <= upper[keep] + 1e-12 * np.abs(upper[keep]))


@pytest.mark.parametrize("lower", [-38.0, -6.0, -0.5, 0.0, 1.0, 2.5, 3.999, 4.0, 4.5, 7.0, 20.0, 40.0, 1e3, 1e6])
def test_a_tail_has_twelve_digits(lower):
    log_mass, mean, variance = reference(lower, np.inf)
    result = compile_in_float64(upper_tail)(np.asarray(lower))
    t = max(lower, 0.0)
    assert result.log_mass == pytest.approx(log_mass - t**2 / 2 - np.log(2 * np.pi) / 2, rel=ACCURATE, abs=ACCURATE)
    # Below -6 the mean is the density at the end, of which the reference has the digits that 1 - Z leaves.
    assert result.mean == pytest.approx(mean, rel=ACCURATE, abs=1e-15)
    assert result.variance == pytest.approx(variance, rel=ACCURATE, abs=0)


def test_a_tail_anywhere_is_the_interval_without_an_end():
    random = np.random.default_rng(3)
    lower = random.normal(size=20_000) * 10 ** random.uniform(-8, 8, 20_000)
    result, expected = compile_in_float64(upper_tail)(lower), moments(lower, np.full_like(lower, np.inf))
    assert np.all(result.variance > 0) and np.all(result.variance <= 1)
    for part, whole in zip(result, expected, strict=True):
        np.testing.assert_allclose(part, whole, rtol=2 * ACCURATE, atol=ACCURATE)  # an error of each


def test_limits_are_those_of_the_normal_and_of_the_half_normal_law():
    whole = moments(np.asarray(-np.inf), np.asarray(np.inf))
    assert whole.log_mass == pytest.approx(0, abs=ACCURATE) and whole.mean == 0
    assert whole.variance == pytest.approx(1, rel=ACCURATE)
    half = moments(np.asarray(0.0), np.asarray(np.inf))
    assert half.log_mass == pytest.approx(-np.log(2), rel=ACCURATE)
    assert half.mean == pytest.approx(np.sqrt(2 / np.pi), rel=ACCURATE)
    assert half.variance == pytest.approx(1 - 2 / np.pi, rel=ACCURATE)


def test_an_interval_and_its_reflection_are_bit_for_bit_the_same():
    with jax.enable_x64(True):
        a, b = moments(np.asarray(0.7), np.asarray(2.5)), moments(np.asarray(-2.5), np.asarray(-0.7))
    assert a.log_mass == b.log_mass and a.mean == -b.mean and a.variance == b.variance
