"""`heliograph export`: what it writes and says, and what it refuses."""

import shutil

import pytest

import heliograph as h
from heliograph import cli
from heliograph.files.network_file import load_network
from tests.cli.example import NETWORK, contents, refused
from tests.export.device import needs_compiler

TWICE = """
network = h.Network(plant, {name: h.Node(sensor, link, filters) for name in ("near", "far")})
"""
DRAWS = """
drifting = h.gilbert_elliott(link, h.hop(0.1, 0.1), 0.1, 0.2)
particles = {"particles": h.filters.particle_filter(plant, sensor, drifting)}
network = h.Network(plant, {"remote": h.Node(sensor, drifting, particles)})
"""


def arguments(*more, filter="aware", out="step.c"):
    return ["export", "net.py", "--filter", filter, "--out", out, *more]


@needs_compiler
def test_it_writes_what_the_library_writes_and_says_what_it_costs(folder, capsys):
    assert cli.main(arguments()) == 0
    first, operations, cost = capsys.readouterr().out.splitlines()
    assert first == "step.h, step.c: remote/aware (nominal), double precision"
    assert operations.split(" ")[1] == "operations:" and "additions" in operations and "divisions" in operations
    assert cost.startswith("state 72 bytes, code ") and "ns (cc -O2 on this machine)" in cost
    assert sorted(set(contents(folder)) - {"net.py", "data.csv"}) == ["step.c", "step.h"]
    assert "z[0]: pos" in (folder / "step.h").read_text() and "u[0]: push" in (folder / "step.h").read_text()
    written = (folder / "step.c").read_text()
    h.export_c(load_network("net.py").nodes["remote"].filters["aware"], folder / "step.c")
    assert (folder / "step.c").read_text() == written


def test_without_a_compiler_it_says_so(folder, capsys, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert cli.main(arguments("--precision", "float")) == 0
    said = capsys.readouterr().out
    assert "remote/aware (nominal), float precision" in said
    assert said.endswith("state 44 bytes, code unmeasured, time unmeasured: no C compiler 'cc' here\n")


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ({"filter": "awake"}, "filter: expected one of the network's filters ['aware', 'trusting'], got 'awake'"),
        ({"out": "step.txt"}, "step.txt: expected a name that ends in .c"),
        ({"out": "no/step.c"}, "output folder no: expected an existing folder"),
        ({"out": "step.c", "window": "0"}, "window: expected a positive whole number, got 0"),
        ({"out": "1.c"}, "expected a name that C takes for its functions, such as step.c, got '1'"),
    ],
)
def test_refusals(folder, capsys, more, words):
    options = [f"--{name}={value}" for name, value in more.items() if name == "window"]
    refused(folder, capsys, arguments(*options, **{k: v for k, v in more.items() if k != "window"}), words)


@pytest.mark.filterwarnings("default:window")
def test_a_window_is_part_of_what_it_costs(folder, capsys):
    """Eight rows of a state of 72 bytes, one number and two inputs; the state; four counters. Its noise is per step."""
    assert cli.main(arguments("--window", "6")) == 0
    said = capsys.readouterr()
    assert "state 856 bytes" in said.out and "window: predictions depend on what comes late: noise over 0" in said.err
    assert "step_window_late(step_window *window, double age" in (folder / "step.h").read_text()


def test_a_node_where_several_have_the_filter(folder, capsys):
    (folder / "net.py").write_text(NETWORK + TWICE)
    refused(folder, capsys, arguments(), "node: expected one of ['near', 'far'], which all have a filter 'aware'")
    refused(folder, capsys, arguments("--node", "there"), "node: expected one that has a filter 'aware'", "'there'")
    assert cli.main(arguments("--node", "far")) == 0
    assert "far/aware" in capsys.readouterr().out


def test_random_numbers_are_refused_with_their_place(folder, capsys):
    (folder / "net.py").write_text(NETWORK + DRAWS)
    words = "export: expected operations that C has, got random_", "particle.py:"
    refused(folder, capsys, arguments(filter="particles"), *words)


def test_an_operation_without_c_is_refused_with_its_line(folder, capsys):
    text = NETWORK.replace("return x + u[1]", "return jax.scipy.special.erfinv(x / 9) + u[1]")
    (folder / "net.py").write_text(text.replace("import jax.numpy", "import jax.scipy.special\nimport jax.numpy"))
    line = next(k for k, row in enumerate((folder / "net.py").read_text().splitlines(), 1) if "erfinv(" in row)
    refused(folder, capsys, arguments(), f"got erf_inv at net.py:{line}")
