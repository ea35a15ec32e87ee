"""A link is independent at each node unless it is shared by name, and what is shared is said."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.report import examine, run_page, run_summary

PLANT = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]])
SENSOR = hg.LinearSensor([[0.0]], hg.Gaussian([[0.0]], [1.0]))  # y = 1, so that z is the gain
LORA = hg.gilbert_elliott(hg.hop(1.0, 0.0), hg.hop(0.2, 0.0), 0.2, 0.3)
RUNS, HORIZON = 64, 30


def network(**channels):
    return hg.Network(PLANT, {name: hg.Node(SENSOR, channel, {}) for name, channel in channels.items()})


def gains(**channels):
    record = hg.monte_carlo(network(**channels), HORIZON, RUNS, 7)
    return {name: z[..., 0] for name, z in record.measurements.items()}


def correlation(a, b):
    return np.corrcoef(a.ravel(), b.ravel())[0, 1]


def test_one_object_at_several_nodes_is_several_links():
    """Independent: the correlation of 64 runs of 30 dependent steps is within 5 of its deviations of some 0.035."""
    relayed = hg.amplify_and_forward([LORA, hg.hop(1.0, 0.0)])
    z = gains(a=LORA, b=LORA, c=relayed, d=hg.erasure(LORA, 1.0))
    for first, second in (("a", "b"), ("a", "c"), ("b", "c"), ("a", "d")):
        assert abs(correlation(z[first], z[second])) < 0.18
    assert network(a=LORA, b=LORA).shared == {}
    np.testing.assert_array_equal(gains(a=LORA)["a"], z["a"])  # and draws what it drew alone


def test_links_of_one_name_are_one():
    road = hg.shared(LORA, "road")
    named = hg.gilbert_elliott(hg.hop(2.0, 0.0), hg.hop(0.5, 0.0), 0.2, 0.3, name="road")
    z = gains(a=road, b=road, c=named, d=LORA)
    np.testing.assert_array_equal(z["a"], z["b"])
    np.testing.assert_array_equal(z["a"] == 1.0, z["c"] == 2.0)
    assert abs(correlation(z["a"], z["d"])) < 0.18
    assert network(a=road, b=road, c=named, d=LORA).shared == {"road": ("a", "b", "c")}


def test_one_object_twice_in_a_channel_is_two_links():
    sensor = hg.LinearSensor([[0.0], [0.0]], hg.Gaussian(np.zeros((2, 2)), [1.0, 1.0]))
    both = {"apart": hg.parallel([LORA, LORA]), "together": hg.parallel([hg.shared(LORA, "road")] * 2)}
    nodes = {name: hg.Node(sensor, channel, {}) for name, channel in both.items()}
    z = hg.monte_carlo(hg.Network(PLANT, nodes), HORIZON, RUNS, 7).measurements
    assert abs(correlation(*np.moveaxis(z["apart"], -1, 0))) < 0.18
    np.testing.assert_array_equal(z["together"][..., 0], z["together"][..., 1])


def test_a_central_filter_believes_what_the_world_does():
    """Two nodes with one link object and a centre with `parallel` of both: its exact claim holds."""
    link = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.2, 0.05), 0.2, 0.3)
    sensor, pair = hg.LinearSensor([[1.0]], 0.05), hg.LinearSensor([[1.0], [1.0]], 0.05 * np.eye(2))
    errors = {}
    for kind, item in (("apart", link), ("together", hg.shared(link, "road"))):
        centre = hg.linear_filter(PLANT, pair, hg.parallel([item, item]))
        nodes = {name: hg.Node(sensor, item, {}) for name in "ab"}
        statistics = hg.monte_carlo(hg.Network(PLANT, nodes, {"centre": centre}), 30, 4000, 0, hg.Statistics())
        statistics_ = statistics["fused"]["centre"]
        actual, claimed = statistics_.actual()[-10:, 0, 0].mean(), statistics_.claimed()[-10:, 0, 0].mean()
        assert actual == pytest.approx(claimed, rel=0.05)  # 40,000 squares, correlated: four deviations
        errors[kind] = claimed
    assert errors["apart"] < 0.9 * errors["together"]


def test_reports_say_what_is_shared():
    road = hg.shared(LORA, "road")
    item = network(a=road, b=road)
    health, alone = (
        examine(one, hg.run(one, {"a": np.ones(20), "b": np.ones(20)})) for one in (item, network(a=LORA, b=LORA))
    )
    assert run_summary(health)["shared"] == {"road": ["a", "b"]} and run_summary(alone)["shared"] == {}
    said = "their links are in one state at each step."
    assert f"a, b share road: {said}" in run_page(health, "roads", {}).html()
    assert said not in run_page(alone, "roads", {}).html()


def test_nodes_of_one_channel_share_it():
    pair = hg.LinearSensor([[1.0], [1.0]], np.eye(2))
    single = hg.linear_filter(PLANT, hg.LinearSensor([[1.0]], 1.0), hg.perfect())
    common = hg.Network.sharing(PLANT, pair, hg.perfect(2), {"a": {"f": single}, "b": {"f": single}})
    assert common.shared == {"sensor and channel": ("a", "b")}


def test_what_has_no_memory_has_nothing_to_share():
    with pytest.raises(ValueError, match="shared link: expected one with memory, such as gilbert_elliott"):
        hg.shared(hg.hop(hg.Rayleigh(1.0), 0.1), "road")
    with pytest.raises(ValueError, match="name of"):
        hg.shared(LORA, "")
    two = hg.shared(hg.amplify_and_forward([LORA, LORA]), "hill")
    assert network(a=two, b=two).shared == {"hill 0": ("a", "b"), "hill 1": ("a", "b")}
