"""Filters of a network by name: central ones, fusions by reports and between neighbours; what is not a filter."""

import numpy as np
import pytest

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.follow import apart

STEPS = 40
ROOMS = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1 * np.eye(2), [0.0, 0.0], np.eye(2), states=["warm", "damp"])


def made(arrival):
    """Two nodes that lose some of what they measure, with a central filter and fusions of three kinds."""
    nodes, gains = {}, hg.Discrete([0.6, 1.0], [0.5, 0.5])
    for i, name in enumerate(["kitchen", "hall"]):
        sensor = hg.LinearSensor(np.eye(2)[[i]], 0.1, outputs=["seen"])
        link = hg.hop(gains, noise=0.05)
        lossy = link if arrival == 1 else hg.erasure(link, arrival)
        nodes[name] = hg.Node(sensor, lossy, {"local": hg.linear_filter(ROOMS, sensor, link)})
    joint = hg.model.joint_sensor({name: node.sensor for name, node in nodes.items()})
    channel = hg.parallel([hg.hop(gains, noise=0.05)] * 2)
    fused = {
        "central": hg.linear_filter(ROOMS, joint, channel),
        "memory": hg.Fusion("local", hg.fusion.AllReports()),
        "weights": hg.Fusion("local", hg.fusion.MatrixWeights()),
        "mesh": hg.Fusion(
            "local", hg.CovarianceIntersection(), neighbours={"kitchen": ["hall"], "hall": ["kitchen"]}
        ),
    }  # fmt: skip
    return hg.Network(ROOMS, nodes, fused)


@pytest.fixture(scope="module")
def network():
    return made(0.8)


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(3)
    z = {name: rng.normal(size=(STEPS, 1)) for name in ("kitchen", "hall")}
    for values in z.values():
        values[rng.random((STEPS, 1)) < 0.2] = np.nan
    return z


@pytest.fixture(scope="module")
def recorded(network, data):
    return hg.run(network, data).estimates


def nothing():
    return np.zeros((STEPS, 0))


@pytest.mark.slow
@needs_compiler
def test_a_central_filter_receives_all_nodes(network, data, recorded, tmp_path):
    device = Device(network, tmp_path, of="central")
    header = device.exported.header.read_text()
    assert "z[0]: kitchen_seen" in header and "z[1]: hall_seen" in header
    right = recorded["fused"]["central"]
    means = device.follow(np.hstack([data["kitchen"], data["hall"]]), nothing())
    assert max(apart(means, (right.mean, right.covariance))) < 1e-12


@pytest.mark.slow
@needs_compiler
def test_a_centre_receives_the_nodes_reports(tmp_path):
    """Equal to the centre of `run`, whose reports are the means of the nodes' filters after each step."""
    rng, network = np.random.default_rng(3), made(1)
    recorded = hg.run(network, {name: rng.normal(size=(STEPS, 1)) for name in ("kitchen", "hall")}).estimates
    device = Device(network, tmp_path, of="memory")
    assert "z[3]: hall_damp" in device.exported.header.read_text()
    reports = np.hstack([recorded[name]["local"].mean for name in ("kitchen", "hall")])
    right = recorded["fused"]["memory"]
    assert max(apart(device.follow(reports, nothing()), (right.mean, right.covariance))) < 1e-12


@pytest.mark.slow
@needs_compiler
def test_a_node_between_neighbours_receives_their_messages(network, data, recorded, tmp_path):
    """Equal to its estimate in `run`; a message says mean and covariance before the step, and the measurement."""
    device = Device(network, tmp_path, of="mesh", node="kitchen")
    assert "z[4]: hall_covariance_warm_damp" in device.exported.header.read_text()
    theirs = recorded["hall"]["mesh"]
    means = np.vstack([np.zeros((1, 2)), theirs.mean[:-1]])
    covariances = np.concatenate([np.eye(2)[None], theirs.covariance[:-1]]).reshape(STEPS, 4)
    z = np.hstack([data["kitchen"], means, covariances, data["hall"]])
    right = recorded["kitchen"]["mesh"]
    assert max(apart(device.follow(z, nothing()), (right.mean, right.covariance))) < 1e-9


@pytest.mark.parametrize(
    ("name", "node", "words"),
    [
        ("weights", None, "filter 'weights': expected a central filter or a fusion by AllReports.*MatrixWeights"),
        ("memory", None, r"AllReports of reports: expected nodes that lose no measurements.*\['kitchen', 'hall'\]"),
        ("local", None, r"node: expected one of \['kitchen', 'hall'\], which all have a filter 'local', got none"),
        ("local", "fused", r"node: expected one that has a filter 'local' \['kitchen', 'hall'\], got 'fused'"),
        ("absent", None, r"filter: expected one of .*'central', 'local', 'memory', 'mesh', 'weights'\], got 'absent'"),
        (None, None, "filter: expected one of .*, got ''"),
    ],
)
def test_what_is_no_filter_is_named_with_what_to_do_instead(network, name, node, words, tmp_path):
    with pytest.raises(ValueError, match=words) as refused:
        hg.export_c(network, tmp_path / "a.c", name=name, node=node)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())


def test_a_fusion_or_a_name_without_its_network(network, tmp_path):
    with pytest.raises(
        ValueError, match="export: expected a filter, or a network and the name of its filter or fusion, got Fusion"
    ):
        hg.export_c(network.fused["memory"], tmp_path / "a.c")
    with pytest.raises(ValueError, match="export by name: expected a network"):
        hg.export_c(network.fused["central"], tmp_path / "a.c", name="central")
