"""The claims of linear filters, by Monte Carlo: exact within its interval, upper never exceeded."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.series_and_stack import Series

PLANT = hg.LinearPlant([[0.95, 0.2], [-0.2, 0.9]], 0.05, [1.0, -0.5], [[0.5, 0.1], [0.1, 0.4]])
SENSOR = hg.LinearSensor([[1.0, 0.0], [0.5, 1.0]], 0.02)
SKEWED = hg.random_affine.FiniteSupport([[0.9, 0.0], [-0.1, 0.1], [-0.1, -0.05]], [0.1, 0.3, 0.6])
FADING = hg.amplify_and_forward(
    [hg.hop(hg.Rayleigh(0.8), SKEWED), hg.hop(hg.random_affine.bernoulli(0.85), 0.01, dimension=2)]
)
P, R = np.array([0.2, 0.3, 0.5]), 0.1
LAW = hg.Discrete([0.2, 0.8, 1.3], P, R)
Z_LIMIT = 4.0  # one number in 30,000 beyond it by chance; seeds are fixed and a few dozen numbers are compared


def statistics(channel, filters, runs=4096, horizon=12):
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, channel, filters)})
    return hg.monte_carlo(network, horizon, runs, 5, keep=hg.Statistics())["node"]


@pytest.fixture(scope="module")
def behind_fading():
    return statistics(
        FADING,
        {
            "linear": hg.linear_filter(PLANT, SENSOR, FADING),
            "mean_gain": hg.mean_gain_filter(PLANT, SENSOR, FADING),
            "open": hg.filters.open_loop_filter(PLANT),
        },
    )


def test_exact_claims_match_the_actual_covariance(behind_fading):
    for name in ("linear", "open"):
        s = behind_fading[name]
        assert s.claim == "exact", name
        actual, claimed = s.actual(), s.claimed()
        batch = s.outer / s.count[:, None, None, None]
        error = batch.std(axis=0, ddof=1) / np.sqrt(len(batch))
        assert np.max(np.abs(actual - claimed) / error) < Z_LIMIT, name
        _, low, high = s.nees_per_dimension(0.9999)
        assert low < 1 < high, name


def test_the_linear_filter_beats_the_others_behind_fading(behind_fading):
    error = behind_fading["linear"].rmse()[0]
    assert error < 0.9 * behind_fading["open"].rmse()[0]
    assert error < 0.9 * behind_fading["mean_gain"].rmse()[0]
    assert behind_fading["mean_gain"].nees_per_dimension()[0] > 2  # it does not know


@pytest.mark.parametrize("corner", range(len(LAW.extremes())))
def test_upper_claims_hold_under_every_extreme_law(corner):
    believed = hg.hop(LAW, 0.05, dimension=2)
    world = GainAndNoise(LAW.extremes()[corner], np.eye(2), 0.05)
    item = hg.linear_filter(PLANT, SENSOR, believed)
    s = statistics(Series([world]), {"linear": item}, runs=2048)["linear"]
    assert s.claim == "upper"
    assert s.worst_direction().z < Z_LIMIT


def test_a_false_claim_is_found(behind_fading):
    """The mean-gain filter's covariance is exceeded many times over: the check can fail."""
    worst = behind_fading["mean_gain"].worst_direction()
    assert worst.z > 5 and worst.ratio > 2


def test_time_varying_parts_are_read_at_their_step():
    horizon = 5
    channels = hg.model.over_time([hg.hop(0.2 + 0.3 * k, 0.05, dimension=2) for k in range(horizon)])
    plants = hg.model.over_time(
        [hg.LinearPlant(PLANT.matrix * (1 - 0.1 * k), 0.05, [1.0, -0.5], 0.4) for k in range(horizon)]
    )
    item = hg.linear_filter(plants, SENSOR, channels)
    state, z = item.init(), np.ones(2)
    mean, cov = np.array([1.0, -0.5]), 0.4 * np.eye(2)
    for k in range(horizon):
        state, estimate = item.step(state, z, (), k)
        a, g = PLANT.matrix * (1 - 0.1 * k), (0.2 + 0.3 * k) * SENSOR.matrix
        mean, cov = a @ mean, a @ cov @ a.T + 0.05 * np.eye(2)
        noise = ((0.2 + 0.3 * k) ** 2 * 0.02 + 0.05) * np.eye(2)
        gain = cov @ g.T @ np.linalg.inv(g @ cov @ g.T + noise)
        mean, cov = mean + gain @ (z - g @ mean), cov - gain @ g @ cov
        np.testing.assert_allclose(estimate.mean, mean, rtol=1e-10)
        np.testing.assert_allclose(estimate.covariance, cov, rtol=0, atol=1e-12)


def test_a_horizon_beyond_what_varies_is_refused():
    channels = hg.model.over_time([hg.hop(1.0, 0.1, dimension=2)] * 3)
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, channels, {"f": hg.linear_filter(PLANT, SENSOR, channels)})})
    with pytest.raises(ValueError, match=r"horizon: expected at most 3 steps, .* got 4"):
        hg.monte_carlo(network, 4, 2, 0)


def test_the_exact_claim_is_the_mean_squared_error_by_enumeration():
    """E of (x, e)(x, e)' propagated over every gain outcome, with the filter's own gains, equals the claim to 1e-12."""
    gamma, xi, qm, qn = hg.Discrete([0.2, 0.8, 1.3], P), hg.Discrete([0.5, 1.0], [0.4, 0.6]), 0.1, 0.05
    channel = hg.amplify_and_forward([hg.hop(gamma, qm, dimension=2), hg.hop(xi, qn, dimension=2)])
    item = hg.linear_filter(PLANT, SENSOR, channel)
    a, c, mu = PLANT.matrix, SENSOR.matrix, gamma.moment(1) * xi.moment(1)
    outcomes = [
        (p * q, g * x, x) for p, g in zip(P, gamma.values, strict=True) for q, x in zip(*_atoms(xi), strict=True)
    ]
    cov = PLANT.initial_covariance
    joint = np.block([[cov + np.outer(PLANT.initial_mean, PLANT.initial_mean), cov], [cov, cov]])
    state = item.init()
    for k in range(6):
        before = state
        state, estimate = item.step(before, np.zeros(2), (), k)
        moved = np.kron(np.eye(2), a)
        joint = moved @ joint @ moved.T + 0.05 * np.kron(np.ones((2, 2)), np.eye(2))
        gain = _gain(item, before, k)
        total = np.zeros((4, 4))
        for p, g, x in outcomes:  # e+ = e - K (g y + x m + n - mu C xhat), y = C x + v, C xhat = C x - C e
            step = np.block([[np.eye(2), np.zeros((2, 2))], [-(g - mu) * gain @ c, np.eye(2) - mu * gain @ c]])
            noise = gain @ ((g**2 * 0.02 + x**2 * qm + qn) * np.eye(2)) @ gain.T
            total += p * (step @ joint @ step.T + np.block([[np.zeros((2, 4))], [np.zeros((2, 2)), noise]]))
        joint = total
        np.testing.assert_allclose(estimate.covariance, joint[2:, 2:], atol=1e-12)


def _atoms(law):
    return law.probabilities, law.values


def _gain(item, state, k):
    """The filter's gain, read off its response to unit measurements."""
    zero = item.step(state, np.zeros(2), (), k)[1].mean
    return np.stack([item.step(state, unit, (), k)[1].mean - zero for unit in np.eye(2)], axis=1)


@pytest.mark.parametrize(("closed", "low", "high"), [(False, 0.9, 1.1), (True, 0.2, 0.4)])
def test_a_random_gain_makes_the_claim_one_for_inputs_known_in_advance(closed, low, high):
    """E[(x - m)^2] / P after 15 steps of a = 1.2 with u = -a m, from the estimate or from the mean before data.

    P counts the power of a state that only the plan holds; in closed loop the state stays small, and so does the error:
    .28 of the claim (20,000 runs), where planned inputs have 1.00; 4,000 runs are within .03.
    """
    plant = hg.LinearPlant([[1.2]], 0.1, [1.0], 0.5, input_matrix=[[1.0]])
    item = hg.linear_filter(plant, SCALAR_SENSOR, hg.hop(hg.Discrete([0.6, 1.4], [0.5, 0.5]), 0.05))
    rng, runs, state = np.random.default_rng(0), 4000, item.init()
    x, m = 1 + np.sqrt(0.5) * rng.normal(size=runs), np.ones(runs)
    for k in range(15):
        # Gain and covariance depend on the planned inputs alone: u = -1.2, then 0.
        planned = -1.2 if k == 0 else 0.0
        prior = item.predict(state, [planned], k)
        state, other = (item.correct(prior, [z], k)[0] for z in (0.0, 1.0))
        gain = other.gaussian.mean[0] - state.gaussian.mean[0]
        u = -1.2 * m if closed else planned
        x, m = 1.2 * x + u + np.sqrt(0.1) * rng.normal(size=runs), 1.2 * m + u
        sent = rng.choice([0.6, 1.4], size=runs) * (x + np.sqrt(0.1) * rng.normal(size=runs))
        m = m + gain * (sent + np.sqrt(0.05) * rng.normal(size=runs) - m)
    assert low < np.mean((x - m) ** 2) / state.gaussian.covariance[0, 0] < high


SCALAR_SENSOR = hg.LinearSensor([[1.0]], 0.1)


def test_a_mean_that_decays_for_ever_stays_a_normal_number():
    """0.9^8000 is 1e-366: below 2e-308 processors compute ten times as long, and by 0.9 the least number stays."""
    plant, sensor = hg.LinearPlant([[0.9]], [[0.1]], [1.0], [[1.0]]), hg.LinearSensor([[1.0]], [[0.2]])
    filtered = hg.linear_filter(plant, sensor, hg.hop(hg.Rayleigh(0.8), 0.1)).run(np.zeros((8000, 1)))
    mean = abs(float(filtered.origin.state.state_mean[0]))
    assert mean == 0 or mean > 1e-150  # and so is its square
