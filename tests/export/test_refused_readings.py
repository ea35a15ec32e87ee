"""Exported steps of a network refuse what its nodes refuse, as `run` does."""

import warnings

import numpy as np
import pytest

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.follow import apart

STEPS = 60
PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1 * np.eye(2), [20.0, 5.0], np.eye(2), states=["warm", "damp"])
RULES = {"kitchen": {"limits": (-40, 85), "invalid": [-999, 0.1]}, "hall": {"limits": [(None, 30)], "stuck": 9}}


def make_network(**fused):
    """Return two nodes with limits and codes, with fusions."""
    nodes = {}
    for i, (name, rules) in enumerate(RULES.items()):
        sensor = hg.LinearSensor(np.eye(2)[[i]], 0.1, outputs=["seen"])
        nodes[name] = hg.Node(sensor, hg.perfect(), {"local": hg.kalman_filter(PLANT, sensor)}, **rules)
    return hg.Network(PLANT, nodes, fused)


@pytest.fixture(scope="module")
def network():
    sensors = {name: hg.LinearSensor(np.eye(2)[[i]], 0.1) for i, name in enumerate(RULES)}
    return make_network(central=hg.kalman_filter(PLANT, hg.model.joint_sensor(sensors)))


@pytest.fixture(scope="module")
def data():
    random = np.random.default_rng(0)
    z = {name: random.normal(mean, 1, (STEPS, 1)) for name, mean in (("kitchen", 20), ("hall", 5))}
    for name, values in (("kitchen", [-999, 0.1, 86, -41, np.float32(0.1)]), ("hall", [31, 1e4])):
        z[name][random.choice(STEPS, len(values), replace=False), 0] = values
    return z


def run_silently(network, data):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what is refused is said
        return hg.run(network, data).estimates


@pytest.fixture(scope="module")
def recorded(network, data):
    return run_silently(network, data)


@needs_compiler
@pytest.mark.parametrize("node", RULES)
def test_a_node_alone(network, data, recorded, node, tmp_path):
    """-999 was a reading for the exported step, of the node whose description calls it a code."""
    device = Device(network, tmp_path, of="local", node=node)
    right = recorded[node]["local"]
    assert max(apart(device.follow(data[node], np.zeros((STEPS, 0))), (right.mean, right.covariance))) < 1e-12
    said = {"kitchen": "seen (not arrived: -999, 0.1, below -40, above 85)", "hall": "seen (not arrived: above 30)"}
    header = device.exported.header.read_text()
    assert f"z[0]: {said[node]}" in header and ("repeat for too long (stuck) are used" in header) == (node == "hall")


@needs_compiler
def test_the_centre_and_single_precision(network, data, recorded, tmp_path):
    z, right = np.hstack([data["kitchen"], data["hall"]]), recorded["fused"]["central"]
    for precision, near in (("double", 1e-12), ("float", 1e-5)):  # rounding of 60 steps
        device = Device(network, tmp_path, of="central", precision=precision)
        assert max(apart(device.follow(z, np.zeros((STEPS, 0))), (right.mean, right.covariance))) < near


@pytest.mark.slow
@needs_compiler
def test_a_node_between_neighbours(data, tmp_path):
    """A message of a neighbour holds its measurement as it was measured, with codes."""
    neighbours = {"kitchen": ["hall"], "hall": ["kitchen"]}
    network = make_network(mesh=hg.Fusion("local", hg.CovarianceIntersection(), neighbours=neighbours))
    recorded = run_silently(network, data)
    device = Device(network, tmp_path, of="mesh", node="kitchen")
    theirs = recorded["hall"]["mesh"]
    means = np.vstack([PLANT.initial_mean[None], theirs.mean[:-1]])
    covariances = np.concatenate([np.eye(2)[None], theirs.covariance[:-1]]).reshape(STEPS, 4)
    z = np.hstack([data["kitchen"], means, covariances, data["hall"]])
    right = recorded["kitchen"]["mesh"]
    assert max(apart(device.follow(z, np.zeros((STEPS, 0))), (right.mean, right.covariance))) < 1e-9


@pytest.mark.slow
@needs_compiler
def test_a_value_that_was_sent_and_is_refused_is_no_silence(tmp_path):
    sensor, rule = hg.LinearSensor(np.eye(2)[[0]], 0.1), hg.SendOnDelta(0.6, losses="known")
    filters = {"event": hg.event_filter(PLANT, sensor, hg.perfect(), rule, known=1, lost=1)}
    network = hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(), filters, trigger=rule, limits=(-40, 85))})
    z = np.array(hg.simulate(network, STEPS, 1).measurements["a"])
    z[np.flatnonzero(~np.isnan(z[:, 0]))[3::4], 0] = 100.0
    with pytest.warns(UserWarning, match="count as not arrived, by limits"):
        right = hg.run(network, {"a": z}).estimates["a"]["event"]
    device = Device(network, tmp_path, of="event")
    assert max(apart(device.follow(z, np.zeros((STEPS, 0))), (right.mean, right.covariance))) < 1e-9
