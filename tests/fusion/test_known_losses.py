"""Observed losses: a claim for each pattern of losses, every pattern of a small case enumerated."""

from itertools import product

import numpy as np
import pytest

import heliograph as hg
from tests.fusion.fusion_problems import network

STEPS, N = 3, 2
PLANT = hg.LinearPlant([[0.9, 0.3], [-0.2, 1.1]], [[0.3, 0.1], [0.1, 0.2]], [1.0, -2.0], np.eye(2))
PARTS = [(np.array([[1.0, 0.0]]), 0.2, 0.8, 0.05, 0.1), (np.array([[0.5, 1.0]]), 0.3, 0.9, 0.1, 0.1)]


def stacked(pattern):
    """Joint covariance of the local errors, and of x given all reports so far, for losses (step, node) as they were.

    x and the estimates as linear maps of x_0, w_1, ... and what the channels add, all white; a gain is zero where
    nothing arrived, else the best for the error's own covariance.
    """
    a, q = np.asarray(PLANT.matrix), np.asarray(PLANT.noise.covariance)
    sources = N + STEPS * (N + len(PARTS))
    weight = np.zeros((sources, sources))
    weight[:N, :N] = PLANT.initial_covariance
    x, mean = np.eye(N, sources), np.asarray(PLANT.initial_mean)
    outputs = [np.zeros((N, sources)) for _ in PARTS]
    reports = []
    for k in range(STEPS):
        place = N + k * (N + len(PARTS))
        weight[place : place + N, place : place + N] = q
        x, mean = a @ x + np.eye(N, sources, place), a @ mean
        second = x @ weight @ x.T + np.outer(mean, mean)
        for i, (c, r, gain, variance, noise) in enumerate(PARTS):
            mine = place + N + i
            weight[mine, mine] = (variance * (c @ second @ c.T + r) + gain**2 * r + noise).item()
            received, before = gain * c @ x + np.eye(1, sources, mine), a @ outputs[i]
            error, unexpected = x - before, received - gain * c @ before
            use = error @ weight @ unexpected.T / (unexpected @ weight @ unexpected.T)
            outputs[i] = before + use @ unexpected if pattern[k, i] else before
            reports.append(outputs[i])
    errors = np.concatenate([x - mine for mine in outputs])
    known = np.concatenate(reports)
    cross = x @ weight @ known.T
    best = x @ weight @ x.T - cross @ np.linalg.pinv(known @ weight @ known.T, rcond=1e-11) @ cross.T
    return errors @ weight @ errors.T, best


@pytest.fixture(scope="module")
def net():
    rules = {"matrix": hg.fusion.MatrixWeights(), "all_reports": hg.fusion.AllReports()}
    perfect = network(PLANT, PARTS, {})
    nodes = {n: hg.Node(v.sensor, hg.erasure(v.channel, 0.6), v.filters) for n, v in perfect.nodes.items()}
    return hg.Network(PLANT, nodes, {name: hg.Fusion("local", rule) for name, rule in rules.items()})


def test_every_pattern_of_losses_has_its_own_covariance(net):
    """All 64 patterns of three steps and two nodes: 1e-8 of the stacked problem, and so the mean over patterns.

    Losses are drawn independently of x and of all noises: given the pattern, the errors are linear in these.
    """
    for pattern in product([False, True], repeat=STEPS * len(PARTS)):
        arrives = np.reshape(pattern, (STEPS, len(PARTS)))
        data = {f"node {i}": np.where(arrives[:, [i]], 0.0, np.nan) for i in range(len(PARTS))}
        result = hg.run(net, data).estimates["fused"]
        joint, best = stacked(arrives)
        np.testing.assert_allclose(result["all_reports"].covariance[-1], best, rtol=1e-8, atol=1e-10)
        ones = np.tile(np.eye(N), (len(PARTS), 1))
        inverse = np.linalg.pinv(joint + ones @ ones.T, rcond=1e-11)
        weights = np.linalg.solve(ones.T @ inverse @ ones, ones.T @ inverse)
        np.testing.assert_allclose(result["matrix"].covariance[-1], weights @ joint @ weights.T, rtol=1e-8, atol=1e-10)


@pytest.mark.slow
def test_precise_nodes_that_lose_measurements_keep_their_covariance():
    """Noise of 1e-9 of the state's variance: most of what a report says is known from those before it.

    Whether a covariance is none, or claims what rounding says, shows in the runs: the mean NEES of 2,560 estimates of
    three states is 3, with a standard error of .05 at most.
    """
    draw = np.random.default_rng(3)
    matrix, root = draw.normal(size=(2, 3, 3))
    plant, channel = hg.LinearPlant(matrix / 2, root @ root.T, np.zeros(3), np.eye(3)), hg.perfect(2)
    nodes = {}
    for name in ("a", "b"):
        sensor = hg.LinearSensor(draw.normal(size=(2, 3)), 1e-9 * np.eye(2))
        local = {"local": hg.linear_filter(plant, sensor, channel)}
        nodes[name] = hg.Node(sensor, hg.erasure(channel, 0.6), local)
    network = hg.Network(plant, nodes, {"all_reports": hg.Fusion("local", hg.fusion.AllReports())})
    statistics = hg.monte_carlo(network, 10, 256, 1, keep=hg.Statistics())
    assert statistics.failures() == []
    result = statistics["fused"]["all_reports"]
    assert np.sum(result.nees) / (10 * result.runs) == pytest.approx(3, abs=0.15)
