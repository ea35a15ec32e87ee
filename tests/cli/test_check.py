"""`heliograph check`: the diagram, the doubts, and an exit status for scripts."""

import pytest

from heliograph import cli
from heliograph.cli.app import app
from heliograph.cli.command import COMMANDS
from tests.cli.example import refused

HIDDEN = """
import numpy as np
import heliograph as h

plant = h.LinearPlant(0.9 * np.eye(2), 0.1, [0, 0], 1.0, states=["x", "bias"])
sensor = h.LinearSensor([[1.0, 0.0]], 0.1)
network = h.Network(plant, {"a": h.Node(sensor, h.perfect(), {"kalman": h.kalman_filter(plant, sensor)})})
"""


def test_a_network_without_doubts_has_status_0(folder, capsys):
    assert cli.main(["check", "net.py"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == "Network of 1 node"
    assert said[1] == "plant   Plant of p, v; inputs push, dt"
    assert said[2] == "remote  pos → Discrete hop → aware (nominal), trusting (nominal, believes another channel)"
    assert said[-1] == "nothing doubtful"


def test_a_doubtful_one_has_status_1_and_bad_input_2(folder, capsys):
    (folder / "hidden.py").write_text(HIDDEN)
    assert cli.main(["check", "hidden.py"]) == 1
    said = capsys.readouterr().out
    assert "doubtful: unobservable: no sensor shows 'bias'" in said and said.endswith("1 doubtful\n")
    refused(folder, capsys, ["check", "missing.py"], "missing.py")


@pytest.mark.parametrize(("command", "arguments"), COMMANDS.items(), ids=lambda item: getattr(item, "__name__", "_"))
def test_every_help_shows_an_example_that_the_command_takes(capsys, command, arguments):
    name = command.__name__
    assert cli.main([name, "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"Example: heliograph {name} {arguments}" in shown
    words = arguments.partition(" | ")[0].partition(" >> ")[0].split()
    assert app.parse_args([name, *words], exit_on_error=False, print_error=False)[0] is command
