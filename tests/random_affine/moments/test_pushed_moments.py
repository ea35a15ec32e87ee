"""Moments pushed through a map against the map's own moment matrices."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.moments import (
    TabulatedNoise,
    count_monomials,
    evaluate_monomials,
    list_exponents,
    products_of_monomials,
    push_moments,
    push_through_known_map,
)
from heliograph.random_affine.noises.noise import noise_moment_vector
from tests.random_affine.test_contract import CHANNELS


def atoms_moments(dimension, order, seed=0):
    """Moments of a law of three points, so that they belong together."""
    g = np.random.default_rng(seed)
    points, chance = g.normal(size=(3, dimension)), g.dirichlet(np.ones(3))
    return chance @ np.array([evaluate_monomials(p, order) for p in points])


@pytest.mark.parametrize("order", [1, 2, 3, 4])
@pytest.mark.parametrize("name", CHANNELS)
def test_pushed_moments_are_those_of_the_matrix(name, order):
    channel = CHANNELS[name]
    before = atoms_moments(channel.inputs, order)
    expected = channel.moments(order).expect(before)
    np.testing.assert_allclose(
        push_moments(channel, order, before), expected, rtol=0, atol=1e-12 * np.abs(expected).max()
    )


def test_lifted_maps_are_pushed_by_their_matrix():
    square = hg.random_affine.square(CHANNELS["discrete"])
    point = evaluate_monomials(np.array([0.3, -0.7]), 2)[:-1]
    before = evaluate_monomials(point, 2)
    np.testing.assert_allclose(push_moments(square, 2, before), square.moments(2).expect(before), rtol=1e-14)


def test_a_known_map_moves_points():
    matrix = np.array([[1.0, 2.0, 0.5], [0.0, -1.0, 3.0], [0.0, 0.0, 1.0]])
    y = np.array([0.4, -0.2])
    for order in (1, 2, 3, 4):
        pushed = push_through_known_map(matrix, order, evaluate_monomials(y, order))
        np.testing.assert_allclose(pushed, evaluate_monomials((matrix @ [*y, 1.0])[:-1], order), rtol=1e-13)


def test_second_moments_are_gathered_from_the_vector():
    y = np.array([0.4, -0.2, 1.5])
    lifted = evaluate_monomials(y, 2)
    np.testing.assert_allclose(
        products_of_monomials(evaluate_monomials(y, 4), 4, 2), np.outer(lifted, lifted), rtol=1e-14
    )


def test_a_table_knows_what_the_law_knows():
    law = hg.random_affine.Shaped(
        [[1.0, 0.5], [0.0, 2.0]], hg.random_affine.FiniteSupport([[1.0, 0.0], [-1.0, 2.0]], [0.25, 0.75])
    )
    table = TabulatedNoise(law, 4)
    np.testing.assert_array_equal(noise_moment_vector(table, 4), noise_moment_vector(law, 4))
    assert all(table.moment(a) == law.moment(a) for k in range(5) for a in list_exponents(2, k))


def test_a_large_order_needs_no_large_matrix():
    """16 states, order 4: the vector has 4845 entries; the matrix that is not formed has 23 million."""
    plant = hg.random_affine.GainAndNoise(hg.random_affine.Constant(1.0), 0.5 * np.eye(16), 0.3)
    gaussian = noise_moment_vector(hg.Gaussian(np.eye(16)), 4)
    assert len(gaussian) == count_monomials(17, 4) == 4845
    expected = noise_moment_vector(hg.Gaussian((0.25 + 0.3) * np.eye(16)), 4)
    np.testing.assert_allclose(push_moments(plant, 4, gaussian), expected, rtol=1e-12)


def test_moments_of_the_wrong_length_are_refused():
    with pytest.raises(ValueError, match=r"moments of order 2: expected shape \(6,\), got shape \(5,\)"):
        push_moments(CHANNELS["known"], 2, np.zeros(5))
