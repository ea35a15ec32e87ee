"""`heliograph check`: the diagram, the doubts, and an exit status for scripts."""

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.cli.app_and_option_types import app
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


PAIR = """
import numpy as np
import heliograph as h

plant = h.LinearPlant([[1.0, 0.5], [0.0, 0.9]], np.diag([0.01, 0.05]), [0, 0], 1.0, states=["way", "speed"])
sensors = {"gnss": h.LinearSensor([[1.0, 0.0]], 4.0), "wheel": h.LinearSensor([[0.0, 1.0]], 0.1)}
network = h.Network(plant, {name: h.Node(sensor, h.perfect(1), {}) for name, sensor in sensors.items()})
mast = h.Node(h.LinearSensor([[1.0, 0.0]], 2.0), h.perfect(1), {})
places = {f"mast {noise}": h.Node(h.LinearSensor([[1.0, 0.0]], noise), h.perfect(1), {}) for noise in (0.5, 1.0)}
"""


def test_what_sensors_are_worth_is_a_table_of_the_function(folder, capsys):
    (folder / "pair.py").write_text(PAIR)
    assert cli.main(["check", "pair.py", "--without", "each", "--outage", "gnss:60"]) == 0
    said = capsys.readouterr().out.splitlines()[-5:]
    assert said[0].split() == ["way", "speed"]
    scope = {}
    exec(PAIR, scope)
    found = hg.planning.worth_of_sensors(scope["network"], 200, ["gnss", "wheel"], {"gnss": 60})
    for line, case in zip(said[1:], [found.complete, *found.cases], strict=True):
        cells = [f"{e:.4g} ({times:.3g})" for e, times in zip(case.error, case.increase, strict=True)]
        assert line.startswith(case.name) and " ".join(line.split()).endswith(" ".join(cells))


def test_places_for_one_more_are_compared_and_drawn(folder, capsys):
    (folder / "pair.py").write_text(PAIR)
    asked = ["check", "pair.py", "--without", "wheel", "--with", "mast", "--with", "places"]
    for name in ("worth.svg", "worth.png"):
        assert cli.main([*asked, "--figure", name]) == 0
    said = capsys.readouterr().out.splitlines()
    scope = {}
    exec(PAIR, scope)
    nodes = {"mast": scope["mast"], **scope["places"]}
    found = hg.planning.worth_of_sensors(scope["network"], 200, ["wheel"], additions=nodes)
    best = found.best_addition
    assert best.name == "with mast 0.5" and best.mean_increase == pytest.approx(float(np.sqrt(np.prod(best.increase))))
    times = f"{best.mean_increase:.3g}"
    assert said[-1] == f"best addition: with mast 0.5, {times} times the error (geometric mean over states)"
    assert [line.partition("  ")[0] for line in said[-5:-1]] == ["without wheel", *(f"with {name}" for name in nodes)]
    assert (folder / "worth.svg").read_text().startswith("<?xml") and (folder / "worth.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["--with", "masts"],
            "--with masts: expected a heliograph.Node of the network's file, or a dictionary of nodes, "
            "got no such name (closest: 'mast')",
        ),
        (["--with", "sensors"], "--with sensors: expected a heliograph.Node of the network's file, or a dictionary of"),
        (["--with", "mast", "--with", "mast"], "--with: expected nodes of different names, got 'mast' twice"),
        (
            ["--figure", "a.svg"],
            "--figure: expected what sensors are worth (--without, --outage or --with), got none of",
        ),
        (["--with", "mast", "--figure", "a.pdf"], "a.pdf: expected a name that ends in .svg or .png, got '.pdf'"),
        (["--without", "radar"], "nodes left out: expected some of the nodes gnss, wheel, got 'radar'"),
        (["--outage", "radar:60"], "outages: expected some of the nodes gnss, wheel, got 'radar'"),
        (["--outage", "gnss:300"], "outage of 'gnss': expected at most the 200 steps of the run, got 300"),
        (["--outage", "gnss"], "--outage: expected NODE:STEPS, such as gnss:60, got 'gnss'"),
        (["--without", "gnss", "--input", "dt"], "--input: expected NAME=VALUE, such as dt=0.5, got 'dt'"),
        (["--without", "gnss", "--input", "dt=1"], "--input: expected one of each input of the plant, []"),
    ],
)
def test_what_cannot_be_left_out_is_one_line(folder, capsys, options, said):
    (folder / "pair.py").write_text(PAIR)
    refused(folder, capsys, ["check", "pair.py", *options], said)
