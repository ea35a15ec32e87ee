"""Every number that a device can be given, among good ones: what is refused leaves the state as it was, bit for bit."""

from functools import cache

import numpy as np
import pytest

import heliograph as hg
from tests.export.device import Device, needs_compiler

STEPS = 3000
ABSURD = [0.0, 5e-324, 1e-310, 1e-45, 1e-38, 1e-20, 1e6, 1e9, 1e16, 1e20, 3e38, 1e155, 1e200, 1e308, np.inf, np.nan]
HUGE = [x for x in ABSURD if not abs(x) < 1e16]
LINE = hg.LinearPlant([[1, 0.1], [0, 0.95]], 0.02 * np.eye(2), [1.0, 2.0], np.eye(2), [[0.0], [0.1]])
FREE = hg.LinearPlant([[1, 0.1], [0, 0.95]], np.zeros((2, 2)), [1.0, 2.0], np.eye(2), [[0.0], [0.1]])
BOTH = hg.LinearSensor([[1.0, 0.3], [0.0, 1.0]], 0.05 * np.eye(2))
PRECISE = hg.LinearSensor([[1.0, 0.3], [0.0, 1.0]], np.zeros((2, 2)))
BEARING = hg.Sensor(lambda x: x[:1] + 0.1 * x[:1] ** 2, 0.05)
GAIN = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 0.01, dimension=2)
FILTERS = {
    "kalman": hg.kalman_filter(LINE, BOTH),
    "linear": hg.linear_filter(LINE, BOTH, GAIN),
    "noise-free": hg.linear_filter(FREE, PRECISE, hg.perfect(2)),
    "cubature": hg.cubature_filter(LINE, BEARING, hg.perfect()),
    "extended": hg.extended_filter(LINE, BEARING, hg.perfect()),
}
BENT = ("cubature", "extended")


@pytest.fixture(scope="module")
def started(tmp_path_factory):
    """Called with the name of a filter and a precision, returns its device at the start; each is compiled once."""

    @cache
    def compiled(name, precision):
        return Device(FILTERS[name], tmp_path_factory.mktemp("device"), precision=precision)

    def start(name, precision):
        compiled(name, precision).start()
        return compiled(name, precision)

    return start


def drawn(random, size, usual):
    """Numbers of which one in ten is absurd, of either sign."""
    absurd = random.choice(ABSURD, size=size) * random.choice([-1.0, 1.0], size=size)
    return np.where(random.random(size) < 0.1, absurd, usual * random.normal(size=size))


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", FILTERS)
def test_no_number_spoils_a_device(name, precision, started):
    """Whatever comes, the estimate is a number, and what is refused changes nothing."""
    device, random = started(name, precision), np.random.default_rng(7)
    received, refused = FILTERS[name].received, 0
    with np.errstate(over="ignore"):  # an absurd double is an infinite float
        for _ in range(STEPS):
            before = device.state.copy()
            if device.step(drawn(random, received, 3.0), drawn(random, 1, 1.0)):
                refused += 1
                np.testing.assert_array_equal(device.state, before)
            mean, covariance = device.mean(), device.covariance()
            assert np.all(np.isfinite(mean)) and np.all(np.isfinite(covariance))
            assert np.all(np.diag(covariance) >= 0)
    assert refused > 0.02 * STEPS


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", FILTERS)
def test_after_absurd_measurements_a_device_follows_the_plant(name, precision, started):
    """Every tenth number is replaced by one beyond the bound of 1e6 deviations: it is refused, and nothing else."""
    filter_, random = FILTERS[name], np.random.default_rng(7)
    device, plant, x = started(name, precision), filter_.plant, np.array([1.3, 1.8])
    noise, output = (
        np.sqrt(0.02) * (plant is LINE),
        BEARING.function if name in BENT else np.asarray(BOTH.matrix).__matmul__,
    )
    with np.errstate(over="ignore"):
        for k in range(STEPS):
            x = np.asarray(plant.matrix) @ x + noise * random.normal(size=2)
            gain = random.choice([0.5, 1.0]) if name == "linear" else 1.0
            right = gain * np.asarray(output(x)) + np.sqrt(0.05) * (plant is LINE) * random.normal(
                size=filter_.received
            )
            z = np.where(random.random(filter_.received) < 0.1 * (50 < k < STEPS - 200), random.choice(HUGE), right)
            if device.step(z, [0.0]):
                assert device.step(np.where(z != right, np.nan, z), [0.0]) == 0
    deviations = np.sqrt(np.diag(device.covariance())) + 1e-6 * np.abs(x) + 1e-30  # rounding in single precision
    assert np.all(np.abs(device.mean() - x) < 5 * deviations)
