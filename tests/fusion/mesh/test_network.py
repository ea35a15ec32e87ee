"""Fusions between neighbours in a network: runs, recordings, statistics, claims, and what is refused."""

import json

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.live.fleet import Fleet, Options
from heliograph.live.lanes import Lanes
from heliograph.serving.service import Service
from heliograph.serving.storage.store_protocol import InMemoryStore
from heliograph.simulation.centres.mesh import mesh_of
from tests.fusion.mesh.worlds import PLANT, RING, ROWS, network

LINK = hg.erasure(hg.perfect(), 0.7)
BURSTS = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.1), 0.05, 0.3)
RULES = {
    "best": hg.fusion.MatrixWeights(),
    "trace": hg.fusion.TraceIntersection(),
    "diffusion": hg.fusion.DiffusionWeights(),
}
STEPS, RUNS = 12, 640


@pytest.fixture(scope="module")
def lossy():
    return network(RULES, link=LINK)


@pytest.fixture(scope="module")
def record(lossy):
    return hg.monte_carlo(lossy, STEPS, RUNS, 4)


@pytest.mark.slow
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
    rules = {"trace": RULES["trace"], "best": RULES["best"]}
    return hg.monte_carlo(network(rules, link=BURSTS), 40, 960, 1, hg.Statistics())


@pytest.mark.slow
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
        mesh = mesh_of(net, "m")
        model = mesh.observation_model
        z = tuple(np.zeros((c, 0 if group is None else 1)) for group, c in zip(model.groups, model.counts, strict=True))
        made = jax.make_jaxpr(lambda s: mesh.step(s, z, mesh.edges.lossless(), np.zeros(0), 0)[0])(mesh.init())
        return str(made).count("\n")

    assert operations(12) == operations(48)


@pytest.mark.slow
def test_a_link_for_each_edge(lossy):
    edges = ["b to a", "c to b", "d to b", "a to c", "b to c", "c to d"]
    net = network({"trace": RULES["trace"]}, link={name: LINK if name == "b to a" else hg.perfect() for name in edges})
    arrived = hg.simulation.mesh_arrivals(net, "trace", 400, 0)
    assert arrived[:, 1:, 0][:, mesh_of(net, "trace").edges.present[1:]].all()
    assert arrived[:, 0, 0, 1].mean() == pytest.approx(0.7, abs=0.08)


def sensor(noise=0.3):
    return hg.LinearSensor([[1.0, 0.0]], noise)


def node(noise=0.3, **filters):
    return hg.Node(sensor(noise), hg.perfect(), filters or {"own": hg.kalman_filter(PLANT, sensor(0.3))})


def fusion(rule=None, neighbours=None, **rest):
    return hg.Fusion("own", rule or hg.CovarianceIntersection(), neighbours=neighbours or {"a": ["b"]}, **rest)


LAW = hg.Discrete([0.0, 1.0], [0.5, 0.5])
STRANGER = {"a": {"c": 1.0}}
SHARES = {"a": {"b": 0.7, "a": 0.7}}
BAD = {
    "a node that is not there": (lambda: hg.Network(PLANT, {"a": node()}, {"m": fusion()}), "unknown ones"),
    "a sensor without the filter": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node(other=hg.kalman_filter(PLANT, sensor()))}, {"m": fusion()}),
        "node 'b': expected the filter 'own'",
    ),
    "an unstable mode that nobody sees": (
        lambda: hg.Network(PLANT, {"a": node(), "b": None}, {"m": fusion(neighbours={"a": ["b"]})}),
        "observes every mode that does not decay, got none for 'b'",
    ),
    "a node's own message": (lambda: fusion(neighbours={"a": ["a"]}), "expected other nodes"),
    "shares above one": (lambda: hg.fusion.DiffusionWeights(SHARES), "shares that sum to 1, got 1.4"),
    "shares below one": (
        lambda: hg.fusion.DiffusionWeights({"a": {"b": 0.1, "a": 0.1}}), "shares that sum to 1, got 0.2"
    ),
    "a negative share": (lambda: hg.fusion.DiffusionWeights({"a": {"b": -0.1}}), "a number of at least 0"),
    "a stranger's share": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(hg.fusion.DiffusionWeights(STRANGER))}),
        "diffusion shares of 'a': expected those of its neighbours",
    ),
    "a stranger's shares": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()}, {"m": fusion(hg.fusion.DiffusionWeights({"c": {"a": 1.0}}))}
        ),
        "diffusion shares: expected those of nodes of the fusion",
    ),
    "losses that nobody knows of on one edge": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()},
            {"m": fusion(neighbours={"a": [], "b": ["a"]}, link={"a to b": hg.dropout(hg.perfect(), 0.8)})}
        ),
        "link 'a to b': expected messages that arrive as they are",
    ),
    "losses that nobody knows of": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(link=hg.dropout(hg.perfect(), 0.8))}),
        "link between neighbours: expected messages that arrive as they are",
    ),
    "delays that nobody knows": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(link=hg.model.delayed(hg.perfect(), LAW))}),
        "link between neighbours: expected delays that the receiver knows",
    ),
    "best weights of what comes late": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()},
            {"m": fusion(hg.fusion.MatrixWeights(), link=hg.model.delayed(hg.perfect(), 1))}
        ),
        "expected a rule that intersects, where there are messages that come late",
    ),
    "events of what comes late": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()}, {"m": fusion(link=hg.model.delayed(hg.perfect(), 1), alpha=0.1)}
        ),
        "expected one round without events, where messages come late or quantized, got events",
    ),
    "a noisy link": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(link=hg.hop(1.0, 0.1))}),
        "link between neighbours: expected",
    ),
    "a link that is none": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(link=0.8)}),
        "link between neighbours: expected",
    ),
    "links of other edges": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(link={"a to b": LINK})}),
        "links between neighbours: expected one for each edge",
    ),
    "noises that nodes share": (
        lambda: hg.Network.sharing(
            PLANT, hg.LinearSensor(np.eye(2), [[1.0, 0.3], [0.3, 1.0]]), hg.perfect(2),
            {name: {"own": hg.kalman_filter(PLANT, sensor())} for name in "ab"}, {"m": fusion()}
        ),
        "whose noises are uncorrelated, got ['a', 'b'], which share a channel: stack their measurements",
    ),
    "a measurement without noise": (
        lambda: hg.Network(PLANT, {"a": node(0.0), "b": node()}, {"m": fusion(neighbours={"a": ["b"], "b": ["a"]})}),
        "node 'a': expected measurement noise in every direction",
    ),
    "a rule without weights": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(hg.fusion.AllReports())}),
        "expected a rule such as",
    ),
    "the plant's mean": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(hg.fusion.MatrixWeights(with_mean=True))}),
        "expected with_mean=False",
    ),
    "rounds of best weights": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"m": fusion(hg.fusion.MatrixWeights(), rounds=2)}),
        "expected one round",
    ),
    "no rounds": (lambda: fusion(rounds=0), "rounds of a fusion: expected a positive whole number"),
    "best weights of what is quantized": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()},
            {"m": fusion(hg.fusion.DiagonalWeights(), quantizer=hg.fusion.UniformQuantizer(4, 1.0))}
        ),
        "expected a rule that intersects, where there are quantizers",
    ),
    "a quantizer that remembers": (
        lambda: hg.Network(
            PLANT, {"a": node(), "b": node()},
            {"m": fusion(quantizer=hg.fusion.EscapeQuantizer(5, 1.0, 0.5, 0.5, 0.1))}
        ),
        "quantizer between neighbours: expected one with a bound on its error",
    ),
    "an uplink": (lambda: fusion(uplink=hg.fusion.ReportLink()), "expected a link of each edge"),
    "links without neighbours": (
        lambda: hg.Fusion("own", hg.CovarianceIntersection(), link=LINK), "expected neighbours"
    ),
    "a name that a filter has": (
        lambda: hg.Network(PLANT, {"a": node(), "b": node()}, {"own": fusion()}), "expected a name that no filter has"
    ),
    "a start without an inverse": (
        lambda: hg.Network(
            hg.LinearPlant(PLANT.matrix, PLANT.noise, [0.0, 0.0], np.diag([1.0, 0.0])),
            {"a": node(), "b": node()}, {"m": fusion()}
        ),
        "expected a regular initial covariance",
    ),
    "diffusion at a centre": (
        lambda: hg.Network(PLANT, {"a": node()}, {"m": hg.Fusion("own", hg.fusion.DiffusionWeights())}),
        "expected neighbours",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_in_a_line(name):
    made, line = BAD[name]
    with pytest.raises(ValueError, match="expected") as error:
        made()
    assert line in str(error.value) and "\n" not in str(error.value)


TWO_WAYS = {"b": ["a", "c"], "c": ["a"]}


@pytest.mark.parametrize(
    ("neighbours", "arrivals", "refused"),
    [
        ({"b": ["a"]}, {"a to b": 0.3}, True),  # .7 lost, of a mode of 1.2 at most 1 / 1.44 = .694
        ({"b": ["a"]}, {"a to b": 0.31}, False),
        (TWO_WAYS, {"a to b": 0.16, "c to b": 0.16, "a to c": 1.0}, True),  # .84 squared = .706
        (TWO_WAYS, {"a to b": 0.17, "c to b": 0.17, "a to c": 1.0}, False),  # .83 squared = .689
    ],
)
def test_losses_above_the_square_of_a_mode_are_refused(neighbours, arrivals, refused):
    plant = hg.LinearPlant([[1.2]], [[0.1]], [0.0], [[1.0]])
    links = {name: hg.erasure(hg.perfect(), arrival) for name, arrival in arrivals.items()}

    def made():
        return network({"m": RULES["trace"]}, neighbours, links, plant=plant, rows={"a": ([[1.0]], 0.3)})

    if refused:
        with pytest.raises(ValueError, match=r"expected losses below 0\.694 in all of what node 'b' learns"):
            made()
    else:
        assert made().claims()["b"]["m"] == "upper"


@pytest.mark.parametrize(("stays", "refused"), [(0.7, True), (0.69, False)])
def test_bursts_that_outlast_a_mode_are_refused(stays, refused):
    link = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.0), 0.01, 1 - stays)
    plant = hg.LinearPlant([[1.2]], [[0.1]], [0.0], [[1.0]])
    if refused:
        with pytest.raises(ValueError, match=r"losses below 0\.694 .* node 'b' learns of a mode of 1.2, got 0.7"):
            network({"m": RULES["trace"]}, {"b": ["a"]}, link, plant=plant, rows={"a": ([[1.0]], 0.3)})
    else:
        assert network({"m": RULES["trace"]}, {"b": ["a"]}, link, plant=plant, rows={"a": ([[1.0]], 0.3)}).meshes


@pytest.mark.slow
@pytest.mark.parametrize("loss", [0.4, 0.6])
def test_fixed_shares_are_refused_where_errors_grow_as_those_before_data_do(loss, monkeypatch):
    plant, near = hg.LinearPlant([[1.2]], [[0.1]], [0.0], [[1.0]]), {"b": ["a"], "c": ["b"]}
    link = hg.erasure(hg.perfect(), 1 - loss)
    with monkeypatch.context() as unrefused:
        unrefused.setattr("heliograph.simulation.centres.mesh_check.check_decay", lambda *_: None)
        net = network({"m": RULES["diffusion"]}, near, link, plant=plant, rows={"a": ([[1.0]], 0.3)})
    error = hg.simulation.mean_mesh_errors(net, "m", 240).mean_trace()
    growth = (error[-1] / error[-101]) ** 0.01
    if loss == 0.4:
        assert growth == pytest.approx(1.0, abs=1e-9)
        network({"m": RULES["diffusion"]}, near, link, plant=plant, rows={"a": ([[1.0]], 0.3)})
        return
    with pytest.raises(ValueError, match=f"squares that grow by {growth:.3g} a step at node 'c'"):
        network({"m": RULES["diffusion"]}, near, link, plant=plant, rows={"a": ([[1.0]], 0.3)})


def test_a_decaying_mode_that_nobody_observes_stays_with_a_warning():
    plant = hg.LinearPlant(np.diag([1.02, 0.5]), 0.1 * np.eye(2), np.zeros(2), np.eye(2))
    rows = {"a": ([[1.0, 0.0]], 0.3), "b": ([[1.0, 0.0]], 0.3)}
    with pytest.warns(UserWarning, match="a decaying mode is observed by nobody upstream"):
        network({"m": RULES["trace"]}, {"a": ["b"]}, plant=plant, rows=rows)


def test_best_weights_of_many_nodes_are_refused_where_they_would_be_stepped():
    names = [f"n{i}" for i in range(201)]
    ring = {name: [names[i - 1]] for i, name in enumerate(names)}
    net = network({"m": hg.fusion.MatrixWeights()}, ring, rows={name: ROWS["a"] for name in names})
    with pytest.raises(ValueError, match="expected at most 200 nodes"):
        hg.monte_carlo(net, 2, 1, 0)


@pytest.mark.slow
def test_a_timeline_has_every_node_where_no_message_gets_lost():
    whole, generator = network({"trace": RULES["trace"]}), np.random.default_rng(3)
    z = {name: generator.standard_normal((3, node.received)) for name, node in whole.nodes.items()}
    expected = hg.run(whole, z).estimates["b"]["trace"]
    timeline = hg.Timeline(
        network({"trace": RULES["trace"]}, link=LINK), window=10.0
    )  # within a process nothing gets lost
    for k in range(3):
        for name in ("a", "c", "d"):
            assert timeline.push(name, k, float(k), z[name][k]) == "used"
    assert timeline.estimates()["b"]["trace"].mean == pytest.approx(np.asarray(expected.mean)[-1], rel=1e-9)


@pytest.mark.slow
def test_a_service_has_every_node_where_no_message_gets_lost():
    whole, generator = network({"trace": RULES["trace"]}), np.random.default_rng(3)
    z = {name: generator.standard_normal((3, node.received)) for name, node in whole.nodes.items()}
    expected = hg.run(whole, z).estimates["b"]["trace"]
    service = Service(Fleet(Lanes(whole), Options(5.0)), InMemoryStore())
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
        assert (len(mesh_of(net, "m").buckets) > 1) == (few == 64)
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
