"""Lanes: neither cores, nor chunks, nor devices change what is simulated; single precision changes it little."""

import os
import subprocess
import sys
import warnings

import equinox as eqx
import jax
import numpy as np
import pytest

import heliograph as hg

BLOCK, LANES = 32, 8  # runs simulated side by side, and the most cores
HORIZON, RUNS = 4, 10 * BLOCK + 7  # two blocks for each lane


def network():
    plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1 * np.eye(2), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    channel = hg.hop(hg.Rayleigh(1.0), 0.1)
    return hg.Network(plant, {"a": hg.Node(sensor, channel, {"f": hg.linear_filter(plant, sensor, channel)})})


@pytest.mark.parametrize("chunk", [BLOCK, 3 * BLOCK, LANES * BLOCK, 11 * BLOCK])
def test_chunks_do_not_change_a_bit(chunk):
    whole, parts = (hg.monte_carlo(network(), HORIZON, RUNS, 0, chunk=c) for c in (100 * BLOCK, chunk))
    np.testing.assert_array_equal(whole.truth, parts.truth)
    np.testing.assert_array_equal(whole.estimates["a"]["f"].mean, parts.estimates["a"]["f"].mean)
    item, other = (
        hg.monte_carlo(network(), HORIZON, RUNS, 0, hg.Statistics(), chunk=c)["a"]["f"] for c in (100 * BLOCK, chunk)
    )
    np.testing.assert_array_equal(item.outer, other.outer)
    np.testing.assert_array_equal(item.nees, other.nees)


def test_one_core_gives_the_same_bits(monkeypatch):
    runs = 9 * BLOCK
    count = hg.monte_carlo(network(), HORIZON, runs, 0, hg.Statistics())["a"]["f"]
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    item = hg.monte_carlo(network(), HORIZON, runs, 0, hg.Statistics())["a"]["f"]
    np.testing.assert_array_equal(count.outer, item.outer)


DEVICES = """
import numpy as np, jax, sys
from tests.simulation.both import Both
from tests.simulation.runs.test_lanes import network, HORIZON, RUNS
import heliograph as hg
assert len(jax.devices()) == 3
record, statistics = hg.monte_carlo(network(), HORIZON, RUNS, 0, Both(), chunk=64)
outer = statistics["a"]["f"].outer
np.savez(sys.argv[1], truth=record.truth, mean=record.estimates["a"]["f"].mean, outer=outer)
"""


@pytest.mark.slow
def test_several_devices_share_the_lanes(tmp_path):
    """Three devices that JAX makes of one processor; sums run in another order, so rounding may differ."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=3"
    environment = os.environ | {"XLA_FLAGS": flags}
    subprocess.run([sys.executable, "-c", DEVICES, str(tmp_path / "found.npz")], env=environment, check=True)
    result = np.load(tmp_path / "found.npz")
    record = hg.monte_carlo(network(), HORIZON, RUNS, 0)
    np.testing.assert_allclose(result["truth"], record.truth, rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(result["mean"], record.estimates["a"]["f"].mean, rtol=1e-10, atol=1e-12)
    statistics = hg.monte_carlo(network(), HORIZON, RUNS, 0, hg.Statistics())["a"]["f"]
    np.testing.assert_allclose(result["outer"], statistics.outer, rtol=1e-10, atol=1e-12)


def test_single_precision_tells_the_same_story():
    """Other draws of the same laws: RMSE within 4 standard errors of its difference over 8,192 runs."""
    double, single = (
        hg.monte_carlo(network(), HORIZON, 8192, 0, hg.Statistics(), chunk=LANES * BLOCK, precision=p)["a"]["f"]
        for p in ("float64", "float32")
    )
    (a, a_error), (b, b_error) = double.rmse(), single.rmse()
    assert a != b and abs(a - b) < 4 * np.hypot(a_error, b_error)
    assert single.outer.dtype == np.float64
    assert (double.claim, single.claim) == ("exact", "nominal")  # nobody counts the digits that it loses


def test_single_precision_error_of_a_filter_on_the_same_data():
    """Rounding to 24 bits, amplified by a few steps: below 1e-5 of the estimates' size."""
    item = network().nodes["a"].filters["f"]
    z = np.random.default_rng(0).normal(size=(20, 1))

    def last(item, z):
        state = jax.tree.map(jax.numpy.asarray, item.init())
        return jax.lax.scan(lambda s, x: item.step(s, x), state, z)[1]

    with jax.enable_x64(True):
        double = eqx.filter_jit(last)(item, z)
    single = eqx.filter_jit(last)(*jax.tree.map(lambda x: x.astype(np.float32) if eqx.is_array(x) else x, (item, z)))
    assert single.mean.dtype == np.float32
    np.testing.assert_allclose(single.mean, double.mean, atol=1e-5 * np.abs(double.mean).max())
    np.testing.assert_allclose(single.covariance, double.covariance, atol=1e-5 * np.abs(double.covariance).max())


def test_what_single_precision_takes_for_none_is_said():
    """Variances below 1.2e-38, as of states in units of 1e20: claims would be 0."""
    plant, sensor = hg.LinearPlant([[0.9]], 1e-39, [0.0], 1e-36), hg.LinearSensor([[1.0]], 1e-36)
    small = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})})
    with pytest.warns(UserWarning, match="single precision: numbers of plant or sensors below 1.2e-38 count as 0; "):
        hg.monte_carlo(small, 1, 4, 0, precision="float32")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hg.monte_carlo(network(), HORIZON, LANES * BLOCK, 0, hg.Statistics(), precision="float32")


def test_an_unknown_precision_is_refused():
    with pytest.raises(ValueError, match=r"precision: expected one of float64, float32, got 'half'"):
        hg.monte_carlo(network(), HORIZON, 10, 0, precision="half")
