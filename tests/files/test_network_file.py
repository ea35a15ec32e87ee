import sys

import pytest

from heliograph.files.network_file import load_network

NETWORK = """
import heliograph as h

plant = h.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=["{state}"])
sensor = h.LinearSensor([[1.0]], 0.1)
{name} = h.Network(plant, {{"only": h.Node(sensor, h.perfect(), {{}})}})
"""
SINGLE = NETWORK.format(state="x", name="network")
TWO = SINGLE + NETWORK.format(state="y", name="other")


@pytest.fixture(autouse=True)
def in_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    modules, path = set(sys.modules), list(sys.path)
    yield tmp_path
    assert sys.path == path
    for name in set(sys.modules) - modules:
        del sys.modules[name]


def refused(reference: str, *fragments: str) -> None:
    with pytest.raises(ValueError) as caught:
        load_network(reference)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"network {reference.partition(':')[0]}")
    assert ": expected " in message and ", got " in message
    for fragment in fragments:
        assert fragment in message


def test_the_only_network_of_a_file(in_folder):
    (in_folder / "net.py").write_text(SINGLE + "\nsame = network\n")
    assert load_network("net.py").states == ("x",)
    assert load_network(str(in_folder / "net.py")).states == ("x",)
    assert [p.name for p in in_folder.iterdir()] == ["net.py"]


def test_a_named_network_of_several(in_folder):
    (in_folder / "net.py").write_text(TWO)
    assert load_network("net.py:other").states == ("y",)
    refused("net.py", "net.py:network or net.py:other", "2 networks")
    refused("net.py:othr", "which holds network, other", "closest: 'other'")
    refused("net.py:plant", "a heliograph.Network", "LinearPlant")


def test_a_function_that_returns_one(in_folder):
    source = SINGLE + "\ndef build():\n    return network\n\ndef needs(seed):\n    return network\n"
    (in_folder / "net.py").write_text(source + "\ndef wrong():\n    return 3\n")
    assert load_network("net.py:build").states == ("x",)
    refused("net.py:needs", "TypeError", "seed")
    refused("net.py:wrong", "a heliograph.Network", "int")


def test_a_module_of_a_package(in_folder):
    (in_folder / "user_package").mkdir()
    (in_folder / "user_package" / "__init__.py").touch()
    (in_folder / "user_package" / "nets.py").write_text(TWO)
    (in_folder / "user_package" / "broken.py").write_text("first = 1\nsecond = 1 / 0\n")
    assert load_network("user_package.nets:other").states == ("y",)
    refused("user_package.nets", "2 networks")
    refused("user_package.broken", "ZeroDivisionError in line 2: division by zero")
    refused("user_package.missing", "ModuleNotFoundError", "user_package.missing")
    refused("no_such_package.nets", "ModuleNotFoundError", "no_such_package")


def test_a_file_finds_modules_next_to_it(in_folder):
    folder = in_folder / "elsewhere"
    folder.mkdir()
    (folder / "shared_settings.py").write_text("GAIN = 0.5\n")
    (folder / "net.py").write_text("from shared_settings import GAIN\n" + SINGLE)
    assert load_network("elsewhere/net.py").states == ("x",)


def test_a_dataclass_in_the_file(in_folder):
    extra = "from __future__ import annotations\nfrom dataclasses import dataclass\n"
    (in_folder / "net.py").write_text(extra + "@dataclass\nclass Setting:\n    a: int = 1\n" + SINGLE)
    assert load_network("net.py").states == ("x",)


def test_no_file(in_folder):
    refused("net.py", "a Python file", "nothing of that name")
    (in_folder / "folder.py").mkdir()
    refused("folder.py", "a Python file", "a folder")
    refused("folder.py:name", "a folder")


def test_no_network(in_folder):
    (in_folder / "net.py").write_text("import heliograph\n")
    refused("net.py", "a heliograph.Network", "none in the module")
    refused("net.py:network", "which holds no networks", "an unknown name")


@pytest.mark.parametrize(
    ("source", "fragments"),
    [
        ("x = 1\nx = (\n", ["SyntaxError in line 2"]),
        ("import no_such_module\n", ["ModuleNotFoundError in line 1", "no_such_module"]),
        ("def f():\n    raise OSError('a\\nb')\n\n\nf()\n", ["OSError in line 2: a b"]),
        ("import sys\nsys.exit(3)\n", ["SystemExit in line 2: 3"]),
        (
            "import heliograph as h\nh.hop(1.0,\n      h.Gaussian([[-1.0]]))\n",
            ["InputError in line 3: noise covariance", "positive semidefinite", "-1"],
        ),
    ],
)
def test_an_error_in_the_file(in_folder, source, fragments):
    (in_folder / "net.py").write_text(source)
    refused("net.py", *fragments)
    assert "heliograph_network_net" not in sys.modules
