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

    Raises:
        ValueError: a number of steps of a plant whose time is continuous, dates, spans that are no whole steps.
    """

    def __init__(self, fleet: Fleet, horizons: Spans):
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

    def forecasts(self, row: HeldRow) -> list[tuple[float, dict[str, dict[str, object]]]]:
        """Return the time of each horizon behind a row, and what each filter says; nothing behind the last step."""
        now = float(row.key[0])
        start = ForecastStart(make_row_origin(self._fleet, row.slot, now))
        if not self._continuous and start.origin.step + max(self.horizons) - 1 > self._fleet.end_step:
            return []
        found = heliograph.forecast(start, self.horizons, inputs="held")
        assert isinstance(found, dict)  # of a network
        return [
            (
                now + distance,
                {node: {name: _write_forecast(f, i) for name, f in filters.items()} for node, filters in found.items()},
            )
            for i, distance in enumerate(self.horizons)
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
