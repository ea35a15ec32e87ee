"""A package of one's own that brings a broker and a format is found by its entry points."""

import importlib
import sys

import numpy as np
import pytest

from heliograph import cli, files
from heliograph.serving import Address, make_transport, parse_address

CODE = '''
"""A broker that is a list, and a format of one number a line."""

import numpy as np


class Listed:
    def __init__(self, address, part, translator):
        self.address = address

    async def receive(self):
        return None

    async def publish(self, outputs):
        print(*(output.body.decode() for output in outputs), sep="\\n")

    async def close(self):
        print("closed", self.address.host)


def read(path):
    numbers = np.array([float(line) for line in path.read_text().split()])
    return {"time": np.arange(len(numbers)), "y": numbers}
'''
OFFERED = "[heliograph.brokers]\nlisted = plug:Listed\ngone = plug:gone\n[heliograph.formats]\nlines = plug:read\n"


def install(folder, name, entries):
    """Lay out a package as an installer does."""
    made = folder / f"{name}-1.0.dist-info"
    made.mkdir()
    (made / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
    (made / "entry_points.txt").write_text(entries)


@pytest.fixture
def plug(tmp_path, monkeypatch):
    """The package, on the path."""
    place = tmp_path / "site"
    place.mkdir()
    (place / "plug.py").write_text(CODE)
    install(place, "plug", OFFERED)
    monkeypatch.syspath_prepend(place)
    monkeypatch.chdir(tmp_path)
    importlib.invalidate_caches()
    yield place
    sys.modules.pop("plug", None)


def test_a_broker_of_another_package_serves(plug, tmp_path, capsys):
    address = parse_address("listed://shelf:7/site")
    assert (address.kind, address.host, address.port, address.topic) == ("listed", "shelf", 7, "site")
    assert type(make_transport(address)).__name__ == "Listed"
    (tmp_path / "net.py").write_text(
        "import heliograph as hg\n"
        "plant, sensor = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)\n"
        "network = hg.Network(plant, {'n': hg.Node(sensor, hg.perfect(), {'k': hg.kalman_filter(plant, sensor)})})\n"
    )
    assert cli.main(["serve", "net.py", "--store", "none", "--broker", "listed://shelf"]) == 0
    assert "closed shelf" in capsys.readouterr().out


def test_a_format_of_another_package_is_read(plug, tmp_path):
    (tmp_path / "data.lines").write_text("1.5\n2.5\n")
    np.testing.assert_array_equal(files.read_table("data.lines")["y"], [1.5, 2.5])


def test_what_nobody_offers_or_two_do_is_one_line(plug, tmp_path):
    with pytest.raises(ValueError, match="broker: expected mqtt://"):
        parse_address("unheard://host")
    with pytest.raises(ValueError, match=r"expected mqtt, nats, opc\.tcp, or a package that offers the broker"):
        make_transport(Address("unheard", "host", 1, "t", False))
    with pytest.raises(ValueError, match="gone: expected plug:gone, which can be imported"):
        parse_address("gone://host")
    (tmp_path / "data.lines").write_text("1\n")
    install(plug, "other", "[heliograph.formats]\nlines = other:read\n")
    importlib.invalidate_caches()
    with pytest.raises(ValueError, match="lines: expected one package that offers it, got other:read and plug:read"):
        files.read_table("data.lines")
