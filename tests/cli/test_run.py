"""What `heliograph run` writes, and what it refuses."""

import os

import numpy as np
import pandas as pd
import pytest

import heliograph as h
from heliograph import cli
from heliograph.files.network_file import load_network
from heliograph.files.recordings.recording import read_recording
from heliograph.files.tables.table import read_table
from tests.cli.example import LOSING, NETWORK, contents, refused, run_arguments


def test_run_writes_what_the_library_computes(folder, capsys):
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr()
    assert said.out == "out.csv: 4 rows of remote/aware (nominal), remote/trusting (nominal)\n"
    assert said.err == ""
    assert sorted(contents(folder)) == ["data.csv", "net.py", "out.csv"]
    net = load_network("net.py")
    recording, table = read_recording("data.csv", net), read_table("out.csv")
    np.testing.assert_array_equal(table["time"], [0, 0.5, 0.5, 2])
    for name in ("aware", "trusting"):
        stream = h.Stream(net.nodes["remote"].filters[name])
        for k in range(4):
            estimate = stream.push(recording.measurements["remote"][k], recording.inputs[k])
            row = {key: table[f"{name}.{key}"][k] for key in ("p", "v", "p.sd", "v.sd", "cov.p.v", "valid")}
            results = [row["p"], row["v"], row["p.sd"] ** 2, row["v.sd"] ** 2, row["cov.p.v"]]
            bound = estimate.covariance
            expected = [*estimate.mean, bound[0, 0], bound[1, 1], bound[0, 1]]
            # compiled apart, and the variance went through a root and back: rounding only
            np.testing.assert_allclose(results, expected, rtol=1e-12, atol=1e-12)
            assert row["valid"] == 1


def test_a_lag_is_refused_of_rows_before_they_are_read(folder, capsys):
    (folder / "data.csv").write_text("time,push,pos\n0,0,no number\n")
    refused(folder, capsys, [*run_arguments(), "--lag", "1"], "--lag", "expected messages or events, got rows of time")


@pytest.mark.parametrize("name", ["data.csv", "data.parquet"])
def test_a_row_without_a_stamp_does_not_cost_the_digits_of_others(folder, capsys, name):
    """The row is refused alone; all stamps were doubles with it, which are 256 apart here."""
    stamps = [1_700_000_000_000_000_000 + step for step in (0, 1, 2, 4)]
    time = pd.array([*stamps[:3], None, stamps[3]], dtype="Int64")
    table = pd.DataFrame({"time": time, "push": 0.0, "pos": [1.0, 1.1, 1.2, 1.3, 1.4]})
    table.to_csv(folder / name, index=False) if name.endswith("csv") else table.to_parquet(folder / name)
    assert cli.main(["run", "net.py", "--measurements", name, "--out", "out.parquet"]) == 0
    assert "row 4, column 'time': expected a finite number, got an empty cell" in capsys.readouterr().err
    assert read_table("out.parquet")["time"].tolist() == stamps
    assert np.isnan(read_table(name)["time"][3])  # for whoever reads the table, which is of float64 then


@pytest.mark.parametrize("word", ["inf", "-Infinity", "1e400"])
def test_an_infinite_stamp_does_not_cost_the_digits_of_others(folder, capsys, word):
    """It was read as a double, and all others of its part of the table with it."""
    stamps = [1_700_000_000_000_000_000 + step for step in (0, 1, 2, 4)]
    rows = [f"{stamp},0,1" for stamp in stamps]
    (folder / "data.csv").write_text("\n".join(["time,push,pos", *rows[:2], f"{word},0,1", *rows[2:], ""]))
    assert cli.main(["run", "net.py", "--measurements", "data.csv", "--out", "out.parquet"]) == 0
    assert (
        f"row 3, column 'time': expected a finite number, or none where it did not arrive, got '{word}'"
        in capsys.readouterr().err
    )
    assert read_table("out.parquet")["time"].tolist() == stamps


def test_hours_of_a_clock_that_was_set_back_are_not_mixed(folder, capsys):
    """Rows of 02:10 to 02:50 came twice, and were put in order between one another."""
    hours = [
        *(f"02:{minute}" for minute in range(10, 60, 10)),
        "02:00",
        *(f"02:{m}" for m in range(10, 60, 10)),
        "03:00",
    ]
    (folder / "data.csv").write_text("time,push,pos\n" + "".join(f"2026-10-25T{hour}:00,0,1\n" for hour in hours))
    refused(folder, capsys, run_arguments(), "row 6, column 'time'", "dates in UTC", "when summer time ends")


def test_rows_that_could_not_be_read_do_not_share_the_time_of_others(folder, capsys):
    """Their times are made up: "3 of 3 rows share their time, as stamps do that lost their digits" was said of them."""
    (folder / "net.py").write_text(
        """import heliograph as hg
plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=["x"])
sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["t"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
"""
    )
    (folder / "data.csv").write_text('time,t,truth.x\n0,"20,5",\n1,"21,5",\n2,22,\n')
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr()
    assert "rows that could not be read: 2" in said.err and "share their time" not in said.err
    assert "nan" not in said.out


WALK = """import heliograph as hg
import jax.numpy as jnp
plant = hg.LinearPlant(lambda u: jnp.eye(1), lambda u: u[0] * jnp.eye(1), [0.0], 1.0, states=["x"], inputs=["dt"])
sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["y"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
"""


def test_a_time_step_reaches_over_rows_that_could_not_be_read(folder, capsys):
    """Their own steps are lost with them: behind two of them a plant had moved by one step in place of three."""
    (folder / "net.py").write_text(WALK)
    values, found = ["1", "2", "hot", "hot", "5", "6"], []
    for share in (1.0, 2.0, None):  # of the time since the row before that is given as dt; none without a column dt
        header, end = ("time,y", "") if share is None else ("time,y,dt", f",{share}")
        rows = [f"{k + 1},{y}{end}" for k, y in enumerate(values) if share is not None or y != "hot"]
        (folder / "data.csv").write_text("\n".join([header, *rows]) + "\n")
        assert cli.main(run_arguments()) == 0
        found.append((read_table("out.csv")["x.sd"][2], capsys.readouterr().err))
    said = "data.csv, row 5, column 'dt': the steps of the rows refused before it are left out"
    assert (said in found[0][1], said in found[1][1]) == (False, True)
    # The first row's dt is 1 in one table and 0 in the other: two measurements later 5e-8 are left of that.
    assert abs(found[0][0] - found[2][0]) < 1e-6


EVENTS = "node,sequence,time,arrival,push,pos\ninputs,0,0,0,0.1,\nremote,0,0.5,0.5,,1.0\nremote,1,1.0,1.1,,1.2\n"


@pytest.mark.parametrize(
    ("read", "text", "options", "lost"),
    [
        ("out.lagged.csv", EVENTS, ["--out", "out.csv", "--lag", "1"], "output file out.lagged.csv"),
        ("out.a.csv", EVENTS.replace("\n", ",a\n").replace("pos,a", "pos,plant", 1) + "remote,0,2,2,,1,b\n",
         ["--out", "out.csv"], "output file out.a.csv"),
        ("page/data.csv", None, ["--report", "page"], "output folder page"),
        ("data.csv", None, ["--report", "page", "--out", "page/out.csv"], "output folder page"),
    ],
)  # fmt: skip
def test_nothing_that_is_read_or_written_is_lost_by_what_is_written(folder, capsys, read, text, options, lost):
    """A lagged file and a plant's replaced the measurements; a page took its folder with all that stood there."""
    (folder / "page").mkdir()
    (folder / "page" / "summary.json").write_text("{}")  # of an earlier page, so that the folder may be replaced
    (folder / read).write_text((folder / "data.csv").read_text() if text is None else text)
    before = contents(folder)
    assert cli.main(["run", "net.py", "--measurements", read, *options]) == 2
    assert f"{lost}: expected " in capsys.readouterr().err and contents(folder) == before


@pytest.mark.parametrize("command", ["fit", "backtest"])
def test_a_page_does_not_replace_a_folder_with_the_data_it_is_made_of(folder, capsys, command):
    target = folder / "page" / ("backtest" if command == "backtest" else "")
    target.mkdir(parents=True)
    (target / "summary.json").write_text("{}")
    data = (target / "data.csv").relative_to(folder)
    data.write_text((folder / "data.csv").read_text())
    assert cli.main([command, "net.py", "--measurements", str(data), "--out", "page"]) == 2
    assert "without data.csv, which would be lost with it" in capsys.readouterr().err and data.is_file()


@pytest.mark.slow
def test_run_writes_what_later_rows_say_too(folder, capsys):
    assert cli.main([*run_arguments(), "--smooth", "1", "--report", "page"]) == 0
    written = "out.csv and page/report.html: 4 rows of remote/aware (nominal), remote/trusting (nominal)\n"
    assert capsys.readouterr().out == written
    assert (folder / "page" / "smoothed_0.png").is_file() and "given later data too" in (
        folder / "page" / "report.html"
    ).read_text()
    net, table = load_network("net.py"), read_table("out.csv")
    result = h.run(net, *read_recording("data.csv", net), smooth=h.smoothing.FixedLag(1)).smoothed
    for name, estimate in result.estimates["remote"].items():
        np.testing.assert_allclose(table[f"{name}.smoothed.p"], estimate.mean[:, 0], rtol=1e-12)
        assert table[f"{name}.smoothed.v.sd"][1] < table[f"{name}.v.sd"][1]
    assert cli.main([*run_arguments(), "--smooth", "soon"]) == 2
    assert "--smooth: expected all, or how many later rows, got 'soon'" in capsys.readouterr().err


def test_limits_act_as_in_a_stream(folder, capsys):
    """Of a table with a fault code and a value beyond the limits the estimates are those of one without them.

    In a timeline and a service: tests/live/test_implausible.py, tests/serving/test_implausible.py.
    """
    bounded = NETWORK.replace("sensor, link, filters)", "sensor, link, filters, limits=(-5, 5), invalid=-999)")
    (folder / "net.py").write_text(bounded)
    (folder / "data.csv").write_text("time,push,pos\n0,0,0.5\n0.5,1,-999\n0.5,0,0.7\n2,0.5,6\n2.5,0,0.2\n")
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr().err
    assert (
        said.count("\n") == 2 and "node 'remote': 1 of 5 values count as not arrived, by limits; row 4: pos 6" in said
    )
    assert "by code; row 2: pos -999 is a code" in said
    table, net = read_table("out.csv"), load_network("net.py")
    item = net.nodes["remote"].filters["aware"]
    recording = read_recording("data.csv", net)
    (folder / "data.csv").write_text("time,push,pos\n0,0,0.5\n0.5,1,\n0.5,0,0.7\n2,0.5,\n2.5,0,0.2\n")
    assert cli.main(run_arguments(out="clean.csv")) == 0
    clean = read_table("clean.csv")
    assert all(np.array_equal(table[name], clean[name], equal_nan=True) for name in clean)
    stream = h.Stream(item, limits=(-5, 5), invalid=-999)
    for k, (z, u) in enumerate(zip(recording.measurements["remote"], recording.inputs, strict=True)):
        mean = stream.push(z, u).mean
        np.testing.assert_allclose([table["aware.p"][k], table["aware.v"][k]], mean, rtol=1e-12, atol=1e-12)


def test_names_do_not_act_on_the_terminal(folder, capsys):
    (folder / "net.py").write_text(NETWORK.replace('"aware"', '"\\x1b[31maware"'))
    assert cli.main(run_arguments()) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out and "\\x1b[31maware" in said.out


def test_a_lost_covariance_is_said_and_flagged(folder, capsys):
    (folder / "net.py").write_text(NETWORK + LOSING)
    assert cli.main(run_arguments()) == 0
    expected = "heliograph: warning: remote/losing: no valid covariance from step 2 in 1 of 1 runs\n"
    said = capsys.readouterr()
    assert said.err == expected and said.out == "out.csv: 4 rows of remote/losing (nominal, none of 2 rows)\n"
    table = read_table("out.csv")
    np.testing.assert_array_equal(table["valid"], [1, 1, 0, 0])
    np.testing.assert_array_equal(table["v.sd"], 1.0)  # the correlation is what is wrong


LAST = "network = "
MODELS = {
    "wrong shape": ("np.eye(2), states", "np.eye(3), states", ["initial covariance", "(2, 2)", "(3, 3)", "line 12"]),
    "sum of probabilities": ("[0.5, 0.5]", "[0.5, 0.6]", ["gain probabilities", "sum to 1", "1.1", "line 14"]),
    "negative probability": ("[0.5, 0.5]", "[-0.5, 1.5]", ["gain probabilities", "negative", "-0.5", "line 14"]),
    "asymmetric covariance": (
        "np.eye(2), states", "[[1, 0.5], [0, 1]], states", ["initial covariance", "symmetric", "0.5", "line 12"]),
    "indefinite covariance": (
        "np.eye(2), states", "[[1, 2], [2, 1]], states", ["initial covariance", "semidefinite", "eigenvalue -1"]),
    "not finite": ("[0, 0]", "[0, np.nan]", ["initial mean", "finite numbers", "1 that are not finite", "line 12"]),
    "no network": (LAST, "_ = lambda: ", ["net.py", "a heliograph.Network", "none in the module"]),
    "two networks": (LAST, 'other = h.Network(plant, {"a": h.Node(sensor, link, {})})\nnetwork = ', [
        "net.py:other or net.py:network", "2 networks"]),
    "an error": (LAST, "raise OSError('one\\ntwo')\nnetwork = ", ["net.py", "OSError in line 19: one two"]),
    "no filters": ("link, filters", "link, {}", ["net.py", "at least one filter", "none"]),
}  # fmt: skip


@pytest.mark.parametrize("case", MODELS)
def test_a_model_that_is_none(folder, capsys, case):
    old, new, fragments = MODELS[case]
    assert NETWORK.count(old) == 1
    (folder / "net.py").write_text(NETWORK.replace(old, new))
    refused(folder, capsys, run_arguments(), "expected", "got", *fragments)


TABLES = {
    "empty file": ("", ["data.csv", "an empty file"]),
    "no rows": ("time,push,pos\n", ["data.csv", "at least one row", "none"]),
    "unknown column": ("time,push,poss\n0,0,1\n", ["only the columns time, push, dt, pos", "'poss'", "'pos'"]),
    "missing column": ("time,pos\n0,0\n", ["one column 'push'", "only time, pos"]),
    "doubled column": ("time,push,pos,pos\n0,0,0,0\n", ["distinct columns", "'pos'"]),
    "time goes backwards beside dt": (
        "time,dt,push,pos\n0,0,0,1\n2,2,0,1\n1,1,0,1\n", ["row 3, column 'time'", "not go backwards", "1 after 2"]),
    "text in all cells": ("time,push,pos\n0,0,far\n1,0,far\n", ["row 1, column 'pos'", "a number", "'far'"]),
    "infinite": ("time,push,pos\n0,0,inf\n", ["row 1, column 'pos'", "a finite number", "inf"]),
    "missing input": ("time,push,pos\n0,,1\n", ["row 1, column 'push'", "a finite number", "an empty cell"]),
    "short row": ("time,push,pos\n0,0\n", ["row 1", "3 cells", "got 2"]),
}  # fmt: skip


@pytest.mark.parametrize("case", TABLES)
def test_measurements_that_are_none(folder, capsys, case):
    text, fragments = TABLES[case]
    (folder / "data.csv").write_text(text)
    refused(folder, capsys, run_arguments(), "data.csv", "expected", "got", *fragments)


def test_places(folder, capsys):
    (folder / "file").touch()
    refused(folder, capsys, run_arguments(network="no.py"), "no.py", "a Python file", "nothing of that name")
    refused(folder, capsys, run_arguments(measurements="no.csv"), "no.csv", "a file", "nothing of that name")
    refused(folder, capsys, run_arguments(out="no/out.csv"), "output folder no", "existing", "nothing of that name")
    refused(folder, capsys, run_arguments(out="file/out.csv"), "output folder file", "a folder", "a file")
    refused(folder, capsys, run_arguments(out="out.txt"), "out.txt", ".csv or .parquet", "'.txt'")
    refused(folder, capsys, run_arguments(out="./data.csv"), "data.csv", "another file than the measurements")
    refused(folder, capsys, ["demo", "--out", "file"], "output folder", "file", "a folder")


def test_the_output_is_checked_before_the_network_runs(folder, capsys):
    (folder / "net.py").write_text("raise SystemError('ran')")
    refused(folder, capsys, run_arguments(out="no/out.csv"), "output folder no")


def test_nothing_is_left_when_the_disk_fills(folder, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "out.csv")

    (folder / "out.csv").write_text("before")
    monkeypatch.setattr(os, "replace", full)
    refused(folder, capsys, run_arguments(), "out.csv: No space left on device")


@pytest.mark.slow
def test_forecasts_are_rows_behind_the_data_and_a_part_of_the_page(tmp_path, capsys):
    """`--forecast 3`: three marked rows, a line on the inputs, a section of the report; MCAP is refused."""
    (tmp_path / "level.py").write_text(
        "import heliograph as hg\n"
        "plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0, [[1.0]], states=['level'], inputs=['flow'])\n"
        "sensor = hg.LinearSensor([[1.0]], 0.5, outputs=['height'])\n"
        "node = hg.Node(sensor, hg.perfect(1), {'f': hg.kalman_filter(plant, sensor)})\n"
        "network = hg.Network(plant, {'a': node})\n"
    )
    rows = "".join(f"{k},0.5,{k}\n" for k in range(30))
    (tmp_path / "data.csv").write_text(f"time,flow,height\n{rows}")
    call = ["run", str(tmp_path / "level.py"), "--measurements", str(tmp_path / "data.csv"), "--forecast", "3"]
    assert cli.main([*call, "--out", str(tmp_path / "out.csv"), "--report", str(tmp_path / "report")]) == 0
    assert "forecast: 3 rows beyond the data, to 32, inputs held at those of the last row" in capsys.readouterr().out
    written = (tmp_path / "out.csv").read_text().splitlines()
    assert [line.split(",")[1] for line in written[-4:]] == ["0", "1", "1", "1"]
    assert "Inputs are held at those of the last row." in (tmp_path / "report" / "report.html").read_text()
    assert cli.main([*call, "--out", str(tmp_path / "out.mcap")]) == 2
    assert "--forecast: expected a table of estimates" in capsys.readouterr().err


@pytest.mark.slow
def test_predictions_of_each_row_are_columns_and_a_figure(tmp_path, capsys):
    """`--predicted`: of messages those rows that the estimates have; MCAP is refused."""
    (tmp_path / "level.py").write_text(
        "import heliograph as hg\n"
        "plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 4.0, states=['level'])\n"
        "sensor = hg.LinearSensor([[1.0]], 0.5, outputs=['height'])\n"
        "node = hg.Node(sensor, hg.perfect(1), {'f': hg.kalman_filter(plant, sensor)})\n"
        "network = hg.Network(plant, {'a': node})\n"
    )
    (tmp_path / "data.csv").write_text("time,height\n" + "".join(f"{k},{'' if k == 7 else k}\n" for k in range(30)))
    call = ["run", str(tmp_path / "level.py"), "--measurements", str(tmp_path / "data.csv"), "--predicted"]
    report = tmp_path / "report"
    assert cli.main([*call, "--forecast", "2", "--out", str(tmp_path / "out.csv"), "--report", str(report)]) == 0
    written = read_table(tmp_path / "out.csv")
    assert written["predicted.output.height"][7] == written["predicted.level"][7] == written["level"][7]
    assert len(written["time"]) == 32
    assert "What each filter expected of a row" in (report / "report.html").read_text()
    assert (report / "predicted_0.svg").exists() and (report / "residuals_0.svg").exists()
    page = (report / "report.html").read_text()
    assert "<h2>Residuals</h2>" in page and "by Ljung and Box" in page
    assert cli.main([*call, "--out", str(tmp_path / "out.mcap")]) == 2
    assert "--predicted: expected a table of estimates" in capsys.readouterr().err
