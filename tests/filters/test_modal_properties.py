"""What holds for every chain: drawn at random, with atoms, offsets and several hops."""

import numpy as np
import pytest

import heliograph as hg
from tests.as_code import printing
from tests.filters.modal_problems import variances

Modes = hg.random_affine.Modes


def drawn(seed):
    """A plant of two states, its sensor, and maps and a chain of three modes."""
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(2, 2))
    a = root * 0.95 / np.abs(np.linalg.eigvals(root)).max()
    plant = hg.LinearPlant(
        a, hg.Gaussian(0.3 * np.eye(2), generator.normal(size=2)), generator.normal(size=2), np.eye(2)
    )
    sensor = hg.LinearSensor(generator.normal(size=(1, 2)), hg.Gaussian([[0.1]], generator.normal(size=1)))
    maps = []
    for _ in range(3):
        gains, weights = generator.normal(size=2), generator.dirichlet(np.ones(2))
        noise = hg.Gaussian([[generator.uniform(0.05, 0.5)]], generator.normal(size=1))
        maps.append(hg.hop(hg.Discrete(gains, weights), noise))
    return plant, sensor, maps, generator.dirichlet(np.ones(3), size=3), generator.dirichlet(np.ones(3))


def of_problems(count):
    """Run a test with each of so many problems; one that fails prints its own as code."""

    def decorated(test):
        @pytest.mark.parametrize("seed", range(count))
        def run(seed):
            plant, sensor, maps, rows, law = drawn(seed)
            with printing(plant=plant, sensor=sensor, maps=maps, rows=rows, law=law):
                test(seed, plant, sensor, maps, rows, law)

        run.__doc__ = test.__doc__
        return run

    return decorated


@of_problems(6)
def test_equal_rows_are_no_memory(seed, plant, sensor, maps, rows, law):
    """Against the mixture of the maps, which the filter of links that forget receives."""
    chain = hg.random_affine.MarkovChain([law] * 3)
    forgets = hg.random_affine.Mixture(maps, law)
    result = variances(plant, sensor, Modes(chain, maps), 30)
    np.testing.assert_allclose(result, variances(plant, sensor, forgets, 30), rtol=1e-11)


@pytest.mark.slow
@of_problems(6)
def test_the_order_of_modes_changes_nothing(seed, plant, sensor, maps, rows, law):
    order = np.random.default_rng(seed + 100).permutation(3)
    item = Modes(hg.random_affine.MarkovChain(rows, law), maps)
    turned = Modes(hg.random_affine.MarkovChain(rows[np.ix_(order, order)], law[order]), [maps[i] for i in order])
    np.testing.assert_allclose(variances(plant, sensor, item, 30), variances(plant, sensor, turned, 30), rtol=1e-11)


@of_problems(6)
def test_a_claim_is_the_propagated_truth_and_no_filter_does_better(seed, plant, sensor, maps, rows, law):
    """Of the filter itself to rounding; a filter made for other rows is worse at every step."""
    channel, other = (Modes(hg.random_affine.MarkovChain(r, law), maps) for r in (rows, rows[::-1]))
    local = hg.filters.true_error(hg.linear_filter(plant, sensor, channel), plant, sensor, channel, 30)
    wrong = hg.filters.true_error(hg.linear_filter(plant, sensor, other), plant, sensor, channel, 30)
    np.testing.assert_allclose(local.claimed, local.true, rtol=1e-9, atol=1e-12)
    smallest = np.linalg.eigvalsh(wrong.true - local.true)[:, 0]
    assert np.all(smallest >= -1e-10 * np.abs(local.true).max())


@pytest.mark.slow
@of_problems(3)
def test_claims_hold_by_simulation(seed, plant, sensor, maps, rows, law):
    """Sum of both states' squares against the trace, within 4.5 standard errors at each of 12 steps."""
    relay = hg.model.autoregressive_fading(1.0, 0.5, 0.7, 0.1)
    channel = hg.amplify_and_forward([Modes(hg.random_affine.MarkovChain(rows, law), maps), relay])
    item = hg.linear_filter(plant, sensor, channel)
    record = hg.monte_carlo(hg.Network(plant, {"node": hg.Node(sensor, channel, {"f": item})}), 12, 4000, seed)
    squares = np.sum(record.errors("node", "f") ** 2, axis=-1)
    claimed = np.trace(record.estimates["node"]["f"].covariance[0], axis1=1, axis2=2)
    assert np.all(np.abs(squares.mean(axis=0) - claimed) < 4.5 * squares.std(axis=0) / np.sqrt(4000))
