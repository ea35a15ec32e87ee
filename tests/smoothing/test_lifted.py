"""Smoothers that work on a lifted state, against everything that can happen, listed; and one that claims a bound."""

from itertools import pairwise, product

import numpy as np
import pytest

import heliograph as hg
from tests.oracles.stacked_estimate import Stacked, Step, estimate, stacked
from tests.relays.relay_problems import example as relays

CLOSE = 1e-11  # of numbers of size one
INTERVAL = hg.smoothing.FixedInterval()


def mixed(parts: list[Stacked], chances: np.ndarray) -> Stacked:
    """Joint moments of what is one of several with these chances."""
    means = [np.tensordot(chances, [getattr(p, name) for p in parts], axes=1) for name in ("x", "z")]
    apart = [(p.x.ravel() - means[0].ravel(), p.z - means[1]) for p in parts]
    xx = sum(c * (p.xx + np.outer(x, x)) for c, p, (x, _) in zip(chances, parts, apart, strict=True))
    xz = sum(c * (p.xz + np.outer(x, z)) for c, p, (x, z) in zip(chances, parts, apart, strict=True))
    zz = sum(c * (p.zz + np.outer(z, z)) for c, p, (_, z) in zip(chances, parts, apart, strict=True))
    return Stacked(means[0], xx, means[1], xz, zz)


@pytest.mark.slow
def test_behind_a_link_that_remembers_it_is_the_best_linear_estimate():
    a, q, mean, p0 = np.array([[0.9, 0.2], [0.0, 0.7]]), np.diag([0.3, 0.0]), np.array([1.0, -0.5]), np.diag([0.5, 0.2])
    plant, sensor = hg.LinearPlant(a, q, mean, p0), hg.LinearSensor([[1.0, 0.5]], 0.1)
    gains, chain, start = np.array([0.2, 1.1]), np.array([[0.8, 0.2], [0.3, 0.7]]), np.array([0.4, 0.6])
    link = hg.markov_fading(gains, hg.random_affine.MarkovChain(chain, start), 0.2)
    time, item, empty = 5, np.eye(1), np.zeros(1)

    def given(modes):
        steps = [
            Step(a, np.zeros(2), q, np.array([[1.0, 0.5]]), empty, 0.1 * item, gains[[m], None, None] * item, np.ones(1)
            ,
                 empty, 0.2 * item) for m in modes
        ]  # fmt: skip
        return stacked(mean, p0, steps)

    paths = list(product(range(2), repeat=time))
    chances = [start[p[0]] * np.prod([chain[i, j] for i, j in pairwise(p)]) for p in paths]
    z = np.array([[0.4], [-0.2], [np.nan], [0.7], [0.1]])
    known = estimate(mixed([given(path) for path in paths], np.array(chances)), z, time)
    _, steps = hg.smoothing.smoother_steps(hg.linear_filter(plant, sensor, link), z)
    smoothed = INTERVAL.estimates(steps)
    assert smoothed.claim == "exact"
    np.testing.assert_allclose(smoothed.mean, known[0], rtol=0, atol=CLOSE)
    np.testing.assert_allclose(smoothed.covariance, known[1], rtol=0, atol=CLOSE)


def test_a_quadratic_smoother_is_the_best_in_z_and_its_squares():
    law, time = hg.random_affine.FiniteSupport([[-0.4], [0.8]], [2 / 3, 1 / 3]), 3
    gains, chances = [0.6, 1.3], [0.5, 0.5]
    plant = hg.LinearPlant([[0.8]], law, [0.5], hg.random_affine.FiniteSupport([[-0.3], [0.6]], [2 / 3, 1 / 3]))
    sensor, link = hg.LinearSensor([[1.0]], law), hg.hop(hg.Discrete(gains, chances), 0.0)
    rows, weights = [], []  # everything that can happen, with its probability
    two = [(-0.4, 2 / 3), (0.8, 1 / 3)]
    for start, *draws in product(
        [(0.2, 2 / 3), (1.1, 1 / 3)], *[two, two, list(zip(gains, chances, strict=True))] * time
    ):
        x, states, received, weight = start[0], [], [], start[1]
        for w, v, g in zip(draws[::3], draws[1::3], draws[2::3], strict=True):
            x = 0.8 * x + w[0]
            states.append(x)
            received.append(g[0] * (x + v[0]))
            weight *= w[1] * v[1] * g[1]
        rows.append([*states, *received, *np.square(received)])
        weights.append(weight)
    table, weights = np.array(rows), np.array(weights)
    center = weights @ table
    joint = (weights[:, None] * (table - center)).T @ (table - center)
    gain = np.linalg.solve(joint[3:, 3:], joint[3:, :3]).T
    z = np.array([0.3, 0.9, -0.2])
    item = hg.polynomial_filter(plant, sensor, link, time, degree=2)
    _, steps = hg.smoothing.smoother_steps(item, z[:, None])
    smoothed = INTERVAL.estimates(steps)
    assert smoothed.claim == "exact"
    expected = center[:3] + gain @ (np.concatenate([z, z**2]) - center[3:])
    np.testing.assert_allclose(smoothed.mean[:, 0], expected, rtol=0, atol=CLOSE)
    left = np.diag(joint[:3, :3] - gain @ joint[3:, :3])
    np.testing.assert_allclose(smoothed.covariance[:, 0, 0], left, rtol=0, atol=CLOSE)


@pytest.mark.slow
def test_a_receiver_behind_relays_smooths_the_relays_states_too():
    network, time = relays(), 6
    gains = hg.relays.local_error_design(network, time).gains
    system = hg.relays.receiver_system(network, gains)
    receiver = hg.filters.LinearSystemFilter(system)
    s, projection = system.steps, system.projection
    n, none = s.drift.shape[1], np.zeros(1)
    steps = [
        Step(s.transition[k], s.drift[k], s.process[k], np.eye(n), np.zeros(n), np.zeros((n, n)), s.output[[k]],
             np.ones(1), none, np.zeros((1, 1))) for k in range(time)
    ]  # fmt: skip
    whole = stacked(system.mean, system.covariance, steps)
    z = (whole.z + np.sqrt(np.diag(whole.zz)) * np.array([0.2, np.nan, -0.1, 0.3, 0.2, 0.1]))[:, None]
    mean, covariance = estimate(whole, z, time)
    _, steps_ = hg.smoothing.smoother_steps(receiver, z)
    smoothed = INTERVAL.estimates(steps_)
    scale = np.sqrt(np.abs(whole.xx).max())
    np.testing.assert_allclose(smoothed.mean, mean @ projection.T, rtol=0, atol=CLOSE * scale)
    np.testing.assert_allclose(
        smoothed.covariance, projection @ covariance @ projection.T, rtol=0, atol=CLOSE * scale**2
    )
    schedule = hg.filters.ScheduledFilter(hg.relays.receiver_behind_relays(network, gains))
    with pytest.raises(
        ValueError, match=r"smoothing: expected a filter that keeps its covariance .*, got ScheduledFilter"
    ):
        hg.smoothing.smoother_steps(schedule, z)


def test_a_bound_holds_under_every_law_where_the_mean_gain_is_known():
    plant, sensor, time = hg.LinearPlant([[0.9]], 0.2, [1.0], 0.5), hg.LinearSensor([[1.0]], 0.1), 6
    quiet, loud = hg.hop(1.0, 0.05), hg.hop(1.0, 0.8)
    link = hg.random_affine.Mixture([quiet, loud], [0.7, 0.3], 0.2)
    planned = hg.smoothing.planned_smoother(hg.linear_filter(plant, sensor, link), time, INTERVAL)
    assert planned.estimate.claim == "upper"
    base = hg.simulation.over_runs(planned.means, np.concatenate([np.zeros((1, time, 1)), np.eye(time)[:, :, None]]))
    gain, offset = (base[1:, :, 0] - base[0, :, 0]).T, base[0, :, 0]
    item = np.eye(1)
    for loud_share in (0.1, 0.3, 0.5):  # the laws within the radius, and in the middle
        noise = (1 - loud_share) * 0.05 + loud_share * 0.8
        step = Step(0.9 * item, np.zeros(1), 0.2 * item, item,
        np.zeros(1), 0.1 * item, item[None], np.ones(1), np.zeros(1),
                    noise * item)  # fmt: skip
        s = stacked([1.0], 0.5 * item, [step] * time)
        true = s.xx - gain @ s.xz.T - s.xz @ gain.T + gain @ s.zz @ gain.T
        np.testing.assert_allclose(s.x[:, 0] - offset - gain @ s.z, 0.0, atol=1e-12)  # no bias
        ratio = np.diag(true) / planned.estimate.covariance[:, 0, 0]
        assert np.all(ratio <= 1 + 1e-9)
        assert loud_share < 0.5 or np.all(ratio > 1 - 1e-6)  # the worst law reaches it
    uncertain = hg.linear_filter(plant, sensor, hg.hop(hg.Discrete([0.5, 1.0], [0.4, 0.6], 0.2), 0.05))
    assert hg.smoothing.planned_smoother(uncertain, 3, INTERVAL).estimate.claim == "nominal"
