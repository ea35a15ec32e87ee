"""One run on its own, and recordings whose truth is known: by argument, by column, on the command line."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.cli.run import run as command
from heliograph.report import examine, run_summary
from heliograph.report.diagnosis.sensor_output_health import compute_filter_errors, round_to
from heliograph.report.pages.run import make_errors_table

PLANT = hg.LinearPlant([[1.0, 0.2], [0.0, 0.9]], 0.1 * np.eye(2), [0.0, 0.0], np.eye(2), states=["place", "speed"])
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.3, outputs=["range"])
LINK = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.05)
NETWORK = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.erasure(LINK, 0.8), {"f": hg.linear_filter(PLANT, SENSOR, LINK)})})


def test_one_run_is_the_first_of_many():
    single, several = hg.simulate(NETWORK, 12, 3), hg.monte_carlo(NETWORK, 12, 5, 3)
    assert single == several.of_run(0) and single.runs is None
    assert single.truth.shape == (12, 2) and single.measurements["a"].shape == (12, 1)
    np.testing.assert_array_equal(single.estimates["a"]["f"].mean, several.estimates["a"]["f"].mean[0])
    assert several.of_run(4) != single
    with pytest.raises(ValueError, match="run: expected one of 5, got 5"):
        several.of_run(5)
    with pytest.raises(ValueError, match="run: expected one of a Monte Carlo simulation"):
        single.of_run(0)


def test_a_recording_is_judged_by_its_truth():
    single = hg.simulate(NETWORK, 12, 3)
    smooth = hg.smoothing.FixedInterval()
    record = hg.run(NETWORK, single.measurements, truth=single.truth, smooth=smooth)
    np.testing.assert_allclose(list(record.rmse("a", "f").values()), list(single.rmse("a", "f").values()), rtol=1e-9)
    estimate = record.estimates["a"]["f"]
    np.testing.assert_array_equal(record.nees("a", "f"), hg.nees(single.truth, estimate.mean, estimate.covariance))
    np.testing.assert_array_equal(record.smoothed.truth, single.truth)
    errors = single.truth - record.smoothed.estimates["a"]["f"].mean
    expected = np.sqrt((errors**2).mean(axis=0))
    np.testing.assert_allclose(list(record.smoothed.rmse("a", "f").values()), expected, rtol=1e-12)


def test_truth_may_be_known_in_part():
    single = hg.simulate(NETWORK, 12, 3)
    known = single.truth.copy()
    known[5:], known[:, 1] = np.nan, np.nan
    record = hg.run(NETWORK, single.measurements, truth=known)
    errors = single.truth[:5, 0] - record.estimates["a"]["f"].mean[:5, 0]
    assert record.rmse("a", "f")["place"] == pytest.approx(np.sqrt(np.mean(errors**2)))
    assert np.isnan(record.rmse("a", "f")["speed"])
    variance = record.estimates["a"]["f"].covariance[:5, 0, 0]
    np.testing.assert_allclose(record.nees("a", "f"), [*errors**2 / variance, *[np.nan] * 7], rtol=1e-12)


def test_angles_are_compared_within_half_a_turn():
    plant = hg.Plant(lambda x, u: x, 0.01, [3.1], 0.01, states=["heading"], circular=["heading"])
    sensor = hg.Sensor(lambda x: x, 0.01, outputs=["compass"], circular=["compass"])
    item = hg.cubature_filter(plant, sensor, hg.perfect())
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": item})})
    record = hg.run(network, {"a": [3.13, 3.13]}, truth=[[-3.13], [-3.13]])
    assert record.rmse("a", "f")["heading"] < 0.1


def test_a_column_holds_the_truth(tmp_path):
    single = hg.simulate(NETWORK, 12, 3)
    recording = hg.files.Recording(single.measurements, np.zeros((12, 0)), single.time, single.truth)
    hg.files.write_recording(recording, NETWORK, tmp_path / "data.csv")
    assert hg.files.read_recording(tmp_path / "data.csv", NETWORK) == recording
    record = hg.run(NETWORK, *recording)
    np.testing.assert_array_equal(record.truth, single.truth)
    table = hg.files.read_table(tmp_path / "data.csv")
    del table["truth.speed"]
    assert np.isnan(hg.files.read_recording(table, NETWORK).truth[:, 1]).all()
    with pytest.raises(ValueError, match=r"the unknown 'truth\.sped' \(closest: 'truth\.speed'"):
        hg.files.read_recording(table | {"truth.sped": table["time"]}, NETWORK)


def test_a_truth_that_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="truth: expected"):
        hg.run(NETWORK, {"a": np.zeros(4)}, truth=np.zeros((3, 2)))


def test_the_report_shows_the_errors():
    single = hg.simulate(NETWORK, 40, 3)
    record = hg.run(NETWORK, single.measurements, truth=single.truth)
    health = examine(NETWORK, record, np.zeros((40, 0)))
    (table,) = make_errors_table(record)
    assert table.headers == ["filter", "claim", "RMSE of place", "RMSE of speed", "NEES"]
    rmse = record.rmse("a", "f")
    size = record.nees("a", "f").mean() / 2
    assert table.rows[0][:2] == ["a/f", "exact"]
    # The standard error of a mean square over twice the root, by numbers that are far enough apart to be independent.
    (of,) = compute_filter_errors(record)
    assert of.rmse == rmse
    for shown, (state, error) in zip(table.rows[0][2:4], of.rmse_error.items(), strict=True):
        assert (
            shown == round_to(rmse[state], error) and 0.05 < error / rmse[state] < 0.3
        )  # 1/sqrt(2 n), n = 40 or fewer
    assert table.rows[0][4] == round_to(size, of.nees_error) and 0.05 < of.nees_error / size < 0.5
    errors = run_summary(health)["errors"]["a"]["f"]
    assert errors == {"rmse": rmse, "nees": pytest.approx(size)}
    assert make_errors_table(hg.run(NETWORK, single.measurements)) == []


def test_the_command_says_how_far_off(tmp_path, capsys):
    single = hg.simulate(NETWORK, 40, 3)
    recording = hg.files.Recording(single.measurements, np.zeros((40, 0)), single.time, single.truth)
    hg.files.write_recording(recording, NETWORK, tmp_path / "data.csv")
    (tmp_path / "net.py").write_text("from tests.simulation.test_truth import NETWORK as network\n")
    command(f"{tmp_path}/net.py", measurements=tmp_path / "data.csv", out=tmp_path / "out.csv")
    record = hg.run(NETWORK, *recording)
    rmse = record.rmse("a", "f")
    (of,) = compute_filter_errors(record)
    place, speed = (round_to(value, of.rmse_error[state]) for state, value in rmse.items())
    line = f"a/f: RMSE of place {place}, of speed {speed}; NEES per state "
    assert line in capsys.readouterr().out
