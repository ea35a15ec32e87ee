"""What is known of a moment given later events: the smoother's numbers, whatever the order and the gaps."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.rows import row_smoother
from heliograph.simulation.rows.row_smoother import RowSmoother

GAPS = {"a": (3, 5, 11), "b": (3, 5, 7, 11)}  # two of them at both nodes, one at the end


@pytest.mark.slow
def test_in_steps_it_is_the_smoother_of_the_rows():
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 0.95]], np.diag([0.01, 0.05]), [0.0, 1.0], np.eye(2))
    sensor, channel = hg.LinearSensor([[1.0, 0.0]], 0.3), hg.hop(hg.Rayleigh(1.0), 0.05)
    local = {"linear": hg.linear_filter(plant, sensor, channel)}
    fused = {"equal": hg.Fusion("linear", hg.fusion.EqualIntersection())}
    nodes = {"a": hg.Node(sensor, channel, local), "b": hg.Node(sensor, channel, local)}
    generator = np.random.default_rng(0)
    z = {name: generator.normal(size=(12, 1)) for name in nodes}
    for name, gaps in GAPS.items():
        z[name][list(gaps)] = np.nan
    whole = hg.run(hg.Network(plant, nodes, fused), z, smooth=hg.smoothing.FixedInterval())
    assert whole.smoothed is not None
    timeline = hg.Timeline(hg.Network(plant, nodes, fused), window=8.0)
    for k in (0, 1, 2, *generator.permutation(9) + 3):
        for name in nodes:
            if k not in GAPS[name]:
                assert timeline.push(name, 0, k, z[name][k], 2.0 if k < 3 else 11.0) == "used"
    with pytest.raises(ValueError, match="lag: expected a number from 0 to the window, 8, got 9"):
        timeline.lagged(9.0)
    before = timeline.save()
    for lag in (0, 3, 4, 6, 8):
        result = timeline.lagged(lag)
        assert {node: set(filters) for node, filters in result.items()} == {
            "a": {"linear"}, "b": {"linear"}, "fused": {"equal"},
        }  # fmt: skip
        for node, filters in result.items():
            for name, estimate in filters.items():
                expected = whole.smoothed.estimates[node][name]
                assert estimate.claim == expected.claim
                np.testing.assert_allclose(estimate.mean, expected.mean[11 - lag], atol=1e-12)
                np.testing.assert_allclose(estimate.covariance, expected.covariance[11 - lag], atol=1e-12)
    assert timeline.save() == before


@pytest.mark.parametrize("engine", ["native", "xla"])
def test_in_continuous_time_it_is_the_conditional_law(engine, monkeypatch):
    """Brownian motion x from a random start, Cov(x_s, x_t) = P0 + q min(s, t), measured with noise R at odd moments."""
    start, q, r = 2.0, 0.3, 0.1
    plant = hg.Plant(lambda x, u: x, lambda u: q * jnp.diag(u), [0.5], start, inputs=["dt"])
    sensor = hg.LinearSensor([[1.0]], r)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.cubature_filter(plant, sensor, hg.perfect())})
    timeline = hg.Timeline(hg.Network(plant, {"a": node}), window=20.0)
    generator = np.random.default_rng(2)
    times, z = np.sort(generator.uniform(0, 10, 9)), generator.normal(size=9)
    for i in generator.permutation(9):
        assert timeline.push("a", int(i), times[i], z[i], 12.0) == "used"
    monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
    for lag in (0.0, 1.5, 12 - times[4], 7.7, 12.0):
        moment = 12.0 - lag
        cross = start + q * np.minimum(moment, times)
        gain = np.linalg.solve(start + q * np.minimum(times[:, None], times) + r * np.eye(9), cross)
        result = timeline.lagged(lag)["a"]["f"]
        np.testing.assert_allclose(result.mean, 0.5 + gain @ (z - 0.5), rtol=1e-12)
        np.testing.assert_allclose(result.covariance, [[start + q * moment - gain @ cross]], rtol=1e-11)


def test_filters_without_a_covariance_refuse_and_are_left_out():
    plant, sensor = hg.LinearPlant([[0.7]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.5)
    gains = hg.h_infinity.HInfinityFilter(
        plant=plant, sensor=sensor, gains=np.full((1, 1), 0.4), expected_gain=np.ones((1, 1)),
        initial_mean=np.zeros(1), claim="none", states=plant.states, inputs=(), received=1,
    )  # fmt: skip
    alone = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": gains})})
    timeline = hg.Timeline(alone, window=3.0)
    timeline.push("a", 0, 2, 1.0)
    with pytest.raises(ValueError, match="smoothing: expected a filter that keeps its covariance"):
        timeline.lagged(1.0)
    both = {"f": gains, "linear": hg.linear_filter(plant, sensor, hg.perfect())}
    fused = {"informed": hg.Fusion("linear", hg.fusion.MatrixWeights())}
    others = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), both)}, fused)
    smoothed = RowSmoother(others, None).sweep
    assert smoothed.fusions == () and [others.stacks[i].filters for i in smoothed.stacks] == [("linear",)]


def test_a_moment_costs_the_rows_of_its_lag_and_not_of_the_window(monkeypatch):
    """Rows before the moment were read too, all of the window, and the engine was chosen anew for each moment."""
    lengths, engines = [], []
    estimates, chosen = RowSmoother.estimates, row_smoother.choose_code
    monkeypatch.setattr(
        RowSmoother, "estimates", lambda self, h, *span: lengths.append(span) or estimates(self, h, *span)
    )
    monkeypatch.setattr(
        row_smoother, "choose_code", lambda *values, **named: engines.append(1) or chosen(*values, **named)
    )
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})
    timeline = hg.Timeline(hg.Network(plant, {"a": node}), window=50.0)
    for k in range(40):
        timeline.push("a", k, k, [0.1 * k])
        if k > 3:
            timeline.lagged(2.0)
    assert set(lengths) == {(1, 4)} and len(engines) == 1  # a row before the moment, its own, and two later ones
