"""The units and the container of docs/run_it_live.md are ones that systemd and Docker read, and the command takes."""

import configparser
import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from heliograph.cli.serve import serve

PAGE = (Path(__file__).parents[2] / "docs" / "run_it_live.md").read_text()
UNITS = re.findall(r"```ini\n(.*?)```", PAGE, re.DOTALL)
(CONTAINER,) = re.findall(r"```dockerfile\n(.*?)```", PAGE, re.DOTALL)
INSTRUCTIONS = {"FROM", "RUN", "USER", "COPY", "ENV", "VOLUME", "STOPSIGNAL", "HEALTHCHECK", "ENTRYPOINT", "CMD"}


def takes(command):
    """Parse the arguments of `heliograph serve` without running it."""
    from cyclopts import App

    program, name, *arguments = command
    assert program.endswith("heliograph") and name == "serve"
    app = App(exit_on_error=False, print_error=False)
    app.default(serve)
    app.parse_args(arguments)


@pytest.mark.parametrize("unit", UNITS)
def test_a_unit_has_options_that_systemd_knows_and_a_command_that_is_taken(unit, tmp_path):
    parsed = configparser.ConfigParser(strict=True, interpolation=None)
    parsed.optionxform = str
    parsed.read_string(unit)
    assert parsed.sections() == ["Unit", "Service", "Install"]
    command = shlex.split(parsed["Service"]["ExecStart"])
    takes(shlex.split(command[2].removeprefix("exec ")) if command[0] == "/bin/sh" else command)
    if verify := shutil.which("systemd-analyze"):
        path = tmp_path / "heliograph.service"
        path.write_text(unit.replace("ExecStart=heliograph", f"ExecStart={sys.executable}"))
        done = subprocess.run([verify, "verify", str(path)], capture_output=True, text=True)
        assert not [line for line in done.stderr.splitlines() if str(path) in line], done.stderr


def test_a_container_has_instructions_that_docker_knows_and_a_command_that_is_taken():
    lines = CONTAINER.replace("\\\n", " ").splitlines()
    parts = dict(line.split(None, 1) for line in lines)
    assert parts.keys() <= INSTRUCTIONS and lines[0].startswith("FROM ")
    health = parts["HEALTHCHECK"].partition("CMD ")[2]
    assert compile(json.loads(health)[2], "health", "exec")
    takes(json.loads(parts["ENTRYPOINT"]) + json.loads(parts["CMD"]))
    # Each volume exists and belongs to the user who writes there.
    owned = re.search(r"mkdir (.*) && chown heliograph (.*)", parts["RUN"])
    assert owned is not None and owned[1] == owned[2] == parts["VOLUME"] and parts["USER"] == "heliograph"
