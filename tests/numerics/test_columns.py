"""Names of a table's columns say what they hold: one twice, or those of a model in another order, is refused."""

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

import heliograph as hg

PLANT = hg.LinearPlant(
    lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]), lambda u: u[1] * jnp.eye(2), [0.0, 0.0], np.eye(2),
    states=["place", "speed"], inputs=["dt", "noise"],
)  # fmt: skip
SENSOR = hg.LinearSensor(np.eye(2), 0.1 * np.eye(2), outputs=["far", "fast"])
KALMAN = hg.kalman_filter(PLANT, SENSOR)
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(2), {"k": KALMAN})})
Z, U = np.arange(6.0).reshape(3, 2), np.array([[1.0, 0.1], [1.0, 0.2], [1.0, 0.3]])


def learned():
    free = hg.LinearSensor(np.eye(2), hg.free(1.0, "r") * np.eye(2), outputs=["far", "fast"])
    return hg.Network(PLANT, {"a": hg.Node(free, hg.perfect(2), {})})


DOORS = {  # what takes a table, and the names of its columns
    "measurements of run": (lambda t: hg.run(NETWORK, {"a": t}, U), Z, ["far", "fast"]),
    "inputs of run": (lambda t: hg.run(NETWORK, {"a": Z}, t), U, ["dt", "noise"]),
    "truth of run": (lambda t: hg.run(NETWORK, {"a": Z}, U, truth=t), Z, ["place", "speed"]),
    "inputs of a filter": (lambda t: KALMAN.run(Z, t), U, ["dt", "noise"]),
    "inputs of a smoother": (lambda t: hg.rts_smoother(KALMAN, Z, t), U, ["dt", "noise"]),
    "measurements of a fit": (lambda t: hg.fit(learned, {"a": t}, U), Z, ["far", "fast"]),
    "inputs of a simulation": (lambda t: hg.simulate(NETWORK, 3, 0, inputs=t), U, ["dt", "noise"]),
}


@pytest.mark.parametrize("door", DOORS)
def test_columns_in_another_order_are_refused(door):
    call, values, (first, second) = DOORS[door]
    said = f"expected columns in the order {first}, {second}, got {second}, {first}$"
    with pytest.raises(hg.InputError, match=said):
        call(pd.DataFrame(values, columns=[second, first]))


@pytest.mark.parametrize("door", [*DOORS, "measurements of a filter"])
def test_a_column_that_is_there_twice_is_refused(door):
    call, values, _ = DOORS.get(door, (KALMAN.run, Z, ()))
    with pytest.raises(hg.InputError, match=r"expected distinct columns, got 'y' more than once$"):
        call(pd.DataFrame(values, columns=["y", "y"]))


def test_other_names_and_numbers_stand_for_their_places():
    expected = hg.run(NETWORK, {"a": Z}, U)
    for names in (["far", "fast"], ["left", "right"], [0, 0], [1, 0]):
        record = hg.run(NETWORK, {"a": pd.DataFrame(Z, columns=names)}, U)
        np.testing.assert_array_equal(record.estimates["a"]["k"].mean, expected.estimates["a"]["k"].mean)
