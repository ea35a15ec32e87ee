"""Attitudes as states: against an own error-state filter and smoother, means on the group, and what is refused."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.filters.gaussian import navigation
from tests.filters.gaussian.navigation import ErrorState, simulate

# An attitude alone: a gyroscope's rate is the input, two directions are measured.
NAMES = ["rx", "ry", "rz"]
UP, FIELD = np.array([0.0, 0.0, 1.0]), np.array([0.43, 0.0, -0.9])


def turned(x, u):
    return hg.models.turn_attitude(x, u[:3] * u[3])


def directions(x):
    back = hg.models.rotation_matrix(x).T
    return jnp.concatenate([back @ UP, back @ FIELD])


def attitude_plant(spread=0.3, center=(0.1, -0.2, 0.4)):
    return hg.Plant(turned, 1e-4 * np.eye(3), center, spread**2 * np.eye(3), NAMES, ["wx", "wy", "wz", "dt"],
                    attitude=NAMES)  # fmt: skip


PLANT = attitude_plant()
SENSOR = hg.Sensor(directions, 0.05**2 * np.eye(6), [f"d{i}" for i in range(6)])
EXTENDED = hg.extended_filter(PLANT, SENSOR)
RATES = np.column_stack([np.full(40, 0.9), np.sin(np.arange(40.0)), np.full(40, -0.6), np.full(40, 0.1)])


def measured(seed=0):
    """Attitudes that tumble through half a turn, and what is measured of them."""
    draw, r, rows, truth = np.random.default_rng(seed), Rotation.from_rotvec([0.3, -0.1, 0.2]), [], []
    for u in RATES:
        r = r * Rotation.from_rotvec(u[:3] * u[3] + 0.01 * draw.normal(size=3))
        truth.append(r.as_rotvec())
        rows.append(np.concatenate([r.inv().apply(UP), r.inv().apply(FIELD)]) + 0.05 * draw.normal(size=6))
    return np.array(rows), np.array(truth)


def apart(a, b):
    """Radians between attitudes."""
    return (Rotation.from_rotvec(np.array(a)).inv() * Rotation.from_rotvec(np.array(b))).magnitude()


@pytest.mark.slow
def test_extended_filter_and_smoother_are_an_error_state_filter():
    """Twelve states of an inertial navigation, F and H of the error by hand: 1e-9, measured 3e-13 in 200 steps."""
    u, z, truth = simulate(200)
    own, rows = ErrorState(), []
    for k in range(len(u)):
        own.predict(u[k])
        own.correct(z[k])
        rows.append((own.R, own.x, own.P))
    filter = hg.extended_filter(navigation.PLANT, navigation.SENSOR)
    ahead, back = filter.run(z, u), hg.rts_smoother(filter, z, u)
    assert np.linalg.norm(ahead.means[:, :3], axis=1).max() > 3.1  # through half a turn
    for result, others in ((ahead, rows), (back, own.smooth())):
        matrices = hg.models.rotation_matrix(result.means[:, :3])
        np.testing.assert_allclose(matrices, [R for R, _, _ in others], atol=1e-9)
        np.testing.assert_allclose(result.means[:, 3:], [x for _, x, _ in others], atol=1e-9)
        np.testing.assert_allclose(result.covariances, [P for _, _, P in others], atol=1e-9)
    assert np.linalg.norm(apart(back.means[:, :3], truth[:, :3])) < np.linalg.norm(
        apart(ahead.means[:, :3], truth[:, :3])
    )


@pytest.mark.parametrize("make", [hg.cubature_filter, hg.unscented_filter])
def test_the_mean_of_points_is_on_the_group(make):
    """Changes of the moved points from the predicted mean have the mean 0, and its covariance their second moment.

    The points and their weights are computed here: 2 n of them at sqrt(n) deviations, beta 2 of unscented points adds
    twice the square of the mean change from the middle point. 1e-9 is what four steps to the mean leave.
    """
    filter, u = make(PLANT, SENSOR), np.array([3.0, -2.0, 1.0, 0.5])
    prior = filter.predict(filter.init(), u)
    points = [s * np.sqrt(3) * 0.3 * e for e in np.eye(3) for s in (1, -1)]
    start, mean = Rotation.from_rotvec(PLANT.initial_mean), Rotation.from_rotvec(np.asarray(prior.mean))
    moved = [start * Rotation.from_rotvec(d) * Rotation.from_rotvec(u[:3] * u[3]) for d in points]
    changes = np.array([(mean.inv() * r).as_rotvec() for r in moved])
    assert np.abs(changes.mean(axis=0)).max() < 1e-9
    expected = changes.T @ changes / 6 + 1e-4 * np.eye(3)
    middle = (mean.inv() * start * Rotation.from_rotvec(u[:3] * u[3])).as_rotvec()
    beta = 2.0 * np.outer(middle, middle) if make is hg.unscented_filter else 0.0
    np.testing.assert_allclose(np.asarray(prior.covariance), expected + beta, atol=1e-9)


@pytest.mark.slow
def test_filters_agree_where_errors_are_small_and_find_the_attitude():
    z, truth = measured()
    results = [make(PLANT, SENSOR).run(z, RATES).means for make in (hg.extended_filter, hg.cubature_filter)]
    assert apart(*results)[5:].max() < 0.01  # of 0.02 rad
    assert apart(results[0], truth)[5:].max() < 0.1
    assert np.linalg.norm(truth, axis=1).max() > 3.0  # the rotation vector turned over


def test_the_same_attitude_by_another_rotation_vector_is_the_same_filter():
    """About a start turned by another vector in the world's axes, everything turns with it: 1e-12, rounding."""
    z, _ = measured()
    turn = Rotation.from_rotvec([1.5, 2.0, -0.7])
    center = (turn * Rotation.from_rotvec(PLANT.initial_mean)).as_rotvec()

    def seen(x):
        back = hg.models.rotation_matrix(x).T @ turn.as_matrix()
        return jnp.concatenate([back @ UP, back @ FIELD])

    there = hg.extended_filter(attitude_plant(center=center), hg.Sensor(seen, SENSOR.noise, SENSOR.outputs))
    here, other = EXTENDED.run(z, RATES), there.run(z, RATES)
    back = turn.inv() * Rotation.from_rotvec(other.means)
    np.testing.assert_allclose(back.as_matrix(), Rotation.from_rotvec(here.means).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(other.covariances, here.covariances, atol=1e-12)


@pytest.mark.slow
def test_smoothers_of_one_step_agree():
    """A lag beyond the end is the whole interval; so is a fixed point, but for squares of what later data change."""
    z, _ = measured()
    _, steps = hg.smoothing.smoother_steps(EXTENDED, z, RATES)
    whole = hg.smoothing.FixedInterval().estimates(steps)
    lagged = hg.smoothing.FixedLag(60).estimates(steps)
    np.testing.assert_allclose(apart(lagged.mean, whole.mean), 0.0, atol=1e-12)
    np.testing.assert_allclose(lagged.covariance, whole.covariance, atol=1e-12)
    point = hg.smoothing.FixedPoint(20).estimates(steps)
    assert apart(np.asarray(point.mean)[0], EXTENDED.run(z, RATES).means[20]) < 1e-12
    change = apart(np.asarray(point.mean)[0], np.asarray(whole.mean)[20])
    assert apart(np.asarray(point.mean)[-1], np.asarray(whole.mean)[20]) < change**2
    assert whole.attitude == (0, 1, 2)


def test_a_stream_steps_as_a_run_does():
    z, _ = measured()
    stream = hg.Stream(EXTENDED)
    means = [np.asarray(stream.push(row, u).mean) for row, u in zip(z, RATES, strict=True)]
    np.testing.assert_allclose(means, EXTENDED.run(z, RATES).means, atol=1e-14)


NETWORK = hg.Network(PLANT, {"imu": hg.Node(SENSOR, hg.perfect(6), {"ekf": EXTENDED})})


@pytest.mark.slow
def test_simulated_errors_are_what_is_claimed():
    """Errors are turns: NEES per dimension 1 within five deviations of its mean (nominal, of .3 rad at the start)."""
    filters = {"ekf": EXTENDED, "ckf": hg.cubature_filter(PLANT, SENSOR)}
    network = hg.Network(PLANT, {"imu": hg.Node(SENSOR, hg.perfect(6), filters)})
    statistics = hg.monte_carlo(network, 40, 400, key=0, inputs=RATES, keep=hg.Statistics())["imu"]
    for name in ("ekf", "ckf"):
        mean, low, high = statistics[name].nees_per_dimension()
        assert abs(mean - 1) < 2.5 * (high - low) + 0.02
    assert statistics["ekf"].rmse()[0] < 0.1


def test_records_know_that_errors_are_turns(tmp_path):
    record = hg.monte_carlo(NETWORK, 40, 3, key=0, inputs=RATES)
    estimate = record.estimates["imu"]["ekf"]
    errors = record.errors("imu", "ekf")
    np.testing.assert_allclose(
        np.linalg.norm(errors, axis=-1).ravel(),
        apart(np.asarray(estimate.mean).reshape(-1, 3), record.truth.reshape(-1, 3)), atol=1e-12,
    )  # fmt: skip
    expected = hg.nees(record.truth, estimate.mean, estimate.covariance, PLANT)
    np.testing.assert_allclose(record.nees("imu", "ekf"), expected, rtol=1e-9)
    for back in (hg.Record.from_xarray(record.to_xarray()), hg.Record.from_pandas(record.to_pandas())):
        assert back.estimates["imu"]["ekf"].attitude == (0, 1, 2)
        np.testing.assert_array_equal(back.errors("imu", "ekf"), errors)
    pooled = hg.simulation.error_statistics(record, "imu", "ekf")
    assert pooled.rmse()[0] == pytest.approx(np.sqrt((errors**2).sum(axis=-1).mean()))


@pytest.mark.slow
def test_a_recording_with_the_truth_is_judged_by_turns():
    z, truth = measured()
    record = hg.run(NETWORK, {"imu": z}, inputs=RATES, truth=truth)
    np.testing.assert_allclose(
        np.linalg.norm(record.errors("imu", "ekf"), axis=-1),
        apart(np.asarray(record.estimates["imu"]["ekf"].mean), truth), atol=1e-12,
    )  # fmt: skip


def test_tables_have_the_quaternion(tmp_path):
    """Of two filters, whose columns begin with their names."""
    z, _ = measured()
    two = hg.Node(SENSOR, hg.perfect(6), {"ekf": EXTENDED, "again": EXTENDED})
    record = hg.run(hg.Network(PLANT, {"imu": two}), {"imu": z}, inputs=RATES)
    hg.files.write_estimates(record, tmp_path / "estimates.csv")
    table = hg.files.read_table(tmp_path / "estimates.csv")
    columns = np.column_stack([np.asarray(table[f"ekf.rx.q{part}"]) for part in "wxyz"])
    mean = np.asarray(record.estimates["imu"]["ekf"].mean)
    np.testing.assert_allclose(hg.models.from_quaternion(columns), mean, atol=1e-12)
    assert "ekf.rx.sd" in table and "ekf.ry.qw" not in table


@needs_compiler
def test_exported_c_steps_as_a_stream_does(tmp_path):
    """4e-15 in forty steps through half a turn."""
    z, _ = measured()
    means, covariances = Device(EXTENDED, tmp_path).follow(z, RATES)
    result = EXTENDED.run(z, RATES)
    np.testing.assert_allclose(means, result.means, atol=1e-12)
    np.testing.assert_allclose(covariances, result.covariances, atol=1e-12)
    assert "mean[0]: rx (of a rotation vector, radians" in (tmp_path / "step.h").read_text()


LINK = hg.perfect(6)
REFUSED = (
    "expected no attitude (hg.extended_filter, unscented_filter and cubature_filter know them), got ['rx', 'ry', 'rz']"
)


@pytest.mark.parametrize(
    "make",
    [
        lambda: hg.robust_filter(PLANT, SENSOR, LINK), lambda: hg.filters.imm_filter(PLANT, SENSOR, LINK),
        lambda: hg.filters.particle_filter(PLANT, SENSOR, LINK, 9), lambda: hg.adaptive_filter(EXTENDED),
        lambda: hg.filters.late_filter(EXTENDED, 2), lambda: hg.filters.sequential_filter([EXTENDED, EXTENDED]),
        lambda: hg.event_filter(PLANT, SENSOR, LINK, hg.SendOnDelta([1.0] * 6)),
    ],
)  # fmt: skip
def test_filters_that_add_are_refused(make):
    with pytest.raises(ValueError) as error:
        make()
    assert REFUSED in str(error.value)


def wrong(transition=turned, attitude=NAMES, **changed):
    return lambda: hg.Plant(transition, np.eye(3), np.zeros(3), np.eye(3), NAMES, ["wx", "wy", "wz", "dt"],
                            attitude=attitude, **changed)  # fmt: skip


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (wrong(lambda x, u: x + u[:3] * u[3]), r"plant with an attitude .*turn_attitude.*: expected one"),
        (wrong(attitude=["rx", "ry"]), r"attitude: expected three of \['rx', 'ry', 'rz'\] for each"),
        (wrong(circular=["rx"]), r"attitude: expected three of \['ry', 'rz'\]"),
        (lambda: hg.extended_filter(PLANT, hg.Sensor(lambda x: x[:1], 0.1)), "sensor of a plant with an attitude"),
        (lambda: hg.markov_plant([PLANT, PLANT], np.full((2, 2), 0.5)),
         "models of a plant: expected ones without an attitude"),
        (lambda: hg.Network(PLANT, {n: hg.Node(SENSOR, LINK, {"f": EXTENDED}) for n in "ab"},
                            {"all": hg.Fusion("f", hg.CovarianceIntersection())}),
         "fused 'all': expected a filter of all"),
        (lambda: hg.fusion.fuse(hg.CovarianceIntersection(), [EXTENDED.estimate(EXTENDED.init())] * 2),
         "fusion: expected estimates without attitudes"),
    ],
)  # fmt: skip
def test_what_is_no_attitude_is_refused_in_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_plants_made_of_plants_keep_attitudes():
    other = hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, states=["level"])
    both = hg.models.join([other, PLANT])
    assert both.attitude == tuple(NAMES) and both.manifold.rotations == (1, 2, 3)
    biased, _ = hg.model.with_bias(PLANT, SENSOR, 0.1, 5.0)
    assert biased.attitude == tuple(NAMES)
    assert replace(EXTENDED.estimate(EXTENDED.init())).attitude == (0, 1, 2)
