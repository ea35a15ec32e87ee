"""A JAX array made outside double precision has lost digits before it reaches a model: that is said."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

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
    assert any("0.1 in it is 0.1000000015" in w for w in words)


@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("table", [EXACT, np.asarray([0.1, 0.25])])
def test_a_table_that_lost_nothing_is_not_mentioned(name, table):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        PLACES[name](table)
