"""Messages of bags and of CSV files as events: times of measuring and logging, rows, and what ends a reading early."""

import re
import sqlite3
from contextlib import closing
from decimal import Decimal

import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

import heliograph as hg
from heliograph.live.event_replay import replay_events
from tests.files import bags
from tests.files.module import load_module


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The network's file, its content, a drive, and its bag."""
    folder = tmp_path_factory.mktemp("bags")
    (folder / "net.py").write_text(bags.NETWORK)
    network, module = load_module(str(folder / "net.py"))
    drive = bags.Drive()
    return network, module["sources"], drive, bags.write(folder / "drive", drive.messages())


def test_header_and_log_times_are_both_there(world):
    network, sources, drive, path = world
    table = hg.files.read_messages(path, network, sources)
    events = list(table.sort_events())
    gps = [event for event in events if event.node == "gps"]
    order = np.argsort(drive.logged, kind="stable")
    assert len(table) == len(events) == 220 and table.date == np.datetime64(bags.START, "ns")
    np.testing.assert_array_equal([e.time for e in gps], (drive.measured[order] - bags.START) / 1e9)
    np.testing.assert_array_equal([e.arrival for e in gps], (drive.logged[order] - bags.START) / 1e9)
    np.testing.assert_array_equal([e.values[0] for e in gps], drive.position[order])
    np.testing.assert_array_equal(table.lateness()["gps"], (drive.logged - drive.measured) / 1e9)
    arrivals = [event.arrival for event in events]
    assert arrivals == sorted(arrivals) and "/picture (20)" in table.notes[0]


def test_rows_are_what_a_timeline_puts_in_order(world):
    """With a window that nothing misses, the final estimates are those of the rows in the order of measuring."""
    network, sources, _, path = world
    table = hg.files.read_messages(path, network, sources)
    final = replay_events(network, table.sort_events(), 10.0).final
    rows = hg.run(network, *table.recording())
    estimate, other = final.estimates["gps"]["filter"], rows.estimates["gps"]["filter"]
    measured = ~np.isnan(table.recording().measurements["gps"][:, 0])
    np.testing.assert_array_equal(final.time, rows.time[measured])
    # Compiled apart: rounding only.
    np.testing.assert_allclose(estimate.mean, other.mean[measured], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(estimate.covariance, other.covariance[measured], rtol=1e-9, atol=1e-12)


def test_the_estimate_is_near_the_truth(world):
    """A tenth of a second apart, deviation 0.2: the error's deviation is below that of a single position."""
    network, sources, drive, path = world
    record = hg.run(network, *hg.files.read_messages(path, network, sources).recording())
    measured = ~np.isnan(hg.files.read_messages(path, network, sources).recording().measurements["gps"][:, 0])
    error = np.asarray(record.estimates["gps"]["filter"].mean)[measured, 0] - drive.truth
    assert np.sqrt(np.mean(error**2)) < 0.15


def test_a_changed_type_ends_the_reading_and_what_was_read_stays(world, tmp_path):
    network, sources, drive, _ = world
    messages = drive.messages()
    later = [(m[0], m[1], bags.ACCEL, bags.acceleration(1.0)) if m[1] == "/odometry" else m for m in messages[150:]]
    changed = dict(sources) | {"/odometry": hg.files.json_field("linear.x", "gps")}
    path = bags.write(tmp_path / "bag", messages[:150] + later)
    with pytest.raises(ValueError, match=r"/odometry: expected a field 'linear.x' in nav_msgs/msg/Odometry, got only"):
        hg.files.read_messages(path, network, changed)
    both = dict(sources) | {"/odometry": hg.files.json_field("pose.pose.position.x", "gps")}
    with pytest.raises(ValueError, match=r"expected a field 'pose.pose.position.x' in geometry_msgs/msg/Accel"):
        hg.files.read_messages(path, network, both)
    # A type with the same field: the first message of another type ends it.
    twist = bags.STORE.types["geometry_msgs/msg/Twist"]
    vector = bags.STORE.types["geometry_msgs/msg/Vector3"](1.0, 0.0, 0.0)
    later = [
        (m[0], m[1], "geometry_msgs/msg/Twist", twist(vector, vector)) if m[1] == "/acceleration" else m
        for m in messages[150:]
    ]
    table = hg.files.read_messages(bags.write(tmp_path / "two", messages[:150] + later), network, sources)
    expected = (
        r"/acceleration, logged at .*: expected messages of geometry_msgs/msg/Accel, as before, got geometry_msgs"
    )
    assert len(table) > 100 and re.search(expected, table.broken)


def test_a_bag_that_is_damaged(world, tmp_path):
    network, sources, drive, _ = world
    (tmp_path / "no.mcap").write_bytes(b"x" * 100)
    with pytest.raises(ValueError, match=r"no.mcap: expected a bag that can be opened, got AnyReaderError"):
        hg.files.read_messages(tmp_path / "no.mcap", network, sources)
    with pytest.raises(ValueError, match=r"none.mcap: expected a bag, got nothing of that name"):
        hg.files.read_messages(tmp_path / "none.mcap", network, sources)
    # A header without a time, in the middle.
    messages = drive.messages()
    place = next(i for i in range(100, 200) if messages[i][1] == "/odometry")
    messages[place] = (*messages[place][:3], bags.odometry(0, 1.0))
    table = hg.files.read_messages(bags.write(tmp_path / "bag", messages), network, sources)
    assert "field 'header.stamp': expected a time that was set" in table.reasons[0] and len(table) == 219
    with pytest.raises(ValueError, match="a time that was set"):
        hg.files.read_messages(tmp_path / "bag", network, sources, strict=True)


def test_a_bag_that_was_cut_off_is_read_up_to_there(world, tmp_path):
    """A chunk is 1 MiB: of two and a half the first two are whole, and their events are those of the whole bag."""
    network, sources, *_ = world
    whole = bags.write(tmp_path / "bag", bags.Drive(4000).messages())
    data = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(data[: int(2.5 * 2**20)])
    table, complete = (hg.files.read_messages(path, network, sources) for path in (cut, whole))
    assert re.search(r"cut.mcap: expected a bag that ends, got one that was cut off after [0-9,]+ bytes", table.broken)
    count = len(table)
    assert 2000 < count < len(complete) and not complete.broken
    for name, columns in table.columns.items():
        n = len(columns.time)
        assert columns.time == complete.columns[name].time[:n] and columns.values == complete.columns[name].values[:n]


@pytest.mark.parametrize(
    ("sources", "line"),
    [
        ({"/odom": hg.files.json_field("x", "gps")}, "expected a topic of the sources, /odom, got only /acceleration"),
        (
            {"/odometry": hg.files.json_field("pose.pose.position.X", "gps")},
            "/odometry: expected a field 'pose.pose.position.X' in nav_msgs/msg/Odometry, got only header.stamp.sec",
        ),
        ({"/odometry": hg.files.json_field("pose.pose.position", "gps")}, "field 'pose.pose.position': expected a num"),
    ],
)
def test_sources_that_do_not_fit_the_bag_are_one_line(world, sources, line):
    network, *_, path = world
    with pytest.raises(ValueError, match=line):
        hg.files.read_messages(path, network, sources)


def test_a_csv_file_is_mapped_by_the_same_object(world, tmp_path):
    """Rows of a logger: a date, a position in millimetres; and a log of messages, with topic and payload."""
    network, sources, *_ = world
    place = hg.files.json_field("Position [mm]", "gps", scale=1e-3, time="Date")
    (tmp_path / "log.csv").write_text(
        "Date,Position [mm],Note\n2026-01-01T00:00:00Z,1500,start\n"
        "2026-01-01T00:00:02Z,,\n2026-01-01T00:00:01Z,250.5,\n"
    )
    table = hg.files.read_messages(tmp_path / "log.csv", network, {"log.csv": place})
    rows = table.recording()
    np.testing.assert_array_equal(rows.time, [0.0, 1.0, 2.0])
    np.testing.assert_allclose(rows.measurements["gps"][:, 0], [1.5, 0.2505, np.nan], rtol=1e-15)  # rounding
    (tmp_path / "mqtt.csv").write_text(
        'topic,arrival,payload\n/acceleration,2026-01-01T00:00:00Z,"{""linear"": {""x"": 2.0}}"\n'
        '/else,2026-01-01T00:00:01Z,{}\n/acceleration,2026-01-01T00:00:02Z,"{""linear"": {}}"\n'
    )
    table = hg.files.read_messages(tmp_path / "mqtt.csv", network, sources)
    (event,) = table.sort_events()
    assert event.node == "inputs" and event.values.tolist() == [2.0] and "/else (1)" in table.notes[0]
    assert "row 3: expected a field 'linear.x', got no 'x' in an empty message" in table.reasons[0]


def test_arrivals_in_seconds_date_the_lines_of_a_log(world, tmp_path):
    """`mosquitto_sub -F "%U %t %p"` prints seconds since 1970 with a fraction."""
    network, _, *_ = world
    log = tmp_path / "mqtt.log"
    log.write_text("1700000000.25 /gps 1.5\n1700000000.75 /gps 2.5\nnoon /gps 3\n1700000002.25 /gps 3.5\n")
    rows = hg.files.read_messages(log, network, {"/gps": hg.files.json_field("", "gps")}).recording()
    np.testing.assert_array_equal(rows.time, [0.0, 0.5, 2.0])
    np.testing.assert_array_equal(rows.measurements["gps"][:, 0], [1.5, 2.5, 3.5])


def test_a_mapped_table_with_semicolons_says_what_rewrites_it(world, tmp_path):
    network, _, *_ = world
    path = tmp_path / "log.csv"
    path.write_text("time;value\n2026-01-01T00:00:00Z;20,1\n2026-01-01T00:00:01Z;20,2\n")
    sources = {"log.csv": hg.files.json_field("value", "gps", time="time")}
    with pytest.raises(ValueError, match="names separated by commas, got semicolons") as said:
        hg.files.read_messages(path, network, sources)
    remedy = str(said.value)
    exec(remedy[remedy.index("pandas.") : remedy.rindex(" rewrites it")], {"pandas": pytest.importorskip("pandas")})
    rows = hg.files.read_messages(path, network, sources).recording()
    np.testing.assert_array_equal(rows.measurements["gps"][:, 0], [20.1, 20.2])


def test_inputs_hold_and_repeated_events_count_once(world):
    """Input 2 from second 1 on: the row at 1 has what held before it, the next has 2; time since the row before."""
    network, *_ = world
    table = hg.files.EventTable(network)
    from heliograph.files.sources.message_reading import Reading

    second = 10**9
    for node, time, value in (("gps", 3, 7.0), ("inputs", 1, 2.0), ("gps", 0, 5.0), ("gps", 3, 7.0)):
        table.add(Reading("", node, 5, bags.START + time * second, np.array([value])), bags.START + 4 * second)
    rows = table.recording()
    np.testing.assert_array_equal(rows.time, [0.0, 1.0, 3.0])
    np.testing.assert_array_equal(rows.inputs, [[0.0, 0.0], [0.0, 1.0], [2.0, 2.0]])
    np.testing.assert_array_equal(rows.measurements["gps"][:, 0], [5.0, np.nan, 7.0])


def test_a_fit_learns_the_law_of_delays_from_the_times_of_logging(world, tmp_path):
    """Delays of 0, 1 and 3 steps, in 60, 30 and 10 of 100: within three deviations of a share of 1,000 messages."""
    network, sources, *_ = world
    chance, share = np.random.default_rng(0), np.array([0.6, 0.3, 0.1])
    delays, jitter = chance.choice([0, 1, 3], 1000, p=share), chance.uniform(-0.4, 0.4, 1000)
    noise = 0.2 * chance.standard_normal(1000)
    messages = []
    for k, (d, part) in enumerate(zip(delays, jitter, strict=True)):
        at = bags.START + k * 10**8
        messages.append(
            (at + round(max(d + part, 0.0) * 10**8), "/odometry", bags.ODOMETRY, bags.odometry(at, 0.1 * k + noise[k]))
        )
    path = bags.write(tmp_path / "late", sorted(messages, key=lambda item: item[0]))
    table = hg.files.read_messages(path, network, sources)

    def build():
        sensor = hg.Sensor(lambda x: x[:1], hg.free(1.0, "variance"))
        return hg.Network(network.plant, {"gps": hg.Node(sensor, hg.perfect(), {})})

    fitted = hg.fit(build, table, starts=1)
    (row,), delays = fitted.table, fitted.delays["gps"]
    assert row.low < 0.04 < row.high
    assert delays.step == 0.1 and (delays.counted, delays.early) == (1000, 0)  # of steps, by their median
    law = delays.law
    np.testing.assert_array_equal(law.values, [0.0, 1.0, 3.0])
    assert all(part.low <= p <= part.high for part, p in zip(delays.shares.values(), share, strict=True))
    assert hg.model.delayed(hg.perfect(), law).times == (0, 1, 3)
    assert "gps: late by 0 s 0." in str(fitted) and list(table.delays()) == ["gps"]


def test_dates_become_steps_of_a_network_that_counts_them(tmp_path):
    """Steps of half a second from the first date on: each date is of the nearest; an event is as late as it was."""
    plant, sensor = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)
    filters = {"skips": hg.kalman_filter(plant, sensor)}
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), filters, trigger=hg.SendOnDelta(0.5))})
    rows = [("10:00:00.100", 1.0, "10:00:00.2"), ("10:00:01.050", 2.0, "10:00:03"), ("10:00:02.320", 3.0, "10:00:02.4")]
    text = "".join(f"2026-11-25T{at}Z,{value},2026-11-25T{came}Z\n" for at, value, came in rows)
    (tmp_path / "log.csv").write_text(f"at,value,arrival\n{text}")
    sources = {"log.csv": hg.files.json_field("value", "a", time="at", step=0.5)}
    table = hg.files.read_messages(tmp_path / "log.csv", network, sources)
    assert [(e.time, e.values[0], e.arrival) for e in table.sort_events()] == [(0, 1.0, 0), (4, 3.0, 5), (2, 2.0, 6)]
    rows = table.recording()
    np.testing.assert_array_equal(rows.measurements["a"][:, 0], [1.0, np.nan, 2.0, np.nan, 3.0])
    np.testing.assert_allclose(table.lateness()["a"], [0.1, 1.95, 0.08], rtol=1e-9)
    assert table.date == np.datetime64("2026-11-25T10:00:00.1")
    line = hg.Timeline(network, window=10)
    assert [line.push(*event) for event in table.sort_events()] == ["used"] * 3
    for changed, words in (
        (dict(step=None), r"log.csv', time: expected the seconds of a step \(step=0.1\), or a time field in steps"),
        (dict(step=0.0), "json_field, step: expected"),
        (dict(step=0.5, time_unit="step"), "json_field, step: expected none where the time is in steps already"),
    ):
        with pytest.raises(ValueError, match=words):
            field = hg.files.json_field("value", "a", time="at", **changed)
            hg.files.read_messages(tmp_path / "log.csv", network, {"log.csv": field})


def test_a_type_that_the_bag_does_not_define_is_one_line(world, tmp_path):
    """An SQLite bag without definitions, as of earlier releases of ROS, with a type of somebody's own."""
    network, *_ = world
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg("float64 level", "tank/msg/Level"))
    with Writer(tmp_path / "old", version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        topic = writer.add_connection("/tank", "tank/msg/Level", typestore=store)
        writer.write(topic, bags.START, store.serialize_cdr(store.types["tank/msg/Level"](1.0), "tank/msg/Level"))
    (file,) = (tmp_path / "old").glob("*.db3")
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("DELETE FROM message_definitions")
    with pytest.raises(ValueError, match=r"/tank: expected a message type that the bag defines, got 'tank/msg/Level'"):
        hg.files.read_messages(tmp_path / "old", network, {"/tank": hg.files.json_field("level", "gps")})


def test_a_folder_of_bags_is_read_as_one(world, tmp_path):
    """Parts that a recorder wrote, without the metadata of ROS 2 beside them."""
    network, sources, drive, whole = world
    messages, folder = drive.messages(), tmp_path / "parts"
    folder.mkdir()
    for i, part in enumerate((messages[:100], messages[100:])):
        bags.write(tmp_path / f"b{i}", part).rename(folder / f"part_{i}.mcap")
    table, expected = (hg.files.read_messages(path, network, sources) for path in (folder, whole))
    for name, columns in table.columns.items():
        assert columns.time == expected.columns[name].time and columns.values == expected.columns[name].values


def test_a_stamp_with_an_offset_is_the_same_one_by_one(world, monkeypatch):
    from heliograph.files.bags.batch_decoder import BatchDecoder

    network, _, drive, path = world
    field = hg.files.json_field("pose.pose.position.x", "gps", time=hg.files.Stamp("header.stamp", -0.05))
    yaw = hg.files.json_field(hg.files.Yaw("pose.pose.orientation"), "inputs", time="header.stamp")
    table = hg.files.read_messages(path, network, {"/odometry": [field, yaw]})
    monkeypatch.setattr(BatchDecoder, "append_events", lambda decoder, batch, table: False)
    one = hg.files.read_messages(path, network, {"/odometry": [field, yaw]})
    order = np.argsort(drive.logged, kind="stable")
    assert list(table.columns["gps"].time) == (drive.measured[order] - 5 * 10**7).tolist()
    assert all(table.columns[n].time == one.columns[n].time for n in ("gps", "inputs"))
    assert set(table.columns["inputs"].values) == set(one.columns["inputs"].values) == {0.0}


def test_flags_and_decimals_of_tables_are_what_they_are_in_messages(world, tmp_path):
    """A flag in CSV was a text, so that `valid` refused every row; a decimal of a database was no number."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    network, *_ = world
    (tmp_path / "log.csv").write_text("at,mm,ok\n1700000000,1.25,True\n1700000001,2.5,False\n1700000002,True,TRUE\n")
    seconds = [Decimal(1_700_000_000), Decimal(1_700_000_001), Decimal("1700000002.000000001")]
    values = pa.array([Decimal("1.25"), Decimal("2.50"), Decimal(1)], pa.decimal128(4, 2))
    flags = pa.array([True, False, True])
    pq.write_table(pa.table({"at": pa.array(seconds), "mm": values, "ok": flags}), tmp_path / "log.parquet")
    for name, last in (("log.csv", 2.0), ("log.parquet", 2.000000001)):
        for options in ({"valid": "ok"}, {"where": {"ok": True}}, {"where": {"ok": "True"}}):
            field = hg.files.json_field("mm", "gps", time="at", **options)
            rows = hg.files.read_messages(tmp_path / name, network, {name: field}).recording()
            assert rows.time.tolist() == [0.0, last] and rows.measurements["gps"].ravel().tolist() == [1.25, 1.0]


def test_parquet_of_another_hand_is_mapped_too(world, tmp_path):
    """Dates with a zone and without digits lost; rows that lack a number did not arrive."""
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    network, *_ = world
    at = pa.array([bags.START, bags.START + 1, bags.START + 10**9], pa.timestamp("ns", "Europe/Berlin"))
    values = pa.array([1.0, None, 2.0], pa.float32())
    pq.write_table(pa.table({"at": at, "mm": values, "note": ["a", "b", None]}), tmp_path / "log.parquet")
    field = hg.files.json_field("mm", "gps", scale=1e-3, time="at")
    rows = hg.files.read_messages(tmp_path / "log.parquet", network, {"log.parquet": field}).recording()
    np.testing.assert_array_equal(rows.time, [0.0, 1e-9, 1.0])
    np.testing.assert_array_equal(rows.measurements["gps"][:, 0], [1e-3, np.nan, 2e-3])
