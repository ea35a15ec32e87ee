"""What a user's functions mean in a filter, a simulation and exported C is what JAX says."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from straightline.lowering import RULES

TABLE = np.array([3.0, 5.0, 7.0])


def predicted(rule, mean):
    """The second component of the state after a step without a measurement: rule(mean)."""
    plant = hg.Plant(lambda x, u: jnp.stack([x[0], rule(x) * 1.0]), 1e-12 * np.eye(2), mean, 1e-12 * np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    return float(hg.Stream(hg.extended_filter(plant, sensor, hg.perfect())).push([np.nan]).mean[1])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rule", "mean", "right"),
    [
        (lambda x: (jnp.stack([x > 0, x > 0]) @ (x > 0)).sum(), [1.0, 2.0], 2.0),
        (lambda x: x.at[jnp.round(x).astype(int)].get(mode="fill", fill_value=-5.0)[0], [7.0, 3.0], -5.0),
        (lambda x: jnp.arctan2(-(x[1] - 2.0), -x[0]), [1.0, 2.0], -np.pi),
        (lambda x: (jnp.asarray(2**62 + 1) // 3) % 1000 + 0 * x[0], [1.0, 2.0], 301.0),
        (lambda x: jax.lax.div(jnp.int32(-(2**31)), jnp.int32(-1)) + 0 * x[0], [1.0, 2.0], -(2.0**31)),
        (lambda x: jax.lax.div(jnp.uint32(3), jnp.uint32(0)) + 0 * x[0], [1.0, 2.0], 2.0**32 - 1),
        (lambda x: jnp.take(TABLE, jnp.round(x[1]).astype(int)), [1.0, 2.0], 7.0),
    ],
)
def test_a_plant_computes_what_jax_does(rule, mean, right):
    np.testing.assert_array_equal(predicted(rule, mean), right)


@pytest.mark.slow
@pytest.mark.parametrize("function", [lambda x: 0.5 * jnp.linalg.svd(jnp.outer(x, x) + jnp.eye(2))[1], jnp.sort])
def test_what_only_xla_computes_is_simulated_too(function):
    plant = hg.Plant(lambda x, u: 0.9 * function(x), 0.1 * np.eye(2), [1.0, 2.0], np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.cubature_filter(plant, sensor, hg.perfect())})
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), 5, 20, 1)
    assert np.all(np.isfinite(record.estimates["a"]["f"].mean))


def test_a_rule_that_fails_lets_xla_compute_and_says_so_once(monkeypatch):
    def fails(*_):
        raise AttributeError("no such thing")

    monkeypatch.setitem(RULES, "cbrt", fails)
    x = np.array([8.0, 27.0])
    with pytest.warns(RuntimeWarning, match=r"no native code: cbrt, .*no such thing.* at .*test_meaning.py:\d+"):
        values = hg.simulation.over_runs(lambda v: jnp.cbrt(v) + 1, x)
    np.testing.assert_allclose(values, [3.0, 4.0], rtol=1e-12)  # XLA's root has 14 digits


def results_of_many_runs():
    """One factor of its own, so that code is made anew."""
    return hg.simulation.over_runs(lambda v: 1.25 * jnp.sin(v), np.array([0.5, 1.5]))


def live_estimates():
    plant = hg.LinearPlant([[0.25]], 0.5, [1.0], 0.125)
    sensor = hg.Sensor(lambda x: jnp.sin(x) + x**3, 0.75)
    stream = hg.Stream(hg.extended_filter(plant, sensor, hg.perfect()))
    return np.stack([stream.push([z]).mean for z in (0.5, np.nan, 1.5)])


def simulated_estimates():
    plant = hg.LinearPlant([[0.25]], 0.5, [1.0], 0.125)
    sensor, link = hg.Sensor(lambda x: jnp.sin(x) + x**5, 0.75), hg.dropout(hg.perfect(), 0.5)
    node = hg.Node(sensor, link, {"f": hg.extended_filter(plant, sensor, link)})
    return hg.monte_carlo(hg.Network(plant, {"a": node}), 4, 3, 1).estimates["a"]["f"].mean


@pytest.mark.parametrize(
    "compute", [results_of_many_runs, live_estimates, pytest.param(simulated_estimates, marks=pytest.mark.slow)]
)
def test_xla_computes_where_llvm_makes_no_code_which_is_said_once(compute, monkeypatch):
    def fails(*_):
        raise RuntimeError(f"LLVM ERROR: out of registers in {compute.__name__}")

    with monkeypatch.context() as patch:
        patch.setattr("straightline.machine_code.MachineCode", fails)
        with pytest.warns(RuntimeWarning) as said:
            values = compute()
    assert ["LLVM ERROR" in str(x.message) and "no native code" in str(x.message) for x in said] == [True]
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    np.testing.assert_allclose(values, compute(), rtol=1e-12)


@pytest.mark.slow
def test_a_table_in_a_sensor_is_exported(tmp_path):
    """Interpolation searches the table by the bits of its numbers."""
    volts = np.linspace(0.0, 1.0, 20) ** 2
    plant = hg.LinearPlant([[1.0]], 1e-3, [0.5], 0.01)
    sensor = hg.Sensor(lambda x: jnp.interp(x[0], np.linspace(0.0, 1.0, 20), volts)[None], 0.01)
    made = hg.export_c(hg.extended_filter(plant, sensor, hg.perfect()), tmp_path / "step.c")
    assert "union" in made.source.read_text()


def test_a_gamma_mass_of_a_huge_shape_has_an_end():
    """By its expansion, to its order a^(-1/2): one half."""
    halves = hg.simulation.over_runs(lambda x: jax.scipy.special.gammainc(1e17 * x, 1e17 * x), np.array([1.0, 2.0]))
    np.testing.assert_allclose(halves, 0.5, atol=1e-8)
