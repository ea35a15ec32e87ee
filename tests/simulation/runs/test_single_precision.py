"""Monte Carlo in single precision runs on native code, with the draws and the numbers that XLA has in float32."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph import filters as hf

A, C = np.eye(4) + 0.1 * np.eye(4, k=2), np.eye(2, 4)
PLANT, SENSOR = hg.LinearPlant(A, 0.01 * np.eye(4), np.zeros(4), np.eye(4)), hg.LinearSensor(C, 0.1 * np.eye(2))
RELAY = hg.amplify_and_forward([
    hg.hop(hg.Rayleigh(0.8), noise=0.02 * np.eye(2)), hg.hop(1.0, noise=0.01 * np.eye(2), amplification=1.2),
])  # fmt: skip
CHAIN = hg.random_affine.MarkovChain(np.array([[0.9, 0.1], [0.3, 0.7]]), np.array([0.75, 0.25]))
MODES = hg.random_affine.Modes(CHAIN, [hg.hop(1.0, 0.05, dimension=2), hg.hop(0.3, 0.1, dimension=2)])
TURNING = hg.Plant(
    lambda x, u: jnp.stack([x[0] + 0.1 * jnp.cos(x[2]), x[1] + 0.1 * jnp.sin(x[2]), x[2]]),
    noise=1e-3 * np.eye(3), initial_mean=np.zeros(3), initial_covariance=0.1 * np.eye(3),
)  # fmt: skip
RANGES = hg.Sensor(
    lambda x: jnp.stack([jnp.hypot(x[0] - 3, x[1] - 4), jnp.hypot(x[0] + 3, x[1] - 4)]), 0.01, outputs=["left", "right"]
)


def alone(plant, sensor, channel, filter_):
    """A network of one node."""
    return hg.Network(plant, {"node": hg.Node(sensor, channel, {"f": filter_})})


NETWORKS = {
    "linear": lambda: alone(PLANT, SENSOR, RELAY, hg.linear_filter(PLANT, SENSOR, RELAY)),
    "cubature": lambda: alone(TURNING, RANGES, RELAY, hg.cubature_filter(TURNING, RANGES, RELAY)),
    "imm": lambda: alone(PLANT, SENSOR, MODES, hf.imm_filter(PLANT, SENSOR, MODES)),
    "fused": lambda: hg.Network(
        PLANT,
        {name: hg.Node(SENSOR, RELAY, {"f": hg.linear_filter(PLANT, SENSOR, RELAY)}) for name in "ab"},
        {"ci": hg.Fusion("f", hg.fusion.EqualIntersection())},
    ),
}


def both(monkeypatch, run):
    """What native code and XLA return; a rule that fails would warn."""
    results = []
    for engine in ("native", "xla"):
        monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            results.append(run())
    return results


@pytest.mark.slow
@pytest.mark.parametrize("name", NETWORKS)
def test_native_code_simulates_what_xla_simulates_in_float32(monkeypatch, name):
    """The same draws; estimates differ by roundings of 1e-7, which thirty steps carry on."""
    network = NETWORKS[name]()
    native, xla = both(monkeypatch, lambda: hg.monte_carlo(network, 30, 64, 3, precision="float32"))
    np.testing.assert_allclose(native.truth, xla.truth, rtol=0, atol=2e-5)
    for node, by_name in xla.estimates.items():
        if node in xla.measurements:
            np.testing.assert_allclose(native.measurements[node], xla.measurements[node], rtol=0, atol=5e-5)
        for label, estimate in by_name.items():
            found = native.estimates[node][label]
            assert found.mean.dtype == found.covariance.dtype == np.float64
            assert found.claim == estimate.claim == "nominal"
            spread = np.sqrt(np.diagonal(estimate.covariance, axis1=-2, axis2=-1))
            assert np.max(np.abs(found.mean - estimate.mean) / spread) < 1e-3


@pytest.mark.slow
def test_sums_and_smoothed_sums_agree(monkeypatch):
    network = NETWORKS["linear"]()

    def run():
        kept = hg.Statistics()
        return hg.monte_carlo(network, 12, 96, 1, kept, precision="float32", smooth=hg.smoothing.FixedInterval())

    native, xla = both(monkeypatch, run)
    for one, other in ((native, xla), (native.smoothed, xla.smoothed)):
        np.testing.assert_allclose(one["node"]["f"].rmse(), other["node"]["f"].rmse(), rtol=1e-5)
    nees, expected = native["node"]["f"].nees_per_dimension(), xla["node"]["f"].nees_per_dimension()
    np.testing.assert_allclose(nees, expected, rtol=1e-5)


def test_parts_of_a_simulation_are_those_of_the_whole(monkeypatch):
    """Neither the chunk nor the runs beside it change a bit, of doubles or of floats."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    network = NETWORKS["linear"]()
    whole = hg.monte_carlo(network, 8, 96, 1, precision="float32")
    parts = [hg.monte_carlo(network, 8, 32, 1, first_run=n, precision="float32", chunk=32) for n in (0, 32, 64)]
    np.testing.assert_array_equal(whole.truth, np.concatenate([p.truth for p in parts]))
    means = [p.estimates["node"]["f"].mean for p in parts]
    np.testing.assert_array_equal(whole.estimates["node"]["f"].mean, np.concatenate(means))
