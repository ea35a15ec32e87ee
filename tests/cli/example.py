"""A network, its data and how the command is called with them."""

from types import SimpleNamespace

from heliograph import cli

NETWORK = """
import jax.numpy as jnp
import numpy as np

import heliograph as h


def move(x, u):
    return x + u[1] * jnp.array([x[1], u[0]])


plant = h.Plant(move, 0.01 * np.eye(2), [0, 0], np.eye(2), states=["p", "v"], inputs=["push", "dt"])
sensor = h.LinearSensor([[1.0, 0.0]], 0.1, outputs=["pos"])
link = h.hop(h.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1)
filters = {
    "aware": h.cubature_filter(plant, sensor, link),
    "trusting": h.mean_gain_filter(plant, sensor, link),
}
network = h.Network(plant, {"remote": h.Node(sensor, link, filters)})
"""
LOSING = """
from tests.losing import Tied

losing = {"losing": Tied(inputs=("push", "dt"))}
network = h.Network(plant, {"remote": h.Node(sensor, link, losing)})
"""
DATA = "time,push,pos\n0,0,0.5\n0.5,1,\n0.5,0,0.7\n2,0.5,nan\n"


def contents(folder):
    return {str(p.relative_to(folder)): p.is_file() and p.read_bytes() for p in folder.rglob("*")}


def run_arguments(network="net.py", measurements="data.csv", out="out.csv") -> list[str]:
    return ["run", network, "--measurements", measurements, "--out", out]


def refused(folder, capsys, arguments, *fragments) -> str:
    """Return the line in which a command refuses its arguments, which changes no file."""
    before = contents(folder)
    assert cli.main(arguments) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("heliograph: ") and said.err.endswith("\n") and said.err.count("\n") == 1
    for fragment in fragments:
        assert fragment in said.err
    assert contents(folder) == before
    return said.err


def stub_study(monkeypatch, run) -> None:
    """Any study is one that calls `run` with its folder and its values."""
    study = SimpleNamespace(settings=dict, run=lambda values, out: run(out, values))
    monkeypatch.setattr("heliograph.cli.studies.load_study", lambda entry: study)
