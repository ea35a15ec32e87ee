"""Forecasts that a service publishes beside provisional estimates: of each filter, at each horizon."""

from dataclasses import dataclass
from math import isnan

import numpy as np

import heliograph
from heliograph.live.fleet import Fleet
from heliograph.live.row_origin import make_row_origin
from heliograph.live.rows import HeldRow
from heliograph.model.origin import Origin
from heliograph.numerics.check import fail, show_value
from heliograph.serving.thresholds import Thresholds, check_names, find_crossings

Spans = int | list[float | np.timedelta64 | np.datetime64]  # how far ahead, as `horizons_in` reads it
SECOND = np.timedelta64(1, "s")


@dataclass(frozen=True)
class ForecastStart:
    """A row as `heliograph.forecast` takes it."""

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
        check_names(fleet.network, thresholds)
        self._thresholds = thresholds
        self._fleet, self._continuous = fleet, fleet.program.dt is not None
        if isinstance(horizons, int):
            if self._continuous:
                raise fail("--forecast", "spans of time, such as 5s,1min, as no step is usual", horizons)
            self.horizons: list[float] = list(range(1, horizons + 1))
        else:
            self.horizons = [self._measure_distance(horizon) for horizon in horizons]
        if not self.horizons or min(self.horizons) <= 0 or sorted(set(self.horizons)) != self.horizons:
            raise fail("--forecast", "horizons ahead, each later than the one before", show_value(horizons))

    def _measure_distance(self, horizon: float | np.timedelta64 | np.datetime64) -> float:
        """Return how far ahead a horizon is, in the unit of dt or in steps."""
        if isinstance(horizon, np.datetime64):
            raise fail("--forecast", "spans of time or steps ahead of each message", str(horizon))
        if not isinstance(horizon, np.timedelta64):
            return float(horizon) if self._continuous else int(horizon)
        seconds, step = float(horizon / SECOND), self._fleet.options.step or 1.0
        if self._continuous:
            return seconds
        if seconds % step:
            raise fail("--forecast", f"whole steps of {step:g} s", f"{seconds:g} s")
        return int(seconds // step)

    def forecasts(self, row: HeldRow) -> list[tuple[float, float, dict[str, dict[str, object]]]]:
        """Return of each horizon its time, how far ahead it is, and what each filter says; none behind the last step.

        How far: in seconds where the messages have dates, else in the unit of their time.
        """
        now = float(row.key[0])
        start = ForecastStart(make_row_origin(self._fleet, row.slot, now))
        if not self._continuous and start.origin.step + max(self.horizons) - 1 > self._fleet.end_step:
            return []
        found = heliograph.forecast(start, self.horizons, inputs="held")
        assert isinstance(found, dict)  # of a network
        said = {
            (node, name): _write_forecasts(forecast, self._pass_levels(start, (node, name), forecast))
            for node, filters in found.items()
            for name, forecast in filters.items()
        }
        unit = 1.0 if self._continuous else self._fleet.options.step or 1.0
        return [
            (
                now + distance,
                distance * unit,
                {node: {name: said[node, name][i] for name in filters} for node, filters in found.items()},
            )
            for i, distance in enumerate(self.horizons)
        ]

    def _pass_levels(
        self, start: ForecastStart, place: tuple[str, str], forecast: "heliograph.forecasting.Forecast"
    ) -> dict[str, list[dict[str, float]]]:
        """Return by level the probabilities that it is passed, at each horizon; of levels that the filter knows."""
        outputs = () if forecast.outputs is None else forecast.outputs.names
        known = () if forecast.states.claim == "none" else (*forecast.states.names, *outputs)
        return {
            str(threshold): find_crossings(start, place, threshold, self.horizons, not self._continuous)
            for threshold in self._thresholds
            if threshold.name in known
        }


def _write_forecasts(
    forecast: "heliograph.forecasting.Forecast", crossings: dict[str, list[dict[str, float]]]
) -> list[dict[str, object]]:
    """Return what one filter says of each horizon, as it is published, with the probabilities to pass levels."""
    bodies = [_write_forecast(forecast, i) for i in range(len(forecast.steps))]
    if not crossings:
        return bodies
    return [
        body | {"thresholds": {level: said[i] for level, said in crossings.items()}} for i, body in enumerate(bodies)
    ]


def _write_forecast(forecast: "heliograph.forecasting.Forecast", i: int) -> dict[str, object]:
    """Return what one filter says of one horizon, as it is published."""
    states, outputs = forecast.states, forecast.outputs
    body: dict[str, object] = {
        "mean": states.mean[i].tolist(),
        "covariance": None if states.claim == "none" else states.covariance[i].tolist(),
        "claim": states.claim,
    }
    if outputs is not None:
        deviations = outputs.deviation[i].tolist()
        body["outputs"] = {
            name: {"mean": mean, "deviation": None if isnan(deviation) else deviation}
            for name, mean, deviation in zip(outputs.names, outputs.mean[i].tolist(), deviations, strict=True)
        }
    return body
