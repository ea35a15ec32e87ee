"""Dates with zones and DataFrames in, dates out."""

from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.files.tables.table import read_table, write_table
from heliograph.numerics import check_dates, format_dates, parse_dates
from heliograph.serving import Message

PLANT = hg.Plant(lambda x, u: x + u[0], 0.1, [0.0], [[1.0]], states=["p"], inputs=["dt"])
SENSOR = hg.Sensor(lambda x: x, noise=0.1, outputs=["pos"])
NETWORK = hg.Network(
    PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {"f": hg.cubature_filter(PLANT, SENSOR, hg.perfect())})}
)
MOMENTS = st.datetimes(datetime(1700, 1, 1), datetime(2200, 1, 1))
ZONES = st.integers(-23 * 60, 23 * 60).map(lambda minutes: timezone(timedelta(minutes=minutes)))


@settings(max_examples=100, derandomize=True)
@given(moment=MOMENTS, zone=ZONES, space=st.booleans())
def test_a_date_is_the_instant_that_python_says(moment, zone, space):
    aware = moment.replace(tzinfo=zone)
    text = aware.isoformat(sep=" " if space else "T")
    (result,) = parse_dates([text], "time")
    expected = np.datetime64(aware.astimezone(UTC).replace(tzinfo=None), "ns")
    assert result == expected and parse_dates([aware], "time")[0] == expected
    assert parse_dates(format_dates(np.array([result])), "time")[0] == result


def test_what_else_is_a_date_and_what_is_none():
    result = parse_dates(["2026-11-21T23:25:00.123456789Z", "2026-11-21 23:25:00.5UTC", "2026-11-22T01:25+02"], "time")
    assert [str(t) for t in result] == [
        "2026-11-21T23:25:00.123456789",
        "2026-11-21T23:25:00.500000000",
        "2026-11-21T23:25:00.000000000",
    ]
    assert (
        parse_dates(["2026-11-21"], "time")[0] == np.datetime64("2026-11-21")
        and np.isnat(parse_dates(["", None], "time")).all()
    )
    assert parse_dates(["1969-12-31T23:59:59.999999999"], "time").astype(int)[0] == -1
    for wrong in ("2026-13-01", "2026-11-21T25:00", "1600-01-01", "21.11.2026", "2026-11-21T23:25+99:00", "today"):
        with pytest.raises(ValueError, match=r"time, row 1: expected a date as 2026-11-21T23:25:00\+01:00, .* got"):
            parse_dates([wrong], "time")
    with pytest.raises(ValueError, match="row 2: expected a zone with every date or with none"):
        parse_dates(["2026-11-21T00:00Z", "2026-11-21T01:00"], "time")


def test_seconds_between_dates_lose_nothing():
    time = np.datetime64("2026-11-21T23:25:00", "ns") + np.array([0, 1, 1_000_000_001]) * np.timedelta64(1, "ns")
    for moments, expected in ((time, [0, 1e-9, 1.0]), (np.array([3.0, 3.5]), [0, 0.5])):
        recording = hg.files.read_recording({"time": moments, "pos": np.zeros(len(moments))}, NETWORK)
        np.testing.assert_array_equal(recording.inputs[:, 0], expected)  # dt


ACROSS_WINTER_TIME = ["2026-10-25T02:59:58+02:00", "2026-10-25T02:59:59+02:00", "2026-10-25T02:00:00+01:00"]


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_dates_pass_through_a_run(tmp_path, ending):
    (tmp_path / "in.csv").write_text("time,pos\n" + "".join(f"{t},{i}\n" for i, t in enumerate(ACROSS_WINTER_TIME)))
    recording = hg.files.read_recording(tmp_path / "in.csv", NETWORK)
    np.testing.assert_array_equal(recording.inputs[:, 0], [0, 1, 1])
    record = hg.run(NETWORK, *recording)
    assert record.time[2] == np.datetime64("2026-10-25T01:00:00")
    hg.files.write_estimates(record, tmp_path / f"out{ending}")
    np.testing.assert_array_equal(read_table(tmp_path / f"out{ending}")["time"], record.time)
    if ending == ".csv":
        assert (tmp_path / "out.csv").read_text().splitlines()[1].startswith("2026-10-25T00:59:58Z,")
    hg.files.write_recording(recording, NETWORK, tmp_path / f"again{ending}")
    assert hg.files.read_recording(tmp_path / f"again{ending}", NETWORK) == recording
    assert record.to_pandas().index[0] == pd.Timestamp("2026-10-25T00:59:58")
    record.save(tmp_path / "record.nc")
    assert hg.Record.open(tmp_path / "record.nc") == record


def test_dataframes_are_tables():
    numbers = {"time": [0.0, 0.5, 0.5], "pos": [1.0, np.nan, 3.0]}
    expected = hg.files.read_recording({k: np.array(v) for k, v in numbers.items()}, NETWORK)
    frame = pd.DataFrame(numbers)
    assert hg.files.read_recording(frame, NETWORK) == expected
    assert hg.files.read_recording(frame.set_index("time"), NETWORK) == expected
    assert hg.files.read_recording(frame.convert_dtypes(), NETWORK) == expected  # pandas's own missing values
    assert hg.files.read_recording(frame.astype(object).where(frame.notna(), None), NETWORK) == expected
    zoned = pd.DataFrame({"time": pd.to_datetime(ACROSS_WINTER_TIME, utc=True).tz_convert("Europe/Berlin"), "pos": 1.0})
    dated = hg.files.read_recording(zoned, NETWORK)
    assert dated.time[0] == np.datetime64("2026-10-25T00:59:58") and dated.inputs[2, 0] == 1
    assert hg.files.read_recording(zoned.assign(time=ACROSS_WINTER_TIME), NETWORK) == dated
    assert hg.files.read_recording(zoned.set_index("time"), NETWORK) == dated


class OfPolars:
    """The part of a polars DataFrame that is used: columns, and series that hand out arrays."""

    class Series(list):
        def to_numpy(self):
            return np.array(self)

    def __init__(self, **named):
        self.columns, self._named = list(named), named

    def __getitem__(self, name):
        return self.Series(self._named[name])


def test_other_frames_are_tables():
    table = OfPolars(time=np.array(["2026-11-21T23:25"], dtype="datetime64[us]"), pos=[3])
    result = hg.files.read_recording(table, NETWORK)
    assert result.time.dtype == "datetime64[ns]" and result.measurements["a"].dtype == np.float64


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (pd.DataFrame({0: [1.0]}), "columns: expected names that are text, got 0"),
        ({"time": ["one"]}, "column 'time': expected numbers or dates, got 'one'"),
        ({"time": [0.0], "pos": [1j]}, "column 'pos': expected numbers or dates"),
        ({"time": [0.0], "pos": [object()]}, "column 'pos': expected numbers or dates"),
        (3, "expected a file, a DataFrame, or a dictionary of columns, got 3"),
        ({"time": [0.0], "pos": pd.to_datetime(["2026-11-21"])}, "column 'pos': expected numbers, got dates"),
        (
            {"time": pd.to_datetime(["2026-11-21", "2026-11-20"]), "pos": [0, 0]},
            "2026-11-20T00:00:00.000000000 after 2026",
        ),
        ({"time": pd.to_datetime(["2026-11-21", None]), "pos": [0, 0]}, "row 2, column 'time': expected a date"),
    ],
)
def test_tables_that_are_none(table, words):
    with pytest.raises(ValueError) as raised:
        hg.files.read_recording(table, NETWORK)
    assert words in str(raised.value) and "\n" not in str(raised.value)


def test_times_of_a_run_may_be_dates_that_do_not_go_backwards():
    time = np.array(["2026-11-21", "2026-11-20"], dtype="datetime64[s]")
    for wrong in (time, time[:1], np.array(["2026-11-21", "NaT"], dtype="datetime64[s]")):
        with pytest.raises(ValueError, match="time: expected"):
            hg.run(NETWORK, {"a": [1.0, 2.0]}, [[0.0], [1.0]], wrong)


@settings(max_examples=30, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    values=st.lists(st.floats(allow_infinity=False), min_size=1, max_size=5),
    ending=st.sampled_from([".csv", ".parquet"]),
)
def test_a_recording_comes_back_bit_for_bit(values, ending, tmp_path):
    time, z = np.arange(len(values)) / 3, np.array(values)
    recording = hg.files.Recording({"a": z[:, None]}, time[:, None], time)
    hg.files.write_recording(recording, NETWORK, tmp_path / f"recording{ending}")
    result = hg.files.read_recording(tmp_path / f"recording{ending}", NETWORK)
    assert (
        result == recording
        and np.signbit(result.measurements["a"])[~np.isnan(z)].tolist() == np.signbit(z[~np.isnan(z), None]).tolist()
    )


def test_a_column_of_dates_in_a_table_is_dates(tmp_path):
    (tmp_path / "t.csv").write_text("when,x\n2026-11-21,1\n,2\n")
    result = read_table(tmp_path / "t.csv")
    assert np.isnat(result["when"][1]) and result["x"].tolist() == [1, 2]
    write_table(result, tmp_path / "u.parquet")
    np.testing.assert_array_equal(read_table(tmp_path / "u.parquet")["when"], result["when"])


FIRST, LAST = "1678-01-01T00:00:00Z", "2262-04-11T23:47:16.854775807Z"  # the last one in 64 bits of nanoseconds


@pytest.mark.parametrize("ending", [".csv", ".parquet"])
def test_all_dates_that_are_written_are_read(tmp_path, ending):
    dates = np.array([FIRST[:-1], "2262-01-01", "2262-04-11T23:47:16", LAST[:-1]], "datetime64[ns]")
    write_table({"time": dates, "pos": np.arange(4.0)}, tmp_path / f"t{ending}")
    np.testing.assert_array_equal(read_table(tmp_path / f"t{ending}")["time"], dates)


@pytest.mark.parametrize("text", [FIRST, LAST, "2262-04-12T01:00:00+02:00", "1677-12-31T20:00:00-04:00", "2262-04-11"])
def test_dates_up_to_the_ends_of_64_bits_are_read(text):
    (moment,) = parse_dates([text], "time")
    zone = text[-6:] if text[-6] in "+-" and text[-3] == ":" else "+00:00"
    local = np.datetime64(text.removesuffix(zone).removesuffix("Z"), "us")
    behind = np.timedelta64(int(zone[:3]) * 60, "m")
    assert moment.astype("datetime64[us]") == local - behind
    for unit in ("us", "ms", "s"):  # the same rule for arrays: dates in this unit within the ends
        date = moment.astype(f"datetime64[{unit}]")
        assert check_dates("time", np.array([date]))[0] == date


@pytest.mark.parametrize("text", ["1677-12-31T23:59:59.999999999Z", "2262-04-11T23:47:16.854775808Z",
                                  "2262-04-11T23:00:00-01:00", "1678-01-01T00:00:00+01:00", "2262-04-12"])  # fmt: skip
def test_dates_beyond_64_bits_are_refused_at_every_door(text):
    expected = "from 1678 to 2262-04-11"
    with pytest.raises(ValueError, match=f"^time, row 1: expected a date as .*{expected}, to the nanosecond"):
        parse_dates([text], "time")
    if text.endswith("Z"):
        with pytest.raises(ValueError):
            Message(node="a", sequence=0, time=text)
    for unit, beyond in (("Y", "1677"), ("M", "2262-05"), ("D", "2262-04-12"), ("us", "1677-12-31T23:59:59.999999"),
                         ("us", "2262-04-11T23:47:16.854776"), ("W", "2262-04-17"), ("s", "1500-01-01"),
                         ("ns", "1677-12-31")):  # fmt: skip
        with pytest.raises(ValueError, match=f"^time: expected dates {expected}, got {beyond[:4]}"):
            check_dates("time", np.array([beyond, "NaT"], f"datetime64[{unit}]"))


@settings(max_examples=100, derandomize=True)
@given(moment=MOMENTS, zone=ZONES, space=st.booleans())
def test_an_instant_is_the_date_that_python_says(moment, zone, space):
    aware = moment.replace(tzinfo=zone)
    text = aware.isoformat(sep=" " if space else "T")
    assert Message(node="a", sequence=0, time=text).time == aware


@pytest.mark.parametrize(
    "text", ["0.1", "1e9", "", "2026-11-21T10:00:00", "2026-11-21", "0001-01-01T00:00+10:00", "9999-12-31T23:59-10:00",
             "2026-13-01T00:00Z", "2026-11-21T25:00Z", "2026-11-21T10:00:00+99:00", "20261121T1000",
             "2026-11-21T10:00:60Z", "nan"]
)  # fmt: skip
def test_no_other_text_is_an_instant(text):
    with pytest.raises(ValueError):
        Message(node="a", sequence=0, time=text)


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("20261121T100000Z", "2026-11-21T10:00:00Z"),
        ("20261121t100000.123456789+0100", "2026-11-21T09:00:00.123456789Z"),
        ("20261121T1000", "2026-11-21T10:00"),
        ("2016-12-31T23:59:60Z", "2017-01-01T00:00:00Z"),  # leap seconds are the second after them
        ("2016-12-31T23:59:60.25Z", "2017-01-01T00:00:00.25Z"),
        ("2017-01-01T00:59:60+01:00", "2017-01-01T00:00:00Z"),
    ],
)
def test_basic_dates_and_leap_seconds_are_read(text, same):
    assert parse_dates([text], "time") == parse_dates([same], "time")
    if text[-5:] != "T1000":  # without a zone it is no instant
        first, second = (Message(node="a", sequence=0, time=moment).time for moment in (text, same))
        assert first == second


@pytest.mark.parametrize("text", ["2016-12-31T22:59:60Z", "2016-12-30T23:59:60Z", "2016-12-31T23:59:60.1234567891Z"])
def test_other_sixtieth_seconds_and_finer_than_nanoseconds_are_refused(text):
    with pytest.raises(
        ValueError, match=r"^time, row 1: expected a date as .*, from 1678 to 2262-04-11, to the nanosecond"
    ):
        parse_dates([text], "time")


def test_text_among_numbers_is_no_number():
    table = {"time": np.arange(2.0), "pos": np.array([1.0, "2.0"], dtype=object)}
    with pytest.raises(ValueError, match=r"column 'pos': expected numbers or dates, got '2\.0'"):
        hg.files.read_recording(table, NETWORK)


def test_missing_dates_are_said_where_each_row_is_a_step():
    """Yearly flows without twenty years; with the input dt they are 21 years, and with all rows nothing is missing."""
    years = np.array([year for year in range(1871, 1971) if not 1900 <= year <= 1919])
    plant, sensor = hg.LinearPlant([[1.0]], 1469.0, [1000.0], 1e6), hg.LinearSensor([[1.0]], 15099.0)
    walk = hg.LinearPlant([[1.0]], lambda u: 1469.0 * u[0].reshape(1, 1), [1000.0], 1e6, inputs=["dt"])
    z, dates = np.full(80, 900.0), (years - 1970).astype("datetime64[Y]")

    def network(plant):
        return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})

    for time, said in ((dates, "steps of 1 and 21 years"), (years.astype(float), "steps of 1 and 21:")):
        with pytest.warns(UserWarning, match=f"time: {said}.* a plant without the input dt takes each for one"):
            hg.run(network(plant), {"a": z}, time=time)
    hg.run(network(plant), {"a": np.zeros(100)}, time=np.arange(1871, 1971))
    hg.run(network(walk), {"a": z}, np.diff(years, prepend=1870)[:, None], time=dates)
