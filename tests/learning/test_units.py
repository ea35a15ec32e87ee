"""What is learned does not depend on the unit of the data, wherever the search starts."""

import numpy as np
import pytest

import heliograph as hg

STEPS = 120


def fit_level(unit):
    """Fit the variances of a level and its noise, both begun at 1, to data in this unit."""
    random = np.random.default_rng(0)
    data = np.cumsum(random.standard_normal(STEPS)) + 2 * random.standard_normal(STEPS)

    def network():
        plant = hg.LinearPlant([[1.0]], hg.free(1.0, "level"), [0.0], [[100 * unit**2]])
        sensor = hg.LinearSensor([[1.0]], hg.free(1.0, "noise"))
        return hg.Network(plant, {"gauge": hg.Node(sensor, hg.perfect(), {})})

    return hg.fit(network, unit * data[:, None], starts=2)


@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_what_data_identify_is_judged_where_the_maximum_is(unit):
    """From a start 12 decades away rounding hid one of two directions: "fix one", no intervals, and an AIC of k = 1."""
    here, scaled = fit_level(1.0), fit_level(unit)
    assert scaled.converged and scaled.identified.ridges == 0 and not scaled.sentences
    assert scaled.free_numbers == 2
    for one, other in zip(here.table, scaled.table, strict=True):
        expected = np.array([one.estimate, one.low, one.high]) * unit**2
        # The search ends where a step gains 1e-4 nats or less: a hundredth of a standard error.
        assert np.array([other.estimate, other.low, other.high]) == pytest.approx(expected, rel=0.01)
