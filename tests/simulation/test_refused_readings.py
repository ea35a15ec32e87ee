"""Readings beyond a node's limits are refused in simulations as they are in recordings."""

import numpy as np
import pytest

import heliograph as hg

START = 0.1 / (1 - 0.95**2)  # stationary variance of x+ = .95 x + w
PLANT, SENSOR = hg.LinearPlant([[0.95]], 0.1, [0.0], START), hg.LinearSensor([[1.0]], 0.05)


def make_network(bound, link=None, **rule):
    """Return a node with limits at +-bound, and one without, so that they differ in numbers alone."""
    link = hg.perfect() if link is None else link
    filters = {"f": hg.kalman_filter(PLANT, SENSOR) if not rule else hg.event_filter(PLANT, SENSOR, link, **rule)}
    limited, free = (hg.Node(SENSOR, link, filters, limits=limits, **rule) for limits in ((-bound, bound), None))
    return hg.Network(PLANT, {"limited": limited, "free": free})


@pytest.mark.parametrize(("c", "ratio"), [(1.0, 2.762), (2.0, 1.840)])
def test_errors_are_those_that_recorded_data_have(c, ratio):
    """Ratios of 200,000 runs of another program (`tests/model/readings`); of 4,000 here 4 standard errors are 9 %."""
    network = make_network(c * np.sqrt(START + 0.05))
    record = hg.monte_carlo(network, horizon=60, runs=4000, key=0)

    def compare(node):
        errors = record.errors(node, "f")[:, -1, 0] ** 2
        return errors.mean() / record.estimates[node]["f"].covariance[:, -1].mean()

    assert compare("limited") == pytest.approx(ratio, rel=0.09) and compare("free") == pytest.approx(1, rel=0.09)
    z = record.measurements["limited"]
    assert np.nanmax(np.abs(z)) < c * np.sqrt(START + 0.05) and np.isnan(z).any()
    assert not np.isnan(record.measurements["free"]).any()


@pytest.mark.parametrize(
    "rule", [{}, {"trigger": hg.SendOnDelta(0.3, losses="known")}], ids=["always sends", "decides"]
)
def test_a_simulation_and_a_run_of_its_measurements_agree(rule):
    network = make_network(0.8, hg.erasure(hg.perfect(), 0.9) if rule else None, **rule)
    record = hg.simulate(network, 100, 3)
    again = hg.run(network, record.measurements)
    for node in network.names:
        np.testing.assert_allclose(  # programs of their own: rounding only
            record.estimates[node]["f"].covariance, again.estimates[node]["f"].covariance, rtol=1e-9
        )
    if rule:  # a value that was sent and refused is told as one
        assert 2.0 in record.measurements["limited"][:, 1] and 2.0 not in record.measurements["free"][:, 1]


def test_xla_refuses_the_same(monkeypatch):
    network = make_network(0.8)
    native = hg.simulate(network, 50, 1)
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    by_xla = hg.simulate(network, 50, 1)
    z = native.measurements["limited"]
    assert np.isnan(z).any()
    np.testing.assert_allclose(z, by_xla.measurements["limited"], rtol=1e-13)  # rounding only, NaN at the same steps
    np.testing.assert_allclose(native.estimates["limited"]["f"].mean, by_xla.estimates["limited"]["f"].mean, rtol=1e-9)
