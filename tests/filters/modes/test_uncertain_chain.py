"""A chain that is known only roughly: the claim dominates every chain within the radius, constant or not."""

import numpy as np
import pytest

import heliograph as hg
from tests.filters.modal_problems import BAD, BURSTS, GOOD, PLANT, SENSOR, bursts, variances

Modes, true_error = hg.random_affine.Modes, hg.filters.true_error
STEPS = 300  # all that tells of the long run is steady by then
THREE = np.array([[0.8, 0.15, 0.05], [0.1, 0.8, 0.1], [0.05, 0.25, 0.7]])


def rough(radius, rows=BURSTS):
    return bursts(hg.random_affine.MarkovChain(rows, radius=radius))


def bound(channel, steps=STEPS):
    item = hg.linear_filter(PLANT, SENSOR, channel)
    assert item.claim == "upper"
    return item, item.planned(np.zeros((steps, 0))).covariances[2::2, 0, 0]


@pytest.mark.parametrize(
    ("radius", "known", "worst"), [(0.005, 0.301, 0.268), (0.01, 0.369, 0.297), (0.02, 0.518, 0.352)]
)
def test_how_loose_it_is(radius, known, worst):
    """Not above the known bound, and not below the exact filter of the worst constant chain."""
    result = bound(rough(radius))[1][-1]
    corners = [BURSTS + radius * np.array([[a, -a], [b, -b]]) for a in (-1, 1) for b in (-1, 1)]
    exact = max(variances(PLANT, SENSOR, bursts(c), STEPS)[-1, 0] for c in corners)
    assert exact == pytest.approx(worst, abs=0.0006)
    assert exact < result < known + 0.0005


def test_a_radius_of_zero_is_the_exact_filter():
    almost = bound(rough(1e-13))[1]
    np.testing.assert_allclose(almost, variances(PLANT, SENSOR, bursts(), STEPS)[:, 0], rtol=1e-5)
    assert hg.linear_filter(PLANT, SENSOR, rough(0.0)).claim == "exact"


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_it_dominates_the_truth_of_chains_that_wander_within_the_radius(seed):
    """Three modes with atoms, transitions drawn anew at each step, half of them at the ends."""
    generator, radius = np.random.default_rng(seed), 0.03
    law, maps, steps = [0.5, 0.3, 0.2], [GOOD, BAD, hg.hop(0.6, 0.1)], 60
    item, claimed = bound(Modes(hg.random_affine.MarkovChain(THREE, law, radius=radius), maps), steps)
    rows = []
    for _ in range(steps):
        draw = generator.uniform(-1, 1, size=(3, 3)) if generator.random() < 0.5 else generator.choice([-1, 1], (3, 3))
        change = draw - draw.mean(axis=1, keepdims=True)
        rows.append(np.clip(THREE + radius * change / max(np.abs(change).max(), 1), 0, 1))
    world = hg.model.over_time(
        [Modes(hg.random_affine.MarkovChain(r / r.sum(axis=1, keepdims=True), law, "w"), maps) for r in rows]
    )
    true = true_error(item, PLANT, SENSOR, world, steps).true[:, 0, 0]
    assert np.all(true <= claimed * (1 + 1e-12))


@pytest.mark.parametrize("corner", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_it_dominates_the_truth_at_the_corners_and_the_exact_filter_there(corner):
    item, claimed = bound(rough(0.02))
    chain = bursts(
        hg.random_affine.MarkovChain(
            BURSTS + 0.02 * np.array([[-corner[0], corner[0]], [-corner[1], corner[1]]]), [0.375, 0.625]
        )
    )
    true = true_error(item, PLANT, SENSOR, chain, STEPS).true[:, 0, 0]
    assert np.all(true <= claimed) and np.all(variances(PLANT, SENSOR, chain, STEPS)[:, 0] <= true * (1 + 1e-12))


@pytest.mark.slow
def test_two_rough_chains_together():
    """|Delta| of a product of chains is at most (Pi_a + r_a) x (Pi_b + r_b) - Pi_a x Pi_b."""
    a, b = rough(0.01), Modes(hg.random_affine.MarkovChain(THREE, radius=0.02), [GOOD, BAD, hg.hop(0.6, 0.1)])
    joint = hg.random_affine.joint_modes(hg.amplify_and_forward([a, b]))
    moved = np.kron(BURSTS + 0.01 * np.array([[1, -1], [-1, 1]]), THREE + 0.02 * np.array([[1, -1, 0]] * 3))
    assert np.all(np.abs(moved - joint.transition) <= joint.radius + 1e-15)
    hg.testing.check_filter(hg.linear_filter(PLANT, SENSOR, hg.amplify_and_forward([a, rough(0.02)])))


def test_claims_of_other_filters():
    assert hg.filters.side_information_filter(PLANT, SENSOR, rough(0.01), np.eye(2)).claim == "nominal"
    assert hg.filters.mode_late_filter(PLANT, SENSOR, rough(0.01)).claim == "nominal"
    assert hg.filters.mode_known_filter(PLANT, SENSOR, rough(0.01)).claim == "exact"
    assert hg.model.memory_matters(rough(0.01, [[0.4, 0.6], [0.4, 0.6]]))
