"""Random networks of one shape whose nodes share noise, a hop and a plant that may grow: what holds for all."""

import hypothesis as hy
import numpy as np
import pytest
from hypothesis import strategies as st

import heliograph as hg
from tests.as_code import printing
from tests.fusion.fusion_problems import two_gains

STEPS = 8
RULES = {
    "matrix": hg.fusion.MatrixWeights(),
    "with_mean": hg.fusion.MatrixWeights(with_mean=True),
    "all_reports": hg.fusion.AllReports(),
}
TURNED, SAME = [1, 0, 2], np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0]])


def drawn(seed, growth):
    """Plant, sensor noise, shared hop and own hops; node 3 receives what node 2 receives, bit for bit."""
    draw = np.random.default_rng(seed)
    matrix = draw.normal(size=(2, 2))
    matrix *= growth / np.abs(np.linalg.eigvals(matrix)).max()
    roots = draw.normal(size=(3, 2, 2))
    q, r, start = (root @ root.T + 0.05 * np.eye(2) for root in roots)
    gains = 0.4 + draw.random(3)
    return {
        "a": matrix, "q": q / 4, "r": r / 4, "mean": draw.normal(size=2), "p": start,
        "outputs": draw.normal(size=(2, 2)), "gains": gains, "spreads": gains**2 * draw.random(3) / 4,
        "noises": 0.05 + draw.random(2) / 4, "guess": draw.normal(size=2),
    }  # fmt: skip


def network(d, rules, order=(0, 1, 2)):
    """Two sensors with correlated noise, one hop for both, a hop to each node, of which the second is received twice.

    The first node's filter trusts the mean gain and starts where it likes: its gains are not the best.
    """
    plant = hg.LinearPlant(d["a"], d["q"], d["mean"], d["p"])
    hops = [hg.hop(two_gains(d["gains"][i], d["spreads"][i]), noise=d["noises"][i]) for i in range(2)]
    shared = two_gains(d["gains"][2], d["spreads"][2])
    first = hg.hop(shared, noise=0.05, dimension=2)
    received = hg.random_affine.known(SAME[list(order)][:, :2])
    channel = hg.amplify_and_forward([first, hg.parallel(hops), received])
    filters = {}
    for node in order:
        i = min(node, 1)
        sensor = hg.LinearSensor(d["outputs"][[i]], d["r"][i, i])
        alone = hg.amplify_and_forward([hg.hop(shared, noise=0.05), hops[i]])
        wrong = hg.mean_gain_filter(plant, sensor, alone, initial_mean=d["guess"])
        filters[f"node {node}"] = {"local": wrong if i == 0 else hg.linear_filter(plant, sensor, alone)}
    fused = {name: hg.Fusion("local", rule) for name, rule in rules.items()}
    return hg.Network.sharing(plant, hg.LinearSensor(d["outputs"], d["r"]), channel, filters, fused)


def by_hand(d, gains):
    """Second moments E e e' of the first two nodes' errors, for gains (node, step, 2) whatever they are."""
    a, q = d["a"], d["q"]
    mean_gain, variance = d["gains"][2], d["spreads"][2]
    known = mean_gain * d["gains"][:2]
    state, mean = d["p"], d["mean"]
    joint = np.array([[d["p"] + np.outer(mean - s, mean - t) for t in (d["guess"], mean)] for s in (d["guess"], mean)])
    for k in range(STEPS):
        state, mean = a @ state @ a.T + q, a @ mean
        y = d["outputs"] @ (state + np.outer(mean, mean)) @ d["outputs"].T + d["r"]
        first = (mean_gain**2 + variance) * y + 0.05 * np.eye(2)
        z = np.outer(d["gains"][:2], d["gains"][:2]) * first + np.diag(d["spreads"][:2] * np.diag(first) + d["noises"])
        clean = np.outer(known, known) * (d["outputs"] @ (state + np.outer(mean, mean)) @ d["outputs"].T)
        noise = z - clean
        keep = [np.eye(2) - np.outer(gains[i][k], known[i] * d["outputs"][i]) for i in range(2)]
        joint = np.array([
            [keep[i] @ (a @ joint[i, j] @ a.T + q) @ keep[j].T + noise[i, j] * np.outer(gains[i][k], gains[j][k])
             for j in range(2)]
            for i in range(2)
        ])  # fmt: skip
    return joint


@pytest.mark.slow
@hy.settings(max_examples=4, deadline=None, derandomize=True)
@hy.given(seed=st.integers(0, 2**32 - 1), growth=st.floats(0.3, 1.2))
def test_what_holds_for_every_network(seed, growth):
    """Cross-covariances are those by hand; order and copies change nothing; the mean and memory are never worse."""
    d = drawn(seed, growth)
    net = network(d, RULES)
    with printing(plant=net.plant, common=net.common, drawn=d):
        check_what_holds(d, net)


def check_what_holds(d, net):
    cross = hg.simulation.cross_covariances(net, "local", STEPS)
    joint = cross.joint + np.einsum("ia,jb->iajb", cross.bias, cross.bias)
    plans = [net.nodes[f"node {i}"].filters["local"].planned(np.zeros((STEPS, 0))) for i in range(2)]
    expected = by_hand(d, [np.asarray(p.steps.values.gain)[:, :, 0] for p in plans])
    size = np.abs(joint).max()
    np.testing.assert_allclose(joint[:2, :, :2].transpose(0, 2, 1, 3), expected, rtol=1e-8, atol=1e-10 * size)
    np.testing.assert_allclose(joint[2], joint[1], rtol=1e-12, atol=1e-12 * size)  # a copy
    turned = hg.simulation.cross_covariances(network(d, {}, TURNED), "local", STEPS)
    np.testing.assert_allclose(turned.joint, cross.joint[TURNED][:, :, TURNED], rtol=1e-9, atol=1e-11 * size)
    fused = hg.simulation.fused_covariances(net, STEPS)
    matrix, with_mean, everything = (float(np.trace(fused[name][-1])) for name in RULES)
    assert everything <= with_mean * (1 + 1e-7) and with_mean <= matrix * (1 + 1e-7)
    two = cross.joint[:2][:, :, :2]
    weights = hg.fusion.MatrixWeights().weights(two)
    without = np.trace(np.einsum("aib,ibjc,djc->ad", weights, two, weights))
    assert abs(matrix - without) <= 1e-7 * without
    assert set(net.claims()["fused"].values()) == {"exact"}
