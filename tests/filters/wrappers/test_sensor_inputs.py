"""Sensors that depend on inputs, against the same sensors over time, which every filter has known for long."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

RNG = np.random.default_rng(0)
STEPS = 40
DOSE = RNG.normal(size=(STEPS, 1))
Y = RNG.normal(size=STEPS)
Y[10:15] = np.nan
PLANT = hg.LinearPlant(
    np.eye(2), np.diag([0.01, 0.02]), [0, 0], 10.0, np.zeros((2, 1)), ["base", "slope"], ["dose"]
)  # fmt: skip


def row(u):
    return jnp.stack([jnp.ones(()), u[0]])[None]


SENSOR = hg.LinearSensor(row, lambda u: (0.5 + 0.1 * u[0] ** 2)[None, None], ["y"], inputs=["dose"])
SAME = hg.model.over_time(
    [hg.LinearSensor([[1.0, d]], 0.5 + 0.1 * d**2, ["y"]) for d in DOSE[:, 0]]
)  # the inputs of these rows put in
FADING = hg.markov_fading([0.5, 1.0], [[0.8, 0.2], [0.3, 0.7]], 0.1)
LOSSY = hg.gilbert_elliott(hg.erasure(hg.hop(1.0, 0.1), 0.9), hg.erasure(hg.hop(1.0, 0.5), 0.2), 0.1, 0.3)


@pytest.mark.parametrize(
    ("make", "claim"),
    [
        (hg.kalman_filter, "exact"),
        (lambda p, s: hg.cubature_filter(p, s), "exact"),
        (lambda p, s: hg.linear_filter(p, s, hg.hop(hg.Discrete([0.5, 1.0], [0.4, 0.6]), 0.1)), "exact"),
        (lambda p, s: hg.linear_filter(p, s, FADING), "exact"),
        pytest.param(lambda p, s: hg.linear_filter(p, s, LOSSY), "exact", marks=pytest.mark.slow),
        (lambda p, s: hg.filters.imm_filter(p, s, FADING), "nominal"),
    ],
    ids=["kalman", "cubature", "random gain", "fading", "lossy", "imm"],
)
def test_filters_are_those_of_a_sensor_over_time(make, claim):
    """To rounding: the same operations, with a matrix that is computed instead of looked up."""
    found, right = make(PLANT, SENSOR).run(Y, DOSE), make(PLANT, SAME).run(Y, DOSE)
    assert found.claim == right.claim == claim
    np.testing.assert_allclose(found.means, right.means, atol=1e-12)
    np.testing.assert_allclose(found.covariances, right.covariances, atol=1e-12)
    assert abs(found.log_likelihood - right.log_likelihood) < 1e-10


def test_smoothed_estimates_are_those_of_a_sensor_over_time():
    found, right = (hg.rts_smoother(hg.kalman_filter(PLANT, s), Y, DOSE) for s in (SENSOR, SAME))
    assert found.claim == right.claim == "exact"
    np.testing.assert_allclose(found.means, right.means, atol=1e-12)
    np.testing.assert_allclose(found.covariances, right.covariances, atol=1e-12)


def test_a_nonlinear_sensor_of_inputs():
    """h(x, u) that is linear in x, by the extended filter: the Kalman filter's estimates, nominal."""
    sensor = hg.Sensor(lambda x, u: row(u) @ x, lambda u: 0.5 + 0.1 * u[0] ** 2, ["y"], inputs=["dose"])
    found, right = hg.extended_filter(PLANT, sensor).run(Y, DOSE), hg.kalman_filter(PLANT, SENSOR).run(Y, DOSE)
    assert found.claim == "nominal"
    np.testing.assert_allclose(found.means, right.means, atol=1e-12)


def network(**more):
    filters = {"k": hg.linear_filter(PLANT, SENSOR, hg.perfect(1))}
    return hg.Network(PLANT, {name: hg.Node(SENSOR, hg.perfect(1), filters) for name in ("a", "b")}, more)


def test_a_network_claims_and_keeps_what_it_claims():
    """400 runs of 20 steps: NEES of two states within four standard errors, sqrt(4 / 400) each."""
    both = hg.model.joint_sensor({"a": SENSOR, "b": SENSOR})
    central = hg.linear_filter(PLANT, both, hg.parallel([hg.perfect(1), hg.perfect(1)]))
    world = network(all=central)
    assert world.claims()["a"]["k"] == world.claims()["fused"]["all"] == "exact"
    runs = hg.monte_carlo(world, 20, 400, 1, inputs=DOSE[:20])
    for node, name in (("a", "k"), ("fused", "all")):
        e = runs.estimates[node][name]
        nees = hg.nees(runs.truth[:, -1], e.mean[:, -1], e.covariance[:, -1])
        assert abs(np.mean(nees) - 2) < 4 * np.sqrt(4 / 400), name


def test_a_filter_of_another_sensor_loses_its_claim():
    other = hg.LinearSensor(lambda u: 2 * row(u), 0.5, ["y"], inputs=["dose"])
    node = hg.Node(other, hg.perfect(1), {"k": hg.kalman_filter(PLANT, SENSOR)})
    assert hg.Network(PLANT, {"a": node}).claims()["a"]["k"] == "nominal"
    twin = hg.LinearSensor(row, lambda u: (0.5 + 0.1 * u[0] ** 2)[None, None], ["y"], inputs=["dose"])
    node = hg.Node(twin, hg.perfect(1), {"k": hg.kalman_filter(PLANT, SENSOR)})
    assert hg.Network(PLANT, {"a": node}).claims()["a"]["k"] == "exact"  # written alike


def test_live_and_recorded_are_one():
    kalman = hg.kalman_filter(PLANT, SENSOR)
    stream = hg.Stream(kalman)
    last = [stream.push([y], u) for y, u in zip(Y, DOSE, strict=True)][-1]
    record = hg.run(network(), {"a": Y, "b": Y}, DOSE)
    np.testing.assert_allclose(last.mean, kalman.run(Y, DOSE).means[-1], atol=1e-12)
    np.testing.assert_allclose(record.estimates["a"]["k"].mean[-1], last.mean, atol=1e-12)


def test_outputs_are_forecast_under_the_inputs_ahead():
    found = hg.kalman_filter(PLANT, SENSOR).run(Y, DOSE)
    ahead = hg.forecast(found, 2, inputs=[[1.0], [3.0]])
    x, p = ahead.states.mean, ahead.states.covariance
    for i, dose in enumerate((1.0, 3.0)):
        c = np.array([1.0, dose])
        assert abs(ahead.outputs.mean[i, 0] - c @ x[i]) < 1e-12
        assert abs(ahead.outputs.covariance[i, 0, 0] - (c @ p[i] @ c + 0.5 + 0.1 * dose**2)) < 1e-12
    assert ahead.outputs.claim == "exact"
    paths = hg.forecasting.draw_paths(found, 2, [[1.0], [3.0]], draws=4000)
    deviation = ahead.outputs.deviation[:, 0]
    assert (np.abs(paths.y.mean(axis=0)[:, 0] - ahead.outputs.mean[:, 0]) < 4 * deviation / np.sqrt(4000)).all()


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: hg.kalman_filter(hg.LinearPlant(np.eye(2), 1.0, [0, 0], 1.0), SENSOR), "inputs of a sensor: expected"),
        (
            lambda: hg.linear_filter(PLANT, SENSOR, hg.model.delayed(hg.perfect(1), 1)),
            "sensor of a filter behind a late",
        ),
        (lambda: hg.filters.particle_filter(PLANT, SENSOR, FADING), "one that depends on no inputs"),
        (lambda: hg.steady_state(PLANT, SENSOR), "sensor matrix: expected a constant one"),
        (lambda: hg.model.with_bias(PLANT, SENSOR, 1.0), "sensor matrix: expected a constant one"),
        (lambda: hg.LinearSensor(lambda u: u, 0.1, inputs=["dose"]), "sensor matrix.*shape"),
        (lambda: hg.LinearSensor(row, 0.1), r"sensor matrix: expected a constant, or inputs=\[...\]"),
        (lambda: hg.Sensor(lambda x, u: x, 0.1), r"a function of x alone, or inputs=\[...\]"),
    ],
)
def test_what_cannot_depend_on_inputs_says_so_in_one_line(call, words):
    with pytest.raises(hg.InputError, match=words):
        call()


def test_a_noise_that_is_none_names_its_row():
    """0.5 - dose^2 is negative in some rows."""
    sensor = hg.LinearSensor(row, lambda u: (0.5 - u[0])[None, None] * 0.1 + 0.06, ["y"], inputs=["dose"])
    with pytest.raises(hg.InputError, match=r"sensor noise covariance\(u\): expected a covariance, got .* in row \d+"):
        hg.kalman_filter(PLANT, sensor).run(Y, 2 + DOSE)
