"""One step ahead at every row: what a filter, or each filter of a record, predicted of it from the rows before."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import scan_rows
from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.forecasting.backtest import list_single_filters, select_measurements
from heliograph.forecasting.forecast import Forecasts, combine_predictions, list_targets
from heliograph.forecasting.forecast_result import Forecast
from heliograph.forecasting.multistep_prediction import MultistepPredictor, make_multistep_predictor
from heliograph.forecasting.start_states import find_origin
from heliograph.model.over_time import first
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.network import Network
from heliograph.simulation.node import name_values
from heliograph.simulation.results.record import Record


def predict_rows(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
) -> Forecast:
    """Predict each row given earlier ones: states, outputs and what arrives, also at rows where nothing arrived.

    Args:
        filter: a filter.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs) that led to each row; by default a filter without inputs is assumed.

    Returns:
        A forecast one step ahead whose horizons are the rows: `received.mean[k]` is E[z_k | z_0 ... z_(k-1)].

    Raises:
        ValueError: data of another size than the filter's, no rows.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    rows, inputs = check_data(filter, z, u)
    if not len(rows):
        raise fail("measurements", "at least one row", "none")
    # The predictor knows the filter's plant, sensor and channel; without a sensor received numbers get plain names.
    predictor = make_multistep_predictor(filter)
    sensor = first(predictor.sensor)
    names = name_values(() if sensor is None else tuple(sensor.outputs), filter.received)
    return _make_forecast(predictor, np.asarray(rows), np.asarray(inputs), names)


def predict_record(record: Record, inputs: Float[ArrayLike, "steps inputs"] | None = None) -> Forecasts:
    """Predict each row of a recording given earlier ones, by each filter that ran over it.

    A fusion of estimates is left out, since it has no state of its own to predict.

    Args:
        record: what `hg.run` returned, which still knows its network and filters.
        inputs: (steps, inputs), as they were given to `hg.run`; by default a plant without inputs is assumed.

    Returns:
        By node and filter a forecast one step ahead whose horizons are the rows, at their times; `write_estimates`
        makes columns of it.

    Raises:
        ValueError: a record from a file or a simulation, which does not know its filters; inputs of another shape.

    Source: the prediction step of the filter.
    """
    # The network that made the record.
    network = find_origin(instance("record", record, Record, "a Record")).model
    assert isinstance(network, Network)  # nothing else makes a record with an origin
    u = read_plant_inputs(network, inputs, len(record.time))
    filters_with_state = list_single_filters(network)  # (node, filter), without fusion rules
    forecasts: Forecasts = {}
    # A target is a filter at a node. Its predictor gives the forecast of row k from rows before k.
    for target in list_targets(find_origin(record)):
        if (target.node, target.filter) in filters_with_state:
            z = select_measurements(target, record)
            forecast_of_rows = _make_forecast(target.predictor, z, u, target.received)
            forecasts.setdefault(target.node, {})[target.filter] = replace(forecast_of_rows, time=record.time)
    return forecasts


def _make_forecast(predictor: MultistepPredictor, z: np.ndarray, u: np.ndarray, names: tuple[str, ...]) -> Forecast:
    """Return a forecast one step ahead whose horizons are the rows, each predicted from the rows before it.

    Args:
        predictor: the filter's predictor.
        z: measurements (rows, received), NaN for what did not arrive.
        u: inputs (rows, inputs) that led to each row.
        names: names of the numbers that arrive.
    """
    rows = np.arange(len(z)), z, u
    # Native code steps over the rows if it supports the filter, else JAX's compiler XLA.
    _, moments = scan_rows(
        begin=_begin, step=_predict_and_correct, fixed=predictor, rows=rows, by_xla=lambda: _by_xla(predictor, rows)
    )
    return combine_predictions(
        predictor,
        moments,
        received_names=names,
        steps=np.ones(len(z), int),
        time=np.arange(float(len(z))),
        inputs="given" if predictor.filter.inputs else "none",
    )


def _begin(predictor: MultistepPredictor) -> PyTree:
    """Return the filter's state before the first row."""
    return jax.tree.map(jnp.asarray, predictor.filter.init())


def _predict_and_correct(
    predictor: MultistepPredictor, state: PyTree, row: tuple[jax.Array, ...]
) -> tuple[PyTree, PyTree]:
    """Return the filter's state after a row, and the moments (K, ...) predicted for the row from the earlier ones.

    Args:
        predictor: predicts the filter's state, and reads the moments of states, outputs and received numbers from it.
        state: the filter's state before the row.
        row: number k of the row, measurements z (received,) and inputs u (inputs,).
    """
    k, z, u = row
    prior, moments = predictor.predict_step(state, u, k)
    state_after, _ = predictor.filter.correct(prior, z, k)
    return state_after, moments


def _predict_each_row(predictor: MultistepPredictor, rows: PyTree) -> tuple[PyTree, PyTree]:
    """Return the last state, and the moments (rows, K, ...) that a filter predicts for each row of a recording.

    `rows`: numbers of the rows, measurements and inputs. XLA compiles this where native code does not support a filter.
    """
    return jax.lax.scan(partial(_predict_and_correct, predictor), _begin(predictor), rows)


_by_xla = quickly_compiled(_predict_each_row)
