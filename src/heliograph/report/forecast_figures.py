"""Forecasts on the page of a run: their bands behind the line where the data end, and a table of what is ahead."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from heliograph.disk.quoted_text import visible
from heliograph.numerics.times.dates import format_times
from heliograph.report.diagnosis.sensor_output_health import round_to
from heliograph.report.figures import COLOURS, MUTED
from heliograph.report.pages.page import Table, Text
from heliograph.simulation.results.record import Record

if TYPE_CHECKING:
    import heliograph

MOST = 12  # horizons of a table
BOTH_SIDES = 0.95  # probability of the intervals in a table
Residuals = Mapping[str, "Mapping[str, heliograph.forecasting.Residuals]"]
Forecasts = Mapping[str, "Mapping[str, heliograph.forecasting.Forecast]"]  # by node and filter


def draw_forecasts(
    panels: Sequence[Axes],
    record: Record,
    node: str,
    forecasts: "Mapping[str, heliograph.forecasting.Forecast]",
    names: Sequence[str],
    sigmas: float,
) -> None:
    """Draw the filters' forecasts with their bands, following their estimates, and a vertical line where these end.

    Args:
        panels: one for each state, on which estimates are drawn already.
        record: the record, from whose last row the filters predict.
        node: name of the node.
        forecasts: forecast of each filter, by its name; a filter may have none.
        names: names of all filters, in the order of their colours.
        sigmas: half width of a band, in claimed deviations.
    """
    # A filter's colour is that of its position among all filters, with a forecast or without.
    for number, name in enumerate(names):
        if name not in forecasts:
            continue
        forecast = forecasts[name]
        estimate = record.estimates[node][name]
        colour = COLOURS[number % len(COLOURS)]
        time = np.concatenate([record.time[-1:], forecast.time])
        for i, panel in enumerate(panels):
            # The curve begins at the last estimate of state i.
            last_mean = np.asarray(estimate.mean)[-1, i]
            last_deviation = np.sqrt(np.asarray(estimate.covariance)[-1, i, i])
            mean = np.append(last_mean, forecast.states.mean[:, i])
            band = sigmas * np.append(last_deviation, forecast.states.deviation[:, i])
            panel.plot(time, mean, color=colour, linestyle=(0, (4, 1.5)))  # dashed
            panel.fill_between(time, mean - band, mean + band, color=colour, alpha=0.2, linewidth=0)
    if forecasts:
        for panel in panels:
            panel.axvline(record.time[-1], color=MUTED, linewidth=1.0)


def make_forecast_tables(record: Record, forecasts: Forecasts) -> list[Table | Text]:
    """Return a text on what is forecast, and then a table for each filter.

    A table has the mean and interval of each state and output at some horizons. `forecasts`: by node and filter;
    `inputs` says what inputs were taken ahead, the same for all.
    """
    any_forecast = next(forecast for filters in forecasts.values() for forecast in filters.values())
    sentence_on_inputs = {
        "held": "Inputs are held at those of the last row.",
        "given": "Inputs ahead are those that were given.",
        "none": "",
    }[any_forecast.inputs]
    intro = f"From what had arrived by the last row, as if nothing arrived any more. {sentence_on_inputs}".strip()
    parts: list[Table | Text] = [Text([intro])]
    for node, filters in forecasts.items():
        parts += [_make_forecast_table(record, f"{node}/{name}", forecast) for name, forecast in filters.items()]
    return parts


def _make_forecast_table(record: Record, name: str, forecast: "heliograph.forecasting.Forecast") -> Table:
    """Return a table with a row for each of at most MOST horizons: its time, then each state and output.

    A cell has the mean and the interval that holds 95 %. A forecast has `states` and, unless None, `outputs`, each with
    names, means and deviations (horizons, numbers). `record`: the run, whose last row the forecast begins from.
    """
    count = len(forecast.time)
    rows = np.unique(np.linspace(0, count - 1, min(count, MOST)).round().astype(int))
    predictions = [("", forecast.states)] + ([] if forecast.outputs is None else [("measured ", forecast.outputs)])
    headers, columns = ["time"], [format_times(forecast.time[rows])]
    for kind, prediction in predictions:
        # Without a claim the deviation is NaN, by which the cell shows the mean alone.
        has_claim = prediction.claim != "none"
        low, high = prediction.interval(BOTH_SIDES) if has_claim else (prediction.mean, prediction.mean)
        for i, name_of_number in enumerate(prediction.names):
            headers.append(visible(f"{kind}{name_of_number}"))
            numbers = (prediction.mean, low, high, prediction.deviation)
            columns.append([_format_mean_and_interval(*(values[row, i] for values in numbers)) for row in rows])
    caption = f"**{visible(name)}**: mean, and the interval that holds 95 % of what it predicts."
    return Table(headers, [list(cells) for cells in zip(*columns, strict=True)], caption)


def _format_mean_and_interval(mean: float, low: float, high: float, deviation: float) -> str:
    """Return the text "mean (low to high)", to two digits of the deviation; only the mean if the deviation is NaN."""
    if np.isnan(deviation):
        return f"{mean:.4g}"
    return f"{round_to(mean, deviation)} ({round_to(low, deviation)} to {round_to(high, deviation)})"
