"""An implausible value that a central filter receives is its node's, and costs that value alone; as live."""

import numpy as np
import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.95]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)


def network():
    joint = hg.LinearSensor(np.ones((3, 1)), 0.1 * np.eye(3))
    node = hg.Node(SENSOR, hg.perfect(), {})
    return hg.Network(PLANT, dict.fromkeys("abc", node), fused={"all": hg.kalman_filter(PLANT, joint)})


@pytest.mark.slow
def test_the_value_is_its_nodes_and_the_others_of_its_row_are_used():
    """Every node was blamed, also one that sent nothing in that row, and the row's good values went with it."""
    z = {name: np.random.default_rng(i).normal(size=(12, 1)) for i, name in enumerate("abc")}
    z["a"][5] = np.nan
    clean = {name: rows.copy() for name, rows in z.items()}
    for name, row, value in (("b", 3, 1e12), ("c", 5, -1e30), ("a", 7, 1e12), ("b", 7, 1e14)):
        z[name][row], clean[name][row] = value, np.nan
    with pytest.warns(UserWarning, match="implausible") as said:
        outcome = hg.run(network(), z)
    begun = [str(line.message).partition(" implausible, as if not arrived")[0] for line in said]
    assert begun == ["node 'b': 2 rows (4, 8) are", "node 'c': row 6 is", "node 'a': row 8 is"]
    expected = hg.run(network(), clean).estimates["fused"]["all"]
    np.testing.assert_array_equal(outcome.estimates["fused"]["all"].mean, expected.mean)
    np.testing.assert_array_equal(outcome.measurements["b"], clean["b"])
    # The same as live.
    timeline = hg.Timeline(network(), window=20.0)
    for k in range(12):
        for name in "abc":
            timeline.push(name, k, k, z[name][k])
    refused = {name: counts["implausible"] for name, counts in timeline.counts.items()}
    assert refused == {"a": 1, "b": 2, "c": 1, "inputs": 0}
    timeline.advance(100.0)
    np.testing.assert_allclose(timeline.final().estimates["fused"]["all"].mean, expected.mean, atol=1e-14)


def test_where_no_single_node_is_to_blame_the_largest_value_goes_first():
    """A filter that is sure of itself finds two equal faults of a row implausible, with and without either."""
    z = {name: np.zeros((4, 1)) for name in "abc"}
    z["a"][2], z["b"][2] = 1e12, 2e12
    with pytest.warns(UserWarning, match="node '[ab]': row 3 is implausible"):
        outcome = hg.run(network(), z)
    assert [bool(np.isnan(outcome.measurements[name][2, 0])) for name in "abc"] == [True, True, False]
