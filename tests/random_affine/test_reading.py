"""The law of a gain given a noisy reading of it, against closed forms and quadrature on fine panels."""

import equinox as eqx
import jax
import numpy as np
import pytest
from scipy.special import erfcx, i0e

import heliograph as hg
from heliograph.random_affine import LogNormal, Nakagami, Rician
from heliograph.random_affine.laws.gain_given_reading import gain_given_reading

SCALE = 0.8


@eqx.filter_jit
def compiled_moments(law, reading, variance):
    """The same, compiled once for each kind of law: within filters it is traced too."""
    given = gain_given_reading(law, reading, variance)
    mean = given.moment(1)
    return mean, given.variance if hasattr(given, "variance") else given.moment(2) - mean**2


def moments(law, reading, variance):
    """Mean and variance of the gain given its reading."""
    with jax.enable_x64(True):
        mean, variance = compiled_moments(law, np.float64(reading), np.float64(variance))
        return float(mean), float(variance)


def mean_of_rayleigh(a, s):
    """E[g | a]: p(g | a) is g times a normal density of mean m and deviation d, cut at 0."""
    m, d = a * SCALE**2 / (SCALE**2 + s**2), SCALE * s / np.hypot(SCALE, s)
    hazard = np.sqrt(2 / np.pi) / erfcx(-m / (d * np.sqrt(2)))
    t = m + d * hazard
    return t + d**2 * (1 - hazard * (hazard + m / d)) / t


def panels(log_density, a, s, high):
    """The same by 20-point rules on 2,000 panels, from 0 on."""
    x, w = np.polynomial.legendre.leggauss(20)
    edges = np.linspace(0, high**0.25, 2001) ** 4
    g = (edges[1:, None] + edges[:-1, None]) / 2 + np.diff(edges)[:, None] / 2 * x
    nats = log_density(g) - (a - g) ** 2 / (2 * s**2)
    weights = np.diff(edges)[:, None] / 2 * w * np.exp(nats - nats.max())
    mean = (weights * g).sum() / weights.sum()
    return mean, (weights * (g - mean) ** 2).sum() / weights.sum()


LAWS = {
    "rayleigh": (hg.Rayleigh(SCALE), lambda g: np.log(g) - g**2 / (2 * SCALE**2), 10.0),
    "rician": (Rician(1.0, 0.3), lambda g: np.log(g) - (g - 1) ** 2 / 0.18 + np.log(i0e(g / 0.09)), 10.0),
    "nakagami": (Nakagami(2.0, 1.0), lambda g: 3 * np.log(g) - 2 * g**2, 10.0),
    "log-normal": (LogNormal(0.0, 0.5), lambda g: -np.log(g) - 2 * np.log(g) ** 2, 60.0),
}


@pytest.mark.parametrize("kind", LAWS)
@pytest.mark.parametrize("a", [0.02, 0.8, 3.5])
@pytest.mark.parametrize("s", [0.5, 0.05])
def test_posterior_of_each_law(kind, a, s):
    law, log_density, high = LAWS[kind]
    # 64 nodes over all that counts: exact to the rounding of sums of some hundred terms
    np.testing.assert_allclose(moments(law, a, s**2), panels(log_density, a, s, high), rtol=3e-13)


def test_mean_of_a_rayleigh_gain_in_closed_form():
    for a in (-0.5, 0.3, 3.5):
        for s in (0.5, 0.1, 0.02):
            # far below zero t cancels, and t + V / t with it: 1e-9 there
            tolerance = 1e-9 if a < 0 else 1e-12
            assert moments(hg.Rayleigh(SCALE), a, s**2)[0] == pytest.approx(mean_of_rayleigh(a, s), rel=tolerance)


def test_discrete_law_by_bayes():
    law = hg.Discrete([0.0, 1.0], [0.25, 0.75])
    odds = 0.25 * np.exp(-(0.4**2) / 0.18) / (0.75 * np.exp(-(0.6**2) / 0.18))
    mean, _ = moments(law, 0.4, 0.09)
    assert mean == pytest.approx(1 / (1 + odds), rel=1e-14)


@pytest.mark.parametrize("law", [hg.Rayleigh(SCALE), hg.Discrete([0.5, 1.5], [0.4, 0.6])])
def test_without_a_reading_the_law_is_its_own(law):
    mean, variance = moments(law, np.nan, 0.01)
    assert mean == pytest.approx(law.moment(1), rel=1e-14)
    assert variance == pytest.approx(law.moment(2) - law.moment(1) ** 2, rel=1e-12)  # a difference of moments


def test_reading_without_error_is_the_gain_and_a_wild_one_tells_nothing():
    assert moments(hg.Rayleigh(SCALE), 1.2, 1e-12)[0] == pytest.approx(1.2, abs=1e-11)
    own = hg.Rayleigh(SCALE).moment(1)
    assert moments(hg.Rayleigh(SCALE), 1.2, 1e8)[0] == pytest.approx(own, rel=1e-7)  # a / s^2 moves it by 1e-8


def test_law_without_a_density_is_refused():
    with pytest.raises(ValueError, match="a law with a density or of finitely many values, got GivenMoments"):
        hg.hop(hg.random_affine.GivenMoments([1.0, 1.1]), 0.1, known=hg.model.Pilot(0.1))
