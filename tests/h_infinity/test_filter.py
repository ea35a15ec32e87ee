"""The H-infinity filter: equation (6), what it does with data that did not arrive, and what it claims."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.h_infinity.h_infinity_problems import channel, node
from tests.oracles import h_infinity_fusion as paper


def model():
    plant = hg.Plant(
        lambda x, u: jnp.array([0.7 * x[0] * jnp.cos(0.1 * x[1]), 0.7 * x[1] * jnp.sin(u[0] * x[0])]),
        0.0,
        [1.7, 1.6],
        np.eye(2),
        inputs=["step"],
    )
    return plant, hg.LinearSensor([[paper.h[0]] * 2], 0.0)


def build():
    plant, sensor = model()
    design = hg.h_infinity.recursive_design(node(0), 1.8, 10 * np.eye(4))
    return hg.h_infinity.h_infinity_filter(plant, sensor, node(0), design), design


def oracle(design, received, missing=()):
    """xhat+ = f(xhat) + K (received - E1 d1bar h(xhat)), a missing component counted as expected."""
    expected = paper.E1 @ np.array([0.8 * 0.75, 0.7])
    x, results, correction = np.array([1.7, 1.6]), [], np.zeros(2)
    for s in range(len(received)):
        x = np.array([0.7 * x[0] * np.cos(0.1 * x[1]), 0.7 * x[1] * np.sin(s * x[0])]) + correction
        results.append(x)
        innovation = received[s] - expected * paper.h[0] * x.sum()
        correction = design.gains[s] @ np.where(np.isin(np.arange(2), missing) & (s == 3), 0.0, innovation)
    return np.array(results)


def test_it_is_equation_6():
    item, design = build()
    received = np.random.default_rng(0).normal(size=(16, 2))
    state, results = item.init(), []
    for s in range(16):
        state, estimate = item.step(state, received[s], [float(s)], s)
        results.append(estimate.mean)
        assert estimate.claim == "none" and np.isnan(estimate.covariance).all()
    np.testing.assert_allclose(results, oracle(design, received), atol=1e-13)


def test_a_component_that_did_not_arrive_corrects_nothing():
    item, design = build()
    received = np.random.default_rng(1).normal(size=(16, 2))
    with_gap = received.copy()
    with_gap[3, 1] = np.nan
    state, results = item.init(), []
    for s in range(16):
        state, estimate = item.step(state, with_gap[s], [float(s)], s)
        results.append(estimate.mean)
    np.testing.assert_allclose(results, oracle(design, received, missing=[1]), atol=1e-13)


def test_in_a_network_its_record_is_sound():
    plant, sensor = model()
    network = hg.Network(plant, {"a": hg.Node(sensor, channel(), {"h_infinity": build()[0]})})
    record = hg.monte_carlo(network, 16, 5, 0, inputs=np.arange(16.0)[:, None])
    assert record.estimates["a"]["h_infinity"].claim == "none"
    assert record.failures() == []
    with pytest.raises(ValueError, match=r"horizon: expected at most 16 steps"):
        hg.monte_carlo(network, 17, 5, 0, inputs=np.arange(17.0)[:, None])


def test_parts_that_do_not_fit_are_refused():
    plant, _ = model()
    design = hg.h_infinity.recursive_design(node(0), 1.8, 10 * np.eye(4))
    two = hg.LinearSensor(np.eye(2), 0.0)
    with pytest.raises(ValueError, match=r"sensor: expected the system's 1 outputs, got 2"):
        hg.h_infinity.h_infinity_filter(plant, two, node(0), design)
    three = hg.Plant(lambda x, u: x, 0.0, np.zeros(3), np.eye(3))
    with pytest.raises(ValueError, match=r"system: expected 3 states"):
        hg.h_infinity.h_infinity_filter(three, hg.LinearSensor(np.ones((1, 3)), 0.0), node(0), design)
