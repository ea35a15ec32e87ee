"""Files of events: whatever their order, dates or format, the estimates are those of the events in order."""

import csv
import re

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.live.event import Event
from heliograph.live.event_replay import replay_events

NETWORK = """
import jax.numpy as jnp
import numpy as np

import heliograph as hg

plant = hg.Plant(lambda x, u: x + u[0] * u[1], lambda u: 0.3 * jnp.diag(u[1:]), [0.5], 2.0, ["x"], ["speed", "dt"])
sensor = hg.LinearSensor([[1.0], [1.0]], 0.1 * np.eye(2), ["left", "right"])
filters = {"f": hg.cubature_filter(plant, sensor, hg.perfect(2))}
network = hg.Network(plant, {"cart": hg.Node(sensor, hg.perfect(2), filters)})
"""
ROWS = [
    ("inputs", 0, 0.0, 0.0, "", "", "0.1"),
    ("cart", 1, 1.5, 1.6, "1.0", "", ""),
    ("cart", 3, 3.0, 3.1, "3.1", "2.9", ""),
    ("cart", 2, 2.0, 3.5, "2.0", "1.9", ""),
    ("cart", 2, 2.0, 3.6, "2.0", "1.9", ""),
    ("cart", 4, 9.0, 9.5, "", "8.0", ""),
    ("cart", 0, 0.5, 15.0, "9.0", "", ""),
]
HEADER = ["node", "sequence", "time", "arrival", "left", "right", "speed"]


@pytest.fixture(scope="module")
def network():
    scope = {}
    exec(NETWORK, scope)
    return scope["network"]


def written(path, header, rows):
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def received(row):
    """The cells of its node."""
    return row[6:] if row[0] == "inputs" else row[4:6]


def dated(seconds):
    """Of a zone, an hour ahead."""
    return f"2026-11-21T10:00:{seconds:06.3f}+01:00"


def read_events(path, network):
    """The events in order of arrival, and the date of time 0."""
    table = hg.files.read_messages(path, network, strict=True)
    return list(table.sort_events()), table.date if table.dated else None


def same(item, other):
    for a, b in zip(item, other, strict=True):
        assert a[:3] == b[:3] and a.arrival == b.arrival
        np.testing.assert_array_equal(a.values, b.values)


def test_every_way_to_write_events_is_read_alike(tmp_path, network):
    plain, none = read_events(written(tmp_path / "a.csv", HEADER, ROWS), network)
    assert none is None and plain[1].node == "cart"
    np.testing.assert_array_equal(plain[1].values, [1.0, np.nan])
    rows = [(n, s, dated(t), dated(a), *rest) for n, s, t, a, *rest in ROWS]
    result, origin = read_events(written(tmp_path / "b.csv", HEADER, rows), network)
    same(plain, result)
    assert origin == np.datetime64("2026-11-21T09:00:00")
    rows = [(*row[:4], " ".join(cell or "nan" for cell in received(row))) for row in ROWS]
    same(plain, read_events(written(tmp_path / "c.csv", [*HEADER[:4], "values"], rows), network)[0])
    columns = dict(zip(HEADER, zip(*ROWS, strict=True), strict=True))
    numbers = {name: [float(x) if x else None for x in columns[name]] for name in HEADER[4:]}
    pq.write_table(pa.table({**{name: list(columns[name]) for name in HEADER[:4]}, **numbers}), tmp_path / "d.parquet")
    same(plain, read_events(tmp_path / "d.parquet", network)[0])
    with pytest.raises(ValueError, match="a message in our own form, or sources for its topic"):
        read_events(written(tmp_path / "rows.csv", ["time", "left"], [(0, 1)]), network)


def test_a_table_of_events_has_rows_and_delays(tmp_path, network):
    """Rows in the order of measuring, a repeated event once; dates or numbers; late by 0.1, 15, 1.5 and 0.5 s."""
    for name, when in (("a.csv", float), ("b.csv", dated)):
        rows = [(n, s, when(t), when(a), *rest) for n, s, t, a, *rest in ROWS]
        table = hg.files.read_messages(written(tmp_path / name, HEADER, rows), network)
        recording = table.recording()
        np.testing.assert_array_equal(recording.time, [0.0, 0.5, 1.5, 2.0, 3.0, 9.0])
        np.testing.assert_array_equal(recording.measurements["cart"][3], [2.0, 1.9])
        delays = table.delays(0.5)["cart"]
        assert list(delays.shares) == [0, 1, 3, 29] and delays.counted == 6
        assert delays.shares[0].estimate == 1 / 3


@pytest.mark.parametrize(
    ("place", "cell", "message"),
    [
        (0, "robot", "row 2, column 'node': expected one of cart, inputs, got 'robot'"),
        (1, "1.5", "row 2, column 'sequence': expected a whole number from 0 to .*, got 1.5"),
        (1, "", "row 2, column 'sequence': expected a number, got an empty cell"),
        (1, "-1", "row 2, column 'sequence': expected a whole number from 0 to .*, got -1"),
        (1, str(10**30), f"row 2, column 'sequence': expected a whole number from 0 to .*, got {10**30}"),
        (1, "1e300", "row 2, column 'sequence': expected a whole number from 0 to .*, got 1e\\+300"),
        (1, "9" * 5000, "row 2, column 'sequence': expected"),
        (2, "1_0", "row 2, column 'time': expected a number, got text, '1_0'"),
        (2, "soon", "row 2, column 'time': expected a number, got text, 'soon'"),
        (3, "", "row 2, column 'arrival': expected a number, got an empty cell"),
        (4, "inf", "row 2, column 'left': expected a number or an empty cell, got inf"),
    ],
)
def test_a_cell_that_is_none_is_named(tmp_path, network, place, cell, message):
    rows = [list(row) for row in ROWS]
    rows[1][place] = cell
    with pytest.raises(ValueError, match=message):
        read_events(written(tmp_path / "events.csv", HEADER, rows), network)


def test_a_sequence_keeps_every_digit(tmp_path, network):
    rows = [list(row) for row in ROWS]
    for cell, number in ((str(2**63 - 1), 2**63 - 1), ("4.0", 4), ("0007", 7)):
        rows[1][1] = cell
        assert read_events(written(tmp_path / "events.csv", HEADER, rows), network)[0][1].sequence == number


@pytest.mark.parametrize("name", ["sequence", "time", "arrival", "left"])
def test_text_in_a_table_of_types_is_no_number(tmp_path, network, name):
    """In CSV everything is text, and quotes mean nothing."""
    table = dict(zip(HEADER, zip(*ROWS, strict=True), strict=True))
    typed = {column: [float(x) if x != "" else None for x in table[column]] for column in HEADER[1:]}
    columns = {"node": list(table["node"]), **typed, name: ["1.0"] * len(ROWS)}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    expected = f"row {1 + (name == 'left')}, column '{name}': expected a number.*, got text, '1.0'"
    with pytest.raises(ValueError, match=expected):
        read_events(tmp_path / "a.parquet", network)
    quoted = [[f'"{cell}"' for cell in row] for row in ROWS]
    (tmp_path / "b.csv").write_text("\n".join([",".join(HEADER), *(",".join(row) for row in quoted)]))
    same(
        read_events(written(tmp_path / "a.csv", HEADER, ROWS), network)[0], read_events(tmp_path / "b.csv", network)[0]
    )


def test_columns_that_nobody_knows_or_that_lack_are_named(tmp_path, network):
    with pytest.raises(ValueError, match=r"header: expected only the columns node, sequence, .*, got 'middle'"):
        read_events(written(tmp_path / "a.csv", [*HEADER[:4], "middle"], [row[:5] for row in ROWS]), network)
    with pytest.raises(ValueError, match="header: expected a column 'time', got only node, sequence"):
        read_events(written(tmp_path / "b.csv", HEADER[:2], [row[:2] for row in ROWS]), network)


def test_playing_gives_final_and_lagged_estimates(network):
    """Final ones are those of the rows in order; of each moment then what was received a lag later."""
    events = [Event(*row[:3], [float(cell or "nan") for cell in received(row)], row[3]) for row in ROWS]
    result = replay_events(network, events, 5.0, 1.0)
    assert {name: {v: n for v, n in count.items() if n} for name, count in result.counts.items()} == {
        "cart": {"used": 4, "duplicate": 1, "late": 1}, "inputs": {"used": 1},
    }  # fmt: skip
    assert result.final.time.tolist() == [1.5, 2.0, 3.0, 9.0] and result.lagged.time.tolist() == [1.5, 3.0, 9.0]
    rows = [events[i].values for i in (1, 3, 2, 5)]
    u = [[0.1, dt] for dt in (1.5, 0.5, 1.0, 6.0)]
    whole = hg.run(network, {"cart": rows}, u)
    np.testing.assert_allclose(result.final.estimates["cart"]["f"].mean, whole.estimates["cart"]["f"].mean, rtol=1e-12)
    within = hg.run(
        network, {"cart": rows[:3]}, u[:3], smooth=hg.smoothing.FixedLag(1)
    )  # at 2.5 nothing else was there
    late = result.lagged.estimates["cart"]["f"]
    np.testing.assert_allclose(late.mean[1], within.estimates["cart"]["f"].mean[2], rtol=1e-12)
    alone = hg.run(network, {"cart": rows[:1]}, u[:1])
    np.testing.assert_allclose(late.mean[0], alone.estimates["cart"]["f"].mean[0], rtol=1e-12)


def test_the_command_takes_events(tmp_path, capsys):
    (tmp_path / "net.py").write_text(NETWORK)
    data, out = written(tmp_path / "events.csv", HEADER, ROWS), tmp_path / "est.csv"
    command = ["run", str(tmp_path / "net.py"), "--measurements", str(data), "--out", str(out)]
    assert cli.main([*command, "--window", "5", "--lag", "1"]) == 0
    known = capsys.readouterr().out
    assert "4 rows of cart/f" in known and "cart: 4 used, 1 duplicate, 1 late" in known and "inputs: 1 used" in known
    assert len(out.read_text().splitlines()) == 5 and len((tmp_path / "est.lagged.csv").read_text().splitlines()) == 4
    assert cli.main([*command, "--window", "1", "--lag", "2"]) == 2
    assert "lag: expected a number from 0 to the window, 1, got 2" in capsys.readouterr().err
    rows = written(tmp_path / "rows.csv", ["time", "left", "right", "speed"], [(0, 1, 1, 0), (1, 1, 1, 0)])
    command[3] = str(rows)
    assert cli.main([*command, "--lag", "1"]) == 2
    assert "--lag: expected messages or events, got rows of time in" in capsys.readouterr().err
    assert cli.main([*command, "--window", "1"]) == 2
    assert "--window, --ahead, --lag and --plant: expected messages or events" in capsys.readouterr().err


def test_an_arrival_of_steps_may_be_no_step_whatever_the_file_is_called(tmp_path):
    """In a file called times.csv it was refused as if it were the column `time`."""
    plant, sensor = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1, outputs=["y"])
    node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})
    rows = [("a", 0, 0, 0.5, 1.0), ("a", 1, 1, 1.25, 2.0)]
    for name in ("times.csv", "steps.csv"):
        path = written(tmp_path / name, ["node", "sequence", "time", "arrival", "y"], rows)
        events = hg.files.read_messages(path, hg.Network(plant, {"a": node}), strict=True)
        assert [event.arrival for event in events.sort_events()] == [0.5, 1.25]


@pytest.mark.parametrize(("first", "said"), [(1_700_000_000_000_000_003, "counted from 17"), (0, "from 17.* rounded")])
def test_whole_numbers_beyond_doubles_are_counted_from_the_first_or_said_to_be_rounded(tmp_path, network, first, said):
    """Of 2^60 doubles are 256 apart; counted from a large first time the times keep every digit."""
    times = [first, 1_700_000_000_000_000_005, 1_700_000_000_000_000_009]
    rows = [("cart", k, time, time, "1.0", "", "") for k, time in enumerate(times)]
    events = hg.files.read_messages(written(tmp_path / "late.csv", HEADER, rows), network)
    (note,) = [note for note in events.notes if "times" in note]
    assert re.search(said, note)
    found = [event.time for event in events.sort_events()]
    assert (found == [0.0, 2.0, 6.0]) is bool(first)
