"""Plants and sensors that look numbers up in tables, in native code and as C."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
import straightline
from tests.export.device import Device, needs_compiler
from tests.follow import apart, follow_known

CHARGE = np.linspace(0.0, 1.0, 12)
VOLTAGE = 3.0 + 1.2 * CHARGE + 0.1 * np.sin(9 * CHARGE)  # an open-circuit voltage, which rises
LONG = np.linspace(0.0, 1.0, 301)
RISING = np.interp(LONG, CHARGE, VOLTAGE)
MAP = VOLTAGE[:, None] + np.linspace(-0.1, 0.1, 9)  # of charge and temperature


def interpolated(x):
    return jnp.interp(x[0], CHARGE, VOLTAGE)


def interpolated_in_a_long_table(x):
    return jnp.interp(x[0], LONG, RISING)


def searched(x):
    """Piecewise linear between knots that are found by bisection."""
    knots, values = (np.asarray(table) for table in (CHARGE, VOLTAGE))
    k = jnp.clip(jnp.searchsorted(jnp.asarray(knots), x[0]) - 1, 0, len(knots) - 2)
    low, high = jnp.asarray(knots)[k], jnp.asarray(knots)[k + 1]
    share = (x[0] - low) / (high - low)
    return jnp.asarray(values)[k] * (1 - share) + jnp.asarray(values)[k + 1] * share


def of_two_numbers(x):
    """Linear in both directions of a map."""
    row, column = jnp.clip(x[0] * 11, 0.0, 10.9), jnp.clip(4 + 40 * x[1], 0.0, 7.9)
    i, j = jnp.floor(row).astype(int), jnp.floor(column).astype(int)
    a, b, table = row - i, column - j, jnp.asarray(MAP)
    low = table[i, j] * (1 - b) + table[i, j + 1] * b
    return low * (1 - a) + (table[i + 1, j] * (1 - b) + table[i + 1, j + 1] * b) * a


LOOKUPS = [interpolated, interpolated_in_a_long_table, searched, of_two_numbers]
CELL = hg.Plant(
    lambda x, u: jnp.array([x[0] - 1e-3 * u[0], 0.95 * x[1] + 0.01 * u[0]]),
    1e-6 * np.eye(2), [0.8, 0.0], np.diag([0.01, 1e-4]), states=["charge", "overvoltage"], inputs=["current"],
)  # fmt: skip


def recorded():
    """An hour's start of a cell that is discharged: voltages, one in seven missing, and currents."""
    rng, steps = np.random.default_rng(0), 200
    u = 1 + 0.5 * np.sin(np.arange(steps) / 9)[:, None]
    z = np.interp(0.8 - 1e-3 * np.cumsum(u), CHARGE, VOLTAGE) - 0.19 + 0.01 * rng.normal(size=steps)
    z[::7] = np.nan
    return z[:, None], u


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("look_up", LOOKUPS)
@pytest.mark.parametrize("make", [hg.extended_filter, hg.cubature_filter])
def test_a_looked_up_number_is_that_of_python(look_up, make, tmp_path):
    """In deviations; single precision to 1e-3 of one: a slope of the long table, from two voltages 4 mV apart.

    That is known to 2.4e-7 / 4e-3, and the first innovations are of ten deviations.
    """
    filter_ = make(CELL, hg.Sensor(lambda x: (look_up(x) - x[1])[None], 1e-4, outputs=["voltage"]))
    (z, u), reference = recorded(), follow_known(filter_, *recorded())
    assert max(apart(Device(filter_, tmp_path).follow(z, u), reference)) < 1e-12
    single = Device(filter_, tmp_path, "single", "float").follow(z, u)
    assert np.max(np.abs(single[0] - reference.mean) / np.sqrt(np.diagonal(reference.covariance, 0, 1, 2))) < 1e-3


@pytest.mark.parametrize("look_up", LOOKUPS)
def test_a_looked_up_number_has_native_code(look_up):
    x = np.array([[0.37, 0.02], [0.0, -0.1], [1.0, 0.3]])
    native = straightline.compile(look_up, x[0])(x)
    with jax.enable_x64(True):
        np.testing.assert_allclose(native, [look_up(jnp.asarray(row)) for row in x], rtol=1e-14)
