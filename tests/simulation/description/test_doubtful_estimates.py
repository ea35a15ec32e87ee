"""Estimates that end where no sensor shows them, or lie at a limit, are doubted; others are not."""

import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.report import examine

CHARGE, VOLTS = np.array([0.0, 0.3, 0.5, 0.7, 1.0]), np.array([3.0, 3.6, 3.65, 3.8, 4.2])
CURRENT = np.full((60, 1), 1.5)
METER = hg.Sensor(lambda x: jnp.interp(x[0], CHARGE, VOLTS)[None], 0.005**2, ["voltage"])


def battery(limits=()):
    return hg.Plant(
        lambda x, u: x - u / 9000.0, 1e-12, [0.5], 0.2**2, states=["soc"], inputs=["current"], limits=limits
    )


def filtered(plant, voltage, make=hg.extended_filter):
    network = hg.Network(plant, {"m": hg.Node(METER, hg.perfect(), {"f": make(plant, METER)})})
    return network, hg.run(network, {"m": voltage[:, None]}, inputs=CURRENT)


def voltages(start):
    soc = start - np.cumsum(CURRENT[:, 0]) / 9000.0
    return np.interp(soc, CHARGE, VOLTS) + 0.005 * np.random.default_rng(1).normal(size=len(soc))


def test_an_estimate_beyond_the_end_of_a_table_is_doubted_in_a_run_and_its_report():
    """The tangent of the table at one half, 0.25 V, takes 0.4 V for a charge of 1.5 more: full is 1."""
    said = r"m/f: 'soc' ends at 2\.\d+, where no sensor shows it, as beyond the end of a table"
    with pytest.warns(UserWarning, match=said):
        network, record = filtered(battery(), voltages(0.95))
    (line,) = [line for line in examine(network, record, CURRENT).warnings() if "no sensor shows it" in line]
    assert line.endswith("If it cannot be there, limits= of the plant say so")


def test_one_that_sensors_show_is_not():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filtered(battery(), voltages(0.6))
        filtered(battery({"soc": (0, 1)}), voltages(0.95))


@pytest.mark.parametrize("make", [hg.cubature_filter, hg.unscented_filter])
def test_a_filter_that_averages_over_points_is_judged_by_these(make):
    """At .05 both jump below -.2, where all their points are beyond the end; at .6 they come near."""
    with pytest.warns(UserWarning, match="m/f: 'soc' ends at -.*, where no sensor shows it"):
        _, record = filtered(battery(), voltages(0.05), make)
    assert record.estimates["m"]["f"].mean[-1, 0] < -0.2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        filtered(battery(), voltages(0.6), make)
        filtered(battery({"soc": (0, 1)}), voltages(0.05), make)


def test_an_estimate_held_at_its_limit_is_noted():
    """A meter that reads 0.3 V too much puts a full battery beyond its limit in every row."""
    with pytest.warns(UserWarning, match="m/f: 'soc' is held at its limit 1 in 60 of 60 rows"):
        network, record = filtered(battery({"soc": (0, 1)}), voltages(0.99) + 0.3)
    assert any("held at its limit 1" in line for line in examine(network, record, CURRENT).warnings())


@pytest.mark.parametrize(("inside", "noted"), [(0.0, True), (0.05, False)])
def test_the_ratio_of_a_gaussian_held_at_its_limit_tells_it(inside, noted):
    """Nothing arrives: the mean starts so many deviations above its limit, and stays there."""
    plant = hg.LinearPlant([[1.0]], 1e-12, [0.1 * inside], 0.01, states=["level"], limits={"level": (0, None)})
    sensor = hg.LinearSensor([[1.0]], 1.0)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})})
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        hg.run(network, {"a": np.full((5, 1), np.nan)})
    assert any("held at its limit 0 in 5 of 5 rows" in str(line.message) for line in said) is noted
