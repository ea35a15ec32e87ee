"""Which real parts ran is said, and a missing one is skipped with the command that installs it."""

import subprocess
import sys
from types import SimpleNamespace

import pytest

from tests import parts


class Item:
    """A test that starts some parts."""

    def __init__(self, *names):
        self.marks, self.added, self.user_properties = [pytest.mark.real(*names).mark], [], []

    def iter_markers(self, name):
        return [mark for mark in self.marks if mark.name == name]

    def add_marker(self, marker):
        self.added.append(marker)


@pytest.fixture
def plugin(monkeypatch):
    """The plugin on a machine that has all but a browser."""
    for name, part in parts.PARTS.items():
        monkeypatch.setitem(parts.PARTS, name, part._replace(there=lambda name=name: name != "browser"))
    return parts.RealParts()


def test_a_test_of_a_missing_part_is_skipped_with_the_command_that_installs_it(plugin):
    there, missing, plain = Item("NATS", "MQTT"), Item("NATS", "browser"), Item()
    plugin.pytest_collection_modifyitems([there, missing, plain])
    assert set(there.added) == {"slow"} and plain.added == []
    (skip,) = [marker.mark for marker in missing.added if marker != "slow"]
    assert skip.name == "skip" and skip.kwargs["reason"] == "no browser here: apt-get install chromium"


def test_what_another_process_started_counts_and_the_last_line_names_every_part(plugin):
    item = Item("PostgreSQL")
    plugin.pytest_runtest_call(item)
    plugin.pytest_runtest_logreport(SimpleNamespace(user_properties=[*item.user_properties, ("another", "MQTT")]))
    assert [plugin.outcome(name) for name in parts.PARTS] == [
        "PostgreSQL ran",
        "InfluxDB left out",
        "Prometheus left out",
        "MQTT left out",
        "NATS left out",
        "OPC UA left out",
        "rattler-build left out",
        "browser skipped (apt-get install chromium)",
    ]


def test_the_settings_of_the_tests_come_before_what_reads_them():
    """JAX and SciPy's BLAS read them once, when imported: with JAX in `conftest`, a process compiled as for use."""
    code = "import sys, tests.conftest; sys.exit(sorted({'jax', 'scipy', 'heliograph'} & set(sys.modules)) or None)"
    subprocess.run([sys.executable, "-c", code], check=True)
