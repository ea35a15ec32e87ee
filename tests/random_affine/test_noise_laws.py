"""Noises made of noises, and noises of which moments or samples are known."""

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from heliograph.testing import check_random_affine
from heliograph_studies.quadratic_bias.setting import TABLE_1

SKEWED = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])


def test_independent_and_shaped_noises_are_what_they_sample():
    joint = hg.random_affine.Independent([SKEWED, hg.Gaussian([[0.5, 0.2], [0.2, 0.3]], [0.1, -0.2])])
    check_random_affine(hg.random_affine.GainAndNoise(hg.random_affine.Constant(1.0), np.ones((3, 1)), joint))
    mixed = hg.random_affine.Shaped([[1.0, 0.5, 0.0], [0.0, -1.0, 2.0]], joint)
    check_random_affine(hg.random_affine.GainAndNoise(hg.random_affine.Constant(1.0), np.ones((2, 1)), mixed))
    np.testing.assert_allclose(mixed.mean, [mixed.moment((1, 0)), mixed.moment((0, 1))], rtol=1e-14)
    second = np.array([[mixed.moment((2, 0)), mixed.moment((1, 1))], [mixed.moment((1, 1)), mixed.moment((0, 2))]])
    np.testing.assert_allclose(mixed.covariance, second - np.outer(mixed.mean, mixed.mean), rtol=1e-13)


def test_given_moments_design_the_same_filter_as_the_law():
    given_ = hg.random_affine.NoiseMoments([SKEWED.moment((k,)) for k in range(1, 5)])
    designs = []
    for noise in (SKEWED, given_):
        plant = hg.LinearPlant([[0.8]], noise, [0.0], 1.0)
        system = hg.linear.lifted_system(plant, hg.LinearSensor([[1.0]], noise), hg.perfect(), 2, 5)
        designs.append(hg.linear.lmmse(system).gains.covariance)
    np.testing.assert_allclose(designs[1], designs[0], rtol=1e-12)
    with pytest.raises(ValueError, match="moments up to order 6, got 4 of them"):
        hg.linear.lifted_system(
            hg.LinearPlant([[0.8]], given_, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0), hg.perfect(), 3, 5
        )
    with pytest.raises(ValueError, match="a law that can be sampled"):
        given_.sample(None)


@given(
    st.lists(st.floats(-3, 3), min_size=1, max_size=6, unique=True),
    st.lists(st.floats(0.05, 1), min_size=6, max_size=6),
    st.integers(2, 8),
)
def test_moments_of_any_law_are_accepted(values, weights, order):
    chance = np.array(weights[: len(values)])
    law = hg.random_affine.FiniteSupport(np.array(values)[:, None], chance / chance.sum())
    hg.random_affine.NoiseMoments([law.moment((k,)) for k in range(1, order + 1)])


@pytest.mark.parametrize(
    ("moments", "message"),
    [
        ([1.0, 0.5], r"E\[n\^2\] of at least 1, which the lower moments imply, got 0\.5"),
        ([0.0, -1.0], r"E\[n\^2\] of at least 0"),
        ([0.0, 1.0, 2.0, 4.9], r"E\[n\^4\] of at least 5, .*got 4\.9, which no distribution has"),
        ([0.0, 0.0, 1.0], r"E\[n\^3\] = 1, which no law has"),
        ([0.0, 1.0, 0.0, 1.0, 1.0], r"E\[n\^5\] = 1, which no law has"),
        ([0.0, 1.0, 0.0, 3.0, 0.0, 8.0], r"E\[n\^6\] of at least 9"),
        ([1.0], "at least E"),
    ],
)
def test_moments_of_no_law_are_refused_with_the_reason(moments, message):
    with pytest.raises(ValueError, match=message):
        hg.random_affine.NoiseMoments(moments)


def test_a_rounded_table_of_moments_can_belong_to_no_law():
    """eps2 as printed: 0.0820 is 8.1e-5 below 0.1875^2 + 0.0938^2 / 0.1875."""
    second, third, fourth = TABLE_1["eps2"]
    assert second**2 + third**2 / second - fourth == pytest.approx(8.1e-5, abs=1e-6)
    with pytest.raises(ValueError, match="which no distribution has"):
        hg.random_affine.NoiseMoments([0.0, second, third, fourth])


def test_recorded_noise_has_the_samples_moments():
    samples = np.random.default_rng(0).normal(size=(4000, 2)) @ [[1.0, 0.3], [0.0, 0.5]]
    law = hg.random_affine.recorded_noise(samples, 4)
    assert law.moment((1, 3)) == pytest.approx(np.mean(samples[:, 0] * samples[:, 1] ** 3), rel=1e-12)
    np.testing.assert_allclose(law.covariance, np.cov(samples.T, bias=True), rtol=1e-12)


def test_a_sample_too_small_for_the_order_is_said_and_the_number_named_is_enough():
    g = np.random.default_rng(0)
    with pytest.warns(UserWarning, match=r"order 4 is known to \d+ % only; about [\d,]+ samples instead of 100"):
        hg.random_affine.recorded_noise(g.normal(size=100), 4)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hg.random_affine.recorded_noise(g.normal(size=500), 2)
        enough = int(1.5 * (96 / 9) / 0.1**2)  # to a tenth; Gaussian: Var(n^4) / (E n^4)^2 = 96 / 9
        hg.random_affine.recorded_noise(g.normal(size=enough), 4)


@pytest.mark.parametrize(
    ("samples", "order", "message"),
    [([1.0], 2, "at least two"), ([1.0, np.nan], 2, "finite"), ([1.0, 2.0], 0, "a positive whole number")],
)
def test_samples_that_are_none_are_refused(samples, order, message):
    with pytest.raises(ValueError, match=message):
        hg.random_affine.recorded_noise(samples, order)


def test_a_plant_draws_its_initial_state_from_the_law():
    plant = hg.LinearPlant([[1.0]], 0.0, [3.0], SKEWED)
    network = hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.perfect(), {})})
    drawn = hg.monte_carlo(network, 1, 500, 0).truth[:, 0, 0]
    assert set(np.round(drawn, 12)) == {5.0, 2.5}
    assert np.mean(drawn == drawn.max()) == pytest.approx(0.2, abs=5 * np.sqrt(0.16 / 500))
    assert plant.initial_mean[0] == 3.0 and plant.initial_covariance[0, 0] == pytest.approx(1.0)


def test_with_bias_refuses_what_does_not_fit():
    plant, sensor = hg.LinearPlant(np.eye(2), 1.0, np.zeros(2), 1.0), hg.LinearSensor([[1.0, 0.0]], 1.0)
    with pytest.raises(ValueError, match=r"coupling of the bias: expected shape \(2, 2\), got shape \(2, 1\)"):
        hg.model.with_bias(plant, sensor, plant, coupling=np.ones((2, 1)))
    driven = hg.LinearPlant(np.eye(1), 1.0, np.zeros(1), 1.0, np.ones((1, 1)))
    with pytest.raises(ValueError, match=r"a plant whose inputs are some of \[\], got \['u0'\]"):
        hg.model.with_bias(plant, sensor, driven, coupling=np.ones((2, 1)))
