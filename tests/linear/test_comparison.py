"""Whether it is worth it, before any run."""

from dataclasses import replace

import numpy as np
import pytest

import heliograph as hg
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model

EXAMPLE = oracle.paper_example()


def test_gain_on_the_example_is_that_of_the_oracle():
    result = hg.linear.gain_over_linear(*model(EXAMPLE, 40), 40, (2, 3), after=30)
    linear, quadratic = (r.true[31:, :4, :4] for r in (oracle.linear(EXAMPLE, 40), oracle.quadratic(EXAMPLE, 40, True)))
    expected = 1 - np.diagonal(quadratic.mean(0)) / np.diagonal(linear.mean(0))
    np.testing.assert_allclose(result.gain(2), expected, rtol=0, atol=1e-12)
    assert result.gain(3)[0] > result.gain(2)[0] and not result.symmetric
    assert result.states == ("x0", "x1", "bias_x0", "bias_x1")


def test_symmetric_noises_gain_nothing_by_squares():
    symmetric = hg.random_affine.FiniteSupport([[-2.0], [0.0], [2.0]], [0.1, 0.8, 0.1])
    plant = hg.LinearPlant([[0.9]], symmetric, [0.0], symmetric)
    channel = hg.hop(hg.random_affine.bernoulli(0.6), symmetric)
    result = hg.linear.gain_over_linear(plant, hg.LinearSensor([[1.0]], symmetric), channel, 20)
    assert result.symmetric and abs(result.gain(2)[0]) < 1e-13
    assert result.gain(3)[0] > 1e-3  # fourth moments are not Gaussian


def test_a_random_gain_of_a_state_with_mean_is_skewed():
    """All laws symmetric, but z = g x with g random and E x != 0: squares gain, and the skewness says so."""
    symmetric = hg.random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5])
    plant = hg.LinearPlant([[0.9]], hg.random_affine.FiniteSupport([[0.0], [1.0]], [0.5, 0.5]), [5.0], symmetric)
    result = hg.linear.gain_over_linear(
        plant, hg.LinearSensor([[1.0]], symmetric), hg.hop(hg.random_affine.bernoulli(0.6), 0.1), 20
    )
    assert not result.symmetric and result.gain(2)[0] > 0.01


def test_skewness_of_one_source():
    """x_0 known, z = v: the standardised third moment is the noise's own."""
    law = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])
    plant = hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0)
    result = hg.linear.gain_over_linear(plant, hg.LinearSensor([[0.0]], law), hg.perfect(), 3)
    assert result.skewness == pytest.approx(law.moment((3,)) / law.moment((2,)) ** 1.5, rel=1e-12)


def test_bad_input_is_named():
    s = model(replace(EXAMPLE), 5)
    with pytest.raises(ValueError, match="degrees: expected at least one, all of 2 or more, got \\[1\\]"):
        hg.linear.gain_over_linear(*s, 5, (1,))
    with pytest.raises(ValueError, match="first step that counts: expected one from 0 to 4, got 5"):
        hg.linear.gain_over_linear(*s, 5, (2,), after=5)
