"""Bad input is a ValueError at construction: one line that names the thing, what was expected and what came."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as h
from tests.losing import Losing

EYE = np.eye(2)
SKEWED = [[1.0, 0.5], [0.4, 1.0]]
INDEFINITE = [[1.0, 2.0], [2.0, 1.0]]
NAN, INF = np.nan, np.inf


def still(x, u):
    return x


def plant() -> h.LinearPlant:
    return h.LinearPlant(EYE, EYE, [0, 0], EYE)


def driven() -> h.LinearPlant:
    return h.LinearPlant(EYE, EYE, [0, 0], EYE, input_matrix=[[1.0], [0.0]], inputs=["push"])


def sensor() -> h.LinearSensor:
    return h.LinearSensor([[1.0, 0.0]], 1.0)


def seen_by(seeing) -> h.Network:
    return h.Network(plant(), {"a": h.Node(seeing, h.perfect(len(seeing.outputs)), {})})


def node() -> h.Node:
    return h.Node(sensor(), h.perfect(), {"aware": h.cubature_filter(plant(), sensor(), h.perfect())})


def network() -> h.Network:
    return h.Network(plant(), {"a": node()})


def pushed() -> h.Network:
    filters = {"aware": h.cubature_filter(driven(), sensor(), h.perfect())}
    return h.Network(driven(), {"a": h.Node(sensor(), h.perfect(), filters)})


def small() -> tuple[h.LinearPlant, h.LinearSensor]:
    """Parts of one state."""
    return h.LinearPlant([[1.0]], 1.0, [0.0], 1.0), h.LinearSensor([[1.0]], 1.0)


def lasting(steps: int) -> h.Network:
    channel = h.model.over_time([h.hop(0.5 + k, 0.1) for k in range(steps)])
    return h.Network(plant(), {"a": h.Node(sensor(), channel, {})})


def one_per_step(*lengths: int) -> h.model.OverTime:
    return h.model.OverTime({str(i): np.zeros(n) for i, n in enumerate(lengths)})


SHAPES = [
    (lambda: h.LinearPlant(np.eye(3), EYE, [0, 0], EYE), "plant matrix", "shape (3, 3)"),
    (lambda: h.LinearPlant([[1, 10**400], [0, 1]], EYE, [0, 0], EYE), "plant matrix", "[[1, 1000"),
    (lambda: h.LinearPlant(np.array([["2026"]], "M8[Y]"), 1.0, [0], 1.0), "plant matrix", "array([['2026"),
    (lambda: h.LinearPlant(np.ma.array(EYE, mask=EYE), EYE, [0, 0], EYE), "plant matrix", "2 that are not finite"),
    (lambda: h.LinearPlant([[1, 0], [1]], EYE, [0, 0], EYE), "plant matrix", "[[1, 0], [1]]"),
    (lambda: h.LinearPlant(EYE, np.eye(3), [0, 0], EYE), "process noise", "shape (3, 3)"),
    (lambda: h.LinearPlant(EYE, h.Gaussian(np.eye(3)), [0, 0], EYE), "process noise", "dimension 3"),
    (lambda: h.LinearPlant(EYE, EYE, EYE, EYE), "initial mean", "shape (2, 2)"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], [1, 1]), "initial covariance", "shape (2,)"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], EYE, [[1.0]]), "input matrix", "shape (1, 1)"),
    (lambda: h.Plant(lambda x, u: x[:1], EYE, [0, 0], EYE), "transition(x, u)", "shape (1,)"),
    (lambda: h.Plant(still, lambda u: jnp.eye(3), [0, 0], EYE), "process noise covariance(u)", "shape (3, 3)"),
    (lambda: h.Plant(still, EYE, [0, 0], EYE, states=["x"]), "state names", "['x']"),
    (lambda: h.Plant(still, EYE, [0, 0], EYE, states=["x", "x"]), "state names", "['x', 'x']"),
    (lambda: h.Plant(still, EYE, [0, 0], EYE, inputs=["u", "u"]), "input names", "['u', 'u']"),
    (lambda: h.LinearSensor([1.0, 0.0], 1.0), "sensor matrix", "shape (2,)"),
    (lambda: h.LinearSensor(EYE, 1.0, outputs=["y"]), "sensor outputs", "['y']"),
    (lambda: h.LinearSensor(EYE, [[1.0]]), "sensor noise", "shape (1, 1)"),
    (lambda: h.Sensor(lambda x: x, np.eye(3), outputs=["a", "b"]), "sensor noise", "shape (3, 3)"),
    (lambda: seen_by(h.Sensor(lambda x: x, 1.0)), "sensor", "shape (2,)"),
    (lambda: seen_by(h.LinearSensor(np.eye(3), 1.0)), "sensor", "a matrix of shape (3, 3)"),
    (lambda: h.Network(plant(), {"a": h.Node(sensor(), h.perfect(2), {})}), "channel", "one that takes 2"),
    (lambda: h.cubature_filter(plant(), sensor(), h.perfect(2)), "channel", "one that takes 2"),
    (lambda: h.cubature_filter(plant(), sensor(), h.perfect(), initial_mean=[0]), "filter's initial mean", "(1,)"),
    (lambda: h.amplify_and_forward([h.perfect(1), h.perfect(2)]), "series", "takes 2"),
    (lambda: h.model.with_direct_link(h.perfect(1), h.perfect(2)), "stack", "[1, 2]"),
    (lambda: h.random_affine.Mixture([h.perfect(1), h.perfect(2)], [0.5, 0.5]), "mixture", "[(1, 1), (2, 2)]"),
    (lambda: h.hop(1.0, np.ones((2, 3))), "hop noise", "shape (2, 3)"),
    (lambda: h.Discrete([[1.0]], [1.0]), "gain values", "shape (1, 1)"),
    (lambda: h.Discrete([1.0, 2.0], [1.0]), "gain probabilities", "shape (1,)"),
    (lambda: one_per_step(2, 3), "OverTime", "['2', '3']"),
    (lambda: h.model.over_time([h.perfect(1), h.perfect(2)]), "over_time", "shape (2, 2) of number 1"),
    (lambda: h.model.over_time([h.hop(1.0, 0.1), h.hop(h.Rayleigh(0.8), 0.1)]), "over_time", "law: Constant of num"),
    (lambda: h.model.over_time([h.perfect(), h.erasure(h.perfect(), 0.9)]), "over_time", "Erasure of number 1"),
]  # fmt: skip

PROBABILITIES = [
    (lambda: h.Discrete([1, 2], [0.5, 0.6]), "gain probabilities", "sum 1.1"),
    (lambda: h.Discrete([1, 2], [-0.1, 1.1]), "gain probabilities", "[-0.1, 1.1]"),
    (lambda: h.Discrete([1, 2], [NAN, 1.0]), "gain probabilities", "1 that are not finite"),
    (lambda: h.Discrete([1, 2], [0.5, 0.5], -0.1), "probability radius", "-0.1"),
    (lambda: h.Discrete([1, 2], [0.5, 0.5], 0.6), "probability radius", "0.6"),
    (lambda: h.Discrete([1, 2], [0.5, 0.5], [0.1, 0.1, 0.1]), "probability radius", "shape (3,)"),
    (lambda: h.random_affine.bernoulli(1.2), "probability that a link works", "1.2"),
    (lambda: h.dropout(h.perfect(), -0.2), "arrival probability", "-0.2"),
    (lambda: h.random_affine.Mixture([h.perfect(), h.model.silent()], [0.7, 0.7]), "gain probabilities", "sum 1.4"),
    (lambda: h.random_affine.FiniteSupport([[1.0], [2.0]], [0.7, 0.7]), "noise probabilities", "sum 1.4"),
]

COVARIANCES = [
    (lambda: h.LinearPlant(EYE, SKEWED, [0, 0], EYE), "process noise", "differ by 0.1"),
    (lambda: h.LinearPlant(EYE, INDEFINITE, [0, 0], EYE), "process noise", "eigenvalue -1"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], SKEWED), "initial covariance", "differ by 0.1"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], INDEFINITE), "initial covariance", "eigenvalue -1"),
    (lambda: h.LinearSensor(EYE, SKEWED), "sensor noise", "differ by 0.1"),
    (lambda: h.LinearSensor([[1.0, 0.0]], -1.0), "sensor noise", "eigenvalue -1"),
    (lambda: h.hop(1.0, INDEFINITE), "hop noise", "eigenvalue -1"),
    (lambda: h.hop(1.0, -0.5), "hop noise", "eigenvalue -0.5"),
    (lambda: h.model.silent(2, noise=SKEWED), "noise of a silent channel", "differ by 0.1"),
    (lambda: h.Gaussian(INDEFINITE), "noise covariance", "eigenvalue -1"),
    (lambda: h.cubature_filter(plant(), sensor(), h.perfect(), initial_covariance=INDEFINITE),
     "filter's initial covariance", "eigenvalue -1"),
    (lambda: h.random_affine.GivenMoments([1.0, 0.5]), "gain moments", "which none has"),
]  # fmt: skip

NUMBERS = [
    (lambda: h.LinearPlant([[1, NAN], [0, 1]], EYE, [0, 0], EYE), "plant matrix", "1 that are not finite"),
    (lambda: h.LinearPlant(EYE, [[INF, 0], [0, INF]], [0, 0], EYE), "process noise", "2 that are not finite"),
    (lambda: h.LinearPlant(EYE, EYE, [0, NAN], EYE), "initial mean", "1 that are not finite"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], NAN), "initial covariance", "1 that are not finite"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], EYE, [[NAN], [0]]), "input matrix", "1 that are not finite"),
    (lambda: h.LinearPlant("A", EYE, [0, 0], EYE), "plant matrix", "'A'"),
    (lambda: h.LinearSensor([[INF, 0]], 1.0), "sensor matrix", "1 that are not finite"),
    (lambda: h.LinearSensor(EYE, NAN), "sensor noise", "1 that are not finite"),
    (lambda: h.hop(NAN, 0.1), "constant gain", "1 that are not finite"),
    (lambda: h.hop(1.0, NAN), "hop noise", "1 that are not finite"),
    (lambda: h.hop(1.0, 0.1, power=-1.0), "hop power", "-1"),
    (lambda: h.hop(1.0, 0.1, amplification=INF), "amplification", "1 that are not finite"),
    (lambda: h.Gaussian([[1.0]], [NAN]), "noise mean", "1 that are not finite"),
    (lambda: h.Discrete([1, INF], [0.5, 0.5]), "gain values", "1 that are not finite"),
    (lambda: h.Rayleigh(-1.0), "Rayleigh scale", "-1"),
    (lambda: h.random_affine.Rician(-1.0, 1.0), "Rician line of sight", "-1"),
    (lambda: h.random_affine.Rician(1.0, 0.0), "Rician scale", "got 0"),
    (lambda: h.random_affine.Nakagami(0.4), "Nakagami shape", "0.4"),
    (lambda: h.random_affine.LogNormal(0.0, -1.0), "log-normal deviation", "-1"),
    (lambda: h.random_affine.GivenMoments([NAN]), "gain moments", "1 that are not finite"),
    (lambda: h.filters.ZeroMean(-1.0), "scalar of the bound", "-1"),
    (lambda: h.filters.Scalars(0.0, 1.0), "scalars of the bound", "(0.0, 1.0)"),
]

KINDS = [
    (lambda: h.hop(1.0, 0.1, dimension=0), "dimension of a hop", "0"),
    (lambda: h.hop(1.0, 0.1, dimension=2.0), "dimension of a hop", "2.0"),
    (lambda: h.hop(1.0, 0.1, dimension=True), "dimension of a hop", "True"),
    (lambda: h.hop(1.0, [0.1, 0.1]), "hop noise", "shape (2,)"),
    (lambda: h.hop(1.0, h.Discrete([1.0, 2.0], [0.5, 0.5])), "hop noise", "Discrete"),
    (lambda: h.hop(h.perfect(), 0.1), "constant gain", "GainAndNoise"),
    (lambda: h.random_affine.GainAndNoise(3, EYE, 0.1), "gain of a hop", "3"),
    (lambda: h.amplify_and_forward([3]), "series", "3"),
    (lambda: h.model.with_direct_link(3, h.perfect()), "stack", "3"),
    (lambda: h.parallel([3]), "parallel channels", "3"),
    (lambda: h.dropout(3, 0.5), "dropout", "3"),
    (lambda: h.erasure(3, 0.5), "erasure", "3"),
    (lambda: h.perfect(2.0), "dimension", "2.0"),
    (lambda: h.model.silent(0), "outputs of a silent channel", "0"),
    (lambda: h.random_affine.Lift(h.perfect(), 2.0), "degree of the lift", "2.0"),
    (lambda: h.random_affine.Independent([3]), "independent noises", "3"),
    (lambda: h.LinearPlant(EYE * 1j, EYE, [0, 0], EYE), "plant matrix", "complex"),
    (lambda: h.LinearPlant(EYE, EYE * 1j, [0, 0], EYE), "process noise", "complex"),
    (lambda: h.LinearPlant(EYE, "1", [0, 0], EYE), "process noise", "'1'"),
    (lambda: h.LinearPlant(EYE, EYE, [0, 0], EYE, states="ab"), "state names", "'ab'"),
    (lambda: h.LinearSensor(EYE, 0.1, outputs="ab"), "sensor outputs", "'ab'"),
    (lambda: h.monte_carlo(network(), 5.0, 1, 0), "horizon", "5.0"),
    (lambda: h.monte_carlo(network(), 5, 10.0, 0), "runs", "10.0"),
    (lambda: h.monte_carlo(network(), 5, True, 0), "runs", "True"),
]

MISSING = [
    (lambda: h.Network(plant(), {}), "network", "none"),
    (lambda: h.amplify_and_forward([]), "series", "none"),
    (lambda: h.parallel([]), "parallel channels", "none"),
    (lambda: h.model.over_time([]), "over_time", "none"),
    (lambda: h.linear_filter(h.Plant(still, EYE, [0, 0], EYE), sensor(), h.perfect()), "linear filter", "Plant"),
]

RUNS = [
    (lambda: h.run(network(), {}), "measurements", "['a']"),
    (lambda: h.run(network(), {"a": [1.0], "b": [1.0]}), "measurements", "['b']"),
    (lambda: h.run(network(), {"a": []}), "measurements", "none"),
    (lambda: h.run(network(), {"a": np.zeros((3, 2))}), "measurements of node 'a'", "shape (3, 2)"),
    (lambda: h.run(network(), {"a": None}), "measurements of node 'a'", "shape ()"),
    (lambda: h.run(network(), {"a": "abc"}), "measurements of node 'a'", "'abc'"),
    (lambda: h.run(network(), {"a": [[10**400]]}), "measurements of node 'a'", "[[1000"),
    (lambda: h.run(network(), {"a": [1.0, INF]}), "measurements of node 'a'", "1 that are not finite"),
    (lambda: h.run(network(), {"a": [1.0, 2.0]}, time=[1.0, 0.5]), "time", "0.5 after 1"),
    (lambda: h.run(network(), {"a": [1.0, 2.0]}, time=[1.0]), "time", "shape (1,)"),
    (lambda: h.run(pushed(), {"a": [1.0]}), "inputs", "none"),
    (lambda: h.run(pushed(), {"a": [1.0]}, [[NAN]]), "inputs", "not finite"),
    (lambda: h.run(lasting(2), {"a": [1.0, 2.0, 3.0]}), "horizon", "got 3"),
    (lambda: h.monte_carlo(lasting(2), 3, 1, 0), "horizon", "got 3"),
    (lambda: h.monte_carlo(network(), 0, 1, 0), "horizon", "got 0"),
    (lambda: h.monte_carlo(network(), 1, 0, 0), "runs", "got 0"),
    (lambda: h.monte_carlo(network(), 1, 1, 0, inputs=np.zeros((1, 3))), "inputs", "shape (1, 3)"),
    (lambda: h.Stream(node().filters["aware"]).push([INF]), "measurement", "[inf]"),
    (
        lambda: h.monte_carlo(network(), 1, 1, np.timedelta64(1, "s")),
        "key",
        "timedelta64(1,'s')",
    ),  # one of NumPy's integers
    (lambda: h.monte_carlo(network(), np.timedelta64(1, "s"), 1, 0), "horizon", "timedelta64(1,'s')"),
    (
        lambda: h.Timeline(network(), 5.0).push("a", np.timedelta64(1, "s"), 0.0, [1.0]),
        "event of 'a', sequence",
        "timedelta64(1,'s')",
    ),
    (lambda: node().filters["aware"].predict(None), "state", "None"),
    (lambda: node().filters["aware"].correct(None, [1.0]), "state", "None"),
    (lambda: node().filters["aware"].step((), [1.0]), "state", "()"),
    (lambda: h.kalman_filter(*small()).step(3, [1.0]), "state", "3"),
    (lambda: node().filters["aware"].predict(h.kalman_filter(*small()).init()), "state", "Gaussian("),
]


@pytest.mark.parametrize(
    ("make", "name", "came"), [*SHAPES, *PROBABILITIES, *COVARIANCES, *NUMBERS, *KINDS, *MISSING, *RUNS]
)
def test_one_line_that_names_it(make, name, came):
    with pytest.raises(ValueError) as caught:
        make()
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(f"{name}: expected ")
    assert "Tracer" not in message
    assert came in "got " + message.split(", got ", 1)[1]


def test_masked_numbers_did_not_arrive():
    """Estimates without the masked value, from an array, a column of a table and a sample of a stream: 0 apart."""
    values = np.ma.array([1.0, 1e3, 2.0], mask=[False, True, False])
    expected = h.run(network(), {"a": [1.0, NAN, 2.0]}).estimates["a"]["aware"].mean
    table = h.files.read_recording({"time": [0.0, 1.0, 2.0], "y0": values}, network())
    stream = h.Stream(node().filters["aware"])
    pushed_means = [stream.push(values[k : k + 1]).mean for k in range(3)]
    for means in (h.run(network(), {"a": values}).estimates["a"]["aware"].mean, pushed_means):
        np.testing.assert_array_equal(means, expected)
    np.testing.assert_array_equal(h.run(network(), *table).estimates["a"]["aware"].mean, expected)


def test_a_covariance_that_is_lost_is_flagged():
    """Simulated, it stays as it is; of a recording the step with a negative variance is not taken, and that is said."""
    net = h.Network(plant(), {"a": h.Node(sensor(), h.perfect(), {"losing": Losing()})})
    record = h.simulate(net, 4, 0)
    assert record.failures() == ["a/losing: no valid covariance from step 2 in 1 of 1 runs"]
    np.testing.assert_array_equal(np.asarray(record.estimates["a"]["losing"].covariance)[:, 1, 1], [1, 1, -1, -1])
    with pytest.warns(UserWarning, match=r"node 'a': 2 rows \(3, 4\) are implausible, .* its covariance is none"):
        record = h.run(net, {"a": np.zeros(4)})
    np.testing.assert_array_equal(np.asarray(record.estimates["a"]["losing"].covariance)[:, 1, 1], [1, 1, 1, 1])
