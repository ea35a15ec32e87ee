"""Rows whose times are counted steps: what cannot be read did not arrive, and the fewest rows are refused."""

import json
import os
import subprocess
import sys
from itertools import combinations

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli

STEPS = """
import heliograph as hg

plant = hg.LinearPlant([[0.9]], 0.01, [0.0], 1.0, input_matrix=[[1.0]], states=["x"], inputs=["push"])
sensor = hg.LinearSensor([[1.0]], 0.04, outputs=["y"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
sources = None
"""
PUSHED = "time,push,y\n0,1,1.0\n1,2,2.5\n2,?!,3.0\n3,0,2.0\n4,1,\n5,0,2.0\n"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_where_steps_are_counted_a_row_that_cannot_be_read_is_one_in_which_nothing_arrived(folder, capsys):
    """Its input is that of the row before. A service that is sent the table estimates the same, to the last bits."""
    (folder / "net.py").write_text(STEPS)
    (folder / "log.csv").write_text(PUSHED)
    assert cli.main(["run", "net.py", "--measurements", "log.csv", "--out", "out.csv"]) == 0
    table, said = hg.files.read_table("out.csv"), capsys.readouterr().err
    assert "rows that could not be read: 1; log.csv, row 3, column 'push'" in said and said.count("\n") == 1
    np.testing.assert_array_equal(table["time"], np.arange(6))
    mean, variance, means = 0.0, 1.0, []
    for push, y in [(1, 1.0), (2, 2.5), (2, np.nan), (0, 2.0), (1, np.nan), (0, 2.0)]:
        mean, variance = 0.9 * mean + push, 0.81 * variance + 0.01
        if not np.isnan(y):
            gain = variance / (variance + 0.04)
            mean, variance = mean + gain * (y - mean), (1 - gain) * variance
        means.append(mean)
    np.testing.assert_allclose(table["x"], means, rtol=1e-12)
    command = [sys.executable, "-m", "heliograph", "serve", "net.py", "--store", "none"]
    with (folder / "log.csv").open("rb") as source:
        done = subprocess.run(command, stdin=source, capture_output=True, text=True, env=os.environ)
    finals = [body for body in map(json.loads, done.stdout.splitlines()) if body["kind"] == "final"]
    known = {body["time"]: body["estimates"]["a"]["k"]["mean"][0] for body in finals}
    for step, value in known.items():
        np.testing.assert_allclose(value, means[int(step)], rtol=1e-12)
    assert {0.0, 1.0, 3.0, 5.0} <= known.keys() and "could not be read" not in done.stderr


@pytest.mark.slow
def test_where_steps_are_counted_the_fewest_rows_that_go_backwards_did_not_arrive(folder, capsys):
    """By a run and by a service that is sent the file; newest first throughout it is refused as a whole."""
    (folder / "net.py").write_text(STEPS)
    rows = ["0,1,1.0", "1,2,2.5", "9999,1,3.0", "3,0,2.0", "2,1,1.0", "5,0,2.0"]
    (folder / "log.csv").write_text("\n".join(["time,push,y", *rows, ""]))
    assert cli.main(["run", "net.py", "--measurements", "log.csv", "--out", "out.csv"]) == 0
    said = capsys.readouterr().err
    assert (
        "rows that could not be read: 2; log.csv, row 3, column 'time': expected a time that does not go back" in said
    )
    means = hg.files.read_table("out.csv")["x"]
    command = [sys.executable, "-m", "heliograph", "serve", "net.py", "--store", "none"]
    with (folder / "log.csv").open("rb") as source:
        done = subprocess.run(command, stdin=source, capture_output=True, text=True, env=os.environ)
    bodies = [json.loads(line) for line in done.stdout.splitlines()]
    known = {body["time"]: body["estimates"]["a"]["k"]["mean"][0] for body in bodies if body["kind"] == "final"}
    assert {0.0, 1.0, 3.0, 5.0} <= known.keys() and sum(body["kind"] == "refused" for body in bodies) == 2
    for step, value in known.items():
        np.testing.assert_allclose(value, means[int(step)], rtol=1e-12)
    (folder / "log.csv").write_text("\n".join(["time,push,y", *rows[1::-1], ""]))
    assert cli.main(["run", "net.py", "--measurements", "log.csv", "--out", "out.csv"]) == 2
    assert "log.csv, row 2, column 'time': expected a time that does not go backwards, got 0 after 1" in (
        capsys.readouterr().err
    )


@pytest.mark.parametrize("seed", range(12))
def test_no_fewer_steps_than_refused_are_out_of_order(folder, capsys, seed):
    """Against all subsets of eight rows; what is left does not go backwards."""
    time = np.random.default_rng(seed).integers(0, 8, 8)
    (folder / "net.py").write_text(STEPS)
    (folder / "log.csv").write_text("time,push,y\n" + "".join(f"{t},0,{t}\n" for t in time))
    subsets = (rows for size in range(9) for rows in combinations(time.tolist(), size))
    longest = max(len(rows) for rows in subsets if sorted(rows) == list(rows))
    known = cli.main(["replay", "log.csv", "--network", "net.py"]) == 0
    assert known == (longest > 4)  # half of them are refused as a whole
    if known:
        messages = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        values = [message["values"][0] for message in messages if message["node"] == "a"]
        assert len(values) == longest and sorted(values) == values
