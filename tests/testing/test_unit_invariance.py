"""Answers that do not depend on units; and a filter whose answers do is found."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.testing import check_scaling

UNCERTAIN = hg.Discrete([0.5, 1.0], [0.4, 0.6], 0.1)


def linear_network(channel, **more):
    plant = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], np.diag([0.1, 0.02]), [1.0, -2.0], [[1.0, 0.3], [0.3, 0.5]])
    sensor = hg.LinearSensor([[1.0, 0.0], [0.5, 1.0]], [[0.1, 0.02], [0.02, 0.2]])
    filters = {
        "kalman": hg.cubature_filter(plant, sensor, channel),
        "linear": hg.linear_filter(plant, sensor, channel),
        "zero_mean": hg.extended_filter(plant, sensor, channel, hg.filters.ZeroMean()),
        "open": hg.filters.open_loop_filter(plant),
        "quadratic": hg.polynomial_filter(plant, sensor, channel, 5, 2),
        "ahead": hg.filters.prediction_of(hg.cubature_filter(plant, sensor, channel)),
    }
    nodes = {name: hg.Node(sensor, channel, filters | more) for name in ("a", "b")}
    fused = {
        "equal": hg.Fusion("kalman", hg.fusion.EqualIntersection()),
        "smallest": hg.Fusion("kalman", hg.CovarianceIntersection()),
        "mean": hg.Fusion("linear", hg.fusion.WeightedFusion([0.4, 0.6])),
        "central": hg.filters.sequential_filter([filters["kalman"]] * 2),
    }
    return hg.Network(plant, nodes, fused)


CHANNELS = {
    "random gain": hg.amplify_and_forward(
        [hg.hop(hg.Rayleigh(0.8), np.diag([0.1, 0.2])), hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 0.1 * np.eye(2))]
    ),
    "two uncertain gains": hg.parallel([hg.hop(UNCERTAIN, 0.1), hg.dropout(hg.hop(1.2, 0.3), 0.7, 0.1)]),
    "silent": hg.parallel([hg.hop(hg.Rayleigh(0.8), 0.1), hg.model.silent()]),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["random gain", *(pytest.param(name, marks=pytest.mark.slow) for name in CHANNELS if name != "random gain")]
)
def test_linear_networks(name):
    assert check_scaling(linear_network(CHANNELS[name])) <= 1


def test_a_mixture():
    two = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], two)
    channel = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 0.1)
    filters = {"mixture": hg.filters.mixture_filter(plant, sensor, channel)}
    assert check_scaling(hg.Network(plant, {"node": hg.Node(sensor, channel, filters)})) <= 1


@pytest.mark.slow
def test_links_that_remember_and_losses_that_are_informed():
    """By mode and by what arrives; of a lost packet the moments of what would have come are compared."""
    plant = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], np.diag([0.1, 0.02]), [1.0, -2.0], np.diag([1.0, 0.5]))
    sensor = hg.LinearSensor([[1.0, 0.5]], 0.1)
    good, bad = hg.hop(hg.Rayleigh(0.8), 0.1), hg.hop(0.3, 0.2)
    channel = hg.gilbert_elliott(good, bad, 0.2, 0.4)
    filters = {
        "linear": hg.linear_filter(plant, sensor, channel),
        "first_degree": hg.polynomial_filter(plant, sensor, channel, 3, 1),
        "informed": hg.filters.side_information_filter(plant, sensor, hg.erasure(good, 0.7)),
        "imm": hg.filters.imm_filter(plant, sensor, channel),
    }
    nodes = {"mine": hg.Node(sensor, channel, filters), "lossy": hg.Node(sensor, hg.erasure(good, 0.7), filters)}
    assert check_scaling(hg.Network(plant, nodes), steps=3) <= 1


@pytest.mark.parametrize("mean_gain", [True, False])
def test_contradicting_certainties_are_compared_up_to_there(mean_gain):
    """A noise-free output over two links: by the mean gain the second reading is impossible; rounding weighs both."""
    plant = hg.LinearPlant([[0.27, 1.9], [0.26, 0.89]], np.diag([0.1, 0.02]), [1.0, -2.0], np.diag([1.0, 0.5]))
    sensor = hg.LinearSensor([[1.0, -3.4], [-8.6, -1.8], [-8.6, -1.8]], np.diag([0.4, 0.0, 0.0]))
    channel = hg.parallel([hg.hop(gain, 0.0) for gain in (1.0, hg.Discrete([0.5, 1.0], [0.5, 0.5]), 1.0)])
    factory = hg.mean_gain_filter if mean_gain else hg.linear_filter
    network = hg.Network(plant, {"node": hg.Node(sensor, channel, {"kalman": factory(plant, sensor, channel)})})
    assert check_scaling(network, trials=5) <= 1
    received = hg.monte_carlo(network, 5, 1, 0).measurements["node"][0]
    filtered = network.nodes["node"].filters["kalman"].run(received)
    assert np.any(np.isneginf(filtered.log_likelihoods)) == mean_gain


@pytest.mark.slow
def test_a_flag_has_no_unit():
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    channel = hg.gilbert_elliott(hg.hop(0.8, 0.1), hg.hop(0.3, 0.2), 0.2, 0.4)
    flagged = hg.filters.side_information_filter(plant, sensor, channel, np.eye(2))
    node = hg.Node(sensor, hg.model.with_flag(channel), {"flagged": flagged})
    with pytest.raises(ValueError, match="filter to rescale"):
        check_scaling(hg.Network(plant, {"node": node}))


@pytest.mark.slow
def test_a_nonlinear_network_with_inputs_and_states_known_exactly():
    plant = hg.Plant(
        lambda x, u: jnp.stack([x[0] + u[0] * x[1], x[1] - u[0] * jnp.sin(x[0]), x[2]]),
        lambda u: jnp.diag(jnp.stack([1e-4, 1e-2 * u[0], 0.0])),
        [1.0, 0.0, 2.0],
        np.diag([0.1, 0.2, 0.0]),
        inputs=["dt"],
    )
    sensor = hg.Sensor(lambda x: jnp.stack([jnp.sin(x[0]), x[1] * x[2]]), np.diag([0.01, 0.0]), ["sine", "rate"])
    channel = hg.hop(hg.Rayleigh(1.0), np.diag([0.01, 0.02]))
    build = {
        "cubature": hg.cubature_filter,
        "extended": hg.extended_filter,
        "mean_gain": hg.mean_gain_filter,
        "moments": lambda *parts: hg.filters.gaussian_filter(*parts, hg.filters.PolynomialMoments(2)),
    }
    filters = {name: make(plant, sensor, channel) for name, make in build.items()}
    network = hg.Network(plant, {"node": hg.Node(sensor, channel, filters)})
    assert check_scaling(network, np.full((5, 1), 0.1)) <= 1


@pytest.mark.slow
def test_a_filter_whose_answers_depend_on_units_is_found():
    network = linear_network(hg.perfect(2))

    class Floored(hg.filters.AbstractUpdate):
        """Adds a variance that is a number without a unit."""

        def describe(self, channel):
            return hg.filters.Polytope().describe(channel)

        def correct(self, prior, signal, channel, present):
            gain, bound = hg.filters.Polytope().correct(prior, signal, channel, present)
            return gain, bound + 1e-6 * jnp.eye(2)

    node = network.nodes["a"]
    floored = hg.cubature_filter(network.plant, node.sensor, node.channel, Floored())
    with pytest.raises(AssertionError, match="a/floored: expected the same estimate in other units"):
        check_scaling(hg.Network(network.plant, {"a": hg.Node(node.sensor, node.channel, {"floored": floored})}))
