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


A_OVER_TIME = np.array([0.2, 1.6, 0.2, 1.6, 0.2, 1.6])[:, None, None]
SENSOR = hg.LinearSensor([[1.0]], 0.25)


def varying_system(**changes):
    given = {"transition": hg.model.OverTime(A_OVER_TIME), "growth": 0.0, "output": [[1.0]]}
    return hg.h_infinity.growth_system(
        6, disturbance=[[1.0, 0.0]], feedthrough=[[0.0, 0.5]], target=[[1.0]], channel=hg.perfect(), **(given | changes)
    )


def plants(matrices):
    return hg.model.over_time([hg.LinearPlant(a, [[1.0]], [0.0], [[1.0]]) for a in matrices])


def test_a_plant_that_varies_moves_into_the_next_row_by_the_step_before():
    """The norm of the map to the errors is the level; of a plant that is one step ahead it is 7.5 times the level."""
    system = varying_system()
    design = hg.h_infinity.horizon_design(system)
    item = hg.h_infinity.h_infinity_filter(plants([A_OVER_TIME[0], *A_OVER_TIME[:-1]]), SENSOR, system, design, [1.0])
    gains = design.gains[:, 0, 0]

    def norm(transitions):
        """Norm of the map from the error in row 0 and all disturbances to the errors in all rows."""
        errors, row = [], np.zeros(13)
        row[0] = 1.0
        for k in range(6):
            errors.append(row)
            row = (transitions[k] - gains[k]) * row
            row[1 + 2 * k : 3 + 2 * k] = 1.0, -0.5 * gains[k]
        return np.linalg.norm(errors, 2)

    # Without disturbances and data the estimates fall as errors do.
    means = item.run(np.zeros((6, 1))).means[:, 0]
    a = A_OVER_TIME[:, 0, 0]
    np.testing.assert_allclose(means[1:], (a - gains)[:-1] * means[:-1], rtol=1e-12, atol=1e-17)
    assert norm(a) == pytest.approx(design.level, rel=1e-5)
    assert norm([*a[1:], a[-1]]) > 7 * design.level
    with pytest.raises(
        hg.InputError, match=r"plant in row 1: expected A x \+ f\(x\) of the system's step 0, which leads"
    ):
        hg.h_infinity.h_infinity_filter(plants(A_OVER_TIME), SENSOR, system, design)


def test_models_that_are_not_the_systems_are_refused():
    """No level holds of them; what the growth constants allow is accepted."""
    system = varying_system(transition=[[0.9]], growth=0.05)
    design = hg.h_infinity.horizon_design(system)

    def make(slope, shown=1.0):
        plant = hg.Plant(lambda x, u: 0.9 * x + slope * jnp.sin(x), [[1.0]], [0.0], [[1.0]])
        return hg.h_infinity.h_infinity_filter(plant, hg.LinearSensor([[shown]], 0.25), system, design)

    assert make(0.05).claim == "none"
    with pytest.raises(
        hg.InputError, match=r"got 0.0841 from it where state 0 changes by 1, the growth constant being 0.0"
    ):
        make(0.1)
    with pytest.raises(
        hg.InputError, match=r"sensor in row 0: expected C x \+ h\(x\) of the system's step 0, got 1 from it"
    ):
        make(0.05, shown=2.0)


def test_models_that_are_not_0_at_0_are_refused():
    """Behind a random gain a constant of 5 makes an error without any disturbance: it was taken."""
    system = varying_system(transition=[[0.9]], growth=0.0)
    design = hg.h_infinity.horizon_design(system)
    drifting, level = hg.Plant(lambda x, u: 0.9 * x + 5.0, 1.0, [0.0], 1.0), hg.Sensor(lambda x: x + 5.0, 0.25)
    plant, sensor = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.25)
    for models, name in (((drifting, sensor), "plant in row 1"), ((plant, level), "sensor in row 0")):
        with pytest.raises(hg.InputError, match=rf"{name}: expected .*, which is 0 at x = 0 .*, got \[5.0\]"):
            hg.h_infinity.h_infinity_filter(*models, system, design)
