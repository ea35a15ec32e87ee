"""States that move, received behind shared fading: a relay that filters, and a plant that changes with the mode."""

from itertools import pairwise, product

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine import second_order
from tests.filters.modal_problems import PLANT, SENSOR, bursts, variances

Series, Stack, Modes, known = (getattr(hg.random_affine, n) for n in ("Series", "Stack", "Modes", "known"))
GainAndNoise, Constant = hg.random_affine.GainAndNoise, hg.random_affine.Constant
CHAIN = hg.random_affine.MarkovChain([[0.8, 0.2], [0.3, 0.7]], [0.6, 0.4])
LINKS = [hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1), hg.hop(0.3, hg.Gaussian([[0.4]], [0.1]))]
BACK = [hg.hop(1.0, 0.05), hg.hop(hg.Rayleigh(0.3), 0.2)]
A, Q, C, R, K = 0.9, 0.3, 1.0, 0.1, 0.4


def relay(link):
    """(x, s) -> (x+, s+): x+ = A x + w, s+ = (A - K A) s + K z, where the relay receives z of x+ through `link`."""
    plant = GainAndNoise(Constant(1.0), np.diag([A, 1.0]), np.diag([Q, 0.0]))
    observed = Series([GainAndNoise(Constant(1.0), [[C, 0.0]], R), link])
    use = known([[1.0, 0.0, 0.0], [0.0, A - K * A, K]])
    return Series([plant, Stack([known(np.eye(2)), observed]), use])


def received(link):
    """The relay sends s+."""
    return Series([known([[0.0, 1.0]]), link])


def step(second, size, move, receive):
    """E[r r'] of r = (y, 1, z_1, ..., z_k) moved and received once: what is known of a map is its mean and spread."""
    for channel, replace in ((move, True), (receive, False)):
        mean, spread = np.asarray(channel.moments(1).mean[:-1]), second_order(channel).nominal.center
        y = second[:size, :size]
        rows = np.hstack([mean, np.zeros((len(mean), len(second) - size))])
        added = np.einsum("abij,ij->ab", spread, y)
        if replace:
            whole = np.eye(len(second))
            whole[: size - 1] = rows
            second = whole @ second @ whole.T
            second[: size - 1, : size - 1] += added
        else:
            whole = np.vstack([np.eye(len(second)), rows])
            second = whole @ second @ whole.T
            second[-len(mean) :, -len(mean) :] += added
    return second


def over_paths(moves, observe, rows, law, mean, covariance, steps):
    """Error covariances of y given (1, z_1, ..., z_k), from all paths of the modes."""
    size, start = len(mean) + 1, np.append(mean, 1.0)
    first = np.outer(start, start) + np.pad(covariance, ((0, 1), (0, 1)))
    results = []
    for k in range(steps):
        total = 0.0
        for path in product(range(len(law)), repeat=k + 1):
            weight, second = law[path[0]] * np.prod([rows[i][j] for i, j in pairwise(path)]), first
            for mode in path:
                second = step(second, size, moves[mode], observe[mode])
            total = total + weight * second
        y, z = total[: size - 1], total[size - 1 :]
        cross, gram = y[:, size - 1 :], z[:, size - 1 :]
        results.append(y[:, : size - 1] - cross @ np.linalg.pinv(gram, rcond=1e-14) @ cross.T)
    return np.array(results)


def test_a_relay_that_filters_in_the_fading_of_its_receiver():
    mean, spread = np.array([1.0, 0.5]), np.array([[1.0, 0.2], [0.2, 0.5]])
    system = hg.linear.modal_system(relay(Modes(CHAIN, LINKS)), received(Modes(CHAIN, BACK)), mean, spread, 5)
    expected = over_paths(
        [relay(m) for m in LINKS], [received(m) for m in BACK], CHAIN.transition, CHAIN.initial, mean, spread, 5
    )
    np.testing.assert_allclose(hg.linear.lmmse(system).gains.covariance, expected, rtol=1e-9, atol=1e-12)


def test_a_plant_that_changes_with_the_mode():
    """A mode of the plant that is received only through it, and other fading on the link."""
    plants = [
        GainAndNoise(Constant(1.0), [[a]], hg.Gaussian([[q]], [b])) for a, q, b in ((0.5, 0.1, 1.0), (0.95, 0.4, 0.0))
    ]
    link = hg.markov_fading([0.4, 1.0], [[0.7, 0.3], [0.2, 0.8]], 0.1)
    system = hg.linear.modal_system(Modes(CHAIN, plants), link, [0.3], [[0.5]], 4)
    joint = hg.random_affine.joint_modes(link)
    moves, observe = [p for p in plants for _ in range(2)], list(joint.maps) * 2
    rows, law = np.kron(CHAIN.transition, joint.transition), np.kron(CHAIN.initial, joint.initial)
    expected = over_paths(moves, observe, rows, law, [0.3], [[0.5]], 4)
    result = hg.linear.lmmse(system).gains.covariance
    np.testing.assert_allclose(result, expected, rtol=1e-9)
    item = hg.filters.LinearSystemFilter(system)
    hg.testing.check_filter(item, steps=4)


def test_without_modes_of_the_plant_it_is_the_linear_filter():
    move = GainAndNoise(Constant(1.0), PLANT.matrix, PLANT.noise)
    observed = Series([GainAndNoise(Constant(1.0), SENSOR.matrix, SENSOR.noise), bursts()])
    system = hg.linear.modal_system(move, observed, PLANT.initial_mean, PLANT.initial_covariance, 20)
    result = hg.linear.lmmse(system).gains.covariance[:, 0]
    np.testing.assert_allclose(result, variances(PLANT, SENSOR, bursts(), 20), rtol=1e-12)


def test_what_does_not_fit_is_refused():
    drifting = hg.model.autoregressive_fading(0.5, 0.1, 0.9, 0.1)
    with pytest.raises(ValueError, match=r"^move: expected chains as its memories, got a gain that drifts"):
        hg.linear.modal_system(drifting, bursts(), [0.0], [[1.0]], 3)
    with pytest.raises(ValueError, match=r"^inputs of the measurement: expected 2"):
        hg.linear.modal_system(relay(LINKS[0]), bursts(), [0.0, 0.0], np.eye(2), 3)
