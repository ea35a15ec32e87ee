"""A gate that gives in: it comes back from a wrong start, stands among outliers, and is not led by a wrong sensor."""

import warnings

import numpy as np
import pytest

import heliograph as hg

F, Q = np.array([[1.0, 0.1], [0.0, 1.0]]), np.diag([1e-4, 1e-3])
PLANT = hg.LinearPlant(F, Q, [0.0, 0.0], np.diag([1.0, 0.1]), states=["place", "speed"])
PLACE = hg.LinearSensor([[1.0, 0.0]], 1.0, outputs=["place"])
BOTH = hg.LinearSensor(np.eye(2), np.diag([1.0, 0.01]), outputs=["place", "speed"])


def gate(sensor, **when):
    return hg.robust_filter(PLANT, sensor, hg.perfect(len(sensor.outputs)), hg.filters.Gate(9.0, **when))


def draw(start, steps, seed=0):
    """States from a start on, and their places with noise of deviation 1."""
    rng, x, states = np.random.default_rng(seed), np.array(start), []
    for _ in range(steps):
        x = F @ x + rng.standard_normal(2) * np.sqrt(np.diag(Q))
        states.append(x)
    states = np.array(states)
    return states, states[:, :1] + rng.standard_normal((steps, 1))


def test_a_gate_with_a_wrong_start_comes_back_and_says_so():
    """1,223 m off: refused for ever without, in the tenth row with it. NEES per state is 1 by its claim, 1.02 came."""
    states, z = draw([1223.0, 8.0], 400)
    never, item = gate(PLACE).run(z), gate(PLACE, after=10)
    assert np.abs(never.means[-1, 0] - states[-1, 0]) > 1000
    run = item.run(z)
    np.testing.assert_array_equal(run.weights[:11, 0], [0] * 9 + [1, 1])
    assert np.abs(run.means[9, 0] - states[9, 0]) < 3
    error = (states - run.means)[50:]
    nees = np.einsum("ti,tij,tj->t", error, np.linalg.inv(run.covariances[50:]), error) / 2
    assert nees.mean() < 1.5 and np.abs(error[-1]).max() < 1
    network = hg.Network(PLANT, {"a": hg.Node(PLACE, hg.perfect(), {"gate": item})})
    with pytest.warns(UserWarning, match=r"a/gate: the gate gave in once, last in row 10, and moved place by 1\.23"):
        hg.run(network, {"a": z})
    stream = hg.Stream(item)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for row in z[:9]:
            stream.push(row)
    with pytest.warns(UserWarning, match="stream, the gate gave in once, last in row 10, and moved place by 1.23e"):
        estimate = stream.push(z[9])
    np.testing.assert_allclose(estimate.mean, run.means[9], rtol=1e-9)


def test_an_angle_moves_by_less_than_half_a_turn():
    """From 3.1 to -3.1: .08 across the seam, in which the words of the warning are by what it moved."""
    plant = hg.LinearPlant([[1.0]], 1e-6, [3.1], 1e-4, states=["yaw"], circular=["yaw"])
    sensor = hg.LinearSensor([[1.0]], 1e-6, outputs=["compass"], circular=["compass"])
    item = hg.robust_filter(plant, sensor, hg.perfect(), hg.filters.Gate(9.0, after=3))
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"gate": item})})
    with pytest.warns(UserWarning, match=r"moved yaw by 0\.08"):
        hg.run(network, {"a": np.full((6, 1), -3.1)})


def test_seconds_count_the_time_between_rows():
    plant = hg.LinearPlant(
        lambda u: np.eye(1) + 0 * u[0], lambda u: 1e-3 * u[0] * np.eye(1), [0.0], [[1.0]], states=["x"], inputs=["dt"]
    )
    sensor = hg.LinearSensor([[1.0]], 1.0)
    item = hg.robust_filter(plant, sensor, hg.perfect(), hg.filters.Gate(9.0, seconds=2.0))
    steps = np.full((30, 1), 0.25)
    weights = item.run(np.full((30, 1), 500.0), steps).weights[:, 0]
    assert int(np.argmax(weights)) == 8  # two seconds after the first
    with pytest.raises(ValueError, match="seconds of a gate: expected a plant with the input 'dt', or after= refusals"):
        gate(PLACE, seconds=2.0)


def test_among_outliers_it_does_what_a_gate_does():
    """5 % outliers: ten in a row come once in 10^13 rows; the estimates are those of the gate to the last digits."""
    _, z = draw([0.0, 0.0], 1000, seed=1)
    z = np.where(np.random.default_rng(2).random(z.shape) < 0.05, z + 40, z)
    one, other = gate(PLACE).run(z), gate(PLACE, after=10).run(z)
    np.testing.assert_allclose(other.means, one.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(other.weights, one.weights)


def test_a_sensor_that_another_contradicts_is_not_followed():
    """A speed off by 5 for 100 rows of .1 s, which places contradict within 20. A gate that gives in after 3 rows,
    before these can have spoken, follows it by metres."""
    states, z = draw([0.0, 0.0], 300, seed=3)
    speed = states[:, 1:] + 0.1 * np.random.default_rng(4).standard_normal((300, 1))
    speed[100:200] += 5
    z = np.hstack([z, speed])
    patient, hasty = gate(BOTH, after=20).run(z), gate(BOTH, after=3).run(z)
    assert (patient.weights[100:200, 1] == 0).all()
    assert np.abs(patient.means[:, 0] - states[:, 0]).max() < 2 < 4 < np.abs(hasty.means[:, 0] - states[:, 0]).max()


def test_what_is_no_rule_is_refused():
    for wrong in ({"after": 0}, {"after": 2.5}, {"after": "x"}):
        with pytest.raises(ValueError, match="after, of a gate: expected a positive whole number"):
            hg.filters.Gate(9.0, **wrong)
    with pytest.raises(ValueError, match="seconds of a gate: expected"):
        hg.filters.Gate(9.0, seconds=-1.0)
