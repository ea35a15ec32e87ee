"""Messages of files that cannot be read: refused alone, and none that was lost."""

import csv
import json

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg


def walk(*nodes):
    """Return a temperature that walks in time, measured by these nodes."""
    plant = hg.LinearPlant(lambda u: jnp.eye(1), lambda u: 1e-4 * u[0] * jnp.eye(1), [20.0], 1.0, inputs=["dt"])
    sensor = hg.LinearSensor([[1.0]], 0.04, outputs=["y"])
    return hg.Network(plant, {name: hg.Node(sensor, hg.perfect(), {}) for name in nodes})


OWN = "node,sequence,time,y\n" + "".join(f"a,{k},{k},{'hot' if k == 2 else k / 10}\n" for k in (0, 1, 2, 3, 5))
LINES = "\n".join(
    json.dumps({"topic": "dev/up", "payload": json.dumps({"t": 1e9 + k, "n": k, "v": "hot" if k == 2 else k / 10})})
    for k in (0, 1, 2, 3, 5)
)


@pytest.mark.parametrize(("name", "text"), [("own.csv", OWN), ("log.jsonl", LINES)])
def test_a_message_that_cannot_be_read_is_not_lost_too(tmp_path, name, text):
    """It came with its count: of 0, 1, 2, 3, 5 one message is refused and one, 4, is lost."""
    sources = {"dev/up": hg.files.json_field("v", node="a", time="t", time_unit="s", sequence="n")}
    (tmp_path / name).write_text(text)
    events = hg.files.read_messages(tmp_path / name, walk("a"), None if name == "own.csv" else sources)
    counts, lost = events.judge()
    assert (events.refused, counts["a"]["used"], lost["a"]) == (1, 4, 1)


def test_a_field_that_cannot_be_read_costs_no_other_node(tmp_path):
    network = walk("a", "b")
    field = hg.files.json_field
    sources = {"dev/up": [field("v", node="a", time="t", time_unit="s"), field("w", node="b", time="t", time_unit="s")]}
    body = {"t": 1e9, "v": "hot", "w": 20.0}
    (tmp_path / "log.jsonl").write_text(json.dumps({"topic": "dev/up", "payload": json.dumps(body)}))
    events = hg.files.read_messages(tmp_path / "log.jsonl", network, sources)
    assert events.refused == 1 and events.judge()[0]["b"]["used"] == 1


LOGGED = [("2026-09-27T10:00:00Z", 20.0), ("2026-09-27T10:10:00Z", 20.5)]


@pytest.mark.parametrize("name", ["arrival", "timestamp", "time", "ts"])
@pytest.mark.parametrize("seconds", [False, True])
@pytest.mark.parametrize("kind", ["csv", "jsonl"])
def test_the_time_of_a_logged_message_is_that_of_its_log(tmp_path, name, seconds, kind):
    """As a date or in seconds, in a table and in lines, beside a payload that has no time."""
    path, rows = tmp_path / f"log.{kind}", []
    for date, value in LOGGED:
        at = np.datetime64(date[:-1], "s").astype(int).item() if seconds else date
        rows.append({name: at, "topic": "home/attic", "payload": json.dumps({"t": value})})
    if kind == "csv":
        with path.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
    else:
        path.write_text("\n".join(map(json.dumps, rows)))
    events = hg.files.read_messages(path, walk("a"), {"home/attic": hg.files.json_field("t", node="a")})
    assert events.date == np.datetime64("2026-09-27T10:00:00", "ns") and events.refused == 0
    np.testing.assert_array_equal(events.recording().time, [0.0, 600.0])


@pytest.mark.parametrize("said", ["10:00:00", 1790503200123, "noon", 17.5, None])
def test_a_field_of_a_log_that_is_no_moment_is_none(tmp_path, said):
    body = {"topic": "home/attic", "time": said, "payload": json.dumps({"t": 20.0, "at": LOGGED[0][0]})}
    (tmp_path / "log.jsonl").write_text(json.dumps(body))
    source = {"home/attic": hg.files.json_field("t", node="a", time="at")}
    assert hg.files.read_messages(tmp_path / "log.jsonl", walk("a"), source).refused == 0
