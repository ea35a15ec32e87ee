import warnings

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import heliograph as h
from heliograph.files import read_recording, write_table
from heliograph.simulation.results.record import Record

NAN = np.nan
TIME = [0.0, 0.5, 0.5, 2.0]


def tracked(inputs=("dt",)) -> h.Plant:
    def move(x, u):
        return x + u[0] * np.array([[0.0, 1.0], [0.0, -0.1]]) @ x

    return h.Plant(move, 0.01 * np.eye(2), [0.0, 1.0], np.eye(2), states=["p", "v"], inputs=inputs)


def sensed(*outputs: str) -> h.LinearSensor:
    return h.LinearSensor(np.eye(2)[: len(outputs)], 0.1, outputs=outputs)


def relayed(dimension: int) -> h.random_affine.AbstractRandomAffine:
    gain = h.Discrete([0.8, 1.2], [0.5, 0.5])
    return h.amplify_and_forward([h.hop(gain, 0.1, dimension=dimension), h.hop(gain, 0.1, dimension=dimension)])


def network(nodes: dict[str, tuple[str, ...]], inputs=("dt",), filters=("aware",)) -> h.Network:
    plant, members = tracked(inputs), {}
    for name, outputs in nodes.items():
        sensor, channel = sensed(*outputs), relayed(len(outputs))
        built = {key: h.cubature_filter(plant, sensor, channel) for key in filters}
        members[name] = h.Node(sensor, channel, built)
    return h.Network(plant, members)


def columns(**others) -> dict[str, np.ndarray]:
    return {key.replace("__", "."): np.array(value) for key, value in {"time": TIME, **others}.items()}


def refused(data, net, *fragments: str) -> None:
    with pytest.raises(ValueError) as caught:
        read_recording(data, net, "data.csv")
    message = str(caught.value)
    assert "\n" not in message
    assert ": expected " in message and ", got " in message
    for fragment in fragments:
        assert fragment in message


def test_columns_find_their_place():
    net = network({"a": ("pos", "vel")}, inputs=("push", "dt"))
    measured = read_recording(columns(vel=[1, 2, 3, 4], pos=[5, NAN, 7, 8], dt=[9, 9, 9, 9], push=[0, 1, 0, 1]), net)
    np.testing.assert_array_equal(measured.time, TIME)
    np.testing.assert_array_equal(measured.measurements["a"], [[5, 1], [NAN, 2], [7, 3], [8, 4]])
    np.testing.assert_array_equal(measured.inputs, [[0, 9], [1, 9], [0, 9], [1, 9]])


def test_time_step_is_filled():
    measured = read_recording(columns(pos=[1, 2, 3, 4]), network({"a": ("pos",)}))
    np.testing.assert_array_equal(measured.inputs, [[0.0], [0.5], [0.0], [1.5]])


def test_no_inputs():
    plant = h.LinearPlant(np.eye(2), 0.1, [0, 0], 1.0)
    net = h.Network(plant, {"a": h.Node(sensed("pos"), h.perfect(), {})})
    assert read_recording(columns(pos=[1, 2, 3, 4]), net).inputs.shape == (4, 0)


def test_names_of_what_is_received():
    sensor, plant = sensed("pos", "vel"), tracked()
    assert h.Node(sensor, relayed(2), {}).received_names == ("pos", "vel")
    both = h.model.with_direct_link(relayed(2), h.perfect(2))
    assert h.Node(sensor, both, {}).received_names == ("z0", "z1", "z2", "z3")
    net = h.Network(plant, {"a": h.Node(sensor, both, {})})
    measured = read_recording(columns(z0=TIME, z1=TIME, z2=TIME, z3=[1, 2, 3, 4]), net)
    np.testing.assert_array_equal(measured.measurements["a"][:, 3], [1, 2, 3, 4])


def test_nodes_and_their_names():
    net = network({"a": ("pos", "vel"), "b": ("pos",)})
    data = columns(a__pos=[1, 1, 1, 1], vel=[2, 2, 2, 2], b__pos=[3, 3, 3, 3])
    measured = read_recording(data, net)
    np.testing.assert_array_equal(measured.measurements["a"][0], [1, 2])
    np.testing.assert_array_equal(measured.measurements["b"][0], [3])
    refused(columns(pos=TIME, vel=TIME), net, "header", "time, dt, a.pos, a.vel, b.pos", "unknown 'pos'")
    refused({**data, "a.vel": data["vel"]}, net, "one column 'a.vel'", "both 'a.vel' and 'vel'")


def test_a_measurement_named_like_an_input_needs_its_node():
    net = network({"a": ("speed",)}, inputs=("speed",))
    measured = read_recording(columns(speed=[1, 1, 1, 1], a__speed=[2, 2, 2, 2]), net)
    assert measured.inputs[0] == 1 and measured.measurements["a"][0] == 2
    refused(columns(speed=[1, 1, 1, 1]), net, "one column 'a.speed'", "only time, speed")


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        ({"poss": TIME}, ["header", "time, push, pos", "unknown 'poss'", "closest: 'pos'"]),
        ({"pos": None}, ["header", "one column 'pos'", "only time, push"]),
        ({"push": None}, ["header", "one column 'push'", "only time, pos"]),
        ({"time": None}, ["header", "one column 'time'", "only pos, push"]),
        ({"push": [1, NAN, 1, 1]}, ["row 2, column 'push'", "a finite number", "an empty cell"]),
        ({"time": [0, 1, 2, NAN]}, ["row 4, column 'time'", "a finite number", "an empty cell"]),
        ({"time": [0, 1, np.inf, 3]}, ["row 3, column 'time'", "a finite number", "inf"]),
        ({"pos": [1, 2, -np.inf, 4]}, ["row 3, column 'pos'", "a finite number", "-inf"]),
        ({"time": [0, 2, 1.5, 3]}, ["row 3, column 'time'", "does not go backwards", "1.5 after 2"]),
    ],
)
def test_what_is_refused(change, fragments):
    data = {**columns(pos=[1, 2, 3, 4], push=[0, 0, 0, 0]), **change}
    stored = {name: np.array(values) for name, values in data.items() if values is not None}
    refused(stored, network({"a": ("pos",)}, inputs=("push",)), "data.csv", *fragments)


def test_an_input_may_not_be_called_time():
    refused(columns(pos=TIME), network({"a": ("pos",)}, inputs=("time",)), "input names", "'time'")


@pytest.mark.parametrize("name", ["data.csv", "data.parquet"])
def test_a_recording_run_at_once_and_sample_by_sample(tmp_path, name):
    rng = np.random.default_rng(0)
    steps = 30
    time = np.cumsum(rng.exponential(0.2, steps))
    cells = rng.normal(size=(steps, 3))
    cells[rng.random((steps, 3)) < 0.4] = NAN
    cells[7] = NAN  # a row in which nothing arrived
    data = dict(zip(["a.pos", "a.vel", "b.pos"], cells.T, strict=True))
    write_table({"time": time, **data}, tmp_path / name)
    net = network({"a": ("pos", "vel"), "b": ("pos",)})
    recording = read_recording(tmp_path / name, net)
    record = h.run(net, *recording)
    np.testing.assert_array_equal(record.time, time)
    for node in net.nodes:
        stream = h.Stream(net.nodes[node].filters["aware"])
        for k in range(steps):
            estimate = stream.push(recording.measurements[node][k], recording.inputs[k])
            whole = record.estimates[node]["aware"]
            # one sample and a scan are compiled apart, so sums may be taken in another order: rounding only
            np.testing.assert_allclose(whole.mean[k], estimate.mean, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(whole.covariance[k], estimate.covariance, rtol=1e-12, atol=1e-12)


def record_of(*filters: str, nodes=("a",), states=("p", "v")) -> Record:
    bound = np.array([[[4.0, 1.0], [1.0, 9.0]], [[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]])
    estimate = h.model.Estimate(np.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]), bound, "upper")
    estimates = {node: {name: estimate for name in filters} for node in nodes}
    return Record(np.array([0.0, 0.5, 0.7]), states, None, {}, estimates)


WALK = h.Network(
    h.Plant(lambda x, u: x, lambda u: u[:1, None], [0.0], 1.0, states=["x"], inputs=["dt"]),
    {"a": h.Node(h.Sensor(lambda x: x, 0.04, outputs=["y"]), h.perfect(), {})},
)


@pytest.mark.parametrize("kind", ["us", "ms", "s", "D"])
def test_a_date_that_nanoseconds_cannot_say_is_refused(kind):
    """The year 1 is "not set" for .NET, OPC UA and Parquet; in 64 bits of nanoseconds it would be one of 1754."""
    table = {"time": np.array(["0001-01-01", "2026-01-01"], f"datetime64[{kind}]"), "y": [1.0, 2.0]}
    with pytest.raises(
        ValueError, match=r"column 'time', row 1: expected a date in whole nanoseconds, .* got 0001-01-01"
    ):
        h.files.read_recording(table, WALK)


def test_parts_of_a_nanosecond_are_refused_and_coarse_dates_are_kept():
    fine = np.array(["1970-01-02T00:00:00", "1970-01-02T00:00:01"], "datetime64[s]").astype("datetime64[ps]")
    assert h.files.read_recording({"time": fine, "y": [1, 2]}, WALK).inputs[1, 0] == 1.0
    with pytest.raises(ValueError, match="row 2: expected a date in whole nanoseconds"):
        h.files.read_recording({"time": fine + np.array([0, 1]), "y": [1, 2]}, WALK)
    for times in (["2026-01", "2026-02"], ["2025Q4", "2026Q1"], np.array(["2025", "2026"], "datetime64[Y]")):
        days = {"2026-01": 31, "2025Q4": 92}.get(str(times[0]), 365)
        assert h.files.read_recording({"time": times, "y": [1, 2]}, WALK).inputs[1, 0] == days * 86400


def test_whole_numbers_keep_every_digit(tmp_path):
    times = [1_700_000_000_000_000_000, 1_700_000_000_005_000_000, 1_700_000_000_010_000_001]
    (tmp_path / "ns.csv").write_text("time,y\n" + "".join(f"{t},1\n" for t in times))
    for table in (tmp_path / "ns.csv", {"time": np.array(times), "y": np.ones(3)}):
        recording = h.files.read_recording(table, WALK)
        assert recording.inputs[:, 0].tolist() == [0, 5_000_000, 5_000_001]
        assert h.run(network_of_walk(), *recording).time.tolist() == times


def network_of_walk():
    """With a filter, so that it runs."""
    node = WALK.nodes["a"]
    plant, sensor = WALK.plant, h.Sensor(lambda x: x, 0.04, outputs=["y"])
    filters = {"f": h.extended_filter(plant, sensor, h.perfect())}
    return h.Network(plant, {"a": h.Node(sensor, node.channel, filters)})


def test_stamps_that_lost_their_digits_are_said(tmp_path):
    (tmp_path / "six.csv").write_text("time,y\n1.73234e+09,1\n1.73234e+09,2\n1.73234e+09,3\n1.73235e+09,4\n")
    with pytest.warns(UserWarning, match="column 'time': 3 of 4 rows share their time with another row"):
        h.files.read_recording(tmp_path / "six.csv", WALK)


@pytest.mark.parametrize("minutes", [10, 60])
def test_a_clock_that_was_set_back_is_refused(minutes):
    """As when summer time ends; of rows an hour apart two had one time, with a dt of 0, and nobody said so."""
    utc = np.datetime64("2026-10-24T22:00", "ns") + np.arange(30) * np.timedelta64(minutes, "m")
    berlin = utc + np.where(utc < np.datetime64("2026-10-25T01:00"), 2, 1) * np.timedelta64(1, "h")
    with pytest.raises(h.InputError, match=r"expected dates in UTC.* clocks are set back so when summer time ends"):
        h.files.read_recording({"time": berlin, "y": np.ones(30)}, WALK)
    twice = np.sort(np.concatenate([berlin[:3], berlin[2:3], berlin[3:4] + np.timedelta64(20, "m")]))
    for times in (utc, twice if minutes == 10 else utc, berlin + np.timedelta64(1, "D")):  # twice: one row; on a Monday
        kept = np.sort(times)
        assert len(h.files.read_recording({"time": kept, "y": np.ones(len(kept))}, WALK).time) == len(kept)


def in_berlin(utc):
    """Local time in the weeks around the 29th of March and the 25th of October 2026."""
    summer = (utc >= np.datetime64("2026-03-29T01:00")) & (utc < np.datetime64("2026-10-25T01:00"))
    return utc + np.where(summer, 2, 1) * np.timedelta64(1, "h")


@pytest.mark.parametrize("minutes", [10, 60])
def test_a_clock_that_was_set_forward_is_said(minutes):
    """As when summer time begins: a dt is an hour too long."""
    utc = np.datetime64("2026-03-28T22:00", "ns") + np.arange(30) * np.timedelta64(minutes, "m")
    with pytest.warns(UserWarning, match=r"column 'time': 2026-03-29T03:00:00 after .*: clocks are set forward so"):
        h.files.read_recording({"time": in_berlin(utc), "y": np.ones(30)}, WALK)
    others = utc, in_berlin(utc) + np.timedelta64(1, "D"), in_berlin(utc) + np.timedelta64(7, "D"), np.delete(utc, 20)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for times in others:
            h.files.read_recording({"time": times, "y": np.ones(len(times))}, WALK)


@pytest.mark.parametrize("ending", [".csv", ".jsonl"])
def test_messages_in_local_time_are_refused_or_said_too(tmp_path, ending):
    """Put in order, messages of two hours were mixed without a word; with their zone they are what they are."""

    def read(first, zone=""):
        utc = np.datetime64(first, "ns") + np.arange(30) * np.timedelta64(10, "m")
        dates = [f"{moment}{zone}" for moment in (utc if zone else in_berlin(utc))]
        rows = [f"a,{i},{date},1" for i, date in enumerate(dates)]
        lines = [f'{{"node":"a","sequence":{i},"time":"{date}","values":[1]}}' for i, date in enumerate(dates)]
        text = ["node,sequence,time,y", *rows] if ending == ".csv" else lines
        (tmp_path / f"t{ending}").write_text("\n".join(text))
        return h.files.read_messages(tmp_path / f"t{ending}", WALK)

    with pytest.raises(
        h.InputError, match=rf"t{ending}, a, column 'time': expected dates in UTC.* clocks are set back"
    ):
        read("2026-10-24T22:00")
    (note,) = read("2026-03-28T22:00").notes
    assert note.endswith(
        "a, column 'time': 2026-03-29T03:00:00 after 2026-03-29T01:50:00: clocks are set forward so when summer time "
        "begins; dates without a zone are taken as UTC"
    )
    for first in ("2026-10-24T22:00", "2026-03-28T22:00"):
        assert read(first, zone="Z").notes == []


def test_steps_that_are_rounded_by_the_size_of_their_times_are_said():
    """Nanoseconds since 1970 as doubles are multiples of 256: steps of 1000 were 1024, or 768, without a word."""
    k = np.arange(20)
    for times in (1.7e18 + 1000.0 * k, (1e6 + 0.2 * k).astype(np.float32), 1.7e9 + 1e-5 * k):
        with pytest.warns(UserWarning, match=r"column 'time': steps of .* they lost digits"):
            h.files.read_recording({"time": times, "y": np.ones(20)}, WALK)
    exact = (
        1.7e18 + 1e6 * k,
        (1e6 + k).astype(np.float32),
        1.7e9 + 0.01 * k,
        2.0**53 + 4 * k,
        k * 0.25,
        1e9 + 0 * k[:1],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for times in exact:
            h.files.read_recording({"time": times, "y": np.ones(len(times))}, WALK)


@pytest.mark.parametrize(
    ("times", "date"),
    [
        (("20200130", "20200131", "20200201"), "2020-01-30"),
        (("202001302359", "202001310000"), "2020-01-30T23:59"),
        (("20200130235959", "20200131000000"), "2020-01-30T23:59:59"),
        (("20200130", "20200132"), None),  # a count
        (("20200130",), None),
    ],
)
def test_dates_written_as_numbers_are_said(tmp_path, times, date):
    """From 30 to 31 January is 1, and from there to 1 February 70."""
    (tmp_path / "compact.csv").write_text("time,y\n" + "".join(f"{time},1\n" for time in times))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        h.files.read_recording(tmp_path / "compact.csv", WALK)
    texts = [str(warning.message) for warning in said]
    found = [text for text in texts if "read as dates without separators" in text]
    assert len(found) == (date is not None) and all(text.endswith(f"a date is written as {date}") for text in found)


@pytest.mark.parametrize("times", [(1.7e9, 1.7e9 + 1, 1.7e12 + 2000), (1.7e12, 1.7e15 + 1e6), (1e8, 1.5e10)])
def test_two_units_in_one_column_of_times_are_said(tmp_path, times):
    """A clock that has counted for years does not count for a hundred times as long in one row."""
    rows = [repr(int(time)) for time in times]
    (tmp_path / "mixed.csv").write_text("time,y\n" + "".join(f"{time},1\n" for time in rows))
    with pytest.warns(
        UserWarning, match=rf"row {len(rows)}, column 'time': .* seconds and milliseconds, or such, in one"
    ):
        h.files.read_recording(tmp_path / "mixed.csv", WALK)
    lines = [f"node,{i},{time},1\n" for i, time in enumerate(rows)]
    (tmp_path / "events.csv").write_text("node,sequence,time,y\n" + "".join(lines))
    drift = h.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], inputs=["dt"])
    network = h.Network(drift, {"node": h.Node(h.LinearSensor([[1.0]], 0.1, ["y"]), h.perfect(), {})})
    notes = h.files.read_messages(tmp_path / "events.csv", network).notes
    assert sum("seconds and milliseconds, or such, in one column" in note for note in notes) == 1


@pytest.mark.parametrize("times", [(0.0, 1e-3, 1e6), (1.7e9, 1.8e9), (5.0, 1.7e9)])
def test_one_unit_is_not_taken_for_two(tmp_path, times):
    (tmp_path / "one.csv").write_text("time,y\n" + "".join(f"{time!r},1\n" for time in times))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        h.files.read_recording(tmp_path / "one.csv", WALK)


def test_nanoseconds_keep_their_digits_also_with_a_point(tmp_path):
    """As text with .0 they were doubles, 256 apart: steps of 100 were 0 and 256."""
    times = [f"{1_700_000_000_000_000_123 + 100 * i}.0" for i in range(4)]
    drift = h.LinearPlant([[1.0]], 0.1, [0.0], 1.0, [[0.0]], inputs=["dt"])
    network = h.Network(drift, {"node": h.Node(h.LinearSensor([[1.0]], 0.1, ["y"]), h.perfect(), {})})
    (tmp_path / "rows.csv").write_text("time,y\n" + "".join(f"{time},1\n" for time in times))
    (tmp_path / "events.csv").write_text(
        "node,sequence,time,y\n" + "".join(f"node,{i},{time},1\n" for i, time in enumerate(times))
    )
    for steps in (
        h.files.read_recording(tmp_path / "rows.csv", network).inputs,
        h.files.read_messages(tmp_path / "events.csv", network).recording().inputs,
    ):
        assert steps[:, 0].tolist() == [0, 100, 100, 100]


def test_doubled_columns_are_refused_at_every_door(tmp_path):
    line = "expected distinct columns, got 'y' more than once"
    with pytest.raises(ValueError, match=line):
        h.files.read_recording(pd.DataFrame([[0, 1, 2]], columns=["time", "y", "y"]), WALK)
    (tmp_path / "rows.csv").write_text("time,y,y\n0,1,2\n")
    with pytest.raises(ValueError, match=line):
        h.files.read_recording(tmp_path / "rows.csv", WALK)
    (tmp_path / "events.csv").write_text("node,sequence,time,y,y\na,0,0,1,2\n")
    with pytest.raises(ValueError, match=line):
        h.files.read_messages(tmp_path / "events.csv", WALK)
    names = ["node", "sequence", "time", "y", "y"]
    columns = [pa.array(c) for c in (["a"], [0], [0.0], [1.0], [2.0])]
    pq.write_table(pa.Table.from_arrays(columns, names=names), tmp_path / "events.parquet")
    with pytest.raises(ValueError, match=line):
        h.files.read_messages(tmp_path / "events.parquet", WALK)


@pytest.mark.parametrize("name", ["a\tb", "a\nb", "y ", " y", "=y", "y (m)"])
def test_names_of_any_characters_are_read_as_they_were_written(tmp_path, name):
    network = h.Network(WALK.plant, {"a": h.Node(h.Sensor(lambda x: x, 0.04, outputs=[name]), h.perfect(), {})})
    recording = h.files.read_recording({"time": [0.0, 1.0], name: [1.0, np.nan]}, network)
    for kind in ("csv", "parquet"):
        h.files.write_recording(recording, network, tmp_path / f"r.{kind}")
        assert h.files.read_recording(tmp_path / f"r.{kind}", network) == recording


def test_thousands_and_decimals_are_told_from_dates():
    with pytest.raises(ValueError, match="column 'y': expected numbers or dates, got '1,120'"):
        h.files.read_recording({"time": [0.0], "y": ["1,120"]}, WALK)


STAMPS = [1_700_000_000_000_000_000 + 100 * k for k in range(5)]  # doubles are 256 apart here


@pytest.mark.parametrize(
    "time",
    [
        np.array(STAMPS, dtype=np.uint64),
        np.array(STAMPS, dtype=object),
        np.ma.array(STAMPS, mask=False),
        pd.array(STAMPS, dtype="Int64"),
        pd.array(STAMPS, dtype="UInt64"),
        pd.Series(STAMPS, dtype=object),
        pa.array(STAMPS, pa.uint64()),
    ],
)
def test_stamps_in_nanoseconds_keep_their_digits(time):
    measured = read_recording({"time": time, "pos": [1.0, 2, 3, 4, 5]}, network({"a": ("pos",)}))
    np.testing.assert_array_equal(measured.inputs[:, 0], [0, 100, 100, 100, 100])
    assert measured.time.tolist() == STAMPS
