"""Prediction and correction apart, a start that is set, and what a correction tells."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.follow import apart, follow_known

STEPS = 60


def move(x, u):
    return jnp.array([x[0] + u[0] * x[2] * jnp.cos(x[1]), x[1] + 0.1 * u[0], x[2]])


VEHICLE = hg.Plant(move, np.diag([1e-3, 1e-4, 1e-2]), [5.0, 0.2, 2.0], 0.2 * np.eye(3), inputs=["dt"])
SENSOR = hg.Sensor(lambda x: jnp.array([jnp.hypot(x[0], 3.0), x[2]]), 0.04 * np.eye(2), outputs=["range", "wheel"])
BOTH = hg.perfect(2)
MAKERS = {
    "extended": hg.extended_filter,
    "cubature": hg.cubature_filter,
    "gate": lambda *parts, **start: hg.robust_filter(VEHICLE, SENSOR, BOTH, hg.filters.Gate(13.8), **start),
    "Huber": lambda *parts, **start: hg.robust_filter(VEHICLE, SENSOR, BOTH, hg.filters.Huber(1.345), **start),
    "linear": lambda *parts, **start: hg.linear_filter(
        hg.LinearPlant([[1, 0.1], [0, 0.95]], 0.02 * np.eye(2), [1.0, 2.0], np.eye(2), [[0.0], [0.1]]),
        hg.LinearSensor(np.eye(2), 0.1 * np.eye(2)), hg.hop(hg.Rayleigh(0.8), 0.1 * np.eye(2), dimension=2)
    ),
}  # fmt: skip


def recorded(far=np.nan):
    """Ranges and speeds, a quarter of them missing, one perhaps far off; inputs are time steps."""
    rng = np.random.default_rng(2)
    u = rng.uniform(0.05, 0.3, size=(STEPS, 1))
    z = np.column_stack([np.hypot(5 + 1.8 * np.cumsum(u), 3.0), np.full(STEPS, 2.0)]) + 0.2 * rng.normal(
        size=(STEPS, 2)
    )
    z[rng.random(z.shape) < 0.25] = np.nan
    z[30] = [far, 2.0]
    return z, u


def followed(device, z, u):
    """Estimates and what is told of each step: innovation (m,), weights where there are any, NIS and what arrived."""
    means, covariances, told = [], [], []
    size = 2 + len(z[0]) * (2 if "weight" in device.exported.header.read_text() else 1)
    for row, given in zip(z, u, strict=True):
        news = np.zeros(size, device.real)
        assert device.call("predict", given) == 0
        assert device.call("correct", row, news) == 0
        means.append(device.mean())
        covariances.append(device.covariance())
        told.append(news.astype(float))
    return (np.stack(means), np.stack(covariances)), np.stack(told)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("precision", "most"), [("double", 1e-12), ("float", 1e-4)])
@pytest.mark.parametrize("name", MAKERS)
def test_prediction_and_correction_are_the_step(name, precision, most, tmp_path):
    """In deviations; innovations and weights are those of Python too, NIS to rounding of a square."""
    filter_, (z, u) = MAKERS[name](VEHICLE, SENSOR), recorded(60.0 if name in ("gate", "Huber") else np.nan)
    estimates, told = followed(Device(filter_, tmp_path, precision=precision, apart=True), z, u)
    assert max(apart(estimates, follow_known(filter_, z, u))) < most
    state, digits = filter_.init(), {"double": 1e-9, "float": 2e-3}[precision]
    for row, given, news in zip(z, u, told, strict=True):
        state, _, judgement, innovation = filter_.judge_step(state, row, given)
        weights = [] if innovation.weight is None else innovation.weight
        right = [*innovation.value, *weights, judgement.distance, judgement.arrived]
        np.testing.assert_allclose(news, np.array(right, float), rtol=digits, atol=digits)


@pytest.mark.slow
@needs_compiler
def test_the_step_is_still_there(tmp_path):
    """Equal to predict and correct, and whole or not at all: a refused half leaves the state as it was."""
    filter_, (z, u) = MAKERS["extended"](VEHICLE, SENSOR), recorded()
    device = Device(filter_, tmp_path, apart=True)
    assert max(apart(device.follow(z, u), follow_known(filter_, z, u))) < 1e-12
    before = device.state.copy()
    for row, given, code in (([np.inf, 1.0], [0.1], 1), ([1.0, 1.0], [-1.0], 6), ([1e300, 1.0], [0.1], 5)):
        assert device.step(row, given) == code
        np.testing.assert_array_equal(device.state, before)


@pytest.mark.slow
@needs_compiler
def test_one_sensor_at_a_time(tmp_path):
    """A wheel and then a range, each with its own correction, as in Python."""
    filter_, (z, u) = MAKERS["extended"](VEHICLE, SENSOR), recorded()
    device, state, nothing = Device(filter_, tmp_path, apart=True), filter_.init(), np.zeros(4)
    for row, given in zip(z, u, strict=True):
        state = filter_.predict(state, given)
        assert device.call("predict", given) == 0
        for one in ([np.nan, row[1]], [row[0], np.nan]):
            state, _ = filter_.correct(state, one)
            assert device.call("correct", one, nothing) == 0
    estimate = filter_.estimate(state)
    assert max(apart((device.mean()[None], device.covariance()[None]),
                     (estimate.mean[None], estimate.covariance[None]))) < 1e-12  # fmt: skip


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("precision", "most"), [("double", 1e-12), ("float", 1e-4)])
def test_a_start_that_is_set(precision, most, tmp_path):
    """Equal to the filter that starts there; what is no mean and no covariance changes nothing."""
    root = np.array([[0.3, 0.0, 0.0], [0.1, 0.2, 0.0], [0.0, -0.1, 0.4]])
    mean, covariance, (z, u) = [4.0, 0.1, 1.5], root @ root.T, recorded()
    device = Device(MAKERS["extended"](VEHICLE, SENSOR), tmp_path, precision=precision, apart=True)
    assert device.call("start_at", mean, covariance) == 0
    before = device.state.copy()
    none = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    for wrong in ((mean, none), (mean, -np.eye(3)), (mean, np.full((3, 3), np.nan)), ([np.inf, 0, 0], covariance)):
        assert device.call("start_at", *wrong) == 7
        np.testing.assert_array_equal(device.state, before)
    right = follow_known(MAKERS["extended"](VEHICLE, SENSOR, None, None, mean, covariance), z, u)
    assert max(apart(device.follow(z, u), right)) < most


def test_a_filter_whose_state_is_more_has_no_start_of_its_own(tmp_path):
    header = hg.export_c(MAKERS["linear"](), tmp_path / "a.c", apart=True).header.read_text()
    assert "a_predict(" in header and "a_start_at" not in header
    assert "a_predict" not in hg.export_c(MAKERS["linear"](), tmp_path / "a.c").header.read_text()
