"""The recursion, the true error of any gains, and saved schedules."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.numerics import pseudo_solve
from heliograph_studies.quadratic_bias import compute
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model, two_sensors

EXAMPLE = oracle.paper_example()


def scalar(process=1.0, noise=1.0, horizon=5):
    values = np.ones((horizon, 1, 1))
    steps = hg.linear.Steps(values, values[:, 0], process * values, values, np.zeros((horizon, 1)), noise * values)
    return hg.linear.LinearSystem(steps, [0.0], [[2.0]], [[1.0]])


def test_scalar_recursion_by_hand():
    p, expected = 2.0, []
    for _ in range(5):
        p = 1 / (1 / (p + 1.0) + 1.0)
        expected.append(p)
    schedule = hg.linear.lmmse(scalar())
    np.testing.assert_allclose(schedule.gains.covariance[:, 0, 0], expected, rtol=1e-14)
    np.testing.assert_allclose(schedule.gains.gain[:, 0, 0], expected, rtol=1e-14)  # R = 1: the gain is P


def test_slow_covariance_is_not_taken_for_its_limit():
    """a = 1 - 1e-5, begun 4e-10 above the limit: 100 steps change 8e-13 of it, and 5000 steps fifty times as much."""
    a, r, horizon = 1 - 1e-5, 1e6, 5000
    q, item = 1 - a**2, np.ones((horizon, 1, 1))
    half = (q + r * (1 - a**2)) / (2 * a**2)
    limit = np.sqrt(half**2 + r * q / a**2) - half
    steps = hg.linear.Steps(a * item, 0 * item[:, 0], q * item, item, 0 * item[:, 0], r * item)
    system = hg.linear.LinearSystem(steps, [0.0], [[limit * (1 + 4e-10)]], [[1.0]])
    p, expected = np.longdouble(system.covariance[0, 0]), []
    for _ in range(horizon):
        p = 1 / (1 / (np.longdouble(a) ** 2 * p + q) + 1 / np.longdouble(r))
        expected.append(p)
    assert 1 - expected[-1] / expected[100] > 1e-11  # it moves: a covariance that stood still at step 100 is seen
    claimed = hg.linear.lmmse(system).gains.covariance[:, 0, 0]
    np.testing.assert_allclose(claimed, expected, rtol=1e-12)  # 64 bits against 53, over all steps


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_claim_is_the_true_error(degree):
    system = hg.linear.lifted_system(*model(two_sensors(), 10), degree, 10)
    schedule = hg.linear.lmmse(system)
    true = hg.linear.true_covariance(system, schedule)
    np.testing.assert_allclose(schedule.gains.covariance, true, rtol=0, atol=1e-11 * np.abs(true).max())


@pytest.mark.parametrize("system", [EXAMPLE, two_sensors()], ids=["example", "two sensors"])
def test_printed_filter_claims_and_has_what_the_oracle_says(system):
    ours = compute.printed_quadratic(*model(system, 15), 15)
    expected, n = oracle.quadratic(system, 15, repaired=False), len(system.F) + system.C.shape[1]
    tolerance = 1e-11 * np.abs(expected.true).max()
    np.testing.assert_allclose(ours.schedule.gains.covariance, expected.claimed[1:, :n, :n], rtol=0, atol=tolerance)
    np.testing.assert_allclose(ours.true_covariance, expected.true[1:, :n, :n], rtol=0, atol=tolerance)


def test_with_known_powers_the_printed_filter_is_the_best():
    item = oracle.Atoms(np.array([[1.3]]), np.array([1.0]))
    s = model(EXAMPLE.__class__(**{**EXAMPLE.__dict__, "l": item, "m": item}), 20)
    best = hg.linear.lmmse(hg.linear.lifted_system(*s, 2, 20)).gains.covariance
    result = compute.printed_quadratic(*s, 20)
    np.testing.assert_allclose(result.true_covariance, best, rtol=0, atol=1e-14)
    np.testing.assert_allclose(result.schedule.gains.covariance, best, rtol=0, atol=1e-14)


def test_true_error_of_wrong_gains_counts_bias_and_spread():
    """xhat = 0.5 z + 0.2 without memory: error x - 0.5 (x + v) - 0.2."""
    system = scalar(horizon=1)
    zero = np.zeros((1, 1))
    gains = hg.linear.Gains(
        zero[None], zero[None], zero, zero[None], 0.5 + zero[None], 0.2 + zero, zero[None], zero, zero[None],
        np.nan + zero[None], np.nan + zero[None],
    )  # fmt: skip
    # x+ = x + 1 + w has mean 1 and variance 3
    expected = 0.25 * 3 + 0.25 + (0.5 - 0.2) ** 2
    result = hg.linear.true_covariance(system, hg.linear.Schedule(gains, [0.0], "nominal"))
    assert result[0, 0, 0] == pytest.approx(expected, rel=1e-14)


def test_linear_degree_is_the_linear_filter_of_the_library():
    s = model(EXAMPLE, 10)
    other, z = hg.linear_filter(*s), np.random.default_rng(0).normal(size=(10, 1))
    ours = hg.polynomial_filter(*s, 10, 1)
    a, b = other.init(), ours.init()
    for k in range(10):
        a, left = other.step(a, z[k], (), k)
        b, right = ours.step(b, z[k], (), k)
        np.testing.assert_allclose(right.mean, left.mean, rtol=0, atol=1e-14)
        np.testing.assert_allclose(right.covariance, left.covariance, rtol=0, atol=1e-14)


def test_units_of_a_measurement_do_not_matter_to_a_singular_innovation():
    g = np.random.default_rng(2).normal(size=(3, 2))
    innovation, cross = g @ g.T, g @ np.ones((2, 1))
    scale = np.array([1e8, 1.0, 1e-8])
    plain = cross.T @ pseudo_solve(innovation, cross)
    scaled = (scale[:, None] * cross).T @ pseudo_solve(scale[:, None] * innovation * scale, scale[:, None] * cross)
    np.testing.assert_allclose(scaled, plain, rtol=1e-10)
    assert plain[0, 0] == pytest.approx(2.0, rel=1e-10)  # all that g holds


SKEWED = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])


def test_a_state_that_outgrows_its_error_costs_no_digits():
    """Growth by half at each step, 60 of them: E[x^2] is 1e21, and the error's is that of the Riccati equation."""
    plant, sensor = hg.LinearPlant([[1.5]], SKEWED, [0.0], 1.0), hg.LinearSensor([[1.0]], SKEWED)
    results = {d: hg.linear.lmmse(hg.linear.lifted_system(plant, sensor, hg.perfect(), d, 60)) for d in (1, 2)}
    p = 1.0
    for _ in range(60):
        p = 1 / (1 / (2.25 * p + 1) + 1)
    assert results[1].gains.covariance[-1, 0, 0] == pytest.approx(p, rel=1e-9)
    assert all(schedule.claim == "exact" for schedule in results.values())
    assert results[2].gains.covariance[10, 0, 0] < p * (1 - 1e-6)  # what squares add vanishes as x grows
    assert results[2].gains.covariance[-1, 0, 0] == pytest.approx(p, rel=1e-9)


def test_digits_lost_lower_the_claim_and_what_is_left_is_no_better_than_the_linear_filter():
    """Far from zero the square of x and x itself agree to all digits but few, or to all."""

    def design(mean):
        plant, sensor = hg.LinearPlant([[1.0]], SKEWED, [mean], 1.0), hg.LinearSensor([[1.0]], SKEWED)
        return hg.linear.lmmse(hg.linear.lifted_system(plant, sensor, hg.perfect(), 2, 5))

    assert design(10.0).claim == "exact"
    with pytest.warns(UserWarning, match=r"rounding is .* of a claimed variance .*; use a shorter horizon"):
        assert design(1e4).claim == "nominal"
    with pytest.warns(UserWarning, match="nominal"):
        far = design(1e6)
    assert far.claim == "nominal" and far.gains.covariance[0, 0, 0] >= 2 / 3  # (1 + 1) and 1 in parallel


def test_schedules_are_saved_and_loaded(tmp_path):
    schedule = hg.linear.lmmse(scalar())
    schedule.save(tmp_path / "gains.npz")
    loaded = hg.linear.load_schedule(tmp_path / "gains.npz")
    assert loaded.claim == "exact"
    for mine, read in zip([*schedule.gains, schedule.start], [*loaded.gains, loaded.start], strict=True):
        np.testing.assert_array_equal(read, mine)


def test_what_is_no_schedule_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("no arrays")
    with pytest.raises(ValueError, match=r"expected a file written by Schedule\.save"):
        hg.linear.load_schedule(tmp_path / "text.npz")
    np.savez(tmp_path / "other.npz", gain=np.eye(2))
    with pytest.raises(ValueError, match="all arrays of a schedule"):
        hg.linear.load_schedule(tmp_path / "other.npz")
    gains = hg.linear.lmmse(scalar()).gains
    with pytest.raises(ValueError, match=r"schedule gain: expected finite numbers"):
        hg.linear.Schedule(gains._replace(gain=gains.gain * np.nan), [0.0], "exact")
    with pytest.raises(ValueError, match=r"schedule direct: expected shape \(5, 1, 1\), got shape \(5, 1, 2\)"):
        hg.linear.Schedule(gains._replace(direct=np.zeros((5, 1, 2))), [0.0], "exact")
    with pytest.raises(ValueError, match="one of"):
        hg.linear.Schedule(gains, [0.0], "sure")
    with pytest.raises(ValueError, match=r"start of the schedule: expected shape \(1,\)"):
        hg.linear.Schedule(gains, [0.0, 1.0], "exact")


def test_systems_and_schedules_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="5 steps of 1 measurements, got 4 steps"):
        hg.linear.true_covariance(scalar(), hg.linear.lmmse(scalar(horizon=4)))
    steps = scalar().steps
    with pytest.raises(ValueError, match=r"system noise: expected shape \(5, 1, 1\)"):
        hg.linear.LinearSystem(steps._replace(noise=np.ones((5, 2, 2))), [0.0], [[1.0]], [[1.0]])
    with pytest.raises(ValueError, match="positive semidefinite"):
        hg.linear.LinearSystem(steps, [0.0], [[-1.0]], [[1.0]])
