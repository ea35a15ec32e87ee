"""Noise as an input: joint second moments against enumeration and samples."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from tests.draws import draw
from tests.h_infinity.h_infinity_problems import channel

probability = st.floats(0.0, 1.0)


def enumerated(beta):
    mean, second = np.zeros((2, 4)), np.zeros((2, 4, 2, 4))
    for outcome in product([0, 1], repeat=3):
        p = np.prod([q if o else 1 - q for q, o in zip(beta, outcome, strict=True)])
        h = np.array([
            [outcome[0] * outcome[1], 0.1 * outcome[1], 0.1, 0.0],
            [np.sqrt(2) * outcome[2], 0.0, 0.0, 0.15],
        ])  # fmt: skip
        mean, second = mean + p * h, second + p * np.multiply.outer(h, h)
    return mean, second


@given(st.tuples(probability, probability, probability))
def test_moments_equal_the_enumeration_of_all_dropouts(beta):
    result = channel(beta).disturb_gain()
    mean, second = enumerated(beta)
    np.testing.assert_allclose(result.mean, mean, atol=1e-15)
    np.testing.assert_allclose(result.second, second, atol=1e-15)


@given(st.tuples(probability, probability, probability))
def test_spreads_reproduce_the_covariance(beta):
    result = channel(beta).disturb_gain()
    spreads = result.spreads()
    np.testing.assert_allclose(np.einsum("jab,jcd->abcd", spreads, spreads), result.covariance, atol=1e-12)
    assert len(spreads) <= 3


def test_nothing_is_spread_where_every_link_always_delivers():
    assert len(channel((1.0, 1.0, 1.0)).disturb_gain().spreads()) == 0


def test_signal_columns_agree_with_the_algebra():
    relay = hg.amplify_and_forward(
        [hg.hop(hg.Rayleigh(1.0), np.diag([0.2, 0.1])), hg.hop(hg.random_affine.bernoulli(0.4), np.diag([0.3, 0.2]))]
    )
    for item in (relay, hg.dropout(relay, 0.7), hg.model.with_direct_link(relay, hg.hop(1.0, np.diag([0.1, 0.4])))):
        result = item.disturb_gain()
        np.testing.assert_allclose(result.mean[:, : result.inputs], item.moments(1).mean[:-1, :-1], atol=1e-14)


def test_noise_power_agrees_with_the_algebra_and_with_samples():
    """E[n n'] = E[N N'] for independent sources of unit variance; 4 standard errors of 40,000 draws."""
    item = hg.dropout(
        hg.amplify_and_forward([hg.hop(hg.Rayleigh(1.0), 0.2), hg.hop(hg.random_affine.bernoulli(0.4), 0.3)]), 0.7
    )
    result = item.disturb_gain()
    power = np.einsum("abib->ai", result.second[:, result.inputs :, :, result.inputs :])[0, 0]
    np.testing.assert_allclose(power, item.moments(2).matrix[0, -1], rtol=1e-13)
    squares = draw(item.sample, 40_000)[:, 0, -1] ** 2
    assert abs(squares.mean() - power) < 4 * squares.std() / np.sqrt(len(squares))


def test_a_lifted_channel_is_refused():
    with pytest.raises(ValueError, match=r"channel: expected hops, series, .* and sums of them, got Lift"):
        hg.random_affine.square(hg.hop(1.0, 0.1)).disturb_gain()
