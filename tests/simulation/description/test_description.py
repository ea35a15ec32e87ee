"""A network in words, and what is doubtful in it before any data."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.description.doubts import doubts_before_data

PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.9]], 0.1 * np.eye(2), [0, 0], np.eye(2), states=["position", "speed"])
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.1, outputs=["y"])
RELAYED = hg.amplify_and_forward([hg.hop(hg.random_affine.Rician(0.9, 0.2), 0.1), hg.hop(1.0, 0.1, amplification=1.1)])
STREET = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.1, 0.1), 0.1, 0.2, name="street")


def node(link, filters=None):
    return hg.Node(SENSOR, link, {"own": hg.linear_filter(PLANT, SENSOR, RELAYED)} if filters is None else filters)


def test_a_network_prints_as_plant_nodes_from_sensor_to_filters_fusions_and_what_is_shared():
    nodes = {f"n{i}": node(hg.erasure(RELAYED, 0.9)) for i in range(20)} | {"a": node(STREET), "b": node(STREET)}
    network = hg.Network(PLANT, nodes, {"all": hg.Fusion("own", hg.CovarianceIntersection())})
    assert repr(network).splitlines() == [
        "Network of 22 nodes",
        "plant              LinearPlant of position, speed",
        "n0, n1, n2 … (20)  y → Rician hop → hop 1.1, 10% lost → own (exact)",
        "a, b               y → 'street': modes (hop or hop 0.1) → own (nominal, believes another channel)",
        "fused all          CovarianceIntersection of 'own' of n0, n1, n2 … (22) (nominal)",
        "shared             fading 'street': a, b",
    ]
    assert "<td" in network._repr_html_() and "Rician hop → hop 1.1" in network._repr_html_()
    assert str([network])  # inside another thing too


@pytest.mark.parametrize(
    ("link", "words"),
    [
        (hg.perfect(), "direct"),
        (hg.dropout(hg.perfect(), 0.9), "direct, 10% lost unnoticed"),
        (hg.model.with_direct_link(RELAYED, hg.perfect()), "(Rician hop → hop 1.1 | direct)"),
        (hg.model.delayed(hg.hop(1.0, 0.1), 2), "hop, 2 steps late"),
        (hg.model.autoregressive_fading(1.0, 0.1, 0.9, 0.1), "drifting hop"),
        (hg.model.over_time([hg.hop(1.0 + k, 0.1) for k in range(3)]), "varying over time, at first hop"),
    ],
)
def test_links_in_words(link, words):
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {})})
    assert repr(network).splitlines()[2] == f"a      y → {words} → no filter of its own"


def words_of(network):
    return [item.words for item in doubts_before_data(network) if item.serious]


def test_a_network_without_doubts():
    assert words_of(hg.Network(PLANT, {"a": node(RELAYED)})) == []


def test_a_state_that_no_sensor_shows_is_named_in_any_units():
    for scale in (1.0, 1e9):
        hidden = hg.LinearPlant(
            np.diag([0.9, 0.8]), np.diag([1.0, scale**2]), [0, 0], np.diag([1.0, scale**2]), states=["x", "bias"]
        )
        kalman = {"own": hg.kalman_filter(hidden, SENSOR)}
        (words,) = words_of(hg.Network(hidden, {"a": hg.Node(SENSOR, hg.perfect(), kalman)}))
        assert words.startswith("unobservable: no sensor shows 'bias',")


def test_a_nonlinear_plant_is_judged_off_its_symmetric_point():
    """The range to the origin has no derivative at the initial mean, and shows a straight drive elsewhere."""
    drive = hg.Plant(lambda x, u: jnp.stack([x[0] + u[0], x[1]]), 0.1, [0.0, 0.0], np.eye(2), inputs=["step"])
    ranging = hg.Sensor(lambda x: jnp.hypot(x[0], x[1])[None], 0.1)
    filters = {"own": hg.cubature_filter(drive, ranging, hg.perfect())}
    assert words_of(hg.Network(drive, {"a": hg.Node(ranging, hg.perfect(), filters)})) == []


def test_an_error_without_bound_is_found_with_its_threshold():
    """A plant that grows by 1.21 in mean square needs arrivals above 1 - 1/1.21 = 0.174."""
    plant, sensor = hg.LinearPlant([[1.1]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    kalman = {"own": hg.kalman_filter(plant, sensor)}
    for arrival, doubtful in ((0.17, True), (0.18, False)):
        network = hg.Network(plant, {"a": hg.Node(sensor, hg.erasure(hg.perfect(), arrival), kalman)})
        assert bool(words_of(network)) is doubtful
        assert not doubtful or "the mean error of every filter grows without end" in words_of(network)[0]


def test_memory_that_a_filter_ignores_names_filter_and_nodes_once():
    street = {"a": node(STREET), "b": node(STREET)}
    (words,) = words_of(hg.Network(PLANT, street))
    assert words.startswith("ignored memory: 'own' of a, b takes a link for one without memory")
    knowing = {"own": hg.linear_filter(PLANT, SENSOR, STREET)}
    network = hg.Network(PLANT, {"a": node(STREET, knowing), "b": node(STREET, knowing)})
    assert words_of(network) == []
    assert "shared, so that losses come together: fading 'street': a, b" in [w for _, w in doubts_before_data(network)]
