"""What commands cost in processor time, each in a process of its own in which nothing is compiled yet."""

import json
import os
import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest

ROBOT = Path(__file__).resolve().parents[2] / "docs" / "robot.md"
SENDERS = """
import heliograph as hg

plant, sensor, link = hg.LinearPlant([[1.0]], 0.01, [20.0], 1.0), hg.LinearSensor([[1.0]], 0.04), hg.perfect()
trigger = hg.SendOnDelta(0.5, heartbeat=10)
node = hg.Node(sensor, link, {"k": hg.event_filter(plant, sensor, link, trigger)}, trigger=trigger)
network = hg.Network(plant, {f"n{i}": node for i in range(12)})
"""
pytestmark = pytest.mark.slow


def cost(folder, *command, sent=""):
    """Run a command; return the seconds of processor that it took, and its output."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, "-m", "heliograph", *command], cwd=folder, env=os.environ | {"XDG_CACHE_HOME": str(folder)},
        input=sent, capture_output=True, text=True, check=True,
    )  # fmt: skip
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done.stdout


@pytest.mark.skipif(not ROBOT.is_file(), reason="a source distribution has no docs")
def test_a_bag_of_fifteen_thousand_messages_of_six_nodes_has_its_page(tmp_path, monkeypatch):
    """The robot of the page, driven for three minutes."""
    pytest.importorskip("rosbags")
    monkeypatch.chdir(tmp_path)
    making, _, network, *_ = re.findall(r"```python\n(.*?)```", ROBOT.read_text(), re.DOTALL)
    scope = {}
    exec(making.replace("np.arange(0, 60, 0.02)", "np.arange(0, 190, 0.02)"), scope)
    exec(network.split("assert main")[0], scope)
    assert len(scope["messages"]) > 15_000
    run = ["run", "robot.py", "--measurements", "loop/loop.mcap", "--out", "out.csv", "--report", "page"]
    seconds, said = cost(tmp_path, *run)
    assert seconds < 20 and "robot" in said
    assert (tmp_path / "page" / "report.html").stat().st_size < 3e6


@pytest.mark.parametrize("time", [0.0, 100.0])
def test_twelve_event_senders_are_estimated(tmp_path, time):
    """From the start of the service to the last estimate of the first messages."""
    (tmp_path / "net.py").write_text(SENDERS)
    sent = (json.dumps({"node": f"n{i}", "sequence": 0, "time": time, "values": [20.0]}) + "\n" for i in range(12))
    seconds, said = cost(tmp_path, "serve", "net.py", "--store", "none", sent="".join(sent))
    assert seconds < 20 and json.loads(said.splitlines()[-1])["kind"] == "final"


def test_twelve_event_senders_are_checked(tmp_path):
    (tmp_path / "net.py").write_text(SENDERS)
    assert cost(tmp_path, "check", "net.py")[0] < 10
