"""A centre, a tree and losses on the way there: errors of nodes between neighbours, and of a fusion without them.

The numbers are those of `docs/without_a_centre.md`: traces of the error of two states, of four nodes, after 60 steps.
"""

import numpy as np
import pytest

import heliograph as hg

pytestmark = pytest.mark.slow
PLANT = hg.LinearPlant([[0.95, 0.3], [0.0, 0.9]], 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
NUMBERS = {
    "output": np.array([[[1.0, 0.0]], [[0.6, 1.0]], [[1.0, 0.5]], [[0.3, 1.0]]]),
    "noise": np.array([0.3, 0.5, 0.8, 0.4]),
}
STEPS, DIGITS = 60, 5e-4
LINK = hg.erasure(hg.perfect(), 0.7)


def leaf(numbers):
    sensor = hg.LinearSensor(numbers["output"], numbers["noise"])
    return hg.Node(sensor, hg.perfect(), {"own": hg.kalman_filter(PLANT, sensor)})


LEAVES = {f"n{i}": leaf({name: values[i] for name, values in NUMBERS.items()}) for i in range(4)}


def between(neighbours, link=None):
    """Network whose only fusion is between these neighbours."""
    others = dict.fromkeys(name for name in neighbours if name not in LEAVES)
    fusion = hg.Fusion("own", hg.fusion.MatrixWeights(), neighbours=neighbours, link=link)
    return hg.Network(PLANT, LEAVES | others, {"m": fusion})


def error_at(errors, name):
    return np.trace(errors.actual[-1, errors.nodes.index(name)])


def central():
    """Trace of the error of the filter that receives every measurement."""
    p, a = np.eye(2), np.asarray(PLANT.matrix)
    for _ in range(STEPS):
        p = a @ p @ a.T + 0.1 * np.eye(2)
        for row, r in zip(NUMBERS["output"], NUMBERS["noise"], strict=True):
            p = p - p @ row.T @ row @ p / (row @ p @ row.T + r)
    return np.trace(p)


def test_a_node_that_receives_all_is_the_central_filter_as_a_centre_of_all_reports_is():
    assert central() == pytest.approx(0.197, abs=DIGITS)
    assert error_at(hg.simulation.mesh_errors(between({"hub": list(LEAVES)}), "m", STEPS), "hub") == pytest.approx(
        central(), rel=1e-9
    )
    rules = {"reports": hg.fusion.AllReports(), "weights": hg.fusion.MatrixWeights()}
    fusions = {name: hg.Fusion("own", rule) for name, rule in rules.items()}
    fused = hg.simulation.fused_covariances(hg.Network(PLANT, LEAVES, fusions), STEPS)
    # Reports of a filter's estimates are worth its measurements where it loses none.
    assert np.trace(fused["reports"][-1]) == pytest.approx(central(), rel=1e-9)
    assert np.trace(fused["weights"][-1]) == pytest.approx(0.210, abs=DIGITS)  # what was fused is not remembered


def test_a_tree_of_neighbours_needs_a_step_for_each_level():
    tree = hg.simulation.relay_tree(PLANT, leaf, NUMBERS, degree=2, horizon=STEPS)
    assert np.trace(tree.covariances[-1][0]) == pytest.approx(0.222, abs=DIGITS)
    levels = between({"r0": ["n0", "n1"], "r1": ["n2", "n3"], "root": ["r0", "r1"]})
    errors, arrived = hg.simulation.mesh_errors(levels, "m", STEPS), hg.simulation.mesh_arrivals(levels, "m", STEPS, 0)
    assert error_at(errors, "root") == pytest.approx(0.371, abs=DIGITS)
    bound = hg.simulation.best_possible(levels, "m", arrived)[errors.nodes.index("root")]
    assert np.trace(bound) == pytest.approx(0.365, abs=DIGITS)


def test_behind_losses_reports_of_all_steps_are_worth_more_than_weights_that_are_best_for_one():
    """Mean over losses: exact for the node; of 4,000 runs of the centre to 1 %, five standard errors."""
    node = error_at(hg.simulation.mean_mesh_errors(between({"hub": list(LEAVES)}, LINK), "m", STEPS), "hub")
    assert node == pytest.approx(0.245, abs=DIGITS)
    uplink = hg.fusion.ReportLink(channel=hg.erasure(hg.perfect(2), 0.7))
    network = hg.Network(PLANT, LEAVES, {"reports": hg.Fusion("own", hg.fusion.AllReports(), uplink=uplink)})
    record = hg.monte_carlo(network, STEPS, 4000, 0)
    claimed = np.trace(record.estimates["fused"]["reports"].covariance[:, -20:], axis1=-2, axis2=-1).mean()
    assert record.estimates["fused"]["reports"].claim == "exact"
    assert claimed == pytest.approx(0.241, rel=0.01)
