"""Forecasts against the prediction's formulas, published numbers, simulation, and from every kind of origin."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.forecasting import Forecast

NILE = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958, 1140,
    1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020, 1050, 969, 831,
    726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796, 1040, 759, 781, 865, 845,
    944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874, 848, 890, 744, 749, 838, 1050, 918,
    986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740,
], float)  # fmt: skip
LEVEL, NOISE = 1469.1, 15099.0  # variances of Durbin and Koopman's local level


def nile():
    return hg.state_space([[1.0]], [[1.0]], LEVEL, NOISE, [0.0], 1e7)


def by_hand(y, steps):
    """Mean, and variances of level and output, by the scalar recursion."""
    mean, variance = 0.0, 1e7
    for value in y:
        variance += LEVEL
        gain = variance / (variance + NOISE)
        mean, variance = mean + gain * (value - mean), variance * (1 - gain)
    levels = variance + LEVEL * np.arange(1, steps + 1)
    return mean, levels, levels + NOISE


def test_nile_is_forecast_as_published():
    """Durbin and Koopman, Time Series Analysis by State Space Methods, Section 2.6: 798.37, and 4032.16 at the end."""
    result = hg.forecast(hg.kalman_filter(*nile()).run(NILE), 10)
    mean, levels, outputs = by_hand(NILE, 10)
    assert mean == pytest.approx(798.37, abs=5e-3)
    assert levels[0] - LEVEL == pytest.approx(4032.16, abs=5e-3)
    # To rounding: a hundred steps of well-conditioned products, of numbers of a thousand.
    np.testing.assert_allclose(result.outputs.mean[:, 0], mean, rtol=1e-11)
    np.testing.assert_allclose(result.states.covariance[:, 0, 0], levels, rtol=1e-11)
    np.testing.assert_allclose(result.outputs.covariance[:, 0, 0], outputs, rtol=1e-11)
    np.testing.assert_allclose(result.received.covariance[:, 0, 0], outputs, rtol=1e-11)
    assert (result.states.claim, result.outputs.claim, result.inputs) == ("exact", "exact", "none")
    low, high = result.outputs.interval(0.8)
    np.testing.assert_allclose(high[:, 0] - low[:, 0], 2 * 1.2815515655446004 * np.sqrt(outputs), rtol=1e-11)
    np.testing.assert_allclose(result.outputs.below(mean)[:, 0], 0.5, atol=1e-10)


def network():
    """Two nodes, one behind a relay and losses, with a filter each, and two fusions."""
    plant = hg.LinearPlant([[0.95, 0.2], [0, 0.9]], np.diag([0.1, 0.2]), [0, 0], np.eye(2), [[0.0], [1.0]],
                           states=["x", "v"], inputs=["force"])  # fmt: skip
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.3, outputs=["x"])
    relayed = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.7), 0.1), hg.hop(hg.Rayleigh(0.9), 0.2)])
    nodes = {
        "far": hg.Node(sensor, hg.erasure(relayed, 0.7), {"best": hg.linear_filter(plant, sensor, relayed)}),
        "near": hg.Node(sensor, hg.perfect(1), {"best": hg.kalman_filter(plant, sensor)}),
    }
    both = hg.model.joint_sensor({"far": sensor, "near": sensor})
    central = hg.linear_filter(plant, both, hg.parallel([relayed, hg.perfect(1)]))
    fusions = {"ci": hg.Fusion("best", hg.CovarianceIntersection()), "central": central}
    return hg.Network(plant, nodes, fusions)


def recorded(rows=30):
    world = network()
    inputs = np.sin(np.arange(rows))[:, None]
    simulated = hg.simulate(world, rows, 1, inputs=inputs)
    return world, simulated.measurements, inputs


def test_a_record_forecasts_each_estimate_and_stays_as_it_is():
    world, z, inputs = recorded()
    record = hg.run(world, z, inputs)
    ahead = np.array([[0.5], [-1.0], [2.0]])
    forecasts = hg.forecast(record, [1, 3], inputs=ahead)
    again = hg.forecast(record, 3, inputs=ahead)
    a, b, q = np.array([[0.95, 0.2], [0, 0.9]]), np.array([0.0, 1.0]), np.diag([0.1, 0.2])
    assert {node: list(of) for node, of in forecasts.items()} == {
        "far": ["best"], "near": ["best"], "fused": ["ci", "central"],
    }  # fmt: skip
    for node, filters in forecasts.items():
        for name, result in filters.items():
            estimate = record.estimates[node][name]
            mean, covariance = np.asarray(estimate.mean)[-1], np.asarray(estimate.covariance)[-1]
            for k in range(3):
                mean, covariance = a @ mean + b * ahead[k, 0], a @ covariance @ a.T + q
                np.testing.assert_allclose(again[node][name].states.mean[k], mean, rtol=1e-10)
                np.testing.assert_allclose(again[node][name].states.covariance[k], covariance, rtol=1e-9)
            np.testing.assert_allclose(result.states.mean[1], mean, rtol=1e-10)
            assert result.states.claim == estimate.claim
            assert result.time.tolist() == [30.0, 32.0]
            assert result.inputs == "given"
    assert forecasts["fused"]["ci"].outputs.names == ("far_x", "near_x")
    # What arrives behind the relay has another gain and more noise than what the sensor measures.
    far = forecasts["far"]["best"]
    assert far.received.names == far.outputs.names == ("x",)
    gain = np.prod([0.7, 0.9]) * np.pi / 2  # product of the means of two Rayleigh gains
    np.testing.assert_allclose(far.received.mean, gain * far.outputs.mean, rtol=1e-9)


def test_live_objects_forecast_what_the_record_does():
    world, z, inputs = recorded()
    batch = hg.forecast(hg.run(world, z, inputs), [1, 4], inputs="held")
    assert batch["near"]["best"].inputs == "held"
    timeline = hg.Timeline(world, 5.0)
    for k in range(30):
        timeline.push("inputs", k, k, inputs[k])
        timeline.push("far", k, k, z["far"][k])
        timeline.push("near", k, k, z["near"][k])
    live = hg.forecast(timeline, [1, 4], inputs="held")
    for node, filters in batch.items():
        for name, result in filters.items():
            np.testing.assert_allclose(live[node][name].states.mean, result.states.mean, rtol=1e-9)
            np.testing.assert_allclose(live[node][name].states.covariance, result.states.covariance, rtol=1e-8)
            np.testing.assert_array_equal(live[node][name].time, result.time)
    # The timeline is as it was: what comes late is still used.
    assert timeline.push("near", 100, 29, [np.nan]) == "used"
    stream = hg.Stream(world.nodes["near"].filters["best"])
    for k in range(30):
        stream.push(z["near"][k], inputs[k])
    for one in (stream, hg.Stream.restore(stream.filter, stream.save())):
        result = hg.forecast(one, [1, 4], inputs="held")
        assert isinstance(result, Forecast)
        np.testing.assert_allclose(result.states.mean, batch["near"]["best"].states.mean, rtol=1e-9)


def continuous():
    """A level and its rate in continuous time, by exact discretisation."""
    plant = hg.LinearPlant(
        lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]),
        lambda u: 0.1 * jnp.array([[u[0] ** 3 / 3, u[0] ** 2 / 2], [u[0] ** 2 / 2, u[0]]]) + 0.0 * jnp.eye(2),
        [0, 0], np.eye(2), inputs=["dt"],
    )  # fmt: skip
    return plant, hg.LinearSensor([[1.0, 0.0]], 0.3)


def test_where_time_is_continuous_a_horizon_may_lie_between_steps():
    plant, sensor = continuous()
    world = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    time = np.datetime64("2026-01-01T00:00:00", "ns") + np.arange(0, 40, 2).astype("timedelta64[s]")
    dt = np.full((20, 1), 2.0)
    record = hg.run(world, {"a": np.sin(np.arange(20.0))}, dt, time)
    result = hg.forecast(record, [0.5, 3.0])["a"]["f"]
    mean, p = (
        np.asarray(part)[-1] for part in (record.estimates["a"]["f"].mean, record.estimates["a"]["f"].covariance)
    )
    for i, s in enumerate([0.5, 3.0]):
        f = np.array([[1, s], [0, 1]])
        q = 0.1 * np.array([[s**3 / 3, s**2 / 2], [s**2 / 2, s]])
        np.testing.assert_allclose(result.states.mean[i], f @ mean, rtol=1e-12)
        np.testing.assert_allclose(result.states.covariance[i], f @ p @ f.T + q, rtol=1e-12)
    spans = hg.forecast(record, [np.timedelta64(500, "ms"), time[-1] + np.timedelta64(3, "s")])["a"]["f"]
    np.testing.assert_array_equal(spans.states.mean, result.states.mean)
    np.testing.assert_array_equal(spans.time, time[-1] + np.array([500, 3000], "timedelta64[ms]"))
    np.testing.assert_array_equal(hg.forecast(record, 2)["a"]["f"].steps, [2.0, 4.0])  # of the usual size


def test_dates_are_steps_where_time_counts_them():
    years = np.arange("1871", "1971", dtype="datetime64[Y]").astype("datetime64[ns]")
    plant, sensor = nile()
    world = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    record = hg.run(world, {"a": NILE}, time=years)
    result = hg.forecast(record, [np.datetime64("1971"), np.datetime64("1975-01-01")])["a"]["f"]
    assert result.steps.tolist() == [1, 5]
    assert abs(result.time[1] - np.datetime64("1975-01-01")) <= np.timedelta64(2, "D")  # of five years of 365 days


def test_modes_are_forecast_as_mixtures():
    """Two far modes of a filter's state: quantiles are those of the mixture, found by its distribution function."""
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0)
    sensor = hg.LinearSensor([[1.0]], 0.1)
    link = hg.markov_fading([1.0, -1.0], [[0.95, 0.05], [0.05, 0.95]], noise=0.1)
    states = hg.forecast(hg.filters.imm_filter(plant, sensor, link).run([[9.0]]), 2).states
    assert states.weights.shape[1] == 2  # x is near 9 or near -9
    np.testing.assert_allclose(states.below(states.quantile(0.1))[:, 0], 0.1, atol=1e-9)
    np.testing.assert_allclose(states.below(states.quantile(0.9))[:, 0], 0.9, atol=1e-9)
    low, high = states.interval(0.8)
    assert np.all(low < -7)
    assert np.all(high > 7)
    weights, means, variances = states.weights[0, :, 0], states.part_means[0, :, 0], states.part_variances[0, :, 0]
    mean = weights @ means
    assert states.covariance[0, 0, 0] == pytest.approx(weights @ (variances + (means - mean) ** 2), rel=1e-12)
    particles = hg.filters.particle_filter(plant, sensor, link, particles=50)
    assert np.all(hg.forecast(particles.run([[9.0]]), 1).states.interval(0.8)[1] > 7)


def test_angles_are_wrapped_and_their_bands_go_on():
    plant = hg.LinearPlant([[1.0]], 0.01, [3.0], 0.01, [[1.0]], circular=["x0"])
    sensor = hg.LinearSensor([[1.0]], 0.01, circular=["y0"])
    result = hg.forecast(hg.cubature_filter(plant, sensor).run([[3.1]], [[0.1]]), 3, inputs=[0.1, 0.1, 0.1])
    for part in (result.states, result.outputs, result.received):
        assert np.all(np.abs(part.mean) <= np.pi)
        low, high = part.interval(0.9)
        assert np.all((low < part.mean) & (part.mean < high))
    assert result.states.mean[-1, 0] < -2.8


REFUSED = [
    (lambda r: hg.forecast(r, 0), "horizons", "a positive whole number"),
    (lambda r: hg.forecast(r, [3, 2], inputs="held"), "horizons", "each later than the one before"),
    (lambda r: hg.forecast(r, [-1.5], inputs="held"), "horizons", "a positive whole number"),
    (lambda r: hg.forecast(r, [np.datetime64("2026-01-01")], inputs="held"), "horizons", "no dates"),
    (lambda r: hg.forecast(r, 3), "inputs ahead", "rows of ['force'] for 3 steps"),
    (lambda r: hg.forecast(r, 3, inputs=[[1.0]]), "inputs ahead", "shape (3, 1)"),
    (lambda r: hg.forecast(r, 3, inputs="kept"), "inputs ahead", "'kept'"),
    (lambda r: hg.forecast(r, []), "horizons", "a number of steps"),
    (lambda r: hg.forecast("data", 3), "forecast", "a result of filter.run or hg.run"),
    (lambda r: hg.forecast(hg.simulate(network(), 3, 0, inputs=np.zeros((3, 1))), 3), "forecast", "without states"),
]  # fmt: skip


@pytest.mark.parametrize(("call", "name", "said"), REFUSED)
def test_what_cannot_be_forecast_is_refused_in_one_line(record, call, name, said):
    with pytest.raises(ValueError, match=re.escape(said)) as refused:
        call(record)
    text = str(refused.value)
    assert text.startswith(name)
    assert "\n" not in text


@pytest.fixture(scope="module")
def record():
    world, z, inputs = recorded(4)
    return hg.run(world, z, inputs)


def test_a_date_behind_the_data_is_refused():
    plant, sensor = nile()
    world = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    days = np.arange("2026-01-01", "2026-01-04", dtype="datetime64[D]").astype("datetime64[ns]")
    found = hg.run(world, {"a": NILE[:3]}, time=days)
    with pytest.raises(ValueError, match="dates after the data, which end at 2026-01-03"):
        hg.forecast(found, [np.datetime64("2026-01-02")])
    with pytest.raises(ValueError, match="whole steps of 86400 s"):
        hg.forecast(found, [np.timedelta64(36, "h")])


def test_a_model_that_ends_is_not_forecast_beyond():
    plant, sensor = nile()
    varying = hg.model.over_time([sensor] * 5)
    found = hg.kalman_filter(plant, varying).run(NILE[:3])
    assert hg.forecast(found, 2).outputs is not None
    with pytest.raises(ValueError, match="at most 2 steps, which the model covers"):
        hg.forecast(found, 3)


def test_ahead_of_a_start_that_nobody_knows_variances_are_infinite_until_enough_was_measured():
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], np.diag([100.0, 1.0]), [0.0, 0.0], hg.diffuse)
    filter = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 15.0))
    one, two = (hg.forecast(filter.run(rows), 2) for rows in ([[5.0]], [[5.0], [7.0]]))
    np.testing.assert_array_equal(one.outputs.covariance, np.full((2, 1, 1), np.inf))  # the slope is not known
    np.testing.assert_array_equal(one.received.covariance, one.outputs.covariance)
    # Of two rows the level is the last and the slope their difference: that of y_4 - y_2 and twice y_2 - y_1.
    np.testing.assert_allclose(two.outputs.mean[:, 0], [9.0, 11.0], rtol=1e-12)
    F, P = plant.matrix, filter.run([[5.0], [7.0]]).covariances[-1]
    for k in range(2):
        P = F @ P @ F.T + np.diag([100.0, 1.0])
        np.testing.assert_allclose(two.states.covariance[k], P, rtol=1e-12)
        np.testing.assert_allclose(two.outputs.covariance[k], P[:1, :1] + 15.0, rtol=1e-12)
