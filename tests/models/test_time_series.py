"""Components of time series against statsmodels 0.15, from the same known start, and against their own laws."""

import jax
import numpy as np
import pytest

import heliograph as hg
from tests.models.public_series import CO2, NILE, SUNSPOTS

m = hg.models


def filtered(model, series):
    return hg.kalman_filter(model.plant, model.sensor).run(series)


def test_nile_is_statsmodels():
    """The local level: log-likelihood to 1e-7, forecasts to 1e-8."""
    found = filtered(m.structural([m.level(1469.1, initial_variance=1e7)], 15099.0), NILE)
    assert abs(found.log_likelihood + 641.5856428104498) < 1e-7
    assert abs(hg.forecast(found, 1).outputs.mean[0, 0] - 798.370292608364) < 1e-8


def test_a_cycle_beside_a_level_is_statsmodels():
    found = filtered(m.structural([m.level(1200.0, initial_variance=1e7), m.cycle(11, 0.9, 2000.0)], 10000.0), NILE)
    assert abs(found.log_likelihood + 641.800000270717) < 1e-7


def test_sunspots_with_gaps_are_statsmodels():
    """ARMA(3, 1) about 50, 21 values missing."""
    series = SUNSPOTS - 50
    series[60:75] = np.nan
    series[200::17] = np.nan
    found = filtered(m.structural([m.arma([1.2, -0.5, -0.1], [0.2], 250.0)]), series)
    right = [-34.537580067568, -13.645096081081, 5.604674736486, 17.001915731081, 18.964471117162]
    ahead = hg.forecast(found, 5).outputs
    assert found.claim == "exact" and abs(found.log_likelihood + 1217.9148247370015) < 1e-7
    np.testing.assert_allclose(ahead.mean[:, 0], right, atol=1e-8)
    np.testing.assert_allclose(ahead.deviation[[0, 4], 0], [15.811388318612, 34.394551312719], atol=1e-8)


def co2_model():
    trend = m.trend(0.03, 0.0004, [315.0, 0.0], initial_variance=1e6)
    return m.structural([trend, m.trigonometric_seasonal(12, 0.001, initial_variance=1e6)], 0.1, "co2")


def test_co2_with_gaps_is_statsmodels():
    """Trend and season of twelve months, thirteen states, five months missing."""
    found = filtered(co2_model(), CO2)
    right = [327.558661200213, 325.663786734328, 323.409269799372, 323.264108268258, 323.749402047188]
    assert abs(found.log_likelihood + 228.13293061110932) < 1e-7
    np.testing.assert_allclose(hg.forecast(found, 5).outputs.mean[:, 0], right, atol=1e-8)


@pytest.mark.slow
def test_components_of_co2_add_up():
    """Mean and variance of trend + season are those of the output less its noise; names are kept."""
    model = co2_model()
    smoothed = hg.rts_smoother(hg.kalman_filter(model.plant, model.sensor), CO2)
    parts = m.components(smoothed, model.components)
    assert parts.names == ("trend", "season") and model.sensor.outputs == ("co2",) and parts.claim == "exact"
    whole = model.sensor.matrix[0]
    np.testing.assert_allclose(parts.mean.sum(axis=1), smoothed.means @ whole, atol=1e-9)
    variance = np.einsum("i,tij,j->t", whole, smoothed.covariances, whole)
    np.testing.assert_allclose(parts.covariance.sum(axis=(1, 2)), variance, rtol=1e-9)
    low, high = parts.interval(0.8)
    np.testing.assert_allclose((high - low)[:, 0], 2 * 1.2815515655446004 * parts.of("trend")[1])
    figure = parts.figure()
    assert [panel.get_title(loc="left") for panel in figure.axes] == ["trend", "season"]


def test_components_of_a_forecast():
    model = co2_model()
    ahead = m.components(hg.forecast(filtered(model, CO2), 3).states, model.components)
    assert ahead.mean.shape == (3, 2) and (np.diff(ahead.of("trend")[1]) > 0).all()


def test_a_regression_is_least_squares():
    """Constant coefficients and an intercept from a variance of 1e8: least squares to 1e-6 of their size."""
    rng = np.random.default_rng(0)
    u = rng.normal(size=(60, 2))
    y = 3 + u @ [2.0, -1.0] + rng.normal(size=60)
    model = m.structural([m.level(0.0), m.regression(["rain", "price"])], 1.0)
    assert model.plant.inputs == ("rain", "price")
    found = hg.kalman_filter(model.plant, model.sensor).run(y, u)
    right = np.linalg.lstsq(np.column_stack([np.ones(60), u]), y, rcond=None)[0]
    np.testing.assert_allclose(found.means[-1], right, atol=1e-6)
    parts = m.components(found, model.weights(u))
    np.testing.assert_allclose(parts.of("regression")[0], np.sum(u * found.means[:, 1:], axis=1), atol=1e-12)
    assert parts.names == ("level", "regression")
    with pytest.raises(hg.InputError, match=r"expected model.weights\(inputs\)"):
        _ = model.components


def test_a_regression_that_wanders_is_one_over_time():
    """The same sensor with the inputs of each row put in, to rounding."""
    rng = np.random.default_rng(1)
    u, y = rng.normal(size=(50, 1)), rng.normal(size=50)
    y[7:12] = np.nan
    model = m.structural([m.level(0.1), m.regression(["rain"], 0.05, 10.0)], 0.5)
    sensor = hg.model.over_time([hg.LinearSensor([[1.0, r]], 0.5) for r in u[:, 0]])
    found = hg.kalman_filter(model.plant, model.sensor).run(y, u)
    right = hg.kalman_filter(model.plant, sensor).run(y, u)
    assert found.claim == "exact" and abs(found.log_likelihood - right.log_likelihood) < 1e-10
    np.testing.assert_allclose(found.means, right.means, atol=1e-9)


def test_coefficients_that_wander_and_a_ragged_factor_are_statsmodels():
    """A time-varying regression with a gap, and a factor of three series with other ends: 1e-7, forecasts 1e-8."""
    rng = np.random.default_rng(5)
    u = np.round(rng.normal(size=80), 3)
    y = np.round(1 + 0.5 * u + rng.normal(size=80), 3)
    y[20:25] = np.nan
    model = m.structural([m.level(0.1, 0.0, 10.0), m.regression(["x"], 0.05, 10.0)], 0.5)
    found = hg.kalman_filter(model.plant, model.sensor).run(y, u[:, None])
    assert abs(found.log_likelihood + 118.58087615863967) < 1e-7
    ahead = hg.forecast(found, 3, inputs=[[0.5], [-1.0], [2.0]]).outputs
    right = [0.939509091936, -0.153461445959, 2.03247962983]
    np.testing.assert_allclose(ahead.mean[:, 0], right, atol=1e-8)
    right = [0.93296537444, 1.058026362247, 1.553861829026]
    np.testing.assert_allclose(ahead.deviation[:, 0], right, atol=1e-8)
    np.testing.assert_allclose(found.means[-1], [0.57518558, 0.72864703], atol=1e-8)
    # One factor, three series.
    factor = np.zeros(80)
    for k in range(1, 80):
        factor[k] = 0.8 * factor[k - 1] + rng.normal()
    loading = np.array([1.0, 0.6, -0.4])
    series = np.round(factor[:, None] * loading + rng.normal(size=(80, 3)) * 0.7, 3)
    series[:10, 1] = series[-4:, 2] = series[-1, 0] = series[30, :] = np.nan
    plant = m.arma([0.8], [], 1.0, "factor").plant
    found = hg.kalman_filter(plant, hg.LinearSensor(loading[:, None], 0.49)).run(series)
    assert abs(found.log_likelihood + 292.92338516599887) < 1e-7
    right = [-0.2731473245979196, -0.16388839475875178, 0.10925892983916785]
    np.testing.assert_allclose(hg.forecast(found, 1).outputs.mean[0], right, atol=1e-8)


def test_a_season_of_dummies_sums_to_noise():
    part = m.seasonal(4, 0.0, initial_variance=1.0)
    assert part.plant.states == ("season", "season_1_ago", "season_2_ago")
    x, seen = np.array([1.0, 2.0, -4.0]), []
    for _ in range(8):
        x = part.plant.matrix @ x
        seen.append(part.loading @ x)
    assert seen[:4] == seen[4:] and sum(seen[:4]) == 0


def test_both_seasons_without_noise_are_one():
    """Of period 5 from the same law of the pattern: the states are linear functions of each other."""
    turning = m.trigonometric_seasonal(5, 0.0, initial_variance=1.0)
    assert turning.plant.states == ("season_1", "season_1_shifted", "season_2", "season_2_shifted")
    x = np.array([1.0, -0.3, 0.5, 0.2])
    seen = [turning.loading @ np.linalg.matrix_power(turning.plant.matrix, k) @ x for k in range(10)]
    np.testing.assert_allclose(seen[:5], seen[5:], atol=1e-14)
    assert abs(sum(seen[:5])) < 1e-14


def test_arma_has_its_autocovariances():
    """ARMA(1, 1): variance s (1 + 2 a b + b^2) / (1 - a^2)."""
    part = m.arma([0.7], [0.4], 2.0)
    right = 2 * (1 + 2 * 0.7 * 0.4 + 0.4**2) / (1 - 0.7**2)
    assert abs(part.plant.initial_covariance[0, 0] - right) < 1e-13
    p = part.plant.initial_covariance
    np.testing.assert_allclose(part.plant.matrix @ p @ part.plant.matrix.T + part.plant.noise.covariance, p, atol=1e-13)


def test_all_reals_are_stationary_and_all_stationary_ones_are_reached():
    rng = np.random.default_rng(0)
    for size in (1, 2, 5):
        ar = m.stationary(3 * rng.normal(size=size))
        assert np.abs(np.roots(np.concatenate([[1], -ar]))).max() < 1
    # x / sqrt(1 + x^2) is the last coefficient; of order 1 it is the only one.
    np.testing.assert_allclose(m.stationary([1.0]), [np.sqrt(0.5)])


def test_a_stationary_process_is_fitted():
    """AR(2) of 400 rows: within three standard errors, .05 each, of what drew them."""
    rng = np.random.default_rng(3)
    y = np.zeros(402)
    for k in range(2, 402):
        y[k] = 1.1 * y[k - 1] - 0.4 * y[k - 2] + rng.normal()
    part = m.arma([1.1, -0.4], [], 1.0)
    with jax.enable_x64(True):
        score = jax.grad(lambda x: (m.arma(m.stationary(x), [], 1.0).plant.initial_covariance)[0, 0])(
            np.array([1.2, -0.5])
        )
    assert np.isfinite(score).all()
    found = filtered(m.structural([part]), y[2:])
    assert abs(found.innovations[10:].std() - 1) < 3 * np.sqrt(0.5 / 390)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: m.arma([1.1], [], 1.0), "ar: expected coefficients of a stationary process"),
        (lambda: m.seasonal(1, 1.0), "period: expected a whole number of at least 2"),
        (lambda: m.trigonometric_seasonal(12, 1.0, 7), "harmonics: expected from 1 to 6"),
        (lambda: m.trigonometric_seasonal(1.5, 1.0), "period: expected a number of at least 2"),
        (lambda: m.cycle(11, 1.0, 1.0), "damping: expected a number from 0 to 1"),
        (lambda: m.level(-1.0), "variance of the level: expected a number of at least 0"),
        (lambda: m.structural([m.level(1.0), m.level(1.0)]), "states of joined plants: expected each name once"),
        (lambda: m.structural([]), "plants: expected at least one"),
        (lambda: m.Component("a", m.level(1.0).plant, [1.0, 2.0]), "loading of a component"),
        (lambda: m.components(3, {"a": [1.0]}), "estimates: expected what filter.run"),
    ],
)
def test_what_is_no_component_is_refused_in_one_line(call, words):
    with pytest.raises(hg.InputError, match=words):
        call()


@pytest.mark.slow
def test_components_may_start_where_nobody_knows_beside_others_that_are_known():
    """As the same matrices by hand, and the limit of ever wider starts: 1e8 leaves 1e-8 of itself."""
    y = np.cumsum(np.random.default_rng(0).normal(size=12)) + np.tile([1.0, -2.0, 0.5, 0.5], 3)

    def structural(start):
        parts = [
            hg.models.trend(1.0, 0.1, initial_variance=start),
            hg.models.seasonal(4, 0.05, initial_variance=start),
            hg.models.arma([0.5], [], 1.0),
        ]
        return hg.models.structural(parts, noise=0.1)

    model = structural(hg.diffuse)
    by_hand = hg.LinearPlant(
        model.plant.matrix, model.plant.noise, np.zeros(6), hg.diffuse(model.plant.states[:5], np.eye(6) / 0.75),
        states=model.plant.states,
    )  # fmt: skip
    filter = hg.kalman_filter(model.plant, model.sensor)
    run, same = filter.run(y), hg.kalman_filter(by_hand, model.sensor).run(y)
    np.testing.assert_allclose(run.means, same.means, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(run.log_likelihood, same.log_likelihood, rtol=1e-12)
    wide = structural(1e8)
    near = hg.kalman_filter(wide.plant, wide.sensor).run(y)
    np.testing.assert_allclose(run.means[-1], near.means[-1], atol=1e-5)
    np.testing.assert_allclose(run.covariances[-1], near.covariances[-1], atol=1e-5)
    smoothed, right = (hg.rts_smoother(one, y) for one in (filter, hg.kalman_filter(wide.plant, wide.sensor)))
    np.testing.assert_allclose(smoothed.means[0], right.means[0], atol=1e-5)


def test_a_law_of_the_start_that_is_not_gaussian_is_refused_beside_one_that_nobody_knows():
    skew = hg.LinearPlant(
        [[1.0]], 1.0, [0.0], hg.random_affine.FiniteSupport([[-1.0], [1.0]], [0.5, 0.5]), states=["s"]
    )
    with pytest.raises(ValueError, match="law of x_0 of a joined plant: expected a Gaussian one"):
        hg.models.join([skew, hg.LinearPlant([[1.0]], 1.0, [0.0], hg.diffuse, states=["d"])])
