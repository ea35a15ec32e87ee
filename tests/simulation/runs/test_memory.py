"""Simulations that do not fit into memory: refused in one line before the first run, and not where they fit."""

import re

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.runs import memory

PLANT = hg.LinearPlant([[1.0, 0.1], [0.0, 0.9]], np.diag([0.01, 0.02]), np.zeros(2), np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.1)
KEPT = {"trajectories": None, "statistics": hg.Statistics()}


def network(nodes=1):
    link = hg.hop(hg.Rayleigh(0.8), 0.1)
    node = hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})
    return hg.Network(PLANT, {f"n{i}": node for i in range(nodes)})


def refusal(monkeypatch, free, *arguments, **options):
    monkeypatch.setattr(memory, "find_available_memory", lambda: free)
    with pytest.raises(ValueError, match="memory of a simulation") as raised:
        hg.monte_carlo(*arguments, **options)
    said = str(raised.value)
    assert "\n" not in said and "available" in said
    return float(re.search(r"got ([\d.e+-]+) GB", said)[1]) * 1e9, said


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kept", KEPT)
def test_what_does_not_fit_is_refused_before_the_first_run(monkeypatch, engine, kept):
    monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
    needed, said = refusal(monkeypatch, 1e3, network(), 20, 320, 0, KEPT[kept], chunk=32, progress=called)
    assert ("keep=Statistics()" in said) == (kept == "trajectories")
    # What is said to be needed suffices, to the three digits that are said.
    monkeypatch.setattr(memory, "find_available_memory", lambda: 1.01 * needed)
    hg.monte_carlo(network(), 20, 320, 0, KEPT[kept], chunk=32)


def called(done, total):
    raise AssertionError("a run was simulated")


@pytest.mark.parametrize("engine", ["native", pytest.param("xla", marks=pytest.mark.slow)])
def test_kept_trajectories_are_counted_by_their_number(monkeypatch, engine):
    """Truth, measurement, mean of each run are 2 + 1 + 2 doubles a step; covariances are common to all.

    What is needed is told to three digits.
    """
    monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
    few, many = (refusal(monkeypatch, 1e3, network(), 20, runs, 0, chunk=256)[0] for runs in (2560, 25600))
    copies = 2 if engine == "xla" else 1  # by chunk and joined
    least = copies * (25600 - 2560) * 20 * 5 * 8
    assert 0.995 * least <= many - few <= 2 * least  # reports and flags beside


def test_independent_nodes_are_counted_together(monkeypatch):
    """Nodes in parts of four, one after another: their results are held together."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    few, many = (refusal(monkeypatch, 1e3, network(nodes), 20, 25600, 0)[0] for nodes in (8, 16))
    assert 1.8 * few < many < 2.2 * few


@pytest.mark.slow
def test_a_mesh_that_xla_computes(monkeypatch):
    """1,000 nodes and steps: 3 sums of errors, 3 of claims, NEES, in 50 batches, before and after a block: 5.6 GB."""
    own = hg.linear_filter(PLANT, SENSOR, hg.perfect())
    names = [f"n{i}" for i in range(1000)]
    ring = {name: [names[i - 1]] for i, name in enumerate(names)}
    nodes = {name: hg.Node(SENSOR, hg.perfect(), {"own": own}) for name in names}
    mesh = hg.Network(PLANT, nodes, {"m": hg.Fusion("own", hg.fusion.TraceIntersection(), neighbours=ring)})
    needed, said = refusal(monkeypatch, 4e9, mesh, 1000, 1, 0, hg.Statistics())
    assert 5.6e9 < needed < 42e9 and "sums by step and batch" in said


def test_an_allocation_that_fails_after_all():
    for error in (MemoryError("Unable to allocate"), jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out\nof memory")):
        with (
            pytest.raises(ValueError, match=r"memory of a simulation: .*runs=2, horizon=3") as raised,
            memory.explain_out_of_memory(2, 3),
        ):
            raise error
        assert "\n" not in str(raised.value)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"), memory.explain_out_of_memory(2, 3):
        raise jax.errors.JaxRuntimeError("INTERNAL: other")


def test_available_memory_is_of_this_machine():
    assert 1e7 < memory.find_available_memory() < 1e15
