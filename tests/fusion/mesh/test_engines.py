"""Fusions between neighbours by native code and by XLA: the same numbers, and which takes how long a graph."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion import MatrixWeights, TraceIntersection
from heliograph.simulation.mesh import build_mesh
from tests.fusion.mesh.worlds import PLANT, network

BURSTS = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.2), 0.1, 0.4)
LOSSY = hg.erasure(hg.perfect(), 0.7)
ROWS = {name: ([[1.0, 0.1 * i]], 0.3) for i, name in enumerate("abcde")}  # alike, and more than a program's
RING = {name: ["abcde"[i - 1], "abcde"[i - 4]] for i, name in enumerate("abcde")}
FUSIONS = {
    "rounds": hg.Fusion("own", TraceIntersection(), neighbours=RING, link=BURSTS, rounds=2),
    "best": hg.Fusion("own", MatrixWeights(), neighbours=RING, link=LOSSY),
}


@pytest.mark.slow
def test_both_engines_have_the_same_numbers(monkeypatch):
    """Draws to the last bits, covariances to 1e-10.

    Where estimates nearly agree, best weights are those of a flat minimum: means to 1e-8, a condition of 5e7.
    """
    world, records = hg.Network(PLANT, network({}, RING, rows=ROWS).nodes, FUSIONS), {}
    for engine in ("native", "xla"):
        monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
        records[engine] = hg.monte_carlo(world, 30, 40, 5)
    native, xla = records["native"], records["xla"]
    for node, fused in xla.estimates.items():
        np.testing.assert_allclose(native.truth, xla.truth, rtol=0, atol=1e-12)
        for name in FUSIONS:
            mean, covariance = (np.asarray(x) for x in (fused[name].mean, fused[name].covariance))
            deviation = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1).max())
            error = {"rtol": 0, "err_msg": f"{node}/{name}"}
            np.testing.assert_allclose(
                native.estimates[node][name].mean, mean, atol=(1e-8 if name == "best" else 1e-10) * deviation, **error
            )
            other = native.estimates[node][name].covariance
            np.testing.assert_allclose(other, covariance, atol=1e-10 * deviation**2, **error)
            assert native.estimates[node][name].claim == fused[name].claim


@pytest.mark.parametrize(
    ("rule", "nodes", "long"),
    [(TraceIntersection(), 240, False), (TraceIntersection(), 267, True), (MatrixWeights(), 20, False),
     (MatrixWeights(), 21, True)],
)  # fmt: skip
def test_graphs_by_the_hundred_are_left_to_xla(rule, nodes, long):
    """Two states, two neighbours and itself: 12 numbers a node; a joint covariance of 40 rows is native still."""
    names = [str(i) for i in range(nodes)]
    ring = {name: [names[i - 1], names[(i + 1) % nodes]] for i, name in enumerate(names)}
    start = network({}).nodes["a"]
    world = hg.Network(PLANT, {name: start for name in names}, {"m": hg.Fusion("own", rule, neighbours=ring)})
    assert build_mesh(world, "m").has_long_step == long


@pytest.mark.slow
def test_large_decompositions_of_two_lanes_do_not_wait_for_each_other(monkeypatch):
    """Five nodes of eight states, with weights of 24 rows: it once never ended, with two lanes on two threads.

    Native code refuses it, after all operations that it takes; XLA ended at no number of steps, from one on.
    """
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    random, names = np.random.default_rng(0), "abcde"
    plant = hg.LinearPlant(0.9 * np.eye(8) + 0.02 * random.normal(size=(8, 8)), 0.1 * np.eye(8), np.zeros(8), np.eye(8))
    sensor = hg.LinearSensor(random.normal(size=(2, 8)), 0.5 * np.eye(2))
    node = hg.Node(sensor, hg.perfect(2), {"own": hg.kalman_filter(plant, sensor)})
    world = hg.Network(plant, dict.fromkeys(names, node), {"best": FUSIONS["best"]})
    sums = hg.monte_carlo(world, 5, 256, 1, hg.Statistics())
    # Exact claims: NEES over 256 runs within five standard errors of one.
    assert all(
        sums[name]["best"].nees_per_dimension()[-1] == pytest.approx(1.0, abs=5 * np.sqrt(2 / 8 / 256))
        for name in names
    )
