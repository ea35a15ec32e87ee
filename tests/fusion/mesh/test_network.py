"""Fusions between neighbours in a network: runs, recordings, statistics, and claims."""

import json

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from heliograph.simulation.mesh import build_mesh
from tests.fusion.mesh.worlds import LINK, RING, RULES, network

BURSTS = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.1), 0.05, 0.3)
STEPS, RUNS = 12, 640


@pytest.fixture(scope="module")
def lossy():
    return network(RULES, link=LINK)


@pytest.fixture(scope="module")
def record(lossy):
    return hg.monte_carlo(lossy, STEPS, RUNS, 4)


def test_every_node_has_an_estimate_with_its_claim(lossy, record):
    assert {name: claim for name, claim in lossy.claims()["b"].items()} == {
        "best": "exact", "trace": "upper", "diffusion": "exact"
    }  # fmt: skip
    assert set(record.estimates["b"]) == set(RULES) and "own" in record.estimates["a"]
    assert record.measurements["b"].shape == (RUNS, STEPS, 0)
    assert record.reports["trace"]["b"].values.shape == (RUNS, STEPS, 2)
    arrived = np.mean([~np.isnan(item.values) for item in (record.reports["best"][n] for n in ("b", "c"))])
    assert arrived == pytest.approx(0.7, abs=4 * np.sqrt(0.21 / (4 * RUNS * STEPS)))


@pytest.mark.slow
def test_exact_claims_are_the_errors_and_upper_ones_not_below(record):
    # 640 runs of 12 correlated steps: the mean of a NEES of 2 states has a deviation of about .015
    for name, (least, most) in {"best": (0.95, 1.05), "diffusion": (0.95, 1.05), "trace": (0.5, 1.05)}.items():
        for node in "abcd":
            error = record.errors(node, name)
            covariance = np.asarray(record.estimates[node][name].covariance)
            nees = np.einsum("rta,rta->rt", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 2
            assert least < nees.mean() < most, (node, name, nees.mean())


@pytest.mark.slow
@pytest.mark.parametrize("name", RULES)
def test_claims_of_a_run_are_those_given_its_arrivals(lossy, record, name):
    arrived = hg.simulation.mesh_arrivals(lossy, name, STEPS, jax.random.fold_in(jax.random.key(4), 7))
    errors = hg.simulation.mesh_errors(lossy, name, arrived)
    for i, node in enumerate("abcd"):
        assert np.asarray(record.estimates[node][name].covariance)[7] == pytest.approx(errors.claimed[:, i], rel=1e-9)


@pytest.mark.slow
def test_a_recording_gives_what_the_run_gave(lossy, record):
    reports = {name: {n: item.values[3] for n, item in mine.items()} for name, mine in record.reports.items()}
    again = hg.run(lossy, {n: z[3] for n, z in record.measurements.items()}, reports=reports)
    for node in "abcd":
        for name in RULES:
            then, now = record.estimates[node][name], again.estimates[node][name]
            assert np.asarray(now.mean) == pytest.approx(np.asarray(then.mean)[3], rel=1e-9, abs=1e-9)
            assert np.asarray(now.covariance) == pytest.approx(np.asarray(then.covariance)[3], rel=1e-9)


@pytest.fixture(scope="module")
def statistics():
    """Over 960 runs of 40 steps with losses in bursts."""
    rules = {name: RULES[name] for name in ("trace", "best")}
    return hg.monte_carlo(network(rules, link=BURSTS), 40, 960, 1, hg.Statistics())


def test_statistics_have_each_node(statistics):
    assert statistics["b"]["trace"].claim == "upper"
    assert statistics["b"]["trace"].runs == 960 and np.isfinite(statistics["b"]["trace"].rmse()[0])


@pytest.mark.slow
def test_bursts_leave_upper_claims_upper_and_exact_ones_exact(statistics):
    for node in "abcd":
        assert statistics[node]["trace"].nees_per_dimension()[0] < 1.05
        assert statistics[node]["best"].nees_per_dimension()[0] == pytest.approx(1.0, abs=0.06)
        assert statistics[node]["trace"].worst_direction().z < 4


def test_a_step_is_one_program_whatever_the_number_of_nodes():
    def operations(count):
        names = [f"n{i}" for i in range(count)]
        ring = {name: [names[i - 1], names[i - 2]] for i, name in enumerate(names)}
        rows = {name: ([[1.0, 0.5]], 0.3) for name in names[::2]}
        net = network({"m": hg.fusion.TraceIntersection()}, ring, rows=rows)
        mesh = build_mesh(net, "m")
        model = mesh.observation_model
        z = tuple(np.zeros((c, 0 if group is None else 1)) for group, c in zip(model.groups, model.counts, strict=True))
        made = jax.make_jaxpr(lambda s: mesh.step(s, z, mesh.edges.lossless(), np.zeros(0), 0)[0])(mesh.init())
        return str(made).count("\n")

    assert operations(12) == operations(48)


def test_a_link_for_each_edge(lossy):
    edges = ["b to a", "c to b", "d to b", "a to c", "b to c", "c to d"]
    net = network({"trace": RULES["trace"]}, link={name: LINK if name == "b to a" else hg.perfect() for name in edges})
    arrived = hg.simulation.mesh_arrivals(net, "trace", 400, 0)
    assert arrived[:, 1:, 0][:, build_mesh(net, "trace").edges.present[1:]].all()
    assert arrived[:, 0, 0, 1].mean() == pytest.approx(0.7, abs=0.08)


def test_a_timeline_has_every_node_where_no_message_gets_lost():
    whole, generator = network({"trace": RULES["trace"]}), np.random.default_rng(3)
    z = {name: generator.standard_normal((3, node.received)) for name, node in whole.nodes.items()}
    expected = hg.run(whole, z).estimates["b"]["trace"]
    lossy = network({"trace": RULES["trace"]}, link=LINK)
    timeline = hg.Timeline(lossy, window=10.0)  # within a process nothing gets lost
    for k in range(3):
        for name in ("a", "c", "d"):
            assert timeline.push(name, k, float(k), z[name][k]) == "used"
    assert timeline.estimates()["b"]["trace"].mean == pytest.approx(np.asarray(expected.mean)[-1], rel=1e-9)


def test_a_service_has_every_node_where_no_message_gets_lost():
    whole, generator = network({"trace": RULES["trace"]}), np.random.default_rng(3)
    z = {name: generator.standard_normal((3, node.received)) for name, node in whole.nodes.items()}
    expected = hg.run(whole, z).estimates["b"]["trace"]
    service = Service(Fleet(NetworkProgram(whole), Options(5.0)), InMemoryStore())
    order = [(k, name) for k in range(3) for name in ("a", "c", "d")]
    sent = [{"node": n, "sequence": k, "time": k, "values": z[n][k].tolist()} for k, n in order]
    result = [json.loads(item.body) for item in service.take([json.dumps(item).encode() for item in sent])][-1]
    estimate = result["estimates"]["b"]["trace"]
    assert estimate["mean"] == pytest.approx(np.asarray(expected.mean)[-1].tolist(), rel=1e-9)
    assert estimate["claim"] == "upper"


@pytest.mark.slow
def test_parts_of_a_large_graph_are_the_whole(monkeypatch):
    """Rows sorted into parts by their length give what padded rows give."""
    generator = np.random.default_rng(0)
    names = [f"n{i}" for i in range(80)]
    near = hg.fusion.neighbours_within({name: generator.random(2) for name in names}, 0.25)
    rows = {name: ([[1.0, 0.5]], 0.3) for name in names}
    plant = hg.LinearPlant([[0.9, 0.3], [0.0, 0.9]], 0.1 * np.eye(2), np.zeros(2), np.eye(2))
    results = []
    for few in (64, 100):
        monkeypatch.setattr("heliograph.fusion.mesh.graph.FEW", few)
        net = network(
            {"m": hg.fusion.TraceIntersection(), "d": hg.fusion.DiffusionWeights()}, near, LINK, 1, plant, rows
        )
        assert (len(build_mesh(net, "m").buckets) > 1) == (few == 64)
        arrived = hg.simulation.mesh_arrivals(net, "m", 6, 0)
        results.append([hg.simulation.mesh_errors(net, name, arrived).actual for name in ("m", "d")])
    assert results[0][0] == pytest.approx(results[1][0], rel=1e-12)
    assert results[0][1] == pytest.approx(results[1][1], rel=1e-12)


def test_estimates_between_neighbours_are_not_smoothed(lossy):
    with pytest.raises(ValueError, match="smoothing: expected filters, and fusions at a centre"):
        hg.monte_carlo(lossy, 4, 1, 0, smooth=hg.smoothing.FixedInterval())


def test_arrivals_of_a_recording_have_their_shape(lossy):
    z = {name: np.zeros((3, node.received)) for name, node in lossy.nodes.items()}
    for reports, line in (
        ({}, "what arrived from the neighbours of"),
        ({"best": {"a": np.ones((3, 1))}}, "what arrived"),
    ):
        with pytest.raises(ValueError, match=line):
            hg.run(lossy, z, reports=reports)
    assert set(RING) == set(lossy.names)
