"""Nodes that share a sensor's noise and a hop: their cross-covariances by hand, and by Monte Carlo."""

import numpy as np
import pytest

import heliograph as hg
from tests.fusion.fusion_problems import two_gains
from tests.oracles.shared_information import local_gains

A, Q = np.array([[0.95, 0.2], [0.0, 0.9]]), 0.1 * np.eye(2)
MEAN = np.array([1.0, -0.5])
R = np.array([[0.2, 0.12], [0.12, 0.3]])
FIRST, LOCAL = (
    (0.8, 0.1),
    ((0.9, 0.05), (0.7, 0.02)),
)  # mean and variance of the gains of the shared hop and each node's
HOP_NOISE, LOCAL_NOISE = 0.05, 0.1


def shared_network(fused):
    """One sensor of two outputs with correlated noise, one hop for both, then a hop to each node."""
    plant = hg.LinearPlant(A, Q, MEAN, np.eye(2))
    hops = [hg.hop(two_gains(*gain), noise=LOCAL_NOISE) for gain in LOCAL]
    common = hg.hop(two_gains(*FIRST), noise=HOP_NOISE, dimension=2)
    channel = hg.amplify_and_forward([common, hg.parallel(hops)])
    filters = {}
    for i, hop in enumerate(hops):
        sensor = hg.LinearSensor(np.eye(2)[[i]], R[i, i])
        alone = hg.amplify_and_forward([hg.hop(two_gains(*FIRST), noise=HOP_NOISE), hop])
        filters[f"node {i}"] = {"local": hg.linear_filter(plant, sensor, alone)}
    return hg.Network.sharing(plant, hg.LinearSensor(np.eye(2), R), channel, filters, fused)


def spread(second):
    """E[nu nu'] for z_i = h_i (g y_i + n_i) + m_i."""
    gains = np.array([mean for mean, _ in LOCAL])
    received = (FIRST[0] ** 2 + FIRST[1]) * (second + R) + HOP_NOISE * np.eye(2)
    total = np.outer(gains, gains) * received + np.diag([variance for _, variance in LOCAL]) * received
    known = FIRST[0] * np.diag(gains)
    return total + LOCAL_NOISE * np.eye(2) - known @ second @ known


def by_hand(steps):
    """Cov of (e_1, e_2)."""
    model, known = (A, Q, MEAN, np.eye(2)), FIRST[0] * np.diag([mean for mean, _ in LOCAL])
    gains = [local_gains(model, known[[i]], lambda s, i=i: spread(s)[i : i + 1, i : i + 1], steps) for i in range(2)]
    state, mean, joint = np.eye(2), MEAN, np.ones((2, 2, 2, 2)) * np.eye(2)[None, :, None, :]
    for k in range(steps):
        state, mean = A @ state @ A.T + Q, A @ mean
        noise = spread(state + np.outer(mean, mean))
        keep = [np.eye(2) - gains[i][k] @ known[[i]] for i in range(2)]
        pairs = [
            [
                keep[i] @ (A @ joint[i, :, j] @ A.T + Q) @ keep[j].T + noise[i, j] * gains[i][k] @ gains[j][k].T
                for j in range(2)
            ]
            for i in range(2)
        ]
        joint = np.array(pairs).transpose(0, 2, 1, 3)
    return joint


def test_cross_covariances_of_what_is_shared():
    cross = hg.simulation.cross_covariances(shared_network({}), "local", 15)
    np.testing.assert_allclose(cross.joint, by_hand(15), rtol=1e-9, atol=1e-12)
    _, covariance = cross.matrix_weights()
    net = shared_network({"matrix": hg.Fusion("local", hg.fusion.MatrixWeights())})
    np.testing.assert_allclose(hg.simulation.fused_covariances(net, 15)["matrix"][-1], covariance, rtol=1e-9)


def test_monte_carlo_agrees():
    """The claims within three standard errors; as if nothing but the plant were shared they would be off by more."""
    rules = {"matrix": hg.fusion.MatrixWeights(), "all": hg.fusion.AllReports()}
    net = shared_network({name: hg.Fusion("local", rule) for name, rule in rules.items()})
    record = hg.monte_carlo(net, 8, 8000, 0)
    errors = np.stack([record.errors(f"node {i}", "local")[:, -1] for i in range(2)], axis=1)
    product = np.einsum("ka,kb->kab", errors[:, 0], errors[:, 1])
    off = np.abs(product.mean(axis=0) - by_hand(8)[0, :, 1]) / (product.std(axis=0) / np.sqrt(len(product)))
    assert np.all(off < 3)
    for name, estimate in record.estimates["fused"].items():
        square = np.sum(record.errors("fused", name)[:, -1] ** 2, axis=-1)
        claimed = np.trace(estimate.covariance[0, -1])
        assert estimate.claim == "exact" and abs(square.mean() - claimed) < 3 * square.std() / np.sqrt(len(square))


def test_all_outputs_are_received_once():
    net = shared_network({})
    filters = {"alone": net.nodes["node 0"].filters}
    with pytest.raises(ValueError, match="to receive its 2 outputs, each once"):
        hg.Network.sharing(net.plant, net.common.sensor, net.common.channel, filters)
