"""Logs of vehicles, read by their sources: the same values at the same moments, whatever recorded them."""

import time

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from tests.files import logs

RESOLUTION = 0.005 / 3.6  # half a step of the signal, in m/s


@pytest.fixture
def drive(tmp_path):
    """Write the drive in a format; return it with its sources."""

    def write(kind, **given):
        path = tmp_path / f"drive{kind[-4:]}"
        if kind == "signals.mf4":
            return logs.write_mdf(path), hg.files.LogSources({"WheelSpeeds": logs.wheel()}, **given)
        if kind == ".ulg":
            return logs.write_ulog(path), hg.files.LogSources({"WheelSpeeds": logs.wheel()}, **given)
        sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()}, dbc=logs.database(tmp_path), **given)
        return logs.write_frames(path), sources

    return write


def recorded(path, sources):
    events = hg.files.read_messages(path, logs.car(), sources)
    return events, events.columns["wheel"].arrays()[0], np.array([event.values[0] for event in events.sort_events()])


KINDS = (".blf", ".asc", ".log", "frames.mf4", "signals.mf4", ".ulg")


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_times_are_those_that_were_recorded(drive, kind):
    """Values to the resolution of the signal; times to a microsecond (ASC: its date is that of the local clock)."""
    events, time, values = recorded(*drive(kind))
    assert np.abs(values - logs.SPEED / 3.6).max() < RESOLUTION
    moments = (time - time[0]) / 1e9 if kind == ".asc" else time / 1e9 - logs.START
    assert np.abs(moments - logs.TIME).max() < 1.1e-6
    assert any("WheelSpeeds.FrontLeft in km/h" in note for note in events.notes) == (kind != ".ulg")


@pytest.mark.parametrize("kind", KINDS)
def test_a_start_is_the_date_of_the_logs_begin(drive, kind):
    path, sources = drive(kind, start="2020-01-01T01:00:00+01:00")
    _, time, _ = recorded(path, sources)
    assert abs(time[0] / 1e9 - 1_577_836_800 - (logs.START - logs.find_begin(path))) < 1.1e-6


def test_a_latency_of_a_source_moves_its_measurements_and_not_their_arrival(tmp_path):
    path = logs.write_frames(tmp_path / "drive.blf")
    late = logs.wheel(time=hg.files.Stamp("timestamp", offset=-0.08))
    sources = hg.files.LogSources({"WheelSpeeds": late}, dbc=logs.database(tmp_path))
    events = hg.files.read_messages(path, logs.car(), sources)
    assert np.allclose(events.lateness()["wheel"], 0.08, rtol=0, atol=2e-6)


WORDS = """VERSION ""
BU_: ECU
BO_ 416 WheelSpeeds: 4 ECU
 SG_ FrontLeft : 0|16@1+ (0.01,0) [0|655.35] "km/h" ECU
 SG_ Signed : 16|8@1- (0.5,0) [-60|60] "m/s2" ECU
 SG_ Gear : 24|3@1+ (1,0) [0|7] "" ECU
VAL_ 416 FrontLeft 0 "standstill" 65534 "error" 65535 "SNA" ;
VAL_ 416 Signed -128 "SNA" 125 "init" ;
VAL_ 416 Gear 0 "park" 7 "reverse" ;
"""


@pytest.mark.parametrize(
    ("signal", "raw", "right", "said"),
    [
        (
            "FrontLeft",
            [0, 100, 65534, 65535, 65535],
            [0.0, 1.0],
            "FrontLeft 'error' (1), WheelSpeeds.FrontLeft 'SNA' (2)",
        ),
        ("Signed", [-127, -128, 125, 120, 0], [-63.5, 60.0, 0.0], "Signed 'SNA' (1), WheelSpeeds.Signed 'init' (1)"),
        ("Gear", [0, 1, 7, 2, 3], [0.0, 1.0, 7.0, 2.0, 3.0], None),
    ],
)
def test_a_value_that_the_database_names_as_a_word_is_no_number(tmp_path, signal, raw, right, said):
    """At the end of what the bits hold, or beyond the range; 655.35 km/h was used. A gear is one, by any name."""
    shift, mask = {"FrontLeft": (0, 0xFFFF), "Signed": (16, 0xFF), "Gear": (24, 7)}[signal]
    data = [((value & mask) << shift).to_bytes(4, "little") for value in raw]
    path = logs.write_frames(tmp_path / "drive.blf", [logs.frame(k, each) for k, each in enumerate(data)])
    field = hg.files.json_field(signal, node="wheel")
    sources = hg.files.LogSources({"WheelSpeeds": field}, dbc=logs.database(tmp_path, WORDS))
    events = hg.files.read_messages(path, logs.car(), sources)
    values = [event.values[0] for event in events.sort_events()]
    np.testing.assert_allclose([value for value in values if value == value], right, rtol=1e-12)
    assert [f"WheelSpeeds.{said}" in note for note in events.notes if "in place of numbers" in note] == [True] * bool(
        said
    )


def test_a_counter_of_four_bits_counts_what_was_lost_across_its_end(tmp_path):
    kept = [logs.frame(k) for k in range(logs.COUNT) if k not in (15, 16, 30)]
    path = logs.write_frames(tmp_path / "drive.blf", kept)
    counted = logs.wheel(sequence=hg.files.Count("Counter", bits=4))
    sources = hg.files.LogSources({"WheelSpeeds": counted}, dbc=logs.database(tmp_path))
    _, lost = hg.files.read_messages(path, logs.car(), sources).judge()
    assert lost == {"wheel": 3}


def test_samples_that_a_file_marks_as_invalid_did_not_arrive(tmp_path):
    path = logs.write_mdf(tmp_path / "drive.mf4", invalid=[3, 4])
    _, _, values = recorded(path, {"WheelSpeeds": logs.wheel()})
    assert np.flatnonzero(np.isnan(values)).tolist() == [3, 4]


def test_signals_of_one_name_are_both_there(tmp_path):
    """Two of one name in a group: the file was called no MDF4 file, whatever was read of it."""
    asammdf = pytest.importorskip("asammdf", reason="the extra `mdf`")
    path, seconds = tmp_path / "twice.mf4", np.arange(logs.COUNT) / 10
    file = asammdf.MDF(version="4.10")
    signals = [asammdf.Signal(seconds + shift, seconds, name="FrontLeft", unit="km/h") for shift in (0.0, 100.0)]
    file.append(signals, acq_name="WheelSpeeds")
    file.save(path)
    for field, first in (("FrontLeft", 0.0), ("FrontLeft 2", 100.0)):
        source = hg.files.json_field(field, node="wheel", output="speed")
        _, _, values = recorded(path, {"WheelSpeeds": source})
        assert values[0] == first and np.isfinite(values).all()


def test_a_log_without_a_date_begins_in_1970(tmp_path):
    path = logs.write_ulog(tmp_path / "drive.ulg", date=False)
    _, time, _ = recorded(path, {"WheelSpeeds": logs.wheel(time="timestamp")})
    assert time[0] == 7_000_000_000


def test_error_and_short_frames_are_left_out_and_counted(tmp_path):
    frames = [logs.frame(k) for k in range(logs.COUNT)]
    frames[5] = logs.frame(5, bytes(4))
    frames.append(logs.frame(39, b"", is_error_frame=True))
    path = logs.write_frames(tmp_path / "drive.blf", frames)
    dbc = logs.database(tmp_path)
    sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()}, dbc=dbc)
    events, time, _ = recorded(path, sources)
    assert len(time) == logs.COUNT - 1 and events.refused == 1
    assert events.reasons == [f"{path}, frame 6, WheelSpeeds: expected 8 bytes, as {dbc} has it, got 4"]
    assert f"{path}: frames left out: error (1)" in events.notes


def test_a_log_that_ends_in_the_middle_is_used_up_to_there(tmp_path):
    path = logs.write_frames(tmp_path / "drive.asc")
    text = path.read_text().splitlines()
    path.write_text("\n".join([*text[:20], "0.9 1 xyz Rx d 8 zz", *text[20:]]))
    sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()}, dbc=logs.database(tmp_path))
    events, time, _ = recorded(path, sources)
    assert 0 < len(time) < logs.COUNT and "expected a log without damage" in events.broken


def mistake(path, sources):
    with pytest.raises(ValueError) as caught:
        hg.files.read_messages(path, logs.car(), sources)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_mistakes_name_file_signal_and_remedy(tmp_path):
    path, dbc = logs.write_frames(tmp_path / "drive.blf"), logs.database(tmp_path)

    def given(table, **more):
        return hg.files.LogSources(table, **({"dbc": dbc} | more))

    place = f"{path} by {dbc}"
    seen = f"heliograph inspect {path} lists what there is"
    assert mistake(path, given({"WheelSpeds": logs.wheel()})) == (
        f"{place}: expected a message 'WheelSpeds' of the sources, "
        f"got none of that name (closest: 'WheelSpeeds'); {seen}"
    )
    assert mistake(path, given({"WheelSpeeds": logs.wheel("FrontRight")})) == (
        f"{place}, WheelSpeeds: expected a signal 'FrontRight' of the sources, "
        f"got none of that name (closest: 'FrontLeft'); {seen}"
    )
    assert "dbc= of LogSources names their database" in mistake(path, given({"WheelSpeeds": logs.wheel()}, dbc=None))
    assert mistake(path, given({"Imu": logs.wheel("YawRate")})) == (
        f"{path}: expected a frame of Imu (0x1a1), got only 0x1a0; another database, or another bus (channel=)?"
    )
    assert "channel" in mistake(path, given({"WheelSpeeds": logs.wheel()}, channel=3))
    assert "expected a file, got nothing of that name" in mistake(tmp_path / "none.blf", given({}))
    short = logs.database(tmp_path / "..", logs.DBC.replace("WheelSpeeds: 8", "WheelSpeeds: 12"))
    assert mistake(path, given({"WheelSpeeds": logs.wheel()}, dbc=short)) == (
        f"{path}, WheelSpeeds: expected frames of 12 bytes, as {short} has it, "
        "got 40 of 8; another database, or another bus (channel=)?"
    )


def test_a_message_of_two_buses_needs_its_channel(tmp_path):
    frames = [logs.frame(k, channel=k % 2) for k in range(logs.COUNT)]
    path, dbc = logs.write_frames(tmp_path / "drive.blf", frames), logs.database(tmp_path)
    table = {"WheelSpeeds": logs.wheel()}
    assert "expected one bus, which channel= of LogSources" in mistake(path, hg.files.LogSources(table, dbc=dbc))
    events, time, _ = recorded(path, hg.files.LogSources(table, dbc=dbc, channel=1))
    assert len(time) == 20 and f"{path}: frames left out: of channel 0 (20)" in events.notes


def test_a_log_of_candump_is_known_by_its_first_line_and_its_buses_have_names(tmp_path, capsys):
    """Bus 0 is can0. Before, the lines were read as messages of MQTT, each moment a topic."""
    frames = [logs.frame(k, channel=k % 2) for k in range(logs.COUNT)]
    path, dbc = logs.write_frames(tmp_path / "candump-2026-09-21.log", frames), logs.database(tmp_path)
    table = {"WheelSpeeds": logs.wheel()}
    events, time, values = recorded(path, hg.files.LogSources(table, dbc=dbc, channel="can1"))
    assert f"{path}: frames left out: of channel can0 (20)" in events.notes
    assert np.abs(values - logs.SPEED[1::2] / 3.6).max() < RESOLUTION
    assert np.abs(time / 1e9 - logs.START - logs.TIME[1::2]).max() < 1.1e-6
    assert cli.main(["inspect", str(path), "--dbc", str(dbc)]) == 2
    assert "(--channel of heliograph inspect) names, got ['can0', 'can1']" in capsys.readouterr().err
    assert cli.main(["inspect", str(path), "--dbc", str(dbc), "--channel", "can1"]) == 0
    assert " 20 " in capsys.readouterr().out


@pytest.mark.parametrize("ending", [".blf", ".asc", ".mf4", ".ulg"])
def test_a_file_that_is_none_is_one_line(tmp_path, ending):
    logs.write_frames(tmp_path / "there.mf4"), logs.write_ulog(tmp_path / "there.ulg")
    path = tmp_path / f"drive{ending}"
    path.write_bytes(b"not a log\n" * 20)
    assert str(path) in mistake(path, {"WheelSpeeds": logs.wheel()})


def test_sources_of_a_log_are_checked():
    for given, words in (
        ({"sources": [1]}, "LogSources, sources"),
        ({"sources": {}, "start": "2026-09-27"}, "LogSources, start"),
        ({"sources": {}, "channel": -1}, "LogSources, channel"),
        ({"sources": {}, "dbc": 3}, "LogSources, dbc"),
    ):
        with pytest.raises(ValueError, match=words):
            hg.files.LogSources(**given)


@pytest.mark.parametrize("kind", KINDS)
def test_inspect_lists_signals_with_rate_gap_and_unit(drive, kind, capsys):
    path, sources = drive(kind)
    assert cli.main(["inspect", str(path), *(["--dbc", str(sources.dbc)] if sources.dbc else [])]) == 0
    said = capsys.readouterr().out
    assert "WheelSpeeds" in said and "10 Hz" in said and "0.1 s" in said and "'FrontLeft'" in said
    assert ("# km/h" in said) == (kind != ".ulg")
    assert ("Count('Counter', bits=4)" in said) == (sources.dbc is not None)


def test_inspect_says_how_degrees_become_radians(tmp_path, capsys):
    path = logs.write_frames(tmp_path / "drive.blf")
    dbc = logs.database(tmp_path, logs.DBC.replace('"km/h"', '"deg"'))
    assert cli.main(["inspect", str(path), "--dbc", str(dbc)]) == 0
    assert "# deg (of an angle: scale=np.pi / 180)" in capsys.readouterr().out


def test_inspect_without_a_database_lists_identifiers_and_asks_for_it(tmp_path, capsys):
    assert cli.main(["inspect", str(logs.write_frames(tmp_path / "drive.blf"))]) == 0
    said = capsys.readouterr()
    assert "0x1a0" in said.out and "--dbc car.dbc" in said.err


@pytest.mark.parametrize("zone", ["UTC", "Asia/Tokyo"])
def test_a_date_without_a_zone_is_utc_wherever_it_is_read(tmp_path, monkeypatch, zone):
    pytest.importorskip("can", reason="the extra `can`")
    pytest.importorskip("cantools", reason="the extra `can`")
    path = tmp_path / "drive.asc"
    date = "Mon Sep 21 02:13:20.000 PM 2026"
    frames = "".join(f" {k / 10:.6f} 1  1A0             Rx   d 8 10 0E 0{k} 00 00 00 00 00\n" for k in range(9))
    header = f"date {date}\nbase hex  timestamps absolute\nno internal events logged\nBegin Triggerblock {date}\n"
    path.write_text(f"{header} 0.000000 Start of measurement\n{frames}End TriggerBlock\n")
    sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()}, dbc=logs.database(tmp_path))
    with monkeypatch.context() as there:
        there.setenv("TZ", zone)
        time.tzset()
        _, moments, _ = recorded(path, sources)
    time.tzset()
    assert np.abs(moments / 1e9 - logs.START - np.arange(9) / 10).max() < 1.1e-6
    # Times from event to event would need every event, also those that are no frames.
    path.write_text(path.read_text().replace("absolute", "relative"))
    assert "expected times from the log's begin" in mistake(path, sources)


def test_signals_that_a_multiplexed_frame_has_not_did_not_arrive(tmp_path):
    text = """VERSION ""
BU_: ECU
BO_ 2566834709 Wheel: 8 ECU
 SG_ Page M : 0|8@1+ (1,0) [0|255] "" ECU
 SG_ Speed m0 : 8|16@1+ (0.01,0) [0|655] "km/h" ECU
 SG_ Heat m1 : 8|16@1+ (0.1,0) [0|655] "degC" ECU
"""
    long = {"arbitration_id": 2566834709 & 0x1FFFFFFF, "is_extended_id": True}
    frames = [logs.frame(k, bytes([k % 2, 16, 14, 0, 0, 0, 0, 0]), **long) for k in range(10)]
    path = logs.write_frames(tmp_path / "drive.blf", frames)
    sources = hg.files.LogSources({"Wheel": logs.wheel("Speed")}, dbc=logs.database(tmp_path, text))
    _, _, values = recorded(path, sources)
    assert np.allclose(values[::2], 10.0) and np.isnan(values[1::2]).all()


@pytest.mark.parametrize("kind", [".blf", "signals.mf4", ".ulg"])
def test_several_logs_in_a_folder_are_one_recording(tmp_path, kind, capsys):
    """The drive in two files gives what one file gives."""
    dbc, folder = logs.database(tmp_path), tmp_path / "drives"
    folder.mkdir()

    def write(path, rows):
        if kind == ".blf":
            return logs.write_frames(path, [logs.frame(k) for k in range(logs.COUNT)[rows]])
        return (logs.write_mdf if kind == "signals.mf4" else logs.write_ulog)(path, rows=rows)

    sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()}, dbc=dbc if kind == ".blf" else None)
    whole, *_ = recorded(write(tmp_path / f"all{kind[-4:]}", slice(None)), sources)
    for name, rows in (("1", slice(0, 15)), ("2", slice(15, None))):
        write(folder / f"{name}{kind[-4:]}", rows)
    (folder / "notes.txt").write_text("rain")
    events = hg.files.read_messages(folder, logs.car(), sources)
    ours, theirs = events.recording(), whole.recording()
    np.testing.assert_array_equal(ours.measurements["wheel"], theirs.measurements["wheel"])
    np.testing.assert_allclose(ours.inputs, theirs.inputs, rtol=0, atol=2e-6)
    assert f"{folder}: not read beside logs: notes.txt" in events.notes
    assert cli.main(["inspect", str(folder), *(["--dbc", str(dbc)] if kind == ".blf" else [])]) == 0
    assert "WheelSpeeds" in capsys.readouterr().out
    with pytest.raises(ValueError, match="expected a message 'Yaw' of the sources"):
        hg.files.read_messages(folder, logs.car(), hg.files.LogSources({"Yaw": logs.wheel()}, dbc=sources.dbc))


@pytest.mark.parametrize(("units", "refused"), [(("km/h", "m/s"), True), (("km/h", ""), False)])
def test_a_unit_that_changes_from_log_to_log_is_refused(tmp_path, units, refused):
    """One scale for both would make one of them wrong by 3.6; a log that names no unit contradicts none."""
    for name, rows, unit in (("1", slice(0, 15), units[0]), ("2", slice(15, None), units[1])):
        logs.write_mdf(tmp_path / f"{name}.mf4", rows=rows, unit=unit)
    sources = hg.files.LogSources({"WheelSpeeds": logs.wheel()})
    if refused:
        with pytest.raises(ValueError, match="expected one unit of 'FrontLeft' in all logs, got km/h or m/s"):
            hg.files.read_messages(tmp_path, logs.car(), sources)
    else:
        notes = hg.files.read_messages(tmp_path, logs.car(), sources).notes
        assert any("WheelSpeeds.FrontLeft in km/h" in note for note in notes)
