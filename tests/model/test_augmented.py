"""Sensors of several nodes as one, and clocks as states: angles, linearity, and steps of varying time."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import wrap_angles

STEPS = 60


def bearing(place, circular=("bearing",)):
    def look(x):
        return jnp.arctan2(x[1] - place[1], x[0] - place[0])[None]

    return hg.Sensor(look, 1e-3**2, outputs=["bearing"], circular=circular)


PLACE = hg.Plant(lambda x, u: x, 1e-6 * np.eye(2), [-9.0, 0.5], np.eye(2))
PLACES, TRUTH = {"a": (0.0, 0.0), "b": (0.0, 5.0)}, np.array([-10.0, 0.0])


def bearings():
    """Both bearings of a target in the west, the first of which jumps between pi and -pi."""
    exact = [np.arctan2(TRUTH[1] - y, TRUTH[0] - x) for x, y in PLACES.values()]
    return wrap_angles(exact + 1e-3 * np.random.default_rng(0).normal(size=(STEPS, 2)), (0, 1))


def test_a_bearing_across_pi_of_a_joint_sensor_is_read_around_the_circle():
    joint, z = hg.model.joint_sensor({name: bearing(place) for name, place in PLACES.items()}), bearings()
    assert z[:, 0].min() < -3 and z[:, 0].max() > 3
    result = hg.cubature_filter(PLACE, joint).run(z)
    error = TRUTH - result.means[-1]
    assert np.abs(error).max() < 0.05 and error @ np.linalg.solve(result.covariances[-1], error) < 16  # of 2: p = 3e-4


def test_a_joint_sensor_of_linear_sensors_is_linear_and_the_claim_exact():
    plant = hg.LinearPlant([[1.0, 0.1], [0.0, 1.0]], 0.01 * np.eye(2), [0.0, 1.0], np.eye(2))
    sensors = {"a": hg.LinearSensor([[1.0, 0.0]], 0.1), "b": hg.LinearSensor([[0.0, 1.0]], 0.2)}
    joint = hg.model.joint_sensor(sensors)
    links = [hg.hop(hg.Rayleigh(0.8), 0.1), hg.perfect()]
    fused = hg.linear_filter(plant, joint, hg.parallel(links))
    assert fused.claim == "exact" == hg.kalman_filter(plant, joint).claim
    z = np.random.default_rng(1).normal(size=(STEPS, 2))
    by_hand = hg.LinearSensor(np.eye(2), np.diag([0.1, 0.2]))
    np.testing.assert_array_equal(fused.run(z).means, hg.linear_filter(plant, by_hand, hg.parallel(links)).run(z).means)
    with pytest.raises(ValueError, match=r"distinct names"):
        hg.model.joint_sensor(
            {"a": hg.LinearSensor([[1.0]], 1.0, ["b_c"]), "a_b": hg.LinearSensor([[1.0]], 1.0, ["c"])}
        )


def test_a_central_filter_that_knows_no_angles_is_refused_in_one_line():
    sensors = {name: bearing(place) for name, place in PLACES.items()}
    nodes = {n: hg.Node(s, hg.perfect(), {"f": hg.cubature_filter(PLACE, s)}) for n, s in sensors.items()}
    joint = hg.model.joint_sensor(sensors)
    hg.Network(PLACE, nodes, {"all": hg.cubature_filter(PLACE, joint)})
    plain = hg.model.joint_sensor({name: bearing(place, ()) for name, place in PLACES.items()})
    sequential = hg.filters.sequential_filter([hg.cubature_filter(PLACE, s) for s in plain.parts])
    for wrong in (hg.cubature_filter(PLACE, plain), hg.extended_filter(PLACE, plain), sequential,
                  hg.filters.late_filter(hg.cubature_filter(PLACE, plain), 1)):  # fmt: skip
        with pytest.raises(ValueError, match=r"^fused 'all': .*angles, \['a.bearing', 'b.bearing'\], got \[\]$"):
            hg.Network(PLACE, nodes, {"all": wrong})
    # States that are angles, too.
    turning = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2), circular=["x0"])
    straight = hg.LinearPlant(np.eye(2), 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
    seen = hg.LinearSensor([[0.0, 1.0]], 0.1)
    node = hg.Node(seen, hg.perfect(), {"f": hg.cubature_filter(turning, seen)})
    both = hg.model.joint_sensor({"a": seen, "b": seen})
    with pytest.raises(ValueError, match=r"^fused 'all': .*angles are the plant's, \['x0'\], got \[\]$"):
        hg.Network(turning, {"a": node, "b": node}, {"all": hg.linear_filter(straight, both, hg.perfect(2))})


def drive(x, u):
    return jnp.stack([x[0] + 0.5 * jnp.cos(x[2]), x[1] + 0.5 * jnp.sin(x[2]), x[2] + 0.1])


@pytest.mark.slow
def test_a_heading_beside_clocks_stays_an_angle():
    """A robot that turns ten times; without its angle the heading was off by radians."""
    plant = hg.Plant(drive, np.diag([1e-4, 1e-4, 1e-5]), [0.0, 0.0, 0.0], np.diag([0.1, 0.1, 0.01]),
                     states=["x", "y", "yaw"], circular=["yaw"])  # fmt: skip
    sensor = hg.LinearSensor(np.eye(3), np.diag([0.01, 0.01, 0.001]), ["x", "y", "compass"], ["compass"])

    def rate(x):
        return jnp.stack([0.5 * jnp.cos(x[2]), 0.5 * jnp.sin(x[2]), 0.1])

    larger, seen = hg.model.with_clocks(plant, {"a": sensor}, {"a": hg.model.Clock(0.05, 1e-4)}, rate, 1.0)
    cubature = hg.cubature_filter(larger, seen["a"])
    network = hg.Network(larger, {"a": hg.Node(seen["a"], hg.perfect(3), {"f": cubature})})
    record = hg.monte_carlo(network, 600, 20, 3)
    assert record.truth[..., 2].max() > 3.1 and record.truth[..., 2].min() < -3.1
    assert record.rmse("a", "f")["yaw"] < 0.02
    nees = record.nees("a", "f").mean()
    assert 4.5 < nees < 5.5  # of five states; 20 runs, correlated in time


DRIFT, WANDER = 0.02, 1e-4


def with_steps(dt):
    """A walk without noise whose one node has a clock: the offset is all that can be told of."""
    plant = hg.LinearPlant(lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]), lambda u: jnp.zeros((2, 2)), [0.0, 1.0],
                           np.zeros((2, 2)), inputs={"dt": "s"})  # fmt: skip
    clocks = {"a": hg.model.Clock(0.1, DRIFT, WANDER)}
    return hg.model.with_clocks(plant, {"a": hg.LinearSensor([[1.0, 0.0]], 0.01)}, clocks, [[0.0, 1.0], [0.0, 0.0]], dt)


def test_an_offset_grows_by_the_time_of_each_step():
    """Two halves of a step are the step: moments of offset and drift over any division of the same time."""
    plant, _ = with_steps("dt")
    blind = hg.filters.open_loop_filter(plant)
    whole = blind.run(np.full((1, 0), np.nan), [[3.0]]).covariances[-1]
    parts = blind.run(np.full((3, 0), np.nan), [[0.5], [0.0], [2.5]]).covariances[-1]
    np.testing.assert_allclose(parts, whole, rtol=1e-12, atol=1e-28)  # rounding of known states of size 1 and 3
    t = 3.0
    moved = [[0.1**2 + DRIFT**2 * t**2 + WANDER * t**3 / 3, DRIFT**2 * t + WANDER * t**2 / 2],
             [DRIFT**2 * t + WANDER * t**2 / 2, DRIFT**2 + WANDER * t]]  # fmt: skip
    np.testing.assert_allclose(whole[2:, 2:], moved, rtol=1e-12)
    assert plant.states[2] == "a_offset" and plant.states[2].unit == "s" and isinstance(plant, hg.LinearPlant)
    with pytest.raises(ValueError, match=r"^dt: expected a number, or one of the inputs \['dt'\], got 'time'$"):
        with_steps("time")


def test_clocks_at_steps_of_varying_time_are_estimated_as_claimed():
    plant, sensors = with_steps("dt")
    f = hg.filters.gaussian_filter(plant, sensors["a"], None, hg.filters.PolynomialMoments(2))
    steps = np.random.default_rng(2).exponential(1.0, size=(40, 1))
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensors["a"], hg.perfect(), {"f": f})}), 40, 400, 0,
                            inputs=steps)  # fmt: skip
    error, covariance = record.errors("a", "f")[..., 2:], np.asarray(record.estimates["a"]["f"].covariance)[..., 2:, 2:]
    nees = np.einsum("rti,rtij,rtj->rt", error, np.linalg.inv(covariance), error)
    assert np.abs(nees[:, -1].mean() / 2 - 1) < 4 / np.sqrt(400)  # four deviations of a mean of 400 of chi^2_2 / 2


def test_nees_is_taken_around_the_circle_where_angles_are_named():
    truth, mean, covariance = [[1.0, 3.1]], [[1.5, -3.1]], np.diag([0.25, 0.01])
    around = 1 + (2 * np.pi - 6.2) ** 2 / 0.01
    plant = hg.LinearPlant(np.eye(2), np.eye(2), [0.0, 0.0], np.eye(2), circular=["x1"])
    for angles in ([1], plant, hg.model.over_time([plant, plant])):
        assert hg.nees(truth, mean, covariance, angles) == pytest.approx([around], rel=1e-12)
    assert hg.nees(truth, mean, covariance)[0] > 3000
    assert hg.nis([0.5, 6.2], covariance, angles=[1]) == pytest.approx(around, rel=1e-12)
    fused = hg.fusion.fuse(hg.fusion.EqualIntersection(), [hg.model.Estimate(np.array(m), covariance, "nominal")
                                                           for m in (truth[0], mean[0])], plant)  # fmt: skip
    assert np.abs(fused.mean[1]) == pytest.approx(np.pi)
    judged = hg.consistency(hg.nees(truth, mean, covariance, [1]), 2)
    assert (judged.mean, judged.expected) == (pytest.approx(around, rel=1e-12), 2)
    for wrong in ([2], [-1], [0.5], "x1", hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0)):
        with pytest.raises(ValueError, match=r"^angles: expected"):
            hg.nees(truth, mean, covariance, wrong)
