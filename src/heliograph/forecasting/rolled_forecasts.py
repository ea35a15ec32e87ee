"""Forecasts from every row of a recording."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.forecasting.mixture_moments import Moments
from heliograph.forecasting.multistep_prediction import MultistepPredictor
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.types import PyTree


def roll_forecasts(
    predictor: MultistepPredictor, z: np.ndarray, u: np.ndarray, horizons: Sequence[int]
) -> tuple[Moments, Moments | None]:
    """Return the forecasts from each row of a recording at each horizon: of the states, and of the received numbers.

    A filter runs over the rows; behind each it predicts as if nothing more arrived, under the inputs of the later rows.
    After the last row its inputs are repeated. Received numbers are None if the filter does not predict them.

    Args:
        predictor: predicts the filter's state without data, and reads moments from it.
        z: measurements (rows, received), NaN where nothing arrived.
        u: inputs (rows, inputs).
        horizons: rows ahead, in rising order.

    Returns:
        Moments of mixtures of K Gaussians: weights (rows, horizons, K) and means (rows, horizons, K, size). The field
        `covariances` holds the variances alone (rows, horizons, K, size).
    """
    longest = horizons[-1]
    padded = np.concatenate([u, np.repeat(u[-1:], longest, axis=0)])
    # windows[k, i] are the inputs of row k + 1 + i: (rows, longest, inputs).
    windows = np.stack([padded[1 + i : 1 + i + len(u)] for i in range(longest)], axis=1)
    indices = np.asarray(horizons) - 1  # among the rows ahead; horizon 1 is the first of them
    arguments = predictor, z, u, windows, indices
    # Native code computes `_forecast_from_each_row` if it supports the filter's operations; else JAX's compiler XLA
    # does.
    rolled: tuple[Moments, Moments | None] = compute_once(
        function=_forecast_from_each_row, by_xla=_by_xla, arguments=arguments
    )
    return rolled


def _forecast_from_each_row(
    predictor: MultistepPredictor, z: jax.Array, u: jax.Array, windows: jax.Array, indices: jax.Array
) -> PyTree:
    """Return the moments that a filter forecasts from each row of a recording: of the states, and of what arrives.

    They are (rows, indices, K, ...), of mixtures of K parts, with variances in place of covariances. A backtest scores
    them by the later rows.

    Args:
        predictor: predicts the filter's state, and from it the states' and measurements' moments, without data.
        z: measurements (rows, received).
        u: inputs (rows, inputs).
        windows: inputs of the rows ahead of each row (rows, ahead, inputs).
        indices: which of the rows ahead are returned, from 0.
    """
    filter, length = predictor.filter, windows.shape[1]

    def select(moments: Moments | None) -> PyTree:
        """Return the moments at `indices` (the horizons among all rows ahead), variances for covariances."""
        if moments is None:
            return None
        variances = jnp.diagonal(moments.covariances, axis1=-2, axis2=-1)
        return jax.tree.map(lambda leaf: leaf[indices], moments._replace(covariances=variances))

    def filter_and_forecast(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, PyTree]:
        """Return the filter's state after row k, and the moments that it forecasts from there.

        The row holds k, the measurements, the inputs, and `window`, the inputs of the `length` rows ahead. `predictor`
        steps the filter without data; `select` takes the horizons from the moments of all rows ahead.
        """
        k, z_k, u_k, window = row
        after, _ = filter.correct(filter.predict(state, u_k, k), z_k, k)
        ahead = window, k + 1 + jnp.arange(length)
        _, (states, _, received) = jax.lax.scan(lambda s, row: predictor.predict_step(s, *row), after, ahead)
        moments_alone = states and states._replace(laws=None)  # states are scored by moments even if they have limits
        return after, (select(moments_alone), select(received))

    start = jax.tree.map(jnp.asarray, filter.init())
    rows = jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u), jnp.asarray(windows)
    _, forecasts = jax.lax.scan(filter_and_forecast, start, rows)
    return forecasts


_by_xla = quickly_compiled(_forecast_from_each_row)
