"""Who falls back to XLA in a network, and why: filters of one's own too, and meshes that are too large."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.description.doubts import doubts_before_data
from straightline import compile

PLANT = hg.LinearPlant(0.9 * np.eye(2), 0.1, [0.0, 0.0], 1.0)
SENSOR = hg.LinearSensor(np.eye(2), 0.1)


class Own(hg.filters.AbstractFilter):
    """A filter whose gain is a fixed share, by a function of the innovation's size."""

    claim: str = eqx.field(static=True, default="nominal")
    states: tuple = eqx.field(static=True, default=PLANT.states)
    inputs: tuple = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=2)
    by_svd: bool = eqx.field(static=True, default=False)

    @hg.filters.in_float64
    def init(self):
        return jnp.zeros(2)

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        return 0.9 * state

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        innovation = hg.filters.gaussian_innovation(z, state, jnp.eye(2))
        error = jnp.where(jnp.isnan(z), 0.0, innovation.value)
        size = jnp.linalg.svd(error[:, None])[1][0] if self.by_svd else jnp.sqrt(error @ error)
        return state + error / (2 + size), innovation

    @hg.filters.estimates
    def estimate(self, state):
        return hg.model.Estimate(state, jnp.eye(2), self.claim)


SAID = "by XLA, which takes longer: "


def list_fallbacks(network):
    """What the description of a network says of XLA, which is no doubt."""
    said = [words for serious, words in doubts_before_data(network) if words.startswith(SAID) and not serious]
    return [words.removeprefix(SAID) for words in said]


def network(filters, count=1):
    nodes = {f"n{i}": hg.Node(SENSOR, hg.perfect(2), filters) for i in range(count)}
    return hg.Network(PLANT, nodes)


def test_a_network_that_native_code_takes_says_nothing():
    assert list_fallbacks(network({"own": Own(), "kalman": hg.kalman_filter(PLANT, SENSOR)})) == []


def test_filters_that_stay_sequential_are_named():
    curved = hg.Sensor(lambda x: x, 0.1 * np.eye(2), ["a", "b"])
    filters = {"kalman": hg.kalman_filter(PLANT, SENSOR)}
    bent = {"extended": hg.extended_filter(PLANT, curved), "cubature": hg.cubature_filter(PLANT, curved)}
    said = "row by row however long a recording is, since not linear in its data: "
    nodes = {"a": hg.Node(SENSOR, hg.perfect(2), filters), "b": hg.Node(curved, hg.perfect(2), bent)}
    lines = [words for serious, words in doubts_before_data(hg.Network(PLANT, nodes)) if "row by row" in words]
    assert lines == [f"{said}filter 'extended' of node 'b', filter 'cubature' of node 'b'"]
    assert not any("row by row" in words for _, words in doubts_before_data(network(filters)))


def test_a_filter_of_one_s_own_that_is_refused_is_named_with_its_line():
    """Once for all nodes that have it; and native code forced or not, nothing is raised."""
    item = network({"own": Own(by_svd=True), "kalman": hg.kalman_filter(PLANT, SENSOR)}, 5)
    (line,) = list_fallbacks(item)
    names = "filter 'own' of node 'n0', filter 'own' of node 'n1', filter 'own' of node 'n2' and 2 more"
    assert line.startswith(f"{names}: svd at ") and "test_execution_fallbacks.py:" in line


def test_filters_whose_outputs_have_other_names_are_compiled_once(monkeypatch):
    """Twelve event senders with names of their own took a program for each to be judged: 49 s of processor, now 10."""
    compiled = []

    def count(function, *arguments, **how):
        compiled.append(function)
        return compile(function, *arguments, **how)

    monkeypatch.setattr("heliograph.engine.choice.compile", count)
    sensors = [hg.LinearSensor(np.eye(2)[[i % 2]], 0.1, outputs=[f"y{i}"]) for i in range(7)]
    nodes = {f"n{i}": hg.Node(s, hg.perfect(), {"k": hg.kalman_filter(PLANT, s)}) for i, s in enumerate(sensors)}
    item = hg.Network(PLANT, nodes)
    compiled.clear()
    assert list_fallbacks(item) == [] and len(compiled) < 7


def test_nothing_falls_back_where_xla_is_forced(monkeypatch):
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    assert list_fallbacks(network({"own": Own(by_svd=True)})) == []


@pytest.mark.slow
def test_a_mesh_of_many_neighbours_is_named():
    names = [f"n{i}" for i in range(30)]
    nodes = {name: hg.Node(SENSOR, hg.perfect(2), {"own": hg.kalman_filter(PLANT, SENSOR)}) for name in names}
    near = {name: tuple(other for other in names if other != name) for name in names}
    mesh = hg.Fusion("own", hg.CovarianceIntersection(), neighbours=near)
    item = hg.Network(PLANT, nodes, {"mesh": mesh})
    assert list_fallbacks(item) == ["fusion 'mesh': between 30 neighbours, too many to be written out"]
    few = {name: (names[i - 1], names[(i + 1) % 30]) for i, name in enumerate(names)}
    assert list_fallbacks(hg.Network(PLANT, nodes, {"mesh": replace(mesh, neighbours=few)})) == []


@pytest.mark.slow
def test_states_of_more_rows_than_are_written_out_run_natively():
    """Loops over 25 states of the factors, one more than is written out, with what they divide by."""
    n = 25
    plant = hg.LinearPlant(0.9 * np.eye(n) + 0.05 * np.eye(n, k=1), np.eye(n), np.zeros(n), np.eye(n))
    sensor = hg.LinearSensor(np.eye(1, n), 0.1)
    filter = hg.kalman_filter(plant, sensor)
    assert list_fallbacks(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"kalman": filter})})) == []
