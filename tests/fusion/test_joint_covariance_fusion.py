import numpy as np
import pytest

import heliograph as hg
from tests.fusion.fusion_problems import case, network, random_case, rules, two_gains
from tests.oracles.shared_information import local_gains, stacked_errors

RULES = ("scalar", "matrix", "matrix_with_mean", "all_reports")
WRONG = ("node 0", "node 2", "node 3")
TARGETS = {  # traces after 200 steps, by these rules and of the central filter
    "three_partial": (79.36, 5.130159, 5.130159, 5.097404, 5.097404),
    "three_rooms": (0.8298, 0.326248, 0.325936, 0.325670, 0.325670),
    "four_equal": (3.975, 3.974674, 3.383056, 3.106209, 3.106209),
}


def brute_force(plant, parts, steps):
    """Joint covariance of (x, e_1, ...) and the central filter's, in NumPy."""
    model = (plant.matrix, plant.noise.covariance, plant.initial_mean, plant.initial_covariance)
    nodes = []
    for c, r, gain, variance, noise in parts:
        m = len(c)

        def spread(second, c=c, r=r, gain=gain, variance=variance, noise=noise, m=m):
            return variance * (c @ second @ c.T + r * np.eye(m)) + (gain**2 * r + noise) * np.eye(m)

        nodes.append((gain * c, spread, local_gains(model, gain * c, spread, steps)))
    return stacked_errors(model, nodes, steps)


@pytest.mark.slow
@pytest.mark.parametrize("name", TARGETS)
def test_every_rule_gives_the_best_linear_estimate_of_what_it_has(name):
    """Against the stacked problem in NumPy to 1e-9, and to the digits that the cases are stated with."""
    plant, parts = case(name)
    net, n = network(plant, parts, {name: rules()[name] for name in RULES}), len(plant.states)
    results = {rule: np.trace(p[-1]) for rule, p in hg.simulation.fused_covariances(net, 200).items()}
    joint, central = brute_force(plant, parts, 200)
    scalar, *others, best = TARGETS[name]
    assert results["scalar"] == pytest.approx(scalar, rel=1e-4)
    for rule, expected in zip(RULES[1:], others, strict=True):
        assert results[rule] == pytest.approx(expected, abs=6e-7)  # half of the last digit, and rounding of it
    assert np.trace(central) == pytest.approx(best, abs=6e-7)
    assert results["all_reports"] == pytest.approx(np.trace(central), rel=1e-9)  # every gain has full column rank
    ones = np.tile(np.eye(n), (len(parts), 1))
    # Of partial outputs P is singular, across the range of the ones: e3_x - e3_y = x - y = e2_x - e1_y.
    information = ones.T @ np.linalg.pinv(joint[n:, n:], rcond=1e-11, hermitian=True) @ ones
    assert results["matrix"] == pytest.approx(np.trace(np.linalg.inv(information)), rel=1e-9)
    assert set(net.claims()["fused"].values()) == {"exact"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 7, 8])
def test_reports_that_bring_no_news_take_no_digits(seed):
    """Of 12 numbers in four reports at most 6 are new: what rounding leaves of the others must not count.

    A pseudo-inverse of one covariance gave traces of -1.17, .997 and 1 - 4e-9 times the central filter's; the last
    joint covariance has a condition of 1e8.
    """
    plant, parts = random_case(seed, nodes=4)
    net = network(plant, parts, {"all_reports": rules()["all_reports"]})
    _, central = brute_force(plant, parts, 15)
    (covariances,) = hg.simulation.fused_covariances(net, 15).values()
    np.testing.assert_allclose(covariances[-1], central, atol=1e-9 * np.trace(central))


@pytest.mark.parametrize("seed", range(3))
def test_cross_covariances_are_those_of_the_stacked_problem(seed):
    """Nodes of different lengths, a plant with a mean: 1e-9 of what brute force says; the order changes nothing."""
    plant, parts = random_case(seed)
    n = len(plant.states)
    cross = hg.simulation.cross_covariances(network(plant, parts, {}), "local", 12)
    joint, _ = brute_force(plant, parts, 12)
    np.testing.assert_allclose(cross.joint.reshape(joint[n:, n:].shape), joint[n:, n:], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cross.of_state.reshape(-1, n), joint[n:, :n], rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(cross.state_covariance, joint[:n, :n], rtol=1e-12)
    np.testing.assert_allclose(cross.bias, 0.0, atol=1e-14)
    order = [2, 1, 0]
    turned = hg.simulation.cross_covariances(network(plant, parts, {}, order), "local", 12)
    assert turned.nodes == tuple(f"node {i}" for i in order)
    np.testing.assert_allclose(turned.joint, cross.joint[order][:, :, order], rtol=1e-12, atol=1e-14)
    weights, covariance = cross.matrix_weights()
    lost = 10 * np.finfo(float).eps * np.linalg.cond(cross.joint.reshape(3 * n, 3 * n))  # digits that a solve loses
    np.testing.assert_allclose(
        weights, hg.fusion.MatrixWeights().weights(cross.joint), atol=lost * np.abs(weights).max()
    )
    np.testing.assert_allclose(weights.sum(axis=1), np.eye(n), atol=1e-12)
    dense = hg.simulation.fused_covariances(network(plant, parts, {"m": rules()["matrix"]}), 12)["m"][-1]
    np.testing.assert_allclose(covariance, dense, rtol=1e-9)


@pytest.fixture(scope="module")
def world():
    """Five nodes; three have a second filter that trusts the mean gain and starts where it likes; every rule."""
    plant, parts = random_case(11, nodes=5, n=2)
    nodes = dict(network(plant, parts, {}).nodes)
    for name in WRONG:
        sensor, channel, filters = nodes[name].sensor, nodes[name].channel, nodes[name].filters
        wrong = hg.mean_gain_filter(plant, sensor, channel, initial_mean=np.ones(len(plant.states)))
        nodes[name] = hg.Node(sensor, channel, filters | {"wrong": wrong})
    return hg.Network(plant, nodes, rules() | {"wrong": hg.Fusion("wrong", hg.fusion.MatrixWeights())})


@pytest.fixture(scope="module")
def record(world):
    return hg.monte_carlo(world, 6, 4000, 2)


@pytest.mark.slow
def test_monte_carlo_agrees_with_what_is_claimed(world, record):
    """E |x - xhat|^2 at the last step within three standard errors, rules that know more never worse.

    Gains that are not the best are taken as they are: their filters' claims are nominal, the fused one is exact.
    """
    for name, estimate in record.estimates["fused"].items():
        square = np.sum(record.errors("fused", name)[:, -1] ** 2, axis=-1)
        error = square.std() / np.sqrt(len(square))
        assert abs(square.mean() - np.trace(estimate.covariance[0, -1])) < 3 * error, name
        assert estimate.claim == "exact"
    assert {record.estimates[name]["wrong"].claim for name in WRONG} == {"nominal"}
    trace = {name: np.trace(e.covariance[0, -1]) for name, e in record.estimates["fused"].items()}
    assert trace["all_reports"] <= trace["matrix"] * (1 + 1e-12) and trace["matrix"] <= trace["diagonal"]
    assert trace["matrix_with_mean"] <= trace["matrix"] and trace["diagonal"] <= trace["scalar"]
    data = {node: z[0] for node, z in record.measurements.items()}
    again = hg.run(world, data)
    for name, estimate in record.estimates["fused"].items():
        np.testing.assert_allclose(again.estimates["fused"][name].mean, estimate.mean[0], rtol=1e-9, atol=1e-11)


def relayed(world):
    """Errors of five nodes, those of two relays that fuse two and three of them, and the relays' weights by hand."""
    groups = {"a": [0, 3], "b": [1, 2, 4]}
    leaves = hg.simulation.cross_covariances(world, "local", 6)
    level = leaves.fused({name: [f"node {i}" for i in mine] for name, mine in groups.items()})
    by_hand = np.zeros((2, 2, 5, 2))
    for r, mine in enumerate(groups.values()):
        by_hand[r][:, mine] = hg.fusion.MatrixWeights().weights(leaves.joint[mine][:, :, mine])
    return leaves, level, by_hand


@pytest.mark.slow
def test_a_tree_of_relays_is_its_weights_on_the_leaves(world):
    """Two relays and a root against W P W' by hand."""
    leaves, level, by_hand = relayed(world)
    joint = np.einsum("raib,ibjc,sdjc->rasd", by_hand, leaves.joint, by_hand)
    np.testing.assert_allclose(level.joint, joint, rtol=1e-7, atol=1e-9)  # weights lose the digits of cond(P)
    covariance = level.matrix_weights()[1]
    flat = leaves.matrix_weights()[1]
    assert np.trace(flat) <= np.trace(covariance) <= min(np.trace(joint[r, :, r]) for r in (0, 1))
    with pytest.raises(ValueError, match=r"nodes: expected one relay for each, got several for \['node 1'\]"):
        leaves.fused({"a": ["node 1"], "b": ["node 1", "node 2"]})


@pytest.mark.slow
def test_simulated_errors_of_a_tree_are_those_of_its_covariance(world, record):
    _, level, by_hand = relayed(world)
    weights, covariance = level.matrix_weights()
    errors = np.stack([record.errors(node, "local")[:, -1] for node in world.names], axis=1)
    square = np.sum(np.einsum("ars,rsib,kib->ka", weights, by_hand, errors) ** 2, axis=-1)
    assert abs(square.mean() - np.trace(covariance)) < 3 * square.std() / np.sqrt(len(square))


def along_and_linear(plant, parts):
    """Two nodes, fused along cubature filters and by the linear ones, and the first alone by the plant's mean."""
    linear, fused = network(plant, parts, {}), {"alone": hg.Fusion("alone", hg.fusion.MatrixWeights(with_mean=True))}
    nodes = {}
    for name, node in linear.nodes.items():
        filters = {"local": node.filters["local"], "cubature": hg.cubature_filter(plant, node.sensor, node.channel)}
        nodes[name] = hg.Node(node.sensor, node.channel, filters)
    first = nodes["node 0"]
    nodes["node 0"] = hg.Node(first.sensor, first.channel, first.filters | {"alone": first.filters["local"]})
    for name in ("matrix", "all_reports"):
        fused |= {f"{item} {name}": hg.Fusion(item, rules()[name].rule) for item in ("local", "cubature")}
    return hg.Network(plant, nodes, fused)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["native", "xla"])
def test_losses_that_are_said_count_with_the_pattern_that_happened(engine, monkeypatch):
    """A node of which nothing arrives is its prediction: fusing with it is fusing with the plant's own mean.

    Every estimate is a number by both engines: what nobody knows along estimates does not count behind whole links.
    """
    monkeypatch.setenv("HELIOGRAPH_ENGINE", engine)
    z = {"node 0": np.zeros((6, 1)), "node 1": np.full((6, 2), np.nan)}
    fused = hg.run(along_and_linear(*random_case(7, nodes=2, n=2)), z).estimates["fused"]
    np.testing.assert_allclose(fused["local matrix"].covariance, fused["alone"].covariance, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_losses_at_random_keep_the_claim():
    """Each run has the covariances of its own losses: mean squares agree within three standard errors."""
    plant, parts = random_case(5)
    perfect = network(plant, parts, {})
    nodes = {
        name: hg.Node(node.sensor, hg.erasure(node.channel, 0.6), node.filters) for name, node in perfect.nodes.items()
    }
    stored = {name: rules()[name] for name in ("matrix", "all_reports")}
    record = hg.monte_carlo(hg.Network(plant, nodes, stored), 4, 3000, 11)
    for name, estimate in record.estimates["fused"].items():
        covariance = np.asarray(estimate.covariance)[:, -1]
        assert estimate.claim == "exact" and np.ptp(np.trace(covariance, axis1=1, axis2=2)) > 0
        excess = np.sum(record.errors("fused", name)[:, -1] ** 2, axis=-1) - np.trace(covariance, axis1=1, axis2=2)
        assert abs(excess.mean()) < 3 * excess.std() / np.sqrt(len(excess))


def test_nodes_that_hear_the_same_and_estimates_without_error():
    """One rank rule: a copy changes nothing, and an estimate without error is followed whatever the others say."""
    draw = np.random.default_rng(0)
    root = draw.normal(size=(4, 4))
    item = (root @ root.T).reshape(2, 2, 2, 2)
    copied = item[[0, 1, 1]][:, :, [0, 1, 1]]
    alone, both = hg.fusion.MatrixWeights().weights(item), hg.fusion.MatrixWeights().weights(copied)
    np.testing.assert_allclose(both[:, 1] + both[:, 2], alone[:, 1], rtol=1e-9)
    known = item.copy()
    known[0], known[:, :, 0] = 0.0, 0.0
    np.testing.assert_allclose(hg.fusion.MatrixWeights().weights(known)[:, 0], np.eye(2), atol=1e-9)
    np.testing.assert_allclose(hg.fusion.MatrixWeights().weights(item * 1e-20), alone, rtol=1e-9)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda p, s, c: hg.polynomial_filter(p, s, c, 2), "whose gains depend on no data, got"),
        (lambda p, s, c: hg.linear_filter(p, s, c), "expected a channel that forgets"),
    ],
)
def test_what_is_not_known_is_refused(make, message):
    plant, parts = random_case(0, nodes=1)
    sensor = hg.LinearSensor(parts[0][0], 1.0)
    fading = hg.Discrete([0.5, 1.0], [0.5, 0.5])
    channel = hg.hop(fading, noise=0.1)
    if "forgets" in message:
        channel = hg.gilbert_elliott(channel, hg.model.silent(noise=0.1), 0.1, 0.5)
    nodes = {"a": hg.Node(sensor, channel, {"local": make(plant, sensor, channel)})}
    with pytest.raises(ValueError, match=message):
        hg.Network(plant, nodes, {"matrix": hg.Fusion("local", hg.fusion.MatrixWeights())})


def test_a_covariance_each_is_not_enough():
    pair = [hg.model.Estimate(np.zeros(2), np.eye(2), "exact")] * 2
    with pytest.raises(ValueError, match="fusion by MatrixWeights: expected the errors' joint covariance"):
        hg.fusion.fuse(hg.fusion.MatrixWeights(), pair)


@pytest.mark.slow
def test_filters_whose_gains_depend_on_data_are_followed_along_the_estimates():
    """Cubature filters behind gains that hardly vary are the linear ones: weights, reports and claims agree.

    The spread of a gain times the square of the signal is all that differs: 1e-10 of variance.
    """
    plant, parts = random_case(2, nodes=2, n=2)
    net = along_and_linear(plant, [(c, r, mean, 1e-10, noise) for c, r, mean, _, noise in parts])
    draw = np.random.default_rng(0)
    data = {name: draw.normal(size=(6, node.received)) for name, node in net.nodes.items()}
    fused = hg.run(net, data).estimates["fused"]
    for name in ("matrix", "all_reports"):
        ours, theirs = fused[f"cubature {name}"], fused[f"local {name}"]
        assert net.claims()["fused"][f"cubature {name}"] == "nominal"
        np.testing.assert_allclose(ours.covariance, theirs.covariance, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="filters whose gains depend on no data"):
        hg.simulation.cross_covariances(net, "cubature", 3)
    with pytest.raises(ValueError, match="for the plant's own moments"):
        hg.Network(plant, net.nodes, {"one": hg.Fusion("cubature", hg.fusion.MatrixWeights(with_mean=True))})


@pytest.mark.slow
def test_a_large_tree_is_the_small_one():
    """Eleven leaves in a tree of degree three, made of numbers: every level as relays of named nodes give it."""
    plant, _ = random_case(4, n=2)
    draw = np.random.default_rng(1)
    numbers = {"output": draw.normal(size=(11, 1, 2)), "noise": 0.1 + draw.random(11)}

    def leaf(item):
        sensor, channel = hg.LinearSensor(item["output"], 0.2), hg.hop(two_gains(0.8, 0.05), noise=item["noise"])
        return hg.Node(sensor, channel, {"local": hg.linear_filter(plant, sensor, channel)})

    tree = hg.simulation.relay_tree(plant, leaf, numbers, 3, 5)
    nodes = {f"{i}": leaf({name: values[i] for name, values in numbers.items()}) for i in range(11)}
    net = hg.Network(plant, nodes)
    level = hg.simulation.cross_covariances(net, "local", 5)
    for covariances in tree.covariances:
        np.testing.assert_allclose(covariances, np.einsum("iaib->iab", level.joint), rtol=1e-7)
        names = level.nodes
        level = level.fused({f"over {i}": names[i : i + 3] for i in range(0, len(names), 3)})
    assert [len(c) for c in tree.covariances] == [11, 4, 2, 1] and tree.claim == "exact"
    record = hg.monte_carlo(net, 5, 2016, 3)
    estimates = np.stack([record.estimates[name]["local"].mean[:, -1] for name in net.names], axis=1)
    square = np.sum((record.truth[:, -1] - tree.fused(estimates)) ** 2, axis=-1)
    assert abs(square.mean() - np.trace(tree.root)) < 3 * square.std() / np.sqrt(len(square))
    with pytest.raises(ValueError, match="one leading axis of nodes"):
        hg.simulation.relay_tree(plant, leaf, {"output": numbers["output"], "noise": np.ones(3)}, 3, 5)
