"""Polynomial filters behind links that remember."""

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modal_problems import BURSTS, PLANT, SENSOR, bursts, variances

TWO_HOPS = hg.amplify_and_forward(
    [
        hg.model.autoregressive_fading(1.0, 0.4, 0.95, 0.05),
        hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.3, 0.1), 0.1, 0.2),
    ]
)


def errors(channel, degree, steps):
    return hg.linear.lmmse(hg.linear.lifted_system(PLANT, SENSOR, channel, degree, steps)).gains.covariance[:, 0, 0]


@pytest.mark.parametrize("channel", [bursts(), TWO_HOPS])
def test_degree_one_is_the_linear_filter(channel):
    np.testing.assert_allclose(errors(channel, 1, 30), variances(PLANT, SENSOR, channel, 30)[:, 0], rtol=1e-12)


def test_a_cubic_filter_gains_two_percent_and_a_quadratic_one_nothing():
    """Everything is symmetric, so squares tell nothing; P_200 is close to the limit."""
    linear, square, cube = (errors(bursts(), degree, 200)[-1] for degree in (1, 2, 3))
    assert square == pytest.approx(linear, rel=1e-9)
    assert cube == pytest.approx(0.2339, abs=5e-5)


def test_equal_rows_are_a_link_that_forgets():
    law = [0.375, 0.625]
    independent = hg.hop(hg.Discrete([0.2, 1.0], law), 0.05)
    np.testing.assert_allclose(errors(bursts([law, law]), 3, 10), errors(independent, 3, 10), rtol=1e-9)


def test_a_chain_that_varies_moves_at_its_steps():
    """A chain that leaves its first mode at a known step, against the gains as they are then."""
    stay, leave = np.eye(2), np.array([[0.0, 1.0], [0.0, 1.0]])
    chains = [hg.random_affine.MarkovChain(leave if k == 2 else stay, [1.0, 0.0], "c") for k in range(6)]
    moving = hg.model.over_time([bursts(chain) for chain in chains])
    known = hg.model.over_time([hg.hop(0.2 if k < 3 else 1.0, 0.05) for k in range(6)])
    np.testing.assert_allclose(errors(moving, 2, 6), errors(known, 2, 6), rtol=1e-9)


def test_its_claim_holds_in_simulation():
    item = hg.polynomial_filter(PLANT, SENSOR, bursts(), 20, 3)
    record = hg.monte_carlo(hg.Network(PLANT, {"node": hg.Node(SENSOR, bursts(), {"cubic": item})}), 20, 2000, 6)
    squares = record.errors("node", "cubic")[..., 0] ** 2
    claimed = record.estimates["node"]["cubic"].covariance[0, :, 0, 0]
    assert item.claim == "exact"
    assert np.all(np.abs(squares.mean(axis=0) - claimed) < 4.5 * squares.std(axis=0) / np.sqrt(2000))


def test_a_rough_chain_is_nominal():
    rough = bursts(hg.random_affine.MarkovChain(BURSTS, radius=0.01))
    assert hg.polynomial_filter(PLANT, SENSOR, rough, 3, 2).claim == "nominal"
