"""Backtests: scores against formulas, honest forecasts pass, and those that trust a mean gain do not."""

import re
import warnings

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import ndtr

import heliograph as hg
from heliograph.forecasting.scores import MixtureLaws, average_overlapping, crps, log_score


def world(loss=1.0):
    plant = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0, states=["x"])
    sensor = hg.LinearSensor([[1.0]], 0.3, outputs=["y"])
    link = hg.perfect(1) if loss == 1.0 else hg.erasure(hg.perfect(1), loss)
    return hg.Network(plant, {"a": hg.Node(sensor, link, {"f": hg.kalman_filter(plant, sensor)})})


def test_one_step_scores_are_those_of_the_innovations():
    """Behind each row the forecast of the next is the filter's own innovation, with its covariance."""
    network = world(0.8)
    z = hg.simulate(network, 200, 3).measurements
    score = hg.backtest(network, z, [1], skip=10).of("a", "f", "y", 1)
    found = network.nodes["a"].filters["f"].run(z["a"])
    e, s = found.innovations[11:, 0], found.innovation_covariances[11:, 0, 0]
    e, s = e[~np.isnan(e)], s[~np.isnan(e)]
    assert score.compared == len(e)
    assert score.bias.value == pytest.approx(e.mean(), rel=1e-10)
    assert score.mse.value == pytest.approx(np.mean(e**2), rel=1e-10)
    assert score.log_score.value == pytest.approx(np.mean(-(e**2 / s + np.log(2 * np.pi * s)) / 2), rel=1e-10)
    assert score.coverage[2].value == pytest.approx(np.mean(np.abs(e) < 1.959963984540054 * np.sqrt(s)), rel=1e-12)


def test_an_honest_filter_covers_ahead_and_a_wrong_one_does_not():
    network = world(0.8)
    simulated = hg.simulate(network, 2000, 5)
    found = hg.backtest(network, simulated.measurements, [1, 5], truth=simulated.truth)
    for score in found.scores:
        for level, share in zip((0.5, 0.8, 0.95), score.coverage, strict=True):
            assert abs(share.value - level) < 4 * share.error, score
    assert {score.part for score in found.scores} == {"state", "received"}
    plant = hg.LinearPlant([[0.9]], 0.05, [0.0], 2.0, states=["x"])
    wrong = {"f": hg.kalman_filter(plant, hg.LinearSensor([[1.0]], 0.03, outputs=["y"]))}
    sure = hg.Network(network.plant, {"a": hg.Node(network.nodes["a"].sensor, network.nodes["a"].channel, wrong)})
    score = hg.backtest(sure, simulated.measurements, [5]).of("a", "f", "y", 5)
    assert score.coverage[2].value < 0.95 - 10 * score.coverage[2].error
    assert score.log_score.value < found.of("a", "f", "y", 5).log_score.value
    assert score.crps.value > found.of("a", "f", "y", 5).crps.value


def test_scores_of_a_mixture_are_their_integrals():
    law = MixtureLaws(np.array([[0.3, 0.7]]), np.array([[-1.0, 2.0]]), np.array([[0.25, 1.5]]))

    def below(x):
        return 0.3 * ndtr((x + 1) / 0.5) + 0.7 * ndtr((x - 2) / np.sqrt(1.5))

    expected = (
        quad(lambda x: (below(x) - (x >= 0.4)) ** 2, -30, 0.4)[0] + quad(lambda x: (below(x) - 1) ** 2, 0.4, 30)[0]
    )
    assert crps(law, np.array([0.4]))[0] == pytest.approx(expected, rel=1e-7)
    slope = (below(0.4 + 1e-5) - below(0.4 - 1e-5)) / 2e-5
    assert log_score(law, np.array([0.4]))[0] == pytest.approx(np.log(slope), rel=1e-7)


def test_scores_of_many_rows_are_those_of_each():
    """Rows whose laws are shifts of one another share the distance of two draws; others, and values, do not."""
    generator = np.random.default_rng(0)
    weights, means, variances = (generator.uniform(0.2, 1.0, size=(3, 4)) for _ in range(3))
    law = MixtureLaws(weights / weights.sum(axis=1, keepdims=True), means, variances)
    shifted = MixtureLaws(*(np.concatenate([part, part[:2]]) for part in law))
    shifted.means[3:] += np.array([[2.0], [-1.0]])
    z = generator.normal(size=5)
    alone = [crps(MixtureLaws(*(part[[k]] for part in shifted)), z[[k]])[0] for k in range(5)]
    np.testing.assert_allclose(crps(shifted, z), alone, rtol=1e-12)


def test_standard_errors_know_the_overlap():
    """Sums of 8 neighbours: their mean's error over 400 series is as said; the naive one is 2.8 times too small."""
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(400, 1007))
    series = np.stack([np.convolve(row, np.ones(8), "valid") for row in noise])
    said = np.mean([average_overlapping(row, 8).error for row in series])
    true = series.mean(axis=1).std()
    assert said == pytest.approx(true, rel=0.15)  # of which Bartlett's weights take a tenth
    assert series.std() / np.sqrt(1000) < true / 2.5


@pytest.mark.parametrize(("horizon", "rows"), [(1, 3), (1, 20), (12, 20), (12, 60)])
def test_standard_errors_of_short_recordings_are_not_too_small(horizon, rows):
    """Sums of `horizon` neighbours in few rows, some of which are missing: the error of their mean over 2,000 series.

    What is said of one series is scattered, so that its root mean square is compared; 5 % are four of its own errors.
    """
    generator = np.random.default_rng(0)
    noise = generator.normal(size=(2000, rows + horizon - 1))
    series = np.stack([np.convolve(row, np.ones(horizon), "valid") for row in noise])
    series[:, rows // 2] = np.nan
    said = np.sqrt(np.mean([average_overlapping(row, horizon).error ** 2 for row in series]))
    assert said == pytest.approx(np.nanmean(series, axis=1).std(), rel=0.05)


def test_of_one_comparison_no_standard_error_is_known():
    found = hg.backtest(world(), {"a": [*[np.nan] * 20, 0.3, np.nan]}, [1]).of("a", "f", "y", 1)
    assert found.compared == 1
    assert np.isnan([found.bias.error, found.mse.error, found.log_score.error, found.crps.error]).all()
    assert [share.error for share in found.coverage] == pytest.approx(np.sqrt([0.25, 0.16, 0.0475]))


def test_a_coverage_of_all_or_nothing_has_an_error():
    """Of few rows all within 95 %, which an honest filter has most of the time: their scatter is 0, their error not."""
    network = world()
    z = np.zeros((25, 1))  # always what is expected
    share = hg.backtest(network, {"a": z}, [1]).of("a", "f", "y", 1).coverage[2]
    assert share.value == 1.0
    assert share.error == pytest.approx(np.sqrt(0.95 * 0.05 / 14))


@pytest.mark.parametrize("level", [0.0, 5.0])
def test_what_is_known_exactly_is_forecast_without_error(level):
    """A state of variance 0: it came as it was said, so that no interval missed it; another value is off for ever."""
    plant = hg.LinearPlant(
        np.diag([1.0, 0.9]), np.diag([0.0, 0.5]), [level, 0.0], np.diag([0.0, 2.0]), states=["c", "x"]
    )
    sensor = hg.LinearSensor([[0.0, 1.0]], 0.3, outputs=["y"])
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(plant, sensor)})})
    drawn = hg.simulate(network, 40, 3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        right = hg.backtest(network, drawn.measurements, [1], truth=drawn.truth).of("a", "f", "c", 1)
        other = drawn.truth + np.array([0.25, 0.0])
        wrong = hg.backtest(network, drawn.measurements, [1], truth=other).of("a", "f", "c", 1)
    assert np.isnan([share.value for share in right.coverage]).all()  # it is no trial of any interval
    assert right.crps.value == pytest.approx(0.0, abs=1e-13)
    assert right.log_score.value > 25.0
    assert [share.value for share in wrong.coverage] == [0.0, 0.0, 0.0]
    assert wrong.crps.value == pytest.approx(0.25, rel=1e-12)
    assert wrong.log_score.value < -1e20


@pytest.mark.parametrize(
    ("horizons", "said"),
    [([30], "end within the 20 rows of data"), ([], "end within"), ([0], "horizon"), (3, "horizons: expected a list")],
)
def test_a_backtest_longer_than_the_data_is_refused(horizons, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        hg.backtest(world(), {"a": np.zeros(20)}, horizons)


def test_refits_forecast_from_their_row_on():
    """The same network is no refit; of another one from a row on, each row has the score of its own network."""
    network, other = world(0.8), world(0.5)
    noisy = hg.LinearPlant([[0.9]], 2.0, [0.0], 2.0, states=["x"])
    wrong = hg.kalman_filter(noisy, other.nodes["a"].sensor)
    other = hg.Network(noisy, {"a": hg.Node(other.nodes["a"].sensor, other.nodes["a"].channel, {"f": wrong})})
    z, asked = hg.simulate(network, 60, 3).measurements, []

    def same(rows):
        asked.append(rows)
        return network

    plain = hg.backtest(network, z, [1], skip=10)
    assert hg.backtest(network, z, [1], skip=10, refit=same, every=20).of("a", "f", "y", 1) == plain.of(
        "a", "f", "y", 1
    )
    assert asked == [10, 30, 50]
    changing = hg.backtest(network, z, [1], skip=10, refit=lambda n: network if n < 30 else other, every=20)
    e = np.concatenate([network.nodes["a"].filters["f"].run(z["a"]).innovations[11:31, 0],
                        wrong.run(z["a"]).innovations[31:, 0]])  # fmt: skip
    assert changing.of("a", "f", "y", 1).mse.value == pytest.approx(np.nanmean(e**2), rel=1e-10)


@pytest.mark.parametrize("refit", [lambda n: 3, lambda n: hg.Network(world().plant, {"b": world().nodes["a"]})])
def test_a_refit_that_is_another_network_is_refused(refit):
    with pytest.raises(hg.InputError, match="refit from 10 rows: expected"):
        hg.backtest(world(), {"a": np.zeros(40)}, [1], refit=refit)
    with pytest.raises(hg.InputError, match="skip: expected a positive whole number, got 0"):
        hg.backtest(world(), {"a": np.zeros(40)}, [1], skip=0, refit=refit)
