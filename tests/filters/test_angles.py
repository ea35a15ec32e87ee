"""Angles in every filter: what crosses the cut at pi gives what the same crossing elsewhere gives."""

from functools import cache

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import wrap_angles, wrap_near

STEPS = 30
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
QUIET, NOISY = hg.hop(1.0, np.diag([0.1, 1e-4])), hg.hop(1.0, np.diag([4.0, 1e-2]))
MODES = hg.random_affine.Modes(CHAIN, [QUIET, NOISY])
U = np.tile([1.0, 0.02], (STEPS, 1))  # a metre a step, turning slowly
TURNED = np.diag([-1.0, -1.0, 1.0])


def move(x, u):
    return jnp.stack([x[0] + u[0] * jnp.cos(x[2]), x[1] + u[0] * jnp.sin(x[2]), x[2] + u[1]])


def look(x):
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def robot(side: float, angles: bool = True) -> hg.Plant:
    """It drives past the station, east of it (side 1) or half a turn away (side -1), where bearings cross pi."""
    return hg.Plant(
        move,
        np.diag([0.05**2, 0.05**2, 0.01**2]),
        [30.0 * side, -12.0 * side, np.pi / 2 * side],
        np.diag([1.0, 1.0, 0.05**2]),
        states=("x", "y", "heading"),
        inputs=("distance", "turn"),
        circular=["heading"] if angles else [],
    )


def station(angles: bool = True) -> hg.Sensor:
    return hg.Sensor(look, np.diag([0.5**2, 0.02**2]), ("range", "bearing"), ["bearing"] if angles else [])


def filters(plant: hg.Plant, sensor: hg.Sensor) -> dict[str, hg.filters.AbstractFilter]:
    """All but the cubature filter, which the network below has at both nodes."""
    return {
        "extended": hg.extended_filter(plant, sensor, MODES),
        "imm": hg.filters.imm_filter(plant, sensor, MODES),
        "gpb1": hg.filters.gpb1_filter(plant, sensor, MODES),
        "gpb2": hg.filters.gpb2_filter(plant, sensor, MODES),
        "particle": hg.filters.particle_filter(plant, sensor, MODES, particles=5),
        "open_loop": hg.filters.open_loop_filter(plant),
    }


@cache
def network(side: float, angles: bool = True) -> hg.Network:
    """Two nodes that lose one packet in five, and both fused."""
    plant, sensor = robot(side, angles), station(angles)
    cubature = hg.cubature_filter(plant, sensor, MODES)
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        "equal": hg.Fusion("cubature", hg.fusion.EqualIntersection()),
        "central": hg.filters.sequential_filter([cubature, cubature]),
    }
    nodes = {name: hg.Node(sensor, hg.erasure(MODES, 0.8), {"cubature": cubature}) for name in "ab"}
    return hg.Network(plant, nodes, fused)


def alone(side: float, name: str) -> hg.Network:
    """The first node with one of the other filters: a program each is cheaper than one of all."""
    plant, sensor = robot(side), station()
    local = {name: filters(plant, sensor)[name]}
    return hg.Network(plant, {"a": hg.Node(sensor, hg.erasure(MODES, 0.8), local)})


def recording() -> dict[str, np.ndarray]:
    """What two nodes received of a robot in the east, in NumPy."""
    rng = np.random.default_rng(5)
    x, received = np.array([30.5, -12.5, np.pi / 2 + 0.03]), []
    for distance, turn in U:
        moved = np.array([distance * np.cos(x[2]), distance * np.sin(x[2]), turn])
        x = x + moved + rng.normal(0, [0.05, 0.05, 0.01])
        y = np.array([np.hypot(x[0], x[1]), np.arctan2(x[1], x[0])]) + rng.normal(0, [0.6, 0.03], (2, 2))
        received.append(np.where(rng.random((2, 1)) < 0.8, y, np.nan))
    z = np.moveaxis(np.array(received), 0, 1)
    return {"a": z[0], "b": z[1]}


@pytest.fixture(scope="module")
def east_and_west() -> tuple[hg.Record, hg.Record]:
    east = recording()
    west = {name: wrap_angles(z + np.array([0.0, np.pi]), (1,)) for name, z in east.items()}
    smooth = hg.smoothing.FixedInterval()
    return hg.run(network(1.0), east, U, smooth=smooth), hg.run(network(-1.0), west, U, smooth=smooth)


@pytest.mark.slow
def test_half_a_turn_further_everything_is_turned(east_and_west):
    """Cubature points turn with P = L L', so results are equal to rounding; the particles' draws come from z's bits."""
    bearings = east_and_west[1].measurements["a"][:, 1]
    assert np.nanmax(bearings) > 3 and np.nanmin(bearings) < -3  # it crosses
    pairs = {}
    for node, estimate in east_and_west[0].estimates.items():
        pairs |= {f"{node}/{name}": (item, east_and_west[1].estimates[node][name]) for name, item in estimate.items()}
    for name in filters(robot(1.0), station()):
        received = [(side, {"a": r.measurements["a"]}) for side, r in zip((1.0, -1.0), east_and_west, strict=True)]
        pairs[name] = [hg.run(alone(side, name), z, U).estimates["a"][name] for side, z in received]
    del pairs["particle"]
    for name, (item, other) in pairs.items():
        mean = wrap_angles(np.asarray(other.mean) - np.asarray(item.mean) @ TURNED - [0.0, 0.0, np.pi], (2,))
        np.testing.assert_allclose(mean, 0.0, atol=1e-8, err_msg=name)
        turned = TURNED @ np.asarray(item.covariance) @ TURNED
        np.testing.assert_allclose(other.covariance, turned, rtol=1e-7, atol=1e-9, err_msg=name)


@pytest.mark.slow
def test_what_is_smoothed_is_turned_too(east_and_west):
    """Sweeps never wrap: the cut is at no angle; what they tell is between -pi and pi. To rounding of 30 steps."""
    results = [record.smoothed for record in east_and_west]
    for node, estimate in results[0].estimates.items():
        for name, item in estimate.items():
            other = np.asarray(results[1].estimates[node][name].mean)
            turned = wrap_angles(other - np.asarray(item.mean) @ TURNED - [0.0, 0.0, np.pi], (2,))
            np.testing.assert_allclose(turned, 0.0, atol=1e-7, err_msg=f"{node}/{name}")
            assert np.all(np.abs(other[:, 2]) <= np.pi)


@pytest.mark.slow
def test_numbers_on_a_line_give_the_same_where_nothing_crosses_and_are_lost_where_something_does(east_and_west):
    east, west = east_and_west
    worst = []
    for side, record in ((1.0, east), (-1.0, west)):
        plain = hg.run(network(side, angles=False), record.measurements, U)
        items = [
            (item, record.estimates[node][f])
            for node, estimate in plain.estimates.items()
            for f, item in estimate.items()
        ]
        worst.append(max(np.abs(np.asarray(item.mean) - other.mean)[:, :2].max() for item, other in items))
    assert worst[0] < 1e-9 and worst[1] > 3  # metres


@pytest.mark.parametrize("side", [1.0, -1.0], ids=["without the cut", "across the cut"])
def test_filters_are_consistent_across_the_cut_as_elsewhere(side):
    outcome = hg.monte_carlo(network(side), STEPS, 2000, 0, keep=hg.Statistics(), inputs=U)
    assert not outcome.failures()
    for node, item in outcome.items():
        for name, statistics in item.items():
            nees, low, high = statistics.nees_per_dimension(0.999)  # six intervals: one in 160 such tests errs
            assert high <= 1 if name == "equal" else low <= 1 <= high, (node, name, nees)
    assert outcome["fused"]["central"].rmse()[0] < outcome["fused"]["equal"].rmse()[0] < 0.75


def turning(angles: bool) -> tuple[hg.LinearPlant, hg.LinearSensor]:
    """A heading and its rate, received by a compass."""
    names, item = ["heading", "rate"], ["heading"] if angles else []
    start = ([3.0, 0.3], np.diag([0.2, 0.01]))
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], np.diag([1e-3, 1e-4]), *start, states=names, circular=item)
    noise = hg.random_affine.FiniteSupport([[-0.3], [0.1]], [0.25, 0.75])
    return plant, hg.LinearSensor([[1.0, 0.0]], noise, ["compass"], ["compass"] if angles else [])


MAKERS = {
    "kalman": lambda p, s, c: hg.kalman_filter(p, s),
    "mixture": hg.filters.mixture_filter,
}


@pytest.mark.parametrize("name", MAKERS)
def test_a_compass_on_the_circle_is_one_on_a_line_that_was_wound_up(name):
    """Five turns: what is received without its turns gives what is received with them, likelihoods too."""
    rng = np.random.default_rng(7)
    wound = np.cumsum(np.full(100, 0.3)) + 3.0 + rng.normal(0, 0.2, 100)
    wound[40:43] = np.nan
    results = []
    for angles, z in ((False, wound), (True, wrap_angles(wound[:, None], (0,))[:, 0])):
        plant, sensor = turning(angles)
        item = MAKERS[name](plant, sensor, hg.perfect())
        record = hg.run(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"f": item})}), {"a": z})
        results.append((record.estimates["a"]["f"], hg.log_likelihood(item, z[:, None], np.zeros((100, 0))), item))
    (line, expected, _), (circle, likelihood, item) = results
    mean = np.asarray(circle.mean)
    assert np.all(np.abs(mean[:, 0]) <= np.pi + 1e-12)
    np.testing.assert_allclose(wrap_near(mean, np.asarray(line.mean), (0,)), line.mean, rtol=0, atol=1e-10)
    np.testing.assert_allclose(circle.covariance, line.covariance, rtol=1e-10, atol=1e-12)
    assert likelihood == pytest.approx(expected, rel=1e-10)
    assert item.claim == "nominal"  # a circle is no line: P grows beyond it


def test_an_unknown_heading_is_no_smaller_than_known():
    """Points that lie more than half a turn apart still tell how a compass is correlated with the heading."""
    plant, sensor = turning(True)
    wide = hg.cubature_filter(plant, sensor, hg.perfect(), initial_covariance=np.diag([30.0, 1e-4]))
    estimate = wide.estimate(wide.correct(wide.init(), [-3.0])[0])
    expected = 30.0 * 0.03 / (30.0 + 0.03)  # P R / (P + R), R = .25 .75 .4^2
    assert estimate.covariance[0, 0] == pytest.approx(expected, rel=1e-10)
    assert abs(wrap_near(np.asarray(estimate.mean), np.array([-3.0, 0.0]), (0,))[0] + 3.0) < 0.01


def test_fused_estimates_are_between_two_on_either_side_of_the_cut():
    mean = np.array([[3.1, 1.0], [-3.1, 2.0]])
    two = [hg.model.Estimate(m, np.eye(2), "nominal") for m in mean]
    for rule in (hg.CovarianceIntersection(), hg.fusion.EqualIntersection(), hg.fusion.WeightedFusion([0.5, 0.5])):
        result = hg.fusion.fuse(rule, two, angles=[0])
        assert abs(abs(result.mean[0]) - np.pi) < 1e-9 and result.mean[1] == pytest.approx(1.5)
        assert hg.fusion.fuse(rule, two).mean[0] == pytest.approx(0.0)  # numbers on a line
    with pytest.raises(ValueError, match="angles: expected places"):
        hg.fusion.fuse(hg.fusion.EqualIntersection(), two, angles=[2])


REFUSED = {
    "linear": lambda p, s: hg.linear_filter(p, s, hg.perfect()),
    "polynomial": lambda p, s: hg.polynomial_filter(p, s, hg.perfect(), 2, 5),
    "informed": lambda p, s: hg.filters.side_information_filter(p, s, hg.perfect()),
    "mode known": lambda p, s: hg.filters.mode_known_filter(p, s, hg.perfect()),
    "boundedness": lambda p, s: hg.simulation.certify_boundedness(
        hg.Network(p, {"a": hg.Node(s, hg.erasure(hg.perfect(), 0.5), {"f": hg.kalman_filter(p, s)})})
    ),
    "relays": lambda p, s: hg.model.RelayNetwork(p, s, ["r"], [{"receiver": {"sensor": hg.perfect()}}]),
    "weights": lambda p, s: hg.Network(
        p,
        {"a": hg.Node(s, hg.perfect(), {"f": hg.kalman_filter(p, s)})},
        {"x": hg.Fusion("f", hg.fusion.MatrixWeights())},
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_knows_only_lines_refuses_angles(name):
    with pytest.raises(ValueError, match=r"expected no angles \(cubature, .*got \['heading'"):
        REFUSED[name](*turning(True))


def test_what_a_full_turn_changes_is_no_circle():
    with pytest.raises(ValueError, match="plant with circular states: expected one that a full turn does not change"):
        hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0, circular=["x0"])
    with pytest.raises(ValueError, match="plant with circular states"):
        hg.LinearPlant([[1.0, 0.0], [0.1, 1.0]], 1.0, np.zeros(2), np.eye(2), circular=["x0"])
    with pytest.raises(ValueError, match=r"circular states: expected some of \['x0'\]"):
        hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, circular=["heading"])
    with pytest.raises(ValueError, match=r"circular outputs: expected some of \['y0'\]"):
        hg.LinearSensor([[1.0]], 1.0, circular=["bearing"])
    plant = hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0, circular=["x0"])
    with pytest.raises(ValueError, match="sensor of a plant with circular states"):
        hg.cubature_filter(plant, hg.LinearSensor([[1.0]], 1.0), hg.perfect())


def test_a_plant_says_how_states_differ():
    plant = robot(1.0)
    x, other = np.array([[1.0, 2.0, 3.1]]), np.array([[0.0, 0.0, -3.1]])
    np.testing.assert_allclose(plant.difference(x, other), [[1.0, 2.0, 6.2 - 2 * np.pi]])
    np.testing.assert_allclose(plant.near(x, other), [[1.0, 2.0, 3.1 - 2 * np.pi]])


def test_simulated_errors_are_around_the_circle():
    """Truth and signals are given between -pi and pi, and x - xhat is the error, whoever subtracts."""
    plant, sensor = turning(True)
    channel = hg.parallel([hg.hop(1.0, 0.5)])
    local = {"f": hg.extended_filter(plant, sensor, channel)}
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, channel, local)}), STEPS, 32, 1)
    assert np.all(np.abs(record.truth[..., 0]) <= np.pi) and np.ptp(record.truth[..., 0]) > 6  # they go around
    errors = record.errors("a", "f")
    assert np.max(np.abs(errors[..., 0])) <= np.pi
    weighed = np.linalg.solve(np.asarray(record.estimates["a"]["f"].covariance), errors[..., None])[..., 0]
    nees = hg.simulation.error_statistics(record, "a", "f").nees_per_dimension()[0]
    assert nees == pytest.approx(np.mean(np.sum(errors * weighed, axis=-1)) / 2, rel=1e-9)
