"""`heliograph run` and `inspect` on bags: estimates in tables and in MCAP, what is listed, what is refused."""

import json
import re

import numpy as np
import pytest

pytest.importorskip("rosbags")
from rosbags.highlevel import AnyReader

import heliograph as hg
from heliograph import cli
from heliograph.files.bags.estimates_writer import Pose, find_pose_states
from tests.files import bags

RUN = ["run", "net.py", "--measurements", "drive/drive.mcap"]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "net.py").write_text(bags.NETWORK)
    bags.write(tmp_path / "drive", bags.Drive(40).messages())
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_estimates_go_back_into_a_bag(folder, capsys):
    """Each row's odometry has the mean and the covariance of the table, at the time of measuring."""
    assert cli.main([*RUN, "--out", "out.csv"]) == 0 and cli.main([*RUN, "--out", "out.mcap"]) == 0
    said = capsys.readouterr().out
    assert "gps: 40 used" in said and "not among the sources: /picture (4)" in said
    table = hg.files.read_table("out.csv")
    with AnyReader([folder / "out.mcap"]) as reader:
        item = next(c for c in reader.connections if c.topic == "/gps/filter/odometry")
        rows = [(logged, reader.deserialize(data, item.msgtype)) for _, logged, data in reader.messages([item])]
        assert {c.topic for c in reader.connections} >= {"/gps/filter/x", "/gps/filter/vx/sd"}
    assert [at for at, _ in rows] == (bags.START + np.arange(40) * 10**8).tolist()
    assert [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in rows] == [at for at, _ in rows]
    np.testing.assert_array_equal([m.pose.pose.position.x for _, m in rows], table["x"])
    np.testing.assert_array_equal([m.twist.twist.linear.x for _, m in rows], table["vx"])
    # The table has deviations: squared again, to rounding.
    np.testing.assert_allclose([m.pose.covariance[0] for _, m in rows], table["x.sd"] ** 2, rtol=1e-14)
    assert all(not m.pose.covariance[1:].any() for _, m in rows)


@pytest.mark.slow
def test_a_bag_has_the_same_rows_where_later_data_count(folder, capsys):
    assert cli.main([*RUN, "--out", "plain.csv"]) == 0
    assert cli.main([*RUN, "--out", "out.csv", "--smooth", "all", "--lag", "1"]) == 0
    plain, table = hg.files.read_table("plain.csv"), hg.files.read_table("out.csv")
    assert table["smoothed.x"].shape == (40,) and table["time"].tolist() == plain["time"].tolist()
    np.testing.assert_allclose(table["x"], plain["x"], rtol=1e-12)  # compiled apart: rounding
    assert len(hg.files.read_table("out.lagged.csv")["x"]) > 0


def test_a_file_without_sources_says_how_to_get_them(folder, capsys):
    (folder / "net.py").write_text(bags.NETWORK.replace("sources =", "others ="))
    assert cli.main([*RUN, "--out", "out.csv"]) == 2
    assert re.search(r"network net.py: expected sources, .*heliograph inspect .*, got none", capsys.readouterr().err)
    assert not (folder / "out.csv").exists()


def test_a_message_that_cannot_be_read_is_refused_alone(folder, capsys):
    messages = bags.Drive(40).messages()
    messages[30] = (*messages[30][:1], "/odometry", bags.ODOMETRY, bags.odometry(0, 1.0))
    bags.write(folder / "bad", messages)
    assert cli.main(["run", "net.py", "--measurements", "bad/bad.mcap", "--out", "out.csv"]) == 0
    said = capsys.readouterr().err
    assert re.search(
        r"warning: .*: 1; bad/bad.mcap, message \d+, logged at .*Z, /odometry, field 'header.stamp': expected", said
    )
    assert len(hg.files.read_table("out.csv")["x"]) == 39
    assert cli.main(["run", "net.py", "--measurements", "bad/bad.mcap", "--out", "out.csv", "--strict"]) == 2


def test_inspect_lists_topics_and_suggests_sources(folder, capsys):
    assert cli.main(["inspect", "drive/drive.mcap", "--network", "net.py"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"/odometry +nav_msgs/msg/Odometry +40 ", said) and "# gps: position" in said
    assert "time='header.stamp'" in said and "'linear.x', node='NODE'" in said
    scope: dict[str, object] = {"hg": hg}
    exec(said[said.index("sources = {") :], scope)  # what it suggests is Python that runs
    assert set(scope["sources"]) == {"/odometry", "/acceleration", "/picture"}
    assert cli.main(["inspect", "none.mcap"]) == 2
    assert "none.mcap: expected a bag, got nothing of that name" in capsys.readouterr().err


def test_a_pose_takes_states_by_name():
    """A heading of 90 degrees turns about z; states that nobody names leave their axis at 0."""
    from heliograph.files.bags.estimates_writer import _convert_angles_to_quaternion

    assert find_pose_states(("x", "theta", "vyaw")).places(("x", "theta", "vyaw")) == (
        [0, None, None, None, None, None],
        [None, None, None, None, None, 2],
    )
    np.testing.assert_allclose(
        _convert_angles_to_quaternion(0.0, 0.0, np.pi / 2), [0, 0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-15
    )
    with pytest.raises(ValueError, match="pose: expected names of the states p, v, got 'x'"):
        Pose(x="x").places(("p", "v"))


def test_a_bag_of_another_hand(folder, capsys):
    """Written by mcap-ros2-support, which has a writer and an encoder of its own."""
    writing = pytest.importorskip("mcap_ros2.writer")
    definition = "std_msgs/Header header\ngeometry_msgs/Point point\n" + "".join(
        f"{'=' * 80}\nMSG: {name}\n{text}\n"
        for name, text in (
            ("std_msgs/Header", "builtin_interfaces/Time stamp\nstring frame_id"),
            ("builtin_interfaces/Time", "int32 sec\nuint32 nanosec"),
            ("geometry_msgs/Point", "float64 x\nfloat64 y\nfloat64 z"),
        )
    )
    with open("other.mcap", "wb") as file, writing.Writer(file) as writer:
        schema = writer.register_msgdef("geometry_msgs/msg/PointStamped", definition)
        for k in range(20):
            at = bags.START + k * 10**8
            stamp = {"sec": at // 10**9, "nanosec": at % 10**9}
            message = {"header": {"stamp": stamp, "frame_id": "map"}, "point": {"x": 0.1 * k, "y": 0.0, "z": 0.0}}
            writer.write_message("/point", schema, message, at + 5 * 10**7, at + 5 * 10**7)
    network = hg.files.load_network("net.py")
    table = hg.files.read_messages(
        "other.mcap", network, {"/point": hg.files.json_field("point.x", "gps", time="header.stamp")}
    )
    events = list(table.sort_events())
    np.testing.assert_array_equal([e.values[0] for e in events], [0.1 * k for k in range(20)])
    np.testing.assert_allclose(table.lateness()["gps"], 0.05, rtol=1e-12)


@pytest.mark.slow
def test_the_noise_of_a_bag_is_learned(folder, capsys):
    """300 steps of a tenth of a second: the interval of the measurement's noise, 95 %, has the truth of 0.04 in it."""
    random = np.random.default_rng(3)
    x = np.cumsum(0.3 * random.standard_normal(300)) + 0.2 * random.standard_normal(300)
    times = bags.START + np.arange(300) * 10**8
    messages = [
        (t + 10**6, "/odometry", bags.ODOMETRY, bags.odometry(t, v)) for t, v in zip(times.tolist(), x, strict=True)
    ]
    bags.write(folder / "walk", messages)
    (folder / "free.py").write_text(
        "import heliograph as hg\n\ndef network():\n"
        "    plant = hg.LinearPlant([[1.0]], 0.09, [0.0], 1.0)\n"
        "    sensor = hg.LinearSensor([[1.0]], hg.free(0.1, 'noise'))\n"
        "    node = hg.Node(sensor, hg.perfect(), {'filter': hg.kalman_filter(plant, sensor)})\n"
        "    return hg.Network(plant, {'gps': node})\n\n"
        "sources = {'/odometry': hg.files.json_field('pose.pose.position.x', 'gps', time='header.stamp', step=0.1)}\n"
    )
    command = [
        "fit",
        "free.py:network",
        "--measurements",
        "walk/walk.mcap",
        "--out",
        "out",
        "--starts",
        "1",
        "--held-out",
        "0",
    ]
    assert cli.main(command) == 0, capsys.readouterr().err
    fitted = json.loads((folder / "out" / "fitted.json").read_text())
    (row,), (share,) = fitted["table"], fitted["delays"]["gps"]["shares"]
    assert row["low"] <= 0.04 <= row["high"] < 0.15
    assert (share["steps"], share["estimate"]) == (0, 1.0) and "gps: late by 0 s 1 (" in capsys.readouterr().out
    # The page's column has seconds, so its caption does not say steps.
    page = (folder / "out" / "report.html").read_text()
    assert "seconds late" in page and "on their way, to the nearest step" in page


def test_times_that_no_stamp_of_a_bag_can_say_are_one_line(tmp_path, monkeypatch, capsys):
    """Nanoseconds as whole numbers are taken for seconds: an error of struct; a date before 1970 was one of Python."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text("""import heliograph as hg
plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=["x"])
sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["z"])
network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})
""")
    for first, second in (("1700000000000000000", "1700000001000000000"), ("1960-01-01", "1960-01-02")):
        (tmp_path / "data.csv").write_text(f"time,z\n{first},1\n{second},2\n")
        assert cli.main(["run", "net.py", "--measurements", "data.csv", "--out", "out.mcap"]) == 2
        said = capsys.readouterr().err
        assert f"times of a bag: expected dates, or seconds since then, from 1970 to 2038, got {first}" in said
        assert not (tmp_path / "out.mcap").exists()
