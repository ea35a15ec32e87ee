"""A long recording run through a network in chunks of rows side by side: the sequential pass."""

import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.rows import chunks

ROWS = 34_001
RNG = np.random.default_rng(5)
PLANT = hg.LinearPlant([[0.99, 0.1], [-0.1, 0.97]], 0.01, [1.0, 1.0], 1.0, [[0.1], [0.0]])
BOTH, ONE = hg.LinearSensor(np.eye(2), 0.1), hg.LinearSensor([[1.0, 0.0]], 0.2)
HOP = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1, dimension=2)
NODES = {
    "near": hg.Node(ONE, hg.perfect(1), {"Kalman": hg.kalman_filter(PLANT, ONE)}),
    "far": hg.Node(BOTH, HOP, {"linear": hg.linear_filter(PLANT, BOTH, HOP)}),
}
NETWORK = hg.Network(PLANT, NODES)
U = RNG.normal(size=(ROWS, 1))


def data():
    z = {"near": RNG.normal(size=(ROWS, 1)), "far": RNG.normal(size=(ROWS, 2))}
    z["far"][RNG.random((ROWS, 2)) < 0.2] = np.nan
    z["near"][10_000:13_000] = np.nan
    return z


@pytest.mark.slow
def test_it_is_the_sequential_pass(monkeypatch):
    z = data()
    of_chunks = hg.run(NETWORK, z, U)
    monkeypatch.setattr(chunks, "CHUNKS", ROWS)
    of_rows = hg.run(NETWORK, z, U)
    for node, filter in (("near", "Kalman"), ("far", "linear")):
        one, other = of_chunks.estimates[node][filter], of_rows.estimates[node][filter]
        deviation = np.sqrt(np.diagonal(other.covariance, axis1=1, axis2=2))
        assert np.max(np.abs(one.mean - other.mean) / deviation) < 1e-10
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-10, atol=1e-13)
        assert one.claim == other.claim == "exact"
    ahead, later = (hg.forecast(record, 3, inputs="held")["far"]["linear"] for record in (of_chunks, of_rows))
    np.testing.assert_allclose(ahead.states.mean, later.states.mean, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_implausible_rows_are_left_out_of_it():
    z = data()
    z["far"][20_000] = 1e30
    with pytest.warns(UserWarning, match=r"node 'far': 1 rows? \(20001\)|node 'far': row 20001"):
        of_all = hg.run(NETWORK, z, U)
    z["far"][20_000] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        without = hg.run(NETWORK, z, U)
    one, other = (record.estimates["far"]["linear"].mean for record in (of_all, without))
    np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11)  # the latter in chunks
