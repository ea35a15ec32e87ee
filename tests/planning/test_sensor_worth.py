"""Worth of sensors: by the steady Riccati equation where all is linear, else by the squares of a second simulation."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

import heliograph as hg
from heliograph.planning import worth_of_sensors

A, Q = np.array([[1.0, 0.5], [0.0, 0.9]]), np.diag([0.01, 0.05])
ROWS = {
    "gnss": (np.array([[1.0, 0.0]]), 4.0),
    "wheel": (np.array([[0.0, 1.0]]), 0.1),
    "mast": (np.array([[1.0, 0.0]]), 0.5),
}


def node(name, link=None):
    row, noise = ROWS[name]
    return hg.Node(hg.LinearSensor(row, noise), hg.hop(1.0, 0.2) if link is None else link, {})


@pytest.fixture(scope="module")
def network():
    return hg.Network(hg.LinearPlant(A, Q, [0.0, 0.0], np.eye(2)), {name: node(name) for name in ("gnss", "wheel")})


def steady(names):
    """Deviations after a measurement in the steady state of the Riccati equation."""
    h = np.concatenate([ROWS[name][0] for name in names])
    r = np.diag([ROWS[name][1] + 0.2 for name in names])
    prior = solve_discrete_are(A.T, h.T, Q, r)
    gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + r)
    return prior - gain @ h @ prior


def test_each_case_is_the_steady_riccati_s(network):
    """To 1e-8 of it after 300 steps, since the slowest mode of the filter without the receiver decays as 0.93^k."""
    found = worth_of_sensors(network, 300, ["wheel"], {"gnss": 20}, {"mast": node("mast")})
    assert found.exact and [case.name for case in found.cases] == [
        "without wheel",
        "gnss out for 20 steps",
        "with mast",
    ]
    whole, cases = steady(["gnss", "wheel"]), found.cases
    np.testing.assert_allclose(found.complete.error, np.sqrt(np.diag(whole)), rtol=1e-8)
    np.testing.assert_allclose(cases[0].error, np.sqrt(np.diag(steady(["gnss"]))), rtol=1e-8)
    np.testing.assert_allclose(cases[2].error, np.sqrt(np.diag(steady(["gnss", "wheel", "mast"]))), rtol=1e-8)
    # During the outage the wheel alone measures.
    p, (h, r) = whole, ROWS["wheel"]
    for _ in range(20):
        p = A @ p @ A.T + Q
        p = p - p @ h.T @ h @ p / (h @ p @ h.T + r + 0.2)
    np.testing.assert_allclose(cases[1].error, np.sqrt(np.diag(p)), rtol=1e-8)
    np.testing.assert_allclose(cases[1].increase, cases[1].error / found.complete.error, rtol=1e-12)
    assert not found.complete.uncertainty.any()


@pytest.mark.slow
def test_of_a_nonlinear_sensor_it_is_the_error_that_is_drawn():
    """Within four standard errors of another thousand runs of the same filter, whose sensors are named as here."""
    plant = hg.LinearPlant(A, Q, [3.0, 0.0], 0.1 * np.eye(2))
    range_to = hg.Sensor(lambda x: jnp.sqrt(1 + x[:1] ** 2), 0.1, ["range"])
    nodes = {"radar": hg.Node(range_to, hg.hop(1.0, 0.05), {}), "wheel": node("wheel")}
    found = worth_of_sensors(hg.Network(plant, nodes), 10, ["radar"], runs=400)
    assert not found.exact
    filters = [hg.cubature_filter(plant, here.sensor, here.channel) for here in nodes.values()]
    both = hg.Network(plant, nodes, {"all": hg.filters.sequential_filter(filters)})
    other = hg.monte_carlo(both, 10, 1000, 7)
    squares = (other.estimates["fused"]["all"].mean[:, -1] - other.truth[:, -1]) ** 2
    drawn, error = np.sqrt(squares.mean(axis=0)), squares.std(axis=0) / np.sqrt(1000)
    off = np.abs(found.complete.error - drawn)
    assert np.all(off < 4 * np.hypot(found.complete.uncertainty, error / (2 * drawn)))
    # Without the radar all is linear, and known.
    p, (h, r) = 0.1 * np.eye(2), ROWS["wheel"]
    for _ in range(10):
        p = A @ p @ A.T + Q
        p = p - p @ h.T @ h @ p / (h @ p @ h.T + r + 0.2)
    assert np.all(np.abs(found.cases[0].error - np.sqrt(np.diag(p))) < 4 * found.cases[0].uncertainty)


def test_losses_are_averaged_over(network):
    """A link that loses everything is worth nothing; one that loses half, less than one that loses none."""
    wheel, plant = node("wheel"), network.plant

    def error(arrives):
        lossy = hg.Network(plant, {"gnss": node("gnss", hg.erasure(hg.hop(1.0, 0.2), arrives)), "wheel": wheel})
        return worth_of_sensors(lossy, 60, ["gnss"], runs=40)

    half = error(0.5)
    never, always = half.cases[0].error[0], np.sqrt(steady(["gnss", "wheel"])[0, 0])
    assert half.exact and always < half.complete.error[0] < never and half.complete.uncertainty[0] > 0


def test_what_cannot_be_asked_is_said_in_one_line(network):
    with pytest.raises(ValueError, match="nodes left out: expected some of the nodes gnss, wheel, got 'radar'"):
        worth_of_sensors(network, without=["radar"])
    with pytest.raises(ValueError, match="outage of 'gnss': expected at most the 50 steps of the run, got 60"):
        worth_of_sensors(network, 50, outages={"gnss": 60})
    with pytest.raises(ValueError, match="additions: expected nodes of other names than the network's, got gnss"):
        worth_of_sensors(network, additions={"gnss": node("gnss")})
    asking = hg.Node(hg.LinearSensor([[1.0, 0.0]], 0.1), hg.perfect(1), {}, trigger=hg.SendOnDelta(0.5))
    with pytest.raises(ValueError, match="node 'a' of a comparison of sensors: expected a sensor that sends what it"):
        worth_of_sensors(hg.Network(network.plant, {"a": asking}))
    link = hg.hop(hg.Rayleigh(1.0), 0.1)  # with feedback its randomness multiplies an error, without all of the state
    heard = hg.Node(asking.sensor, link, {"f": hg.filters.fed_back_filter(network.plant, asking.sensor, link)})
    with pytest.raises(ValueError, match=r"node 'a' of a comparison of sensors: expected .* step, got feedback"):
        worth_of_sensors(hg.Network(network.plant, {"a": heard}))
    with pytest.raises(ValueError, match="node 'mast' of the additions: expected a sensor that sends what it measures"):
        worth_of_sensors(network, additions={"mast": asking})
    with pytest.raises(ValueError, match="runs: expected a whole number of at least 2, got 1"):
        worth_of_sensors(network, runs=1)  # of which the uncertainty would be 0, as if it were computed


def test_gains_that_are_told_make_an_exact_error_random():
    """A gain of 0 or 2 that each message tells: the variance after it is P or 1 / (1 / P + 4 / r), by half each."""
    plant, link = hg.LinearPlant([[1.0]], 0.5, [0.0], 0.5), hg.hop(hg.Discrete([0.0, 2.0], [0.5, 0.5]), 0.4, known=True)
    found = worth_of_sensors(
        hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.0), link, {})}), steps=1, runs=400, without=[]
    )
    variance = (1.0 + 1 / (1 + 4 / 0.4)) / 2
    assert found.exact and 0 < found.complete.uncertainty[0] < 0.03
    assert found.complete.error[0] ** 2 == pytest.approx(variance, abs=5 * 0.5 * (1 - 1 / 11) / np.sqrt(400))
