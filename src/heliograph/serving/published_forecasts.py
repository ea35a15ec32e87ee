"""Forecasts that a service publishes beside provisional estimates: of each filter, at each horizon."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import isnan

import numpy as np

import heliograph
from heliograph.live.fleet import Fleet
from heliograph.live.forecast_start_of_row import make_forecast_origin
from heliograph.live.sorted_rows import HeldRow
from heliograph.model.forecast_origin import Origin
from heliograph.numerics.check import fail, show_value
from heliograph.serving.thresholds import Thresholds, check_threshold_names, find_crossing_probabilities

# Forecasts at one horizon: its time, how far ahead it is, and what each filter says, by node and filter.
Ahead = tuple[float, float, dict[str, dict[str, object]]]
Bodies = list[list[dict[str, object]]]  # what one filter says, by row and horizon
Spans = int | list[float | np.timedelta64 | np.datetime64]  # how far ahead, as `horizons_in` reads it
SECOND = np.timedelta64(1, "s")
OFF = 1e-6  # of a step: a horizon of 300 ms is three steps of 0.1 s, which no binary number is


@dataclass(frozen=True)
class ForecastStart:
    """What `heliograph.forecast` takes in place of a live object: an origin made of one row, or of several."""

    origin: Origin


class ForecastPublisher:
    """Forecasts of a fleet's plants at fixed horizons, with inputs held.

    Args:
        fleet: the plants.
        horizons: a number of steps, or spans of time, as `horizons_in` reads them.
        thresholds: levels of which the probability to pass them is said; none by default.

    Raises:
        ValueError: a level of what is no state or output; a number of steps of a plant whose time is continuous,
            dates, spans that are no whole steps.
    """

    def __init__(self, fleet: Fleet, horizons: Spans, thresholds: Thresholds = ()):
        """Check thresholds and horizons against the network; raise ValueError if they do not fit.

        `self.horizons` are how far ahead: in steps, or in the unit of dt if time is continuous.
        """
        check_threshold_names(fleet.network, thresholds)
        self._thresholds = thresholds
        self._fleet, self._continuous = fleet, fleet.program.dt is not None
        if isinstance(horizons, int):
            if self._continuous:
                raise fail("--forecast", "spans of time, such as 5s,1min, as no step is usual", horizons)
            self.horizons: list[float] = list(range(1, horizons + 1))
        else:
            self.horizons = [self._convert_horizon(horizon) for horizon in horizons]
        are_increasing = sorted(set(self.horizons)) == self.horizons
        if not self.horizons or min(self.horizons) <= 0 or not are_increasing:
            raise fail("--forecast", "horizons ahead, each later than the one before", show_value(horizons))

    def _convert_horizon(self, horizon: float | np.timedelta64 | np.datetime64) -> float:
        """Return how far ahead a horizon is: in steps, or in the unit of dt where time is continuous.

        A number is that already. A span of time is taken in seconds if time is continuous; else it has to be a whole
        number of steps.
        """
        if isinstance(horizon, np.datetime64):
            raise fail("--forecast", "spans of time or steps ahead of each message", str(horizon))
        if not isinstance(horizon, np.timedelta64):
            if not self._continuous and not float(horizon).is_integer():
                raise fail("--forecast", "whole steps", f"{horizon:g} of one")
            return float(horizon) if self._continuous else int(horizon)
        seconds, step = float(horizon / SECOND), self._fleet.options.step or 1.0
        if self._continuous:
            return seconds
        count = round(seconds / step)
        if abs(seconds - count * step) > OFF * step:
            raise fail("--forecast", f"whole steps of {step:g} s", f"{seconds:g} s")
        return count

    def make_forecasts(self, rows: Sequence[HeldRow]) -> list[list[Ahead]]:
        """Return for each row its forecasts, one for each horizon, which are published beside the row's estimate.

        A forecast is (its time, how far ahead it is, {node: {filter: what is published}}). A row holds a plant's state
        after its newest measurement; the rows of all plants are predicted in one call. A row has no forecasts if its
        longest horizon is after the last step for which the network is defined.
        """
        results: list[list[Ahead]] = [[] for _ in rows]
        # A network whose models vary ends at the step `end_step`: no forecast may go beyond it.
        latest_time = np.inf if self._continuous else self._fleet.end_step - max(self.horizons)
        times = [float(row.key[0]) for row in rows]  # a row's key begins with its time
        covered = [i for i, time in enumerate(times) if time <= latest_time]  # numbers of the rows that have forecasts
        if not covered:
            return results
        # Forecasts by node and filter, each of all covered rows; `bodies` has what is published of them, by node,
        # filter, row and horizon. A slot is the row's line in the fleet's table of filter states.
        slots = [rows[i].slot for i in covered]
        start = ForecastStart(make_forecast_origin(self._fleet, slots, np.array([times[i] for i in covered])))
        # The inputs of the plants keep their last values ("held") over the horizon.
        forecasts = heliograph.forecast(start, self.horizons, inputs="held")
        assert isinstance(forecasts, dict)  # of a network
        bodies = {
            node: {name: _write_forecasts(forecast) for name, forecast in filters.items()}
            for node, filters in forecasts.items()
        }
        # For each covered row (`i` its index in `rows`, `index` its index in the forecasts) add the probabilities of
        # crossing thresholds, and sort by horizon.
        for index, i in enumerate(covered):
            if self._thresholds:
                self._add_crossings(rows[i], forecasts, bodies, index)
            results[i] = self._arrange_by_horizon(times[i], bodies, index)
        return results

    def _arrange_by_horizon(self, now: float, bodies: dict[str, dict[str, Bodies]], number: int) -> list[Ahead]:
        """Return the forecasts from row `number` of `bodies`, one for each horizon; `now` is the row's time.

        A forecast is (its time, how far ahead it is, {node: {filter: what is published}}). How far ahead is in seconds
        if messages have dates, else in the unit of their time.
        """
        unit = 1.0 if self._continuous else self._fleet.options.step or 1.0  # seconds of a step, if they are known
        results: list[Ahead] = []
        for i, distance in enumerate(self.horizons):
            by_filter: dict[str, dict[str, object]] = {
                node: {name: of_filter[number][i] for name, of_filter in filters.items()}
                for node, filters in bodies.items()
            }
            results.append((now + distance, distance * unit, by_filter))
        return results

    def _add_crossings(
        self,
        row: HeldRow,
        found: "Mapping[str, Mapping[str, heliograph.forecasting.Forecast]]",
        bodies: dict[str, dict[str, Bodies]],
        number: int,
    ) -> None:
        """Add the probabilities of passing each threshold to the forecasts from one row, in `bodies`.

        Args:
            row: a row of live data, from whose filter states the forecasts begin.
            found: the forecasts from all rows, by node and filter.
            bodies: the published forecasts by node and filter: for each row a list with a dictionary for each horizon.
                The probabilities are added to them as "thresholds".
            number: number of the row among all rows.
        """
        # Paths are drawn from this row alone.
        start = ForecastStart(make_forecast_origin(self._fleet, row.slot, float(row.key[0])))
        for node, filters in found.items():
            for name, forecast in filters.items():
                of_row = bodies[node][name][number]
                if of_row[0]["claim"] == "none":  # no covariance, and so no probabilities
                    continue
                crossings = self._find_all_crossings(start, (node, name), forecast)
                for i, body in enumerate(of_row if crossings else []):
                    body["thresholds"] = {level: by_horizon[i] for level, by_horizon in crossings.items()}

    def _find_all_crossings(
        self, start: ForecastStart, node_and_filter: tuple[str, str], forecast: "heliograph.forecasting.Forecast"
    ) -> dict[str, list[dict[str, float]]]:
        """Return {threshold: probabilities that it is crossed, by horizon}, for the states and outputs of a filter.

        It is {} if the filter claims no covariance. `node_and_filter`: names of the filter's node and of the filter.
        """
        if forecast.states.claim == "none":
            return {}
        outputs = () if forecast.outputs is None else forecast.outputs.names
        known = (*forecast.states.names, *outputs)
        thresholds = tuple(threshold for threshold in self._thresholds if threshold.name in known)
        if not thresholds:
            return {}
        return find_crossing_probabilities(
            start, node_and_filter, thresholds, self.horizons, whole=not self._continuous
        )


def _write_forecasts(forecast: "heliograph.forecasting.Forecast") -> Bodies:
    """Return what is published of one filter's forecast, by row and horizon.

    That is mean, covariance and claim of the states, and mean and deviation of each output. A covariance that is not
    finite is published as null, with the claim "none".
    """
    states, outputs = forecast.states, forecast.outputs
    # Arrays by (row, horizon); as lists, they are taken apart row by row and then horizon by horizon.
    is_claimed = np.isfinite(states.covariance).all(axis=(-2, -1)) & (states.claim != "none")
    numbers = is_claimed.tolist(), states.mean.tolist(), states.covariance.tolist()
    bodies: Bodies = [
        [
            {"mean": mean, "covariance": covariance if claimed else None, "claim": states.claim if claimed else "none"}
            for claimed, mean, covariance in zip(*of_row, strict=True)
        ]
        for of_row in zip(*numbers, strict=True)
    ]
    if outputs is not None:
        _add_outputs(bodies, outputs.names, outputs.mean, outputs.deviation)
    return bodies


def _add_outputs(bodies: Bodies, names: Sequence[str], mean: np.ndarray, deviation: np.ndarray) -> None:
    """Add the outputs' means and deviations, each (row, horizon, output), to `bodies`; NaN becomes null.

    `bodies` holds by row and horizon what is published of a filter's forecast.
    """
    for bodies_of_row, *numbers_of_row in zip(bodies, mean.tolist(), deviation.tolist(), strict=True):
        for body, means, deviations in zip(bodies_of_row, *numbers_of_row, strict=True):
            body["outputs"] = {
                name: {"mean": mean_of_output, "deviation": None if isnan(of_output) else of_output}
                for name, mean_of_output, of_output in zip(names, means, deviations, strict=True)
            }
