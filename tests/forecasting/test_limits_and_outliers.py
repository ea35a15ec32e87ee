"""Laws that are not Gaussian, ahead: of states with limits, and of noise with outliers."""

import numpy as np
import pytest
from scipy import stats

import heliograph as hg

LIMITS = {"soc": (0.0, 1.0)}


def walk(limits):
    return hg.LinearPlant([[1.0]], 0.01, [0.1], 0.04, states=["soc"], limits=limits)


def run(limits, z=(0.05, 0.02)):
    return hg.kalman_filter(walk(limits), hg.LinearSensor([[1.0]], 0.04)).run(z)


def test_nothing_is_forecast_beyond_the_limits_of_a_state():
    """Of one limited state of a linear plant the law is the normal one of the plain filter, cut to its limits."""
    ahead, plain = (hg.forecast(run(limits), [1, 5, 50]).states for limits in (LIMITS, {}))
    m, s = plain.mean[:, 0], plain.deviation[:, 0]
    law = stats.truncnorm((0 - m) / s, (1 - m) / s, m, s)
    assert ahead.claim == "nominal" and ahead.limits == ((0.0, 1.0),)
    np.testing.assert_allclose(ahead.mean[:, 0], law.mean(), rtol=1e-9)
    for value in (-0.1, 0.0, 0.05, 0.3, 1.0, 1.2):
        np.testing.assert_allclose(ahead.below(value)[:, 0], law.cdf(value), rtol=1e-9)
    for level in (0.025, 0.5, 0.9):
        np.testing.assert_allclose(ahead.quantile(level)[:, 0], law.ppf(level), rtol=1e-9)
    assert not np.any(plain.quantile(0.025) > 0)  # where the plain one is wrong


def test_paths_keep_the_limits_of_states():
    """Drawn noise is mirrored at a limit, so that the walk is a reflected one: judged by tests of 10,000 draws."""
    found = run(LIMITS)
    x = hg.forecasting.draw_paths(found, 20).x[:, :, 0]
    assert x.min() >= 0 and x.max() <= 1
    beyond = hg.forecasting.crossing(found, "soc", 0.0, 20, above=False)
    assert not beyond.beyond.any() and not beyond.by.any()
    # A walk from a uniform start between reflecting ends stays uniform.
    wide = hg.LinearPlant([[1.0]], 0.01, [0.5], 1e6, states=["soc"], limits=LIMITS)
    blind = hg.kalman_filter(wide, hg.LinearSensor([[1.0]], 1.0)).run([np.nan])
    drawn = hg.forecasting.draw_paths(blind, 20).x[:, -1, 0]
    assert stats.kstest(drawn, "uniform").pvalue > 1e-3
    # What is moved beyond a limit stays there: with symmetric noise by half a normal law.
    charged = hg.LinearPlant([[1.0]], 1e-4, [0.95], 1e-6, [[1.0]], ["soc"], ["charge"], limits=LIMITS)
    full = hg.kalman_filter(charged, hg.LinearSensor([[1.0]], 1.0)).run([np.nan], [[0.0]])
    drawn = hg.forecasting.draw_paths(full, 3, np.full((3, 1), 0.5)).x[:, -1, 0]
    assert stats.kstest((1 - drawn) / 0.01, "halfnorm").pvalue > 1e-3


def test_a_path_begins_by_the_law_of_several_limited_states():
    """Against draws of the normal law of which those beyond a limit are left out; 5 standard errors."""
    mean, covariance = np.array([0.1, 0.2]), np.array([[0.04, 0.03], [0.03, 0.05]])
    plant = hg.LinearPlant(np.eye(2), 1e-12 * np.eye(2), mean, covariance, states=["a", "b"],
                           limits={"a": (0, 1), "b": (0, None)})  # fmt: skip
    blind = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 1.0)).run([np.nan])
    x = hg.forecasting.draw_paths(blind, 1).x[:, 0]
    every = np.random.default_rng(0).multivariate_normal(mean, covariance, 200_000)
    kept = every[(every > 0).all(axis=1) & (every[:, 0] < 1)]
    for drawn, right in ((x, kept), (x[:, :1] * x[:, 1:], kept[:, :1] * kept[:, 1:])):
        error = right.std(axis=0) / np.sqrt(len(drawn) / 2)  # resampling doubles some draws
        np.testing.assert_array_less(np.abs(drawn.mean(axis=0) - right.mean(axis=0)), 5 * error)


OUTLIERS = {
    "student": (hg.StudentT(1.0, 3.0), lambda v: stats.t.cdf(v, 3)),
    "contaminated": (
        hg.Contaminated(1.0, 0.1, 100.0),
        lambda v: 0.9 * stats.norm.cdf(v) + 0.1 * stats.norm.cdf(v / 10),
    ),
    "biased": (
        hg.Contaminated(1.0, 0.2, 4.0, bias=5.0),
        lambda v: 0.8 * stats.norm.cdf(v) + 0.2 * stats.norm.cdf((v - 5) / 2),
    ),
}


@pytest.mark.parametrize("name", OUTLIERS)
@pytest.mark.parametrize("where", ["sensor", "last hop"])
def test_noise_with_outliers_is_forecast_as_it_is(name, where):
    """What is measured of a known state has the noise's law, for which branches of Student's stand to .005."""
    law, cdf = OUTLIERS[name]
    plant = hg.LinearPlant([[1.0]], 1e-10, [0.0], 1e-10)
    sensor = hg.LinearSensor([[1.0]], law if where == "sensor" else 1e-10)
    link = hg.hop(1.0, 1e-10) if where == "sensor" else hg.hop(1.0, law)
    for build in (hg.linear_filter, hg.robust_filter):
        ahead = hg.forecast(build(plant, sensor, link).run([0.1, np.nan]), 2)
        for prediction in (ahead.outputs, ahead.received) if where == "sensor" else (ahead.received,):
            for value in (-4.0, -1.0, 0.0, 2.0, 6.0):
                assert prediction.below(value)[1, 0] == pytest.approx(cdf(value), abs=0.005)
            assert cdf(prediction.quantile(0.9)[1, 0]) == pytest.approx(0.9, abs=0.005)
            variance = np.asarray(law.covariance)[0, 0]
            assert prediction.covariance[1, 0, 0] == pytest.approx(variance, rel=0.02)


@pytest.mark.parametrize("degrees", [2.0, 1.5])
def test_noise_without_variance_of_the_last_hop_has_no_end_ahead(degrees):
    plant, sensor = hg.LinearPlant([[1.0]], 0.01, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    found = hg.robust_filter(plant, sensor, hg.hop(1.0, hg.StudentT(0.1, degrees))).run([0.1, 0.2])
    ahead = hg.forecast(found, 1)
    assert np.isinf(ahead.received.deviation).all() and np.isfinite(ahead.outputs.deviation).all()
    low, high = ahead.received.interval(0.8)
    assert np.isneginf(low).all() and np.isposinf(high).all()


@pytest.mark.parametrize("of", ["plant", "sensor"])
def test_modes_are_forecast_and_drawn_within_limits(of):
    """What a perfect link brings is what is measured, and what paths measure: to 5 errors of 10,000 draws, and some
    hundredths by which both laws differ."""
    slow, fast = (
        hg.LinearPlant([[a]], q, [1.0], 1.0, states=["x"], limits={"x": (0.0, None)})
        for a, q in ((0.9, 0.1), (0.5, 0.4))
    )
    fine, coarse = (hg.LinearSensor([[c]], r) for c, r in ((1.0, 0.1), (2.0, 0.5)))
    chain = [[0.9, 0.1], [0.2, 0.8]]
    plant = hg.markov_plant([slow, fast], chain) if of == "plant" else slow
    sensor = hg.markov_sensor([fine, coarse], chain) if of == "sensor" else fine
    found = hg.filters.imm_filter(plant, sensor, hg.perfect()).run(np.ones((6, 1)))
    ahead, paths = hg.forecast(found, 1), hg.forecasting.draw_paths(found, 1)
    np.testing.assert_allclose(ahead.received.mean, ahead.outputs.mean, rtol=1e-9)
    np.testing.assert_allclose(ahead.received.covariance, ahead.outputs.covariance, rtol=1e-9)
    assert paths.x.min() >= 0
    assert paths.x.mean() == pytest.approx(ahead.states.mean[0, 0], abs=5 * 0.5 / 100 + 0.02)
    assert paths.y.mean() == pytest.approx(ahead.outputs.mean[0, 0], abs=5 * 0.65 / 100 + 0.02)
