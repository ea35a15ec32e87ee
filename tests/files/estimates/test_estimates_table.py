"""Estimates as tables: their columns and names, in both formats, and angles beside a truth."""

import numpy as np
import pyarrow.parquet as pq
import pytest

import heliograph as h
from heliograph.files import read_table, write_estimates
from tests.files.recordings.test_recording import NAN, network, record_of


@pytest.fixture
def estimate_columns(tmp_path):
    """What `write_estimates` writes, by column."""

    def written(record):
        write_estimates(record, tmp_path / "estimates.csv")
        return read_table(tmp_path / "estimates.csv")

    return written


def test_columns_of_estimates(estimate_columns):
    result = estimate_columns(record_of("aware"))
    assert list(result) == ["time", "p", "p.sd", "v", "v.sd", "cov.p.v", "valid"]
    np.testing.assert_array_equal(result["v"], [2, 4, 6])
    np.testing.assert_array_equal(result["p.sd"], [2, 1, NAN])
    np.testing.assert_array_equal(result["v.sd"], [3, 1, 1])
    np.testing.assert_array_equal(result["cov.p.v"], [1, 2, 0])
    np.testing.assert_array_equal(result["valid"], [True, False, False])


def test_no_columns_for_a_covariance_that_is_not_claimed(estimate_columns):
    record = record_of("silent")
    means = record.estimates["a"]["silent"].mean
    record.estimates["a"]["silent"] = h.model.Estimate(means, np.full((3, 2, 2), np.nan), "none")
    result = estimate_columns(record)
    assert list(result) == ["time", "p", "v", "valid"]
    np.testing.assert_array_equal(result["valid"], np.isfinite(means).all(axis=1))


def test_prefixes_of_nodes_and_filters(estimate_columns):
    assert list(estimate_columns(record_of("aware", "other")))[1] == "aware.p"
    assert list(estimate_columns(record_of("aware", nodes=("a", "b"))))[1] == "a.p"
    named = list(estimate_columns(record_of("aware", "other", nodes=("a", "b"))))
    assert named[1:3] == ["a.aware.p", "a.aware.p.sd"] and named[-1] == "b.other.valid"


def test_estimates_that_cannot_be_a_table(estimate_columns):
    with pytest.raises(ValueError, match=r"^columns of the estimates: expected distinct names, got 'time' more"):
        estimate_columns(record_of("aware", states=("time", "v")))
    net = network({"a": ("pos",)})
    several = h.monte_carlo(net, 2, 3, 0, inputs=np.ones((2, 1)))
    with pytest.raises(ValueError, match=r"^record: expected the run over one recording, got .*\(3, 2, 2\)"):
        estimate_columns(several)


def test_estimates_in_both_formats(tmp_path):
    record = record_of("aware")
    write_estimates(record, tmp_path / "e.parquet")
    write_estimates(record, tmp_path / "e.csv")
    table = pq.read_table(tmp_path / "e.parquet")
    assert table.column("valid").to_pylist() == [True, False, False]
    assert (tmp_path / "e.csv").read_text().splitlines() == [
        "time,p,p.sd,v,v.sd,cov.p.v,valid",
        "0.0,1.0,2.0,2.0,3.0,1.0,1",
        "0.5,3.0,1.0,4.0,1.0,2.0,0",
        "0.7,5.0,nan,6.0,1.0,0.0,0",
    ]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["e.csv", "e.parquet"]


@pytest.mark.parametrize("smooth", [None, h.smoothing.FixedInterval()])
def test_angles_in_tables_are_those_without_the_truth(estimate_columns, smooth):
    """A record has its angles beside a known truth, so that they may be subtracted; a table has no truth in it."""
    plant = h.LinearPlant([[1.0]], [[0.01]], [3.1], 0.1, states=["heading"], circular=["heading"])
    sensor = h.LinearSensor([[1.0]], 0.1, outputs=["compass"], circular=["compass"])
    node = h.Node(sensor, h.perfect(), {"f": h.kalman_filter(plant, sensor)})
    z = {"a": [[3.1], [-3.1], [-2.9], [3.0], [-3.0]]}
    truth = np.full((5, 1), 3.13)
    net = h.Network(plant, {"a": node})
    record, without = (h.run(net, z, truth=x, smooth=smooth) for x in (truth, None))
    assert np.asarray(record.estimates["a"]["f"].mean).max() > np.pi
    columns, expected = estimate_columns(record), estimate_columns(without)
    assert columns.keys() == expected.keys()
    for name, values in columns.items():
        np.testing.assert_allclose(values, expected[name], rtol=1e-14)  # full turns came and went: rounding
