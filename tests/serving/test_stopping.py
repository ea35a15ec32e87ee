"""A real service, said to stop at any moment: while it starts, compiles, computes and waits."""

import json
import os
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from time import monotonic, sleep

import pytest

from heliograph_studies.live.server import free_port

pytestmark = pytest.mark.slow
LONGEST = 10.0  # seconds from SIGTERM to the end
NETWORK = """
import heliograph as hg

plant, sensor, link = hg.LinearPlant([[1.0]], 0.01, [20.0], 1.0), hg.LinearSensor([[1.0]], 0.04), hg.perfect()
triggers = [hg.SendOnDelta(0.5, heartbeat=5 + i) for i in range(6)]
nodes = [hg.Node(sensor, link, {"k": hg.event_filter(plant, sensor, link, t)}, trigger=t) for t in triggers]
network = hg.Network(plant, {f"n{i}": node for i, node in enumerate(nodes)})
"""


@pytest.fixture
def service(tmp_path):
    """A service of six event senders, whose programs take seconds to compile: its process, and the port of its page."""
    (tmp_path / "net.py").write_text(NETWORK)
    port = free_port()
    command = [sys.executable, "-m", "heliograph", "serve", "net.py", "--store", "none", "--page", str(port)]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}  # nothing is compiled yet
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    yield process, port
    process.kill()
    process.communicate()


def send(process):
    """Send a message of each node, which needs all programs."""
    for i in range(6):
        line = json.dumps({"node": f"n{i}", "sequence": 0, "time": 100.0, "values": [20.0]})
        process.stdin.write(f"{line}\n".encode())
    process.stdin.flush()


def ask(port, path):
    """Return the status and the seconds until the page answers; None before it is there."""
    begun = monotonic()
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=30) as answer:
            return answer.status, monotonic() - begun
    except (urllib.error.URLError, TimeoutError):
        return None


def ends(process):
    """Say to stop, and return the exit status and the seconds until the end."""
    begun = monotonic()
    process.send_signal(signal.SIGTERM)
    status = process.wait(60)
    return status, monotonic() - begun


def wait_for_page(port):
    begun = monotonic()
    while ask(port, "/healthz") is None:
        assert monotonic() - begun < 120
        sleep(0.1)


@pytest.mark.parametrize("after", [0.1, 1.0, 3.0])
def test_it_ends_while_it_starts(service, after):
    process, _ = service
    sleep(after)
    assert ends(process)[1] < LONGEST


@pytest.mark.parametrize("after", [0.0, 0.5, 2.0, 6.0])
def test_it_answers_and_ends_while_it_compiles(service, after):
    process, port = service
    wait_for_page(port)
    send(process)
    sleep(after)
    for path in ("/healthz", "/metrics"):
        status, took = ask(port, path)
        assert status == 200 and took < 5.0
    status, took = ends(process)
    assert (status, took < LONGEST) == (0, True)
