"""A JAX array made outside double precision has lost digits before it reaches a model: that is said."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import find_rounded_to_single
from heliograph.simulation.description.doubts import doubts_before_data

TABLE = jnp.asarray([0.1, 0.25])  # as in a user's file: 0.1 is 0.1000000015
EXACT = jnp.asarray([0.5, 3.0])
SENSOR = ("measure(x) of a sensor", lambda table: hg.Network(
    PLANT, {"a": hg.Node(hg.Sensor(lambda x: x[:1] * table[0], 0.1), hg.perfect(), {})}
))  # fmt: skip
PLANT = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
PLACES = {
    "transition(x, u)": lambda table: hg.Plant(lambda x, u: table * x, np.eye(2), [0.0, 0.0], np.eye(2)),
    "process noise covariance(u)": lambda table: hg.LinearPlant(
        np.eye(2), lambda u: jnp.diag(table) * u[0], [0.0, 0.0], np.eye(2), inputs=["s"]
    ),
    "plant matrix": lambda table: hg.LinearPlant(table * np.eye(2), np.eye(2), [0.0, 0.0], np.eye(2)),
    "initial mean": lambda table: hg.LinearPlant(np.eye(2), np.eye(2), table, np.eye(2)),
    SENSOR[0]: SENSOR[1],
}


@pytest.mark.parametrize("name", PLACES)
def test_a_table_of_single_precision_is_said(name):
    with pytest.warns(UserWarning) as said:
        PLACES[name](TABLE)
    words = {str(line.message) for line in said}
    assert any(w.startswith(f"{name}: expected double precision") and "np.asarray" in w for w in words), words
    assert any("0.1 is 0.1000000015" in w for w in words)


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("table", [EXACT, np.asarray([0.1, 0.25])])
def test_a_table_that_lost_nothing_is_not_mentioned(name, table):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PLACES[name](table)


def network(table, gain):
    """A plant whose function holds a table, one sensor of two nodes, and a link with a gain."""
    plant = hg.Plant(lambda x, u: table * x, np.eye(2), [0.0, 0.0], np.eye(2), states=["p", "q"])
    sensor, link = hg.LinearSensor([[1.0, 0.0]], 0.1), hg.hop(gain, 0.01)
    return hg.Network(plant, {name: hg.Node(sensor, link, {}) for name in ("a", "b")})


def test_it_is_said_once():
    table = jnp.asarray([0.3, 0.25])
    with pytest.warns(UserWarning, match="0.3 is 0.3000000119"):
        network(table, 1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        network(table, 1.0)


def test_a_network_shows_which_numbers_were_rounded():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        made = network(TABLE, jnp.asarray(0.7))
    first, second = (line for line in str(made).splitlines() if line.startswith("digits"))
    assert first.endswith("rounded to single precision before they came in: 0.1 is 0.1000000015 (plant)")
    assert second.endswith("0.7 is 0.6999999881 (channel of a, channel of b)")
    words = [doubt.words for doubt in doubts_before_data(made)]
    assert sum("0.1 is 0.1000000015 (plant); make tables with np.asarray" in line for line in words) == 1
    assert "digits" not in str(network(np.asarray(TABLE, float).round(6), 0.7))


@pytest.mark.parametrize(
    ("number", "rounded"),
    [
        (np.float32(0.1), (0.1, float(np.float32(0.1)))), (float(np.float32(0.1)), (0.1, float(np.float32(0.1)))),
        (0.1, None), (2.0**-30, None), (1.5, None), (1 / 3, None), (123456.0, None), (np.inf, None), (7, None),
        ([np.nan, 1e300, 5e-324], None),
    ],
)  # fmt: skip
def test_a_rounded_number_is_known_by_its_value(number, rounded):
    """A power of two is meant as it is, though its shortest decimal in single precision is another number."""
    assert find_rounded_to_single(number) == rounded
