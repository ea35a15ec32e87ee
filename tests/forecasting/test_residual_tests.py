"""One-step predictions at every row, and tests of residuals that fail where they should and nowhere else."""

import numpy as np
import pytest
from scipy import stats

import heliograph as hg
from heliograph.forecasting import predict_rows, record_residuals, residuals


def filter_of(noise=0.3):
    return hg.kalman_filter(*hg.state_space([[0.9]], [[1.0]], 0.5, noise, [0.0], 2.0))


def drawn(rows, seed):
    plant, sensor = hg.state_space([[0.9]], [[1.0]], 0.5, 0.3, [0.0], 2.0)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), {})})
    return hg.simulate(network, rows, seed).measurements["a"]


def test_a_record_has_the_residuals_of_each_of_its_filters():
    """Node by node those of the filter alone; none of one that claims nothing."""
    plant, sensor = hg.state_space([[0.9]], [[1.0]], 0.5, 0.3, [0.0], 2.0)
    filters = {"k": hg.kalman_filter(plant, sensor), "h": hg.filters.open_loop_filter(plant)}
    z = drawn(60, 2)
    z[5] = np.nan
    record = hg.run(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(1), filters)}), {"a": z})
    found, alone = record_residuals(record), residuals(filters["k"], z)
    assert {node: list(of) for node, of in found.items()} == {"a": ["k"]}
    np.testing.assert_array_equal(found["a"]["k"].values, alone.values)
    np.testing.assert_array_equal(found["a"]["k"].ljung_box, alone.ljung_box)
    assert found["a"]["k"].names == alone.names and found["a"]["k"].doubts() == []
    with pytest.raises(ValueError, match="record: expected a Record"):
        record_residuals("record")


def test_rows_are_predicted_where_nothing_arrived_too():
    z = drawn(8, 0)
    z[3:5] = np.nan
    predicted, found = predict_rows(filter_of(), z), filter_of().run(z)
    came = ~np.isnan(z[:, 0])
    np.testing.assert_allclose((z - predicted.received.mean)[came], found.innovations[came], rtol=1e-12)
    covariance = predicted.received.covariance
    np.testing.assert_allclose(covariance[came], found.innovation_covariances[came], rtol=1e-12)
    mean, variance = found.means[2, 0], found.covariances[2, 0, 0]
    for k in (3, 4):  # behind the last that came
        mean, variance = 0.9 * mean, 0.81 * variance + 0.5
        assert predicted.states.mean[k, 0] == pytest.approx(mean, rel=1e-12)
        assert predicted.outputs.covariance[k, 0, 0] == pytest.approx(variance + 0.3, rel=1e-12)


def test_a_right_model_is_not_doubted_and_a_wrong_one_is():
    z = drawn(400, 1)
    z[50:60] = np.nan
    right = residuals(filter_of(), z)
    assert right.doubts() == []
    assert np.isnan(right.values[50:60]).all()
    assert np.all(np.abs(right.autocorrelation) < 3.5 * right.band / 1.96)
    slow = hg.kalman_filter(*hg.state_space([[0.9]], [[1.0]], 0.01, 5.0, [0.0], 2.0))
    assert any("correlated over time" in line for line in residuals(slow, z).doubts())
    outliers = z.copy()
    outliers[100::40] += 8.0
    assert any("not normal" in line for line in residuals(filter_of(), outliers).doubts())
    louder = z.copy()
    louder[200:] += np.random.default_rng(0).normal(size=(200, 1)) * 3
    assert any("variance that changes" in line for line in residuals(filter_of(), louder).doubts())


def test_tests_are_those_of_the_textbook():
    """Of complete residuals: Jarque and Bera by scipy, Ljung and Box by its formula."""
    found = residuals(filter_of(), drawn(200, 2), lags=5)
    e = found.values[:, 0]
    assert found.normality[0] == pytest.approx(stats.jarque_bera(e).pvalue, rel=1e-9)
    d = e - e.mean()
    r = np.array([d[lag:] @ d[:-lag] for lag in range(1, 6)]) / (d @ d)
    q = 200 * 202 * np.sum(r**2 / (200 - np.arange(1, 6)))
    assert found.ljung_box[0] == pytest.approx(stats.chi2.sf(q, 5), rel=1e-9)


def test_missing_rows_do_not_hide_a_correlation():
    """A filter that believes in too little noise of the plant, with half of the rows: the same correlation, within 0.1.

    Of 2,000 rows a half has pairs for an error of some 0.05.
    """
    slow = hg.kalman_filter(*hg.state_space([[0.9]], [[1.0]], 0.01, 5.0, [0.0], 2.0))
    z = drawn(2000, 4)
    whole = residuals(slow, z).autocorrelation[:3, 0]
    z[np.random.default_rng(0).random(len(z)) < 0.5] = np.nan
    some = residuals(slow, z)
    assert np.all(whole > 0.3)
    np.testing.assert_allclose(some.autocorrelation[:3, 0], whole, atol=0.1)


def test_filters_without_residuals_are_refused():
    plant = hg.LinearPlant([[0.9]], 0.5, [0.0], 2.0)
    with pytest.raises(ValueError, match="residuals: expected a filter that claims a covariance of what arrives"):
        residuals(hg.filters.open_loop_filter(plant), [[1.0]])
    with pytest.raises(ValueError, match="measurements: expected at least one row"):
        predict_rows(filter_of(), np.zeros((0, 1)))


def test_quantiles_of_a_normal_law_lie_in_their_band():
    """500 residuals of an honest filter: nineteen of twenty within bands of 95 %; a heavy tail leaves them."""
    rng = np.random.default_rng(0)
    plant, sensor = hg.LinearPlant([[0.0]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 1e-9, outputs=["y"])
    honest = hg.forecasting.residuals(hg.kalman_filter(plant, sensor), rng.normal(size=500)).quantiles("y")
    assert np.mean((honest.low <= honest.residuals) & (honest.residuals <= honest.high)) > 0.9
    heavy = hg.forecasting.residuals(hg.kalman_filter(plant, sensor), rng.standard_t(2, size=500))
    tails = heavy.quantiles("y")
    assert tails.residuals[-1] > tails.high[-1] and tails.residuals[0] < tails.low[0]
    figure = heavy.figure()
    assert len(figure.axes) == 3 and figure.axes[0].get_ylabel() == "y"
    with pytest.raises(hg.InputError, match="time: expected 500 times"):
        heavy.figure([1.0, 2.0])
    with pytest.raises(hg.InputError, match="output: expected one of y"):
        heavy.quantiles("z")
