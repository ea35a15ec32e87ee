"""A fit as ArviZ reads it: the maximum's rows, the spread of the estimates, and what cannot be drawn."""

from importlib.util import find_spec

import numpy as np
import pytest

import heliograph as hg

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(find_spec("arviz") is None, reason="no ArviZ here: pip install arviz"),
    pytest.mark.filterwarnings("ignore::FutureWarning"),  # of ArviZ, on its own next version
]
TRUE, ROWS = 0.5, 400


def build(spare=False):
    noise = hg.free(0.3, "noise")
    sensor = hg.LinearSensor([[1.0]], noise + hg.free(0.1, "more") if spare else noise)
    plant = hg.LinearPlant([[0.9]], hg.free(0.1, "drift"), [0.0], 1.0)
    return hg.Network(plant, {"n": hg.Node(sensor, hg.perfect(), {})})


@pytest.fixture(scope="module")
def fitted():
    """A level that drifts, measured with a noise of known size; one row did not arrive."""
    random, x, z = np.random.default_rng(3), 0.0, np.empty((ROWS, 1))
    for k in range(ROWS):
        x = 0.9 * x + random.normal() * np.sqrt(0.2)
        z[k] = x + random.normal() * np.sqrt(TRUE)
    z[7] = np.nan
    return hg.fit(build, {"n": z}, starts=1)


def test_draws_are_of_the_estimates_and_rows_sum_to_the_likelihood(fitted):
    made = fitted.to_arviz(draws=2000, seed=1)
    posterior, rows = made["posterior"], made["log_likelihood"]
    assert rows["rows"].shape == (1, 2000, ROWS - 1) and 7 not in rows["row"].values
    total = rows["rows"].values[0].sum(axis=1)
    np.testing.assert_allclose(total, made["sample_stats"]["lp"].values[0], rtol=1e-12)
    # No draw is above the maximum, and below it by half a chi-squared number of two degrees on average: 1 nat, of
    # 2,000 draws to 4 standard errors of 1 / sqrt(2000), and a tenth for what is not quadratic.
    best = fitted.log_likelihood
    fall = best - total
    assert fall.min() > -1e-6 and abs(fall.mean() - 1) < 4 / np.sqrt(2000) + 0.1
    for row in fitted.rows("hessian"):
        draws = posterior[row.name].values[0]
        low, high = np.quantile(draws, [0.025, 0.975])
        # To 6 standard errors of a quantile of 2,000 draws, sqrt(0.025 0.975 / 2000) / 0.058 widths
        tolerance = 6 * np.sqrt(0.025 * 0.975 / 2000) / 0.0584 * row.standard_error
        assert abs(low - row.low) < tolerance and abs(high - row.high) < tolerance


def test_arviz_compares_by_rows(fitted):
    import arviz

    found = arviz.loo(fitted.to_arviz(draws=1000))
    best = fitted.log_likelihood
    # The expected log density of rows left out is below the likelihood by some two numbers' worth.
    assert best - 6 < found.elpd_loo < best and 1 < found.p_loo < 4


def test_what_cannot_be_drawn_is_one_line(fitted):
    with pytest.raises(ValueError, match="draws: expected"):
        fitted.to_arviz(draws=1)


def test_numbers_that_are_not_identified_are_named(fitted):
    z = np.random.default_rng(0).normal(size=(60, 1))
    found = hg.fit(lambda: build(spare=True), {"n": z}, starts=1)
    with pytest.raises(ValueError, match="to_arviz: expected numbers inside their domains that the data identify"):
        found.to_arviz()
