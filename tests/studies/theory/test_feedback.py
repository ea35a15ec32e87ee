"""Noise that an unstable plant tolerates when its sensor has feedback: iteration, eigenvalues, Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.filters import fed_back_filter
from heliograph.model import over_time
from heliograph_studies.theory import fed_back_channel, feedback_limit
from heliograph_studies.theory.feedback import noise_of_hops

PLANT = hg.LinearPlant([[1.1]], 1.0, [0.0], [[1.0]])
SENSOR = hg.LinearSensor([[1.0]], 0.5)
GAIN = hg.Discrete([1 - np.sqrt(0.02), 1 + np.sqrt(0.02)], [0.5, 0.5])  # kappa = 1.02
HOP = hg.hop(GAIN, 0.2 * 1.02)  # alpha = 0.2


def test_noise_of_a_path_is_that_of_the_hops() -> None:
    assert noise_of_hops([HOP], [1.0]) == pytest.approx(1.02 * 1.2, rel=1e-14)
    assert noise_of_hops([HOP, HOP], [1.0, 2.0]) == pytest.approx(1.02**2 * 1.2 * 1.1, rel=1e-14)
    assert noise_of_hops([hg.hop(1.0, 0.0)], 5.0) == 1.0


def test_unit_power_keeps_an_unstable_plant_for_ever() -> None:
    result = feedback_limit(PLANT, SENSOR, [HOP], 1.0)
    assert result.bounded
    assert result.limit == pytest.approx(1.21 / 0.21, rel=1e-12)
    assert result.filtered is not None and result.filtered[0, 0] == pytest.approx(0.6447, abs=5e-5)


def test_without_feedback_the_power_or_the_error_grows() -> None:
    """Amplification 1 takes power 2.7 at k = 1 and 5.3e5 at k = 60; at power 1 the error is 2.6, 132, 3068."""
    second = np.array([1.21**k + (1.21**k - 1) / 0.21 + 0.5 for k in range(1, 61)])
    assert second[0] == pytest.approx(2.71, rel=1e-12)
    assert second[-1] == pytest.approx(5.34e5, rel=1e-3)
    channel = over_time([hg.hop(GAIN, 0.2 * 1.02, amplification=s**-0.5) for s in second])
    item = hg.linear_filter(PLANT, SENSOR, channel).planned(np.zeros((60, 0)))
    state, errors = item.init(), []
    for k in range(60):
        state, estimate = item.step(state, [0.0], (), k)
        errors.append(estimate.covariance[0, 0])
    assert np.array(errors)[[9, 39, 59]] == pytest.approx([2.564, 131.9, 3067.8], rel=1e-3)


def test_the_error_is_the_simulated_one() -> None:
    """Two hops at constant power, and every transmitter does send its power."""
    horizon, runs, powers = 20, 4000, [1.0, 3.0]
    channel = fed_back_channel(PLANT, SENSOR, [HOP, HOP], powers, horizon)
    item = fed_back_filter(PLANT, SENSOR, channel)
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, {"fed": item})})
    record = hg.monte_carlo(network, horizon, runs, 2)
    estimate = record.estimates["node"]["fed"]
    squared = (np.asarray(estimate.mean) - record.truth)[:, -1, 0] ** 2
    claimed = np.asarray(estimate.covariance).reshape(-1, horizon, 1, 1)[0, -1, 0, 0]
    assert abs(squared.mean() - claimed) < 3 * squared.std() / np.sqrt(runs)
    steady = feedback_limit(PLANT, SENSOR, [HOP, HOP], powers).filtered
    assert steady is not None and claimed == pytest.approx(steady[0, 0], rel=1e-3)  # after 20 steps
    # what arrives is the last hop's power with its gain and noise: E z^2 = E g^2 p + Var m
    received = record.measurements["node"][:, :, 0] ** 2
    errors = received.std(axis=0) / np.sqrt(runs)
    assert np.max(np.abs(received.mean(axis=0) - 1.02 * (3.0 + 0.2)) / errors) < 4


@pytest.mark.slow
@settings(max_examples=25, deadline=None)
@given(
    st.lists(st.floats(-1.3, 1.3).filter(lambda v: abs(abs(v) - 1) > 0.05), min_size=2, max_size=2, unique=True),
    st.floats(0.9, 1.1).filter(lambda v: abs(v - 1) > 0.02),
)
def test_the_limit_is_where_the_error_ends_to_be_bounded(values: list[float], share: float) -> None:
    """Plain iteration of the filter, on either side of the limit."""
    if abs(values[0] - values[1]) < 0.2:
        values = [values[0], -values[0] / 2]
    turn = np.array([[1.0, 0.4], [-0.3, 1.0]])
    a = turn @ np.diag(values) @ np.linalg.inv(turn)
    plant, sensor = hg.LinearPlant(a, np.diag([0.1, 0.2]), [0, 0], np.eye(2)), hg.LinearSensor([[1.0, 0.5]], 0.5)
    lam = np.prod([max(abs(v), 1.0) ** 2 for v in values])
    noise = max(share * lam / (lam - 1), 1.0) if lam > 1 else 7.0
    result = feedback_limit(plant, sensor, [hg.hop(1.0, noise - 1)], 1.0)
    assert result.bounded == (noise < result.limit)
    p, c = np.eye(2), np.array([[1.0, 0.5]])
    for _ in range(3000):
        p = a @ (p - p @ c.T @ c @ p / (noise * ((c @ p @ c.T).item() + 0.5))) @ a.T + np.diag([0.1, 0.2])
    if result.predicted is None:
        later = a @ (p - p @ c.T @ c @ p / (noise * ((c @ p @ c.T).item() + 0.5))) @ a.T
        assert np.trace(p) > 30 and np.trace(later) + 0.3 > np.trace(p)  # it grows still
    else:
        np.testing.assert_allclose(p, result.predicted, rtol=1e-6)


def test_bad_input_is_one_clear_line() -> None:
    with pytest.raises(ValueError, match="expected one output, got 2"):
        feedback_limit(PLANT, hg.LinearSensor([[1.0], [2.0]], 0.1), [HOP], 1.0)
    blind = hg.LinearPlant(np.diag([1.1, 1.2]), 0.1, [0, 0], np.eye(2))
    with pytest.raises(ValueError, match="shows every unstable mode"):
        feedback_limit(blind, hg.LinearSensor([[1.0, 0.0]], 0.1), [HOP], 1.0)
    with pytest.raises(ValueError, match="powers: expected positive numbers"):
        noise_of_hops([HOP], 0.0)
    with pytest.raises(ValueError, match="single hops of one number"):
        noise_of_hops([hg.parallel([HOP, HOP])], 1.0)


def test_every_transmitter_sends_its_power() -> None:
    channel = fed_back_channel(PLANT, SENSOR, [HOP, HOP], [1.0, 3.0], 12)
    fed = hg.Node(SENSOR, channel, {"fed": fed_back_filter(PLANT, SENSOR, channel)})
    network = hg.Network(PLANT, {"node": fed})
    sent = hg.power(network, 12).over_time
    np.testing.assert_allclose(sent["node.hop1"], 1.0, rtol=1e-9)
    np.testing.assert_allclose(sent["node.hop2"], 3.0, rtol=1e-9)
    same = hg.Node(SENSOR, HOP, {"fed": fed_back_filter(PLANT, SENSOR, HOP)})
    with pytest.raises(ValueError, match="with feedback: expected a horizon"):
        hg.power(hg.Network(hg.LinearPlant([[0.9]], 1.0, [0.0], [[1.0]]), {"node": same}))
    with pytest.raises(ValueError, match="what it measures at each step, got feedback"):
        hg.design(network, error=hg.planning.Error(horizon=12), budget=3.0)
