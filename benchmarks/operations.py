"""How many operations a step has in native code, and how many products and sums the textbook's covariance form.

Run: python benchmarks/operations.py, which writes the table of docs/operations.md. Counts are no times: they are the
same whatever else the machine does.
"""

import re
import sys
from importlib import import_module
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import heliograph as hg
from heliograph.simulation.arguments import make_run_key
from heliograph.simulation.runs.native import compile_network_runs

HERE = Path(__file__).resolve().parent
PAGE = HERE.parent / "docs" / "operations.md"
TABLE = re.compile(r"(\| a step of \|.*\n\|-.*\n)(?:\|.*\n)+")
FILTERS = {
    "the Kalman filter, 4 states, 2 outputs, a gain of its own in each run and step": ("kalman", "kalman_heliograph"),
    "the same, smoothed": ("smoothing", "smoothing_heliograph"),
    "multiple models (IMM), 2 modes, 4 states, 2 outputs": ("modes", "modes_heliograph"),
    "the same of a plant with 2 laws of motion": ("motion", "motion_heliograph"),
    "the cubature filter behind relays, 5 states, 2 outputs": ("cubature", "cubature_heliograph"),
}
STEPS = 20


class Row(NamedTuple):
    """A step: operations, loads and selections among them, divisions and roots, and what the covariance form has."""

    name: str
    operations: int
    divisions: int | None = None
    covariance_form: int | None = None

    @property
    def text(self) -> str:
        """The row of the table."""
        return f"| {self.name} | {' | '.join('–' if n is None else f'{n:,}' for n in self[1:])} |"


def of_filters() -> list[Row]:
    """Count the operations of the filters that are compared with those of others."""
    sys.path.insert(0, str(HERE / "peers"))
    problems, rows = import_module("problems"), []
    for name, (problem, program) in FILTERS.items():
        given = getattr(problems, problem)(8)
        how = import_module(program).prepare(given.arrays).how
        operations, divisions = map(int, re.findall(r"native: (\d+) operations, (\d+) of them", how)[0])
        rows.append(Row(name, operations, divisions, given.flops))
    return rows


def of_networks() -> list[Row]:
    """Count what a run of a network computes for each node and step, draws of the world among it."""
    draw, n = np.random.default_rng(0), 4
    plant = hg.LinearPlant(0.95 * np.eye(n) + 0.05 * np.eye(n, k=1), 0.1 * np.eye(n), np.zeros(n), np.eye(n))
    sensors = [hg.LinearSensor(draw.normal(size=(2, n)), 0.1) for _ in range(4)]
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02, dimension=2) for _ in range(2)])
    apart = {f"n{i}": hg.Node(s, relay, {"f": hg.linear_filter(plant, s, relay)}) for i, s in enumerate(sensors)}
    seen = hg.LinearSensor(np.eye(n), 0.1)
    meshed = {f"n{i}": hg.Node(seen, hg.perfect(n), {"f": hg.kalman_filter(plant, seen)}) for i in range(4)}
    near = {name: [other for other in meshed if other != name][:2] for name in meshed}
    mesh = {"m": hg.Fusion("f", hg.fusion.EqualIntersection(), neighbours=near)}
    return [
        Row("a node, simulated: a two-hop Rayleigh relay, the linear filter", _of_node(hg.Network(plant, apart))),
        Row("a node of a mesh, simulated: two neighbours, intersection", _of_node(hg.Network(plant, meshed, mesh))),
    ]


def _of_node(network: hg.Network) -> int:
    """Count the operations that differ between runs and that these share, of a step and node."""
    code = compile_network_runs(network, np.zeros((STEPS, 0)), make_run_key(0), hg.Statistics(), 64).begun.program.code
    work: float = code.blocks.work + (0 if code.once is None else code.once.work)
    return round(work / STEPS / len(network.names))


def table() -> list[Row]:
    """Count all rows."""
    with jax.enable_x64(True):
        return [*of_filters(), *of_networks()]


def main() -> None:
    rows = table()
    lines = "".join(f"{row.text}\n" for row in rows)
    PAGE.write_text(TABLE.sub(lambda found: found[1] + lines, PAGE.read_text()))
    print(lines, end="")


if __name__ == "__main__":
    main()
