"""What a model did not predict: the standardised residuals of its predictions one step ahead, and tests of them."""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.stats import chi2, f

from heliograph.filters.base import AbstractFilter, FilterAngles
from heliograph.filters.rows.run_over_data import check_data
from heliograph.forecasting.backtest import select_measurements
from heliograph.forecasting.forecast import list_targets
from heliograph.forecasting.forecast_result import Array, Forecast
from heliograph.forecasting.one_step_predictions import predict_record, predict_rows
from heliograph.forecasting.residual_figure import ResidualQuantiles, compare_with_normal_quantiles, draw_residuals
from heliograph.forecasting.start_states import find_origin
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.check import check_count, fail, instance, show_value
from heliograph.numerics.confidence_intervals import correlate_over_steps
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.results.record import Record

if TYPE_CHECKING:  # it takes a second
    from matplotlib.figure import Figure

FALSE_DOUBT = 0.01  # probability of any false doubt, of all tests together
FEWEST_RESIDUALS = 20  # residuals for tests
LAGS = 10  # of autocorrelations
NORMAL_QUANTILE = 1.959963984540054  # quantile of an interval of 95 %


@readable
@dataclass(frozen=True)
class Residuals:
    """Standardised residuals (z - E z) / deviation of each output, white and normal of variance 1 where all is right.

    p-values are NaN where too few values came.

    Args:
        names: of the outputs, m of them.
        values: residuals (steps, m), NaN where nothing arrived.
        predicted: what was predicted at each row.
        autocorrelation: over the first lags (lags, m), of the pairs that came; NaN where none did.
        band: half-width of the interval of 95 % about zero for one of them (m,).
        ljung_box: p-values (m,) that all are zero.
        normality: p-values (m,) of skewness and kurtosis together, by Jarque and Bera.
        variance: p-values (m,) that the variance of the last third is that of the first.
    """

    names: tuple[str, ...]
    values: Array
    predicted: Forecast = field(repr=False)
    autocorrelation: Array
    band: Array
    ljung_box: Array
    normality: Array
    variance: Array

    def doubts(self) -> list[str]:
        """List what speaks against the model, one line each.

        A p-value does if it is below FALSE_DOUBT (0.01) divided by the number of tests (Bonferroni): if the model is
        right, the probability of any doubt at all is then at most FALSE_DOUBT.
        """
        tests = {"correlated over time": self.ljung_box, "not normal": self.normality,
                 "of a variance that changes": self.variance}  # fmt: skip
        count = sum(int(np.sum(np.isfinite(p))) for p in tests.values())
        return [
            f"residuals of {name} are {finding} (p = {p[i]:.1g} of {count} tests)"
            for i, name in enumerate(self.names)
            for finding, p in tests.items()
            if p[i] < FALSE_DOUBT / count
        ]

    def quantiles(self, name: str) -> ResidualQuantiles:
        """Return the residuals of one output in order, beside the quantiles of a normal law, with a band of 95 % each.

        Raises:
            ValueError: no output of this name.
        """
        if name not in self.names:
            raise fail("output", f"one of {', '.join(self.names)}", show_value(name))
        return compare_with_normal_quantiles(self.values[:, self.names.index(name)])

    def figure(self, time: "Float[ArrayLike, ' steps'] | None" = None) -> "Figure":
        """Return a figure: of each output residuals over time, autocorrelations with their band, and quantiles.

        Args:
            time: of the rows, numbers or dates (steps,); 0, 1, ... by default.

        Raises:
            ValueError: times of another number.
        """
        clock = np.arange(len(self.values)) if time is None else np.asarray(time)
        if clock.shape != (len(self.values),):
            raise fail("time", f"{len(self.values)} times", f"shape {clock.shape}")
        return draw_residuals(self.names, self.values, self.autocorrelation, self.band, clock)


def residuals(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
    lags: int = LAGS,
) -> Residuals:
    """Standardise what a filter did not predict, and test it: correlation, normality, changing variance.

    If the model is right, the innovations (z minus its prediction) over their deviations are uncorrelated and standard
    normal.

    Args:
        filter: a filter that states a covariance.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs), the one that led to each row; by default a filter without inputs is assumed.
        lags: number of autocorrelations; 10 by default.

    Raises:
        ValueError: data of another size than the filter's, a filter that claims nothing or uses no measurements.

    Source: Ljung and Box (1978), of gaps Stoffer and Toloi (1992); Jarque and Bera (1980); Durbin and Koopman, Time
        Series Analysis by State Space Methods, Section 2.12.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    # Predict each row from those before it, then standardise and test; angles are compared within a turn.
    rows, inputs = check_data(filter, z, u)
    predicted = predict_rows(filter, rows, inputs)
    count = check_count("lags", lags)
    angles = (filter.angles_used() or FilterAngles((), ())).received
    found = _standardise(predicted, np.asarray(rows), angles, count)
    if found is None:
        raise fail("residuals", "a filter that claims a covariance of what arrives", type(filter).__name__)
    return found


def record_residuals(
    record: Record, inputs: Float[ArrayLike, "steps inputs"] | None = None
) -> dict[str, dict[str, Residuals]]:
    """Return the standardised one-step prediction errors of each filter of a record, as `residuals` of one filter.

    Args:
        record: what `hg.run` returned.
        inputs: (steps, inputs), as they were given to `hg.run`; by default a plant without inputs is assumed.

    Returns:
        By node and filter, for filters that state a covariance of what arrives: residuals (z - E z) / deviation
        (steps, received), and tests whether they are uncorrelated, normal and of constant variance.

    Raises:
        ValueError: a record of a file or a simulation, which does not know its filters; inputs of another shape.

    Source: as of `residuals`.
    """
    predicted = predict_record(record, inputs)
    found: dict[str, dict[str, Residuals]] = {}
    for target in list_targets(find_origin(record)):
        prediction = predicted.get(target.node, {}).get(target.filter)
        if prediction is None:
            continue
        angles = (target.predictor.filter.angles_used() or FilterAngles((), ())).received
        of_filter = _standardise(prediction, select_measurements(target, record), angles, LAGS)
        if of_filter is not None:
            found.setdefault(target.node, {})[target.filter] = of_filter
    return found


def _standardise(predicted: Forecast, rows: np.ndarray, angles: Angles, lags: int) -> Residuals | None:
    """Return the standardised residuals e = (z - E z) / deviation of all rows, and tests of each received number.

    If model and filter are right, these are independent, normal and of variance 1; the tests ask if they are. Return
    None if the filter predicts no received numbers, or states no covariance of them.

    Args:
        predicted: the forecast one step ahead whose horizons are the rows.
        rows: measurements z (steps, received), NaN for what did not arrive.
        angles: indices of the angles among the received numbers.
        lags: number of autocorrelations.
    """
    prediction = predicted.received
    if prediction is None or prediction.claim == "none":
        return None
    # e; a deviation is infinite before the first measurement if nothing is known of the initial state.
    deviation = np.where(np.isfinite(prediction.deviation), prediction.deviation, np.nan)
    values = (wrap_near(rows, prediction.mean, angles) - prediction.mean) / deviation
    by_number = list(values.T)  # residuals e (steps,) of each received number
    correlations, errors = zip(*(correlate_over_steps(_subtract_mean(e)[None], lags) for e in by_number), strict=True)
    return Residuals(
        names=prediction.names,
        values=values,
        predicted=predicted,
        autocorrelation=np.stack(correlations, axis=1),
        band=NORMAL_QUANTILE * np.array(errors),
        ljung_box=np.array([_test_correlation(e, lags) for e in by_number]),
        normality=np.array([_test_normality(e) for e in by_number]),
        variance=np.array([_test_same_variance(e) for e in by_number]),
    )


def _multiply_pairs(e: np.ndarray, lag: int) -> np.ndarray:
    """Return the products e_t e_(t+lag) of residuals (steps,) of which both came.

    Args:
        e: residuals (steps,), NaN where nothing arrived.
        lag: distance of the rows that are multiplied.
    """
    products = e[lag:] * e[: len(e) - lag]
    return np.asarray(products[~np.isnan(products)])


def _subtract_mean(e: np.ndarray) -> np.ndarray:
    """Return residuals (steps,) less the mean of those that are not NaN."""
    return e - np.nanmean(e) if np.any(~np.isnan(e)) else e


def _test_correlation(e: np.ndarray, lags: int) -> float:
    """Return the p-value of n (n + 2) sum_l r_l^2 / n_l, which is chi-squared if all correlations r_l are zero.

    r_l = sum e_t e_(t+l) / sum e_t^2 over what came: n residuals, and n_l pairs of lag l. The result is NaN for n below
    FEWEST_RESIDUALS.

    Args:
        e: residuals (steps,), NaN where nothing arrived.
        lags: number of lags l.
    """
    n = int(np.sum(~np.isnan(e)))
    if n < FEWEST_RESIDUALS:
        return float("nan")
    e = _subtract_mean(e)
    pairs = [_multiply_pairs(e, lag) for lag in range(1, lags + 1)]
    r = np.array([products.sum() for products in pairs]) / np.nansum(e**2)
    counts = np.array([max(len(products), 1) for products in pairs])
    return float(chi2.sf(n * (n + 2) * np.sum(r**2 / counts), df=lags))


def _test_normality(e: np.ndarray) -> float:
    """Return the p-value of n (S^2 + (K - 3)^2 / 4) / 6, with S the skewness and K the kurtosis of residuals.

    The number is chi-squared with 2 degrees of freedom if the n residuals that are not NaN are normal. The result is
    NaN for n below FEWEST_RESIDUALS. `e`: residuals (steps,), NaN where nothing arrived.
    """
    e = e[~np.isnan(e)]
    n = len(e)
    if n < FEWEST_RESIDUALS:
        return float("nan")
    standardised = (e - e.mean()) / e.std()
    S = np.mean(standardised**3)
    K = np.mean(standardised**4)
    return float(chi2.sf(n * (S**2 + (K - 3) ** 2 / 4) / 6, df=2))


def _test_same_variance(e: np.ndarray) -> float:
    """Return the two-sided p-value of the ratio of the sums of squares in the last and the first third of residuals.

    With h residuals (not NaN) in a third, the ratio has the F law with h and h degrees of freedom if the variance is
    the same. The result is NaN for h below half of FEWEST_RESIDUALS. `e`: residuals (steps,), NaN where nothing
    arrived.
    """
    e = e[~np.isnan(e)]
    h = len(e) // 3
    if h < FEWEST_RESIDUALS // 2:
        return float("nan")
    ratio = float(np.sum(e[-h:] ** 2) / np.sum(e[:h] ** 2))
    return float(2 * min(f.sf(ratio, h, h), f.cdf(ratio, h, h)))
