"""Real parts: servers and a browser that tests start as users do; the last line of a run says which of them ran.

A test names what it starts, `@pytest.mark.real("PostgreSQL")`. Where that is not installed the test is skipped with the
command that installs it.
"""

import sys
import sysconfig
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from typing import NamedTuple

import pytest

from tests.influx import influxd
from tests.postgres import programs
from tests.widths import program

ROOT = Path(__file__).parents[1]
PROPERTY = "real part"  # under which a report, also of another process, says what was started


class Part(NamedTuple):
    """How a part is looked for, and the command that installs it."""

    there: Callable[[], bool]
    install: str


def broker(client: str) -> bool:
    """Whether there is a server of both protocols, in the environment or on the machine, and a client of one."""
    server = which("nats-server", path=sysconfig.get_path("scripts")) or which("nats-server")
    return server is not None and find_spec(client) is not None


LIVE = f"{Path(sys.executable).name} -m pip install '{ROOT}[live]'"
PARTS = {
    "PostgreSQL": Part(lambda: programs() is not None, "apt-get install postgresql"),
    "InfluxDB": Part(lambda: influxd() is not None, "apt-get install influxdb"),
    "Prometheus": Part(lambda: which("promtool") is not None, "apt-get install prometheus"),
    "MQTT": Part(lambda: broker("paho"), LIVE),
    "NATS": Part(lambda: broker("nats"), LIVE),
    "OPC UA": Part(lambda: find_spec("asyncua") is not None, LIVE.replace("live", "opcua")),
    "rattler-build": Part(
        lambda: find_spec("rattler_build") is not None, f"{Path(sys.executable).name} -m pip install py-rattler-build"
    ),
    "browser": Part(lambda: program() is not None, "apt-get install chromium"),
}


def started(item: pytest.Item, name: str) -> None:
    """A test has a part to itself: its report says so."""
    item.user_properties.append((PROPERTY, name))


class RealParts:
    """The plugin: skips, and the last line."""

    def __init__(self) -> None:
        self.ran: set[str] = set()

    @pytest.hookimpl(tryfirst=True)  # before tests are chosen by their marks
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """What starts a real part is slow, and skipped where there is none."""
        for item in items:
            for name in {name for mark in item.iter_markers("real") for name in mark.args}:
                item.add_marker("slow")
                if not PARTS[name].there():
                    item.add_marker(pytest.mark.skip(reason=f"no {name} here: {PARTS[name].install}"))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> None:
        """It was not skipped."""
        for name in {name for mark in item.iter_markers("real") for name in mark.args}:
            started(item, name)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Of this process, or of the one that ran it."""
        self.ran |= {str(value) for key, value in report.user_properties if key == PROPERTY}

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> Iterator[None]:
        """The last line, after the summary; workers print nothing."""
        yield
        terminal = session.config.pluginmanager.get_plugin("terminalreporter")
        worker, only_listed = hasattr(session.config, "workerinput"), session.config.option.collectonly
        if terminal is not None and not worker and not only_listed:
            terminal.ensure_newline()
            terminal.write_line(f"real parts: {', '.join(map(self.outcome, PARTS))}")

    def outcome(self, name: str) -> str:
        """Whether a part ran."""
        if name in self.ran:
            return f"{name} ran"
        return f"{name} left out" if PARTS[name].there() else f"{name} skipped ({PARTS[name].install})"
