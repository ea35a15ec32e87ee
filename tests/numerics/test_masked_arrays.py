"""What is masked, None or NA did not arrive: at every door the numbers are those of NaN, bit for bit."""

import warnings

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

import heliograph as hg

PLANT = hg.LinearPlant([[1.0]], 1469.0, [1000.0], [[1e6]], states=["level"])
SENSOR = hg.LinearSensor([[1.0]], 15099.0, outputs=["flow"])
KALMAN = hg.kalman_filter(PLANT, SENSOR)
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"k": KALMAN})})
FLOWS = 900 + 120 * np.random.default_rng(0).normal(size=30)
ABSENT = np.arange(30) % 5 == 3
MASKED, MISSING = np.ma.array(FLOWS, mask=ABSENT), np.where(ABSENT, np.nan, FLOWS)


def final(timeline, values):
    for k, value in enumerate(values):
        timeline.push("a", k, k, value)
    return timeline.estimates()["a"]["k"].mean


DOORS = {  # of measurements (steps, 1): an array that shows that they were used
    "filter": lambda z: KALMAN.run(z).means,
    "likelihood": lambda z: hg.log_likelihood(KALMAN, z),
    "run": lambda z: hg.run(NETWORK, {"a": z}).estimates["a"]["k"].mean,
    "truth": lambda z: hg.run(NETWORK, {"a": z}, truth=z).truth,
    "stream": lambda z: pushed(z),
    "stream of lists": lambda z: pushed([[row[0]] for row in z]),
    "timeline": lambda z: final(hg.Timeline(NETWORK, 5), z),
    "smoother": lambda z: hg.rts_smoother(KALMAN, z).means,
    "steps": lambda z: hg.smoothing.smoother_steps(KALMAN, z)[1].mean,
    "steps of one axis": lambda z: hg.smoothing.smoother_steps(KALMAN, z[:, 0])[1].mean,
    "whitened": lambda z: hg.simulation.whitened_innovations(z, KALMAN),
    "step": lambda z: KALMAN.step(KALMAN.init(), z[3])[1].mean,
    "recording": lambda z: hg.files.read_recording({"time": np.arange(30.0), "flow": z[:, 0]}, NETWORK)[0]["a"],
    "fates": lambda z: hg.learning.learn_losses(np.sign(z[:, 0]) - 1).packets,
    "fused": lambda z: fused(hg.model.Estimate(z, np.ones((30, 1, 1)), "exact")).mean,
    "fused variances": lambda z: fused(hg.model.Estimate(np.ones((30, 1)), z[..., None], "exact")).mean,
    "over runs": lambda z: hg.simulation.over_runs(twice, z),
    "quantizer": lambda z: hg.fusion.UniformQuantizer(101, 3e3).step((), z[:, 0])[1].value,
    "another": lambda z: hg.fusion.EscapeQuantizer(101, 1e3, 0.5, 0.5, 1.0).step(*begun(z[:, 0]))[1].value,
    "nees": lambda z: hg.nees(z, np.ones((30, 1)), np.ones((30, 1, 1))),
}


def fused(estimate):
    return hg.fusion.fuse(hg.CovarianceIntersection(), [estimate] * 2)


def twice(x):
    return 2 * x


def begun(z):
    return hg.fusion.EscapeQuantizer(101, 1e3, 0.5, 0.5, 1.0).init(len(z)), z


def pushed(z):
    stream = hg.Stream(KALMAN)
    return [stream.push(row).mean for row in z]


@pytest.mark.parametrize("door", DOORS)
def test_masked_is_missing_at_every_door(door):
    both = [np.asarray(DOORS[door](z)) for z in (MASKED[:, None], MISSING[:, None])]
    np.testing.assert_array_equal(*both)


def test_a_fit_leaves_out_what_is_masked():
    def build():
        plant = hg.LinearPlant([[1.0]], hg.free(1000.0, "level"), [1000.0], [[1e6]])
        return hg.Network(plant, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(plant, SENSOR)})})

    both = [hg.fit(build, {"a": z[:, None]}, starts=1).values["level"] for z in (MASKED, MISSING)]
    assert both[0] == both[1]


WHOLE = np.round(FLOWS)
COLUMNS = {
    "masked whole numbers": np.ma.array(WHOLE, dtype=int, mask=ABSENT),
    "None": [None if absent else value for absent, value in zip(ABSENT, WHOLE.tolist(), strict=True)],
    "masked objects": np.ma.array(WHOLE.astype(object), mask=ABSENT),
    "NA": pd.Series(WHOLE, dtype="Float64").mask(ABSENT),
    "NA of whole numbers": pd.Series(WHOLE.astype(int), dtype="Int64").mask(ABSENT),
    "NA of objects": pd.Series(WHOLE, dtype=object).mask(ABSENT, pd.NA),
    "null": pa.chunked_array([pa.array(WHOLE, mask=ABSENT)]),
    "null of whole numbers": pa.chunked_array([pa.array(WHOLE.astype(int), mask=ABSENT)]),
}


@pytest.mark.parametrize("kind", COLUMNS)
def test_a_column_of_any_table_is_the_same_recording(kind):
    expected = np.where(ABSENT, np.nan, WHOLE)
    column = COLUMNS[kind]
    read = hg.files.read_recording({"time": np.arange(30.0), "flow": column}, NETWORK)[0]["a"]
    np.testing.assert_array_equal(read[:, 0], expected)
    np.testing.assert_array_equal(KALMAN.run(column).means, KALMAN.run(expected).means)
    np.testing.assert_array_equal(hg.run(NETWORK, {"a": column}).measurements["a"][:, 0], expected)


def test_what_must_be_there_is_refused_where_it_is_masked():
    driven = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, [[1.0]], inputs=["push"])
    network = hg.Network(driven, {"a": hg.Node(SENSOR, hg.perfect(), {"k": hg.kalman_filter(driven, SENSOR)})})
    push = np.ma.array(np.ones((3, 1)), mask=[[False], [True], [False]])
    calls = [
        lambda: hg.simulate(network, 3, 0, inputs=push),
        lambda: hg.run(network, {"a": np.zeros(3)}, push),
        lambda: hg.Stream(network.nodes["a"].filters["k"]).push([0.0], push[1]),
        lambda: hg.LinearPlant(push[:1] / 1.0, push[1:2], [0.0], 1.0),
        lambda: hg.run(NETWORK, {"a": np.zeros(3)}, time=np.ma.array([0.0, 1.0, 2.0], mask=[False, True, False])),
    ]
    for call in calls:
        with pytest.raises(ValueError, match="finite numbers"):
            call()
    dates = np.ma.array(np.arange(3).astype("datetime64[D]"), mask=[False, True, False])
    with pytest.raises(ValueError, match="1 of them missing"):
        hg.run(NETWORK, {"a": np.zeros(3)}, time=dates)


@pytest.mark.parametrize("absent", [None, pd.NA, np.ma.masked, np.nan])
def test_one_number_that_is_absent_did_not_arrive(absent):
    two = hg.kalman_filter(PLANT, hg.LinearSensor([[1.0], [1.0]], 15099.0 * np.eye(2)))
    for item, value, expected in [(KALMAN, [absent], [np.nan]), (two, [absent, 900.0], [np.nan, 900.0])]:
        columns = [value, tuple(value)] + [pd.Series(value, dtype=object)] * (absent is not np.ma.masked)
        for column in columns:
            assert hg.Stream(item).push(column).mean == hg.Stream(item).push(expected).mean


def test_masks_within_a_list_are_kept():
    parts = [np.ma.array([1.0, 2.0], mask=[False, True]), np.ma.array([3.0, 4.0], mask=[True, False])]
    two = hg.kalman_filter(PLANT, hg.LinearSensor([[1.0], [1.0]], 15099.0 * np.eye(2)))
    np.testing.assert_array_equal(two.run(parts).means, two.run([[1.0, np.nan], [np.nan, 4.0]]).means)


@pytest.mark.parametrize("zone", [None, "UTC"])
def test_rows_that_are_known_by_unequal_dates_are_said(zone):
    """As the same dates in time= are: a plant without dt takes each row for one step."""
    dates = pd.DatetimeIndex(["2020-01-01", "2020-01-02", "2020-01-03", "2020-01-07"], tz=zone)
    for rows in (pd.Series(np.ones(4), index=dates), pd.DataFrame({"flow": np.ones(4)}, index=dates)):
        with pytest.warns(UserWarning, match=r"^time: steps of 1 and 4 days: a plant without the input dt"):
            hg.run(NETWORK, {"a": rows})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hg.run(NETWORK, {"a": pd.Series(np.ones(4), index=pd.date_range("2020", periods=4, tz=zone))})
