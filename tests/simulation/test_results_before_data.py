"""Results before any data are for senders that transmit at each step: of others they are refused, not wrong."""

import numpy as np
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.1)
FADING = hg.Rayleigh(0.8)


def network(trigger, channel=None, **fused):
    channel = hg.hop(FADING, 0.1) if channel is None else channel
    filters = {"f": hg.linear_filter(PLANT, SENSOR, channel)}
    nodes = {name: hg.Node(SENSOR, channel, filters, trigger=trigger) for name in "ab"}
    return hg.Network(PLANT, nodes, fused)


def one_node(trigger, gain=1.0):
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.hop(gain, 0.1), {}, trigger=trigger)})


def fuse(rule, **options):
    return hg.Fusion("f", rule, **options)


NEIGHBOURS = {"a": ["b"], "b": ["a"]}
RESULTS = {
    "power": lambda t: hg.power(network(t)).total,
    "cross covariances": lambda t: hg.simulation.cross_covariances(network(t), "f", 3).joint,
    "fused": lambda t: hg.simulation.fused_covariances(network(t, w=fuse(hg.fusion.MatrixWeights())), 3)["w"],
    "tree": lambda t: hg.simulation.relay_tree(
        PLANT, lambda one: network(t, hg.hop(1.0, one)).nodes["a"], np.array([0.1, 0.2]), 2, 3
    ),
    "mesh": lambda t: hg.simulation.mesh_errors(
        network(t, m=fuse(hg.fusion.TraceIntersection(), neighbours=NEIGHBOURS)), "m", 3
    ),
    "samples": lambda t: hg.learning.samples_to_tell(FADING, hg.random_affine.LogNormal(0, 0.5), one_node(t, FADING)),
    "identifiable": lambda t: hg.learning.identifiable(lambda: one_node(t, hg.free(1.0))),
}


@pytest.mark.parametrize("result", RESULTS)
@pytest.mark.parametrize("trigger", [hg.Periodic(3), hg.SendOnDelta(0.5)])
def test_a_sender_that_decides_when_to_transmit_is_refused(result, trigger):
    """A trigger was ignored: a sender of every third step "sent" three times its power."""
    with pytest.raises(hg.InputError, match=r"expected senders that transmit at each step, got triggers of"):
        RESULTS[result](trigger)


WORDS = {
    "cross covariances": lambda net: hg.simulation.cross_covariances(net, "f", 3),
    "fused": lambda net: hg.simulation.fused_covariances(net, 3),
    "mesh": lambda net: hg.simulation.mesh_errors(net, "m", 3),
    "mean mesh": lambda net: hg.simulation.mean_mesh_errors(net, "m", 3),
    "best": lambda net: hg.simulation.best_possible(net, "m", 3),
}


def rounded(**fusions):
    """Two nodes whose filters know nothing of the words of two bits, 2.7 apart, over a perfect link."""
    encoder = hg.Words(bits=2, low=-4.0, high=4.0)
    plain = {"f": hg.linear_filter(PLANT, SENSOR, hg.perfect())}
    nodes = {name: hg.Node(SENSOR, hg.perfect(), plain, encoder=encoder) for name in NEIGHBOURS}
    return hg.Network(PLANT, nodes, fusions)


@pytest.mark.parametrize("result", WORDS)
def test_words_are_refused_by_results_for_numbers(result):
    """The rounding was left out: the covariance was that of the numbers themselves."""
    network = rounded(w=fuse(hg.fusion.MatrixWeights()), m=fuse(hg.fusion.MatrixWeights(), neighbours=NEIGHBOURS))
    with pytest.raises(hg.InputError, match="expected senders of the numbers themselves, got an encoder of words at"):
        WORDS[result](network)


def test_a_fusion_that_knows_nothing_of_words_claims_no_more_than_nominal():
    """It follows the errors by sensors and channels alone; "exact" and "upper" were claimed, 18 times too small."""
    rules = hg.fusion.MatrixWeights(), hg.fusion.TraceIntersection()
    network = rounded(
        w=fuse(rules[0]), m=fuse(rules[1], neighbours=NEIGHBOURS), n=fuse(rules[0], neighbours=NEIGHBOURS)
    )
    claims = network.claims()
    assert claims["fused"] == {"w": "nominal"}
    assert claims["a"] == claims["b"] == {"f": "nominal", "m": "nominal", "n": "nominal"}
    fused = hg.monte_carlo(network, 20, 500, key=0).estimates["fused"]["w"]
    assert fused.claim == "nominal"


def test_an_intersection_of_filters_that_know_the_words_is_an_upper_bound():
    encoder = hg.Words(bits=3, low=-8.0, high=8.0, dither="triangular")
    knows = {"f": hg.linear_filter(PLANT, SENSOR, hg.perfect(), encoder=encoder)}
    nodes = {name: hg.Node(SENSOR, hg.perfect(), knows, encoder=encoder) for name in NEIGHBOURS}
    network = hg.Network(PLANT, nodes, {"w": fuse(hg.fusion.EqualIntersection())})
    assert network.claims()["fused"] == {"w": "upper"}


DATA = {"a": np.arange(50.0)[:, None]}


@pytest.mark.parametrize("learn", [hg.learning.identifiable, lambda build: hg.fit(build, DATA)])
def test_words_are_no_numbers_to_learn_from(learn):
    """Their rounding counted as noise of the sensor."""

    def build():
        sensor, encoder = hg.LinearSensor([[1.0]], hg.free(0.1)), hg.Words(bits=2, low=-4.0, high=4.0)
        return hg.Network(PLANT, {"a": hg.Node(sensor, hg.perfect(), {}, encoder=encoder)})

    with pytest.raises(hg.InputError, match="network to be learned: expected senders of the numbers themselves"):
        learn(build)


LAWS = hg.Discrete([0.5, 1.5], [0.5, 0.5]), hg.Discrete([0.2, 1.8], [0.5, 0.5])
LEARN_OF_FEEDBACK = {
    "identifiable": hg.learning.identifiable,
    "fit": lambda build: hg.fit(build, DATA),
    "samples_to_tell": lambda build: hg.learning.samples_to_tell(*LAWS, build(0.1)),
}


@pytest.mark.parametrize("learn", LEARN_OF_FEEDBACK)
def test_differences_from_a_prediction_are_no_measurements_to_learn_from(learn):
    """They were taken for what the sensor measures, with the very log-likelihood of a node without feedback."""
    link = hg.hop(LAWS[0], 0.1)

    def build(noise=None):
        sensor = hg.LinearSensor([[1.0]], hg.free(0.1) if noise is None else noise)
        informed = hg.filters.fed_back_filter(PLANT, hg.LinearSensor([[1.0]], 0.1), link)
        return hg.Network(PLANT, {"a": hg.Node(sensor, link, {"f": informed})})

    with pytest.raises(hg.InputError, match="expected senders of the numbers themselves, got a sensor with feedback"):
        LEARN_OF_FEEDBACK[learn](build)
