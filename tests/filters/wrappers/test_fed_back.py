"""A sensor with feedback sends the innovation: simulated as filtered, with exact claims."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters import fed_back_filter, open_loop_filter

HORIZON, RUNS = 6, 4000
Z_LIMIT = 4.0  # as in test_linear.py
PLANT = hg.LinearPlant([[1.2, 0.3], [0.0, 1.05]], np.diag([0.1, 0.2]), [5.0, -3.0], np.eye(2), [[1.0], [0.0]])
SENSOR = hg.LinearSensor([[1.0, 0.5]], 0.5)
INPUTS = np.arange(HORIZON)[:, None] - 2.0
LINK = hg.hop(hg.Discrete([0.5, 1.0, 1.4], [0.3, 0.4, 0.3]), 0.3)
LOSSY = hg.erasure(LINK, 0.8)


@pytest.fixture(scope="module")
def statistics() -> dict[str, dict[str, hg.Statistics]]:
    fed = {"fed": fed_back_filter(PLANT, SENSOR, LINK), "open": open_loop_filter(PLANT)}
    nodes = {"sure": hg.Node(SENSOR, LINK, fed), "lossy": hg.Node(SENSOR, LOSSY, fed)}
    return hg.monte_carlo(hg.Network(PLANT, nodes), HORIZON, RUNS, 1, keep=hg.Statistics(), inputs=INPUTS)


@pytest.mark.parametrize("node", ["sure", "lossy"])
def test_claims_are_exact(statistics: dict[str, dict[str, hg.Statistics]], node: str) -> None:
    s = statistics[node]["fed"]
    assert s.claim == "exact"
    batch = s.outer / s.count[:, None, None, None]
    error = batch.std(axis=0, ddof=1) / np.sqrt(len(batch))
    assert np.max(np.abs(s.actual() - s.claimed()) / error) < Z_LIMIT
    assert np.trace(s.actual()[-1]) < 0.5 * np.trace(statistics[node]["open"].actual()[-1])


def test_the_covariance_is_that_of_the_formula(statistics: dict[str, dict[str, hg.Statistics]]) -> None:
    a, c, q = np.array(PLANT.matrix), np.array([[1.0, 0.5]]), np.diag([0.1, 0.2])
    mean, second = 0.15 + 0.4 + 0.42, 0.3 * 0.25 + 0.4 + 0.3 * 1.96
    p, results = np.eye(2), []
    for _ in range(HORIZON):
        p = a @ p @ a.T + q
        s = (c @ p @ c.T + 0.5).item()
        p = p - (p @ c.T @ c @ p) * mean**2 / (second * s + 0.3)
        results.append(p)
    np.testing.assert_allclose(statistics["sure"]["fed"].claimed(), results, rtol=1e-10)


def test_a_nonlinear_sensor_takes_off_what_it_sends_of_the_prediction() -> None:
    """By hand: r = h(f(xhat)), and the gain's noise sees Var y + (E y - r)^2."""
    plant = hg.Plant(lambda x, u: jnp.sin(x) + 1, 0.1, [2.0], [[0.2]])
    sensor = hg.Sensor(lambda x: x**2, 0.05)
    item = fed_back_filter(plant, sensor, LINK)
    assert item.claim == "nominal"
    cubature = hg.cubature_filter(plant, sensor, LINK)
    prior = item.predict(item.init())
    expected = cubature.predict(cubature.init())
    np.testing.assert_allclose(prior.reference, [(np.sin(2.0) + 1) ** 2], rtol=1e-14)
    m, p = expected.mean[0], expected.covariance[0, 0]
    points = m + np.array([-1, 1]) * np.sqrt(p)
    left = np.mean(points**2) - prior.reference[0]
    spread = np.var(points**2) + 0.05
    mean, second = 0.97, 0.3 * 0.25 + 0.4 + 0.3 * 1.96
    cross = mean * np.mean((points - m) * points**2)
    total = second * (spread + left**2) - (mean * left) ** 2 + 0.3
    _, result = item.step(item.init(), [0.7])
    np.testing.assert_allclose(result.mean, [m + cross / total * (0.7 - mean * left)], rtol=1e-12)
    np.testing.assert_allclose(result.covariance, [[p - cross**2 / total]], rtol=1e-9)


def test_bad_nodes_are_one_clear_line() -> None:
    fed, other = fed_back_filter(PLANT, SENSOR, LINK), hg.linear_filter(PLANT, SENSOR, LINK)
    with pytest.raises(ValueError, match="sensor has feedback: expected no filter with measurements besides 'fed'"):
        hg.Node(SENSOR, LINK, {"fed": fed, "other": other})
    compass = hg.LinearSensor([[1.0]], 0.1, outputs=("heading",), circular=("heading",))
    turning = hg.LinearPlant([[1.0]], 0.1, [0.0], [[1.0]], states=("heading",), circular=("heading",))
    with pytest.raises(ValueError, match="no angles"):
        fed_back_filter(turning, compass, hg.hop(1.0, 0.1))
