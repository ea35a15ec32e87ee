"""Networks without a centre that are refused, in a line."""

import numpy as np
import pytest

import heliograph as hg
from tests.fusion.mesh.worlds import LINK, PLANT, ROWS, RULES, network


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


@pytest.mark.parametrize("loss", [0.4, 0.6])
def test_fixed_shares_are_refused_where_errors_grow_as_those_before_data_do(loss, monkeypatch):
    plant, near = hg.LinearPlant([[1.2]], [[0.1]], [0.0], [[1.0]]), {"b": ["a"], "c": ["b"]}
    link = hg.erasure(hg.perfect(), 1 - loss)
    with monkeypatch.context() as unrefused:
        unrefused.setattr("heliograph.simulation.mesh.check.check_error_decay", lambda *_: None)
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
