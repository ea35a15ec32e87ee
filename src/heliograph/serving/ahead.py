"""Forecasts that a service publishes beside provisional estimates: of each filter, at each horizon."""

from collections.abc import Mapping, Sequence
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

Ahead = tuple[float, float, dict[str, dict[str, object]]]  # time of a horizon, how far it is, what each filter says
Bodies = list[list[dict[str, object]]]  # of one filter, by row and horizon
Spans = int | list[float | np.timedelta64 | np.datetime64]  # how far ahead, as `horizons_in` reads it
SECOND = np.timedelta64(1, "s")
OFF = 1e-6  # of a step: a horizon of 300 ms is three steps of 0.1 s, which no binary number is


@dataclass(frozen=True)
class ForecastStart:
    """A row, or several side by side, as `heliograph.forecast` takes them."""

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
            self.horizons = [self._convert_horizon(horizon) for horizon in horizons]
        if not self.horizons or min(self.horizons) <= 0 or sorted(set(self.horizons)) != self.horizons:
            raise fail("--forecast", "horizons ahead, each later than the one before", show_value(horizons))

    def _convert_horizon(self, horizon: float | np.timedelta64 | np.datetime64) -> float:
        """Return how far ahead a horizon is: in steps; where time is continuous in the unit of dt, or in seconds."""
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

    def forecasts(self, rows: Sequence[HeldRow]) -> list[list[Ahead]]:
        """Return of each row and horizon its time, how far ahead it is, and what each filter says.

        The rows of all plants are predicted side by side. Nothing is said of a row whose horizons reach behind the last
        step. How far: in seconds where the messages have dates, else in the unit of their time.
        """
        said: list[list[Ahead]] = [[] for _ in rows]
        limit = np.inf if self._continuous else self._fleet.end_step - max(self.horizons)
        covered = [i for i, row in enumerate(rows) if row.key[0] <= limit]
        if not covered:
            return said
        slots, times = [rows[i].slot for i in covered], np.array([float(rows[i].key[0]) for i in covered])
        start = ForecastStart(make_row_origin(self._fleet, slots, times))
        found = heliograph.forecast(start, self.horizons, inputs="held")
        assert isinstance(found, dict)  # of a network
        bodies = {
            node: {name: _write_forecasts(forecast) for name, forecast in filters.items()}
            for node, filters in found.items()
        }
        for place, i in enumerate(covered):
            if self._thresholds:
                self._add_crossings(rows[i], found, bodies, place)
            said[i] = self._arrange_by_horizon(float(rows[i].key[0]), bodies, place)
        return said

    def _arrange_by_horizon(self, now: float, bodies: dict[str, dict[str, Bodies]], place: int) -> list[Ahead]:
        """Return of each horizon its time, how far it is, and what each filter says of one of the rows."""
        unit = 1.0 if self._continuous else self._fleet.options.step or 1.0
        return [
            (
                now + distance,
                distance * unit,
                {node: {name: of[place][i] for name, of in filters.items()} for node, filters in bodies.items()},
            )
            for i, distance in enumerate(self.horizons)
        ]

    def _add_crossings(
        self,
        row: HeldRow,
        found: "Mapping[str, Mapping[str, heliograph.forecasting.Forecast]]",
        bodies: dict[str, dict[str, Bodies]],
        place: int,
    ) -> None:
        """Add to what filters say of one of the rows the probabilities to pass levels."""
        start = ForecastStart(make_row_origin(self._fleet, row.slot, float(row.key[0])))
        for node, filters in found.items():
            for name, forecast in filters.items():
                of_row = bodies[node][name][place]
                passed = {} if of_row[0]["claim"] == "none" else self._find_all_crossings(start, (node, name), forecast)
                for i, body in enumerate(of_row if passed else []):
                    body["thresholds"] = {level: said[i] for level, said in passed.items()}

    def _find_all_crossings(
        self, start: ForecastStart, place: tuple[str, str], forecast: "heliograph.forecasting.Forecast"
    ) -> dict[str, list[dict[str, float]]]:
        """Return, for each level of a state or output of this filter, how probably it is passed by each horizon."""
        outputs = () if forecast.outputs is None else forecast.outputs.names
        known = () if forecast.states.claim == "none" else (*forecast.states.names, *outputs)
        return {
            str(threshold): find_crossings(start, place, threshold, self.horizons, not self._continuous)
            for threshold in self._thresholds
            if threshold.name in known
        }


def _write_forecasts(forecast: "heliograph.forecasting.Forecast") -> Bodies:
    """Return what one filter says of each row and horizon, as it is published: (rows, horizons).

    A covariance that is no number is none, and claims nothing.
    """
    states, outputs = forecast.states, forecast.outputs
    known = np.isfinite(states.covariance).all(axis=(-2, -1)) & (states.claim != "none")
    numbers = known.tolist(), states.mean.tolist(), states.covariance.tolist()
    bodies: Bodies = [
        [
            {"mean": mean, "covariance": covariance if has else None, "claim": states.claim if has else "none"}
            for has, mean, covariance in zip(*of_row, strict=True)
        ]
        for of_row in zip(*numbers, strict=True)
    ]
    if outputs is not None:
        rows = zip(bodies, outputs.mean.tolist(), outputs.deviation.tolist(), strict=True)
        for body, means, deviations in (one for row in rows for one in zip(*row, strict=True)):
            body["outputs"] = {
                name: {"mean": mean, "deviation": None if isnan(deviation) else deviation}
                for name, mean, deviation in zip(outputs.names, means, deviations, strict=True)
            }
    return bodies
