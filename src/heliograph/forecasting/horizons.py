"""How far ahead, and with which inputs: horizons in steps, time or dates as rows of inputs to predict with."""

from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta
from typing import Literal, NamedTuple, Protocol, cast, runtime_checkable

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.forecasting.forecast_result import InputsAhead
from heliograph.model.checks.plant_inputs import check_inputs
from heliograph.model.forecast_origin import Origin
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import array, check_count, fail, is_whole, rank, show_value
from heliograph.numerics.times.row_times import check_dates
from heliograph.numerics.types import ArrayLike, Float, units_in

Horizon = int | float | timedelta | datetime | np.timedelta64 | np.datetime64
Horizons = TypeAliasType("Horizons", Horizon | Sequence[Horizon] | np.ndarray)
Inputs = TypeAliasType("Inputs", ArrayLike | Literal["held"] | None)  # rows ahead
NANOSECONDS = 1e9  # nanoseconds
MONTHS_OF_UNIT = {"Y": 12, "M": 1}  # in NumPy's units of time that have no length in seconds
LARGEST_MISFIT = 0.25  # of a step: months and years differ by less from the usual one
MOST_STEPS_AHEAD = 1_000_000  # steps ahead
MOST_SECONDS_AHEAD = 1e15  # seconds, 30 million years: further than any date, and held by 64 bits


@runtime_checkable
class HasInputs(Protocol):
    """A filter or a network, with the names of its inputs."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""


class RowsAhead(NamedTuple):
    """Rows to predict over, and which of them the horizons are.

    Args:
        u: inputs of each row ([plants,] rows, inputs); the leading axis is there only of several plants.
        rows: index of the row that ends at each horizon (horizons,).
        steps: how far each horizon is (horizons,), in steps or in the unit of the input dt.
        time: time of each horizon on the clock of the data, numbers or dates ([plants,] horizons).
        inputs: whether u was "given", repeats the last inputs ("held"), or the plant has none but dt ("none").
    """

    u: Float[np.ndarray, "... rows inputs"]
    rows: np.ndarray
    steps: np.ndarray
    time: np.ndarray
    inputs: InputsAhead


def find_rows_ahead(origin: Origin, names: Sequence[str], horizons: Horizons, inputs: Inputs) -> RowsAhead:
    """Return the rows of inputs over which a filter predicts from an origin, and which of these rows the horizons are.

    Where time counts steps there is one row for each step. Where the plant has an input dt (time is continuous), there
    is one row for each horizon, with dt from the horizon before.

    Args:
        origin: where the data end: the last state, with the time and the inputs of its step.
        names: names of the plant's inputs.
        horizons: how far ahead: numbers of steps, times, or dates.
        inputs: inputs of the rows ahead without dt; "held" repeats those of the last row; None for a plant that has no
            inputs but dt.

    Raises:
        ValueError: a horizon that is not after the one before, or not after the data; inputs that are not those of the
            rows, none of a plant that has some, or none to hold.
    """
    is_continuous = TIME_STEP in names
    distances = _convert_to_times(origin, horizons) if is_continuous else _convert_to_steps(origin, horizons)
    if np.any(np.diff(distances, prepend=0.0) <= 0):
        raise fail("horizons", "times after the data, each later than the one before", show_value(horizons))
    time = _place_on_clock(origin, distances, is_continuous)
    # A row for each horizon if time is continuous, else one for each step up to the last horizon.
    count = len(distances) if is_continuous else int(distances[-1])
    others = [name for name in names if name != TIME_STEP]
    u, source = _complete_inputs(origin, names, others, inputs, count)
    if is_continuous:
        u = np.insert(u, list(names).index(TIME_STEP), np.diff(distances, prepend=0.0), axis=-1)
        return RowsAhead(u, rows=np.arange(count), steps=distances, time=time, inputs=source)
    # Step 1 ahead is row 0, so the horizon at step h is row h - 1.
    steps = distances.astype(int)
    return RowsAhead(u, rows=steps - 1, steps=steps, time=time, inputs=source)


def _convert_to_steps(origin: Origin, horizons: Horizons) -> np.ndarray:
    """Return how many steps ahead each horizon is (horizons,), from numbers of steps, spans of time, or dates.

    A single whole number stands for each step up to it.

    Args:
        origin: where the data end: time of the last row, and time between rows.
        horizons: a number of steps, or a list of steps, spans of time or dates.
    """
    if is_whole(horizons):
        return np.arange(1.0, _require_step_count(horizons) + 1)
    return np.array([_convert_horizon_to_steps(origin, horizon) for horizon in _list_horizons(horizons)])


def _convert_horizon_to_steps(origin: Origin, horizon: object) -> float:
    """Return how many steps ahead one horizon is: a number of steps, a span of time or a date.

    Args:
        origin: where the data end: `time` of the last row, and `spacing` between rows in seconds, or `months` where
            steps are whole months.
        horizon: a number of steps, a span of time or a date.

    Raises:
        ValueError: no whole number of steps, or a time where that of a step is not known.
    """
    # Steps of whole months are not of equal length.
    months = _count_months(origin, horizon) if origin.months else None
    if months is not None:
        steps, left = divmod(months, origin.months)
        if left or not steps:
            raise fail("horizons", f"whole steps of {origin.months} months", f"{show_value(horizon)}, {months} ahead")
        return float(steps)
    seconds = _convert_to_seconds(origin, horizon)
    if seconds is None:  # a number
        return float(_require_step_count(horizon))
    if not origin.spacing > 0:
        raise fail("horizons", "numbers of steps, where the time between them is not known", show_value(horizon))
    count = seconds / origin.spacing
    if abs(count - round(count)) > LARGEST_MISFIT:
        expected = f"whole steps of {origin.spacing:g} s"
        raise fail("horizons", expected, f"{show_value(horizon)}, {count:.4g} steps ahead")
    return float(round(count))


def _count_months(origin: Origin, horizon: object) -> int | None:
    """Return how many calendar months ahead a date, or a span of months or years, is; None for anything else.

    Args:
        origin: where the data end, for the date of the last row.
        horizon: a date, a span of time or a number.
    """
    if isinstance(horizon, np.timedelta64):
        unit, size = np.datetime_data(horizon)
        return int(horizon.astype(np.int64)) * size * MONTHS_OF_UNIT[unit] if unit in MONTHS_OF_UNIT else None
    if not isinstance(horizon, datetime | np.datetime64):
        return None
    date, end = _read_date_ahead(origin, horizon)
    return int((date.astype("datetime64[M]") - end.astype("datetime64[M]")).astype(int))


def _convert_to_times(origin: Origin, horizons: Horizons) -> np.ndarray:
    """Return how far ahead each horizon is (horizons,), in the unit of dt; spans of time and dates give seconds.

    A single whole number stands for each step of the usual size up to it.

    Args:
        origin: where the data end: `time` of the last row, and the usual time between rows (`spacing`).
        horizons: a number of steps, or a list of numbers in the unit of dt, spans of time or dates.
    """
    if is_whole(horizons):
        if not origin.spacing > 0:
            raise fail("horizons", "times ahead, such as [1.0, 5.0], where no step is usual", horizons)
        return origin.spacing * np.arange(1, _require_step_count(horizons) + 1)
    times = []
    for horizon in _list_horizons(horizons):
        seconds = _convert_to_seconds(origin, horizon)
        times.append(float(array("horizon", cast(ArrayLike, horizon), ())) if seconds is None else seconds)
    return np.array(times)


def _require_step_count(value: object) -> int:
    """Return a number of steps ahead; raise ValueError if it is above MOST_STEPS_AHEAD, a million."""
    count = check_count("horizons", value)
    if count > MOST_STEPS_AHEAD:
        raise fail("horizons", f"at most {MOST_STEPS_AHEAD:,} steps", count)
    return count


def _list_horizons(horizons: object) -> list[object]:
    """Return horizons as a list; a single time or date gives a list of one.

    A list of anything is checked later, horizon by horizon.
    """
    if isinstance(horizons, float | timedelta | datetime | np.timedelta64 | np.datetime64):
        return [horizons]
    values = list(cast(Iterable[object], horizons)) if rank("horizons", horizons) == 1 else []
    if not values:
        raise fail("horizons", "a number of steps, or a list of how far ahead", show_value(horizons))
    return values


def _convert_to_seconds(origin: Origin, horizon: object) -> float | None:
    """Return how many seconds ahead a span of time or a date is; None of a number.

    If the plant has an input dt (TIME_STEP), the time to the next step, its unit has to be seconds.

    Args:
        origin: where the data end: its model, whose inputs may say the unit of dt, and the time of the last row.
        horizon: a span of time, a date or a number.
    """
    if isinstance(horizon, timedelta | np.timedelta64):
        unit = units_in(origin.model.inputs).get(TIME_STEP, "s") if isinstance(origin.model, HasInputs) else "s"
        if unit != "s":
            raise fail("horizons", f"numbers of {unit}, the unit of dt", show_value(horizon))
        return _convert_span_to_seconds(horizon)
    if not isinstance(horizon, datetime | np.datetime64):
        return None
    date, end = _read_date_ahead(origin, horizon)
    # As Python's integers: 64 bits of nanoseconds hold dates of six centuries, but spans of three.
    return (int(date.astype(np.int64)) - int(end.astype(np.int64))) / NANOSECONDS


def _read_date_ahead(origin: Origin, horizon: datetime | np.datetime64) -> tuple[np.datetime64, np.datetime64]:
    """Return a date ahead and the date at which the data end, both in nanoseconds.

    Args:
        origin: where the data end.
        horizon: the date.

    Raises:
        ValueError: a date that is missing or not after the data, or that 64 bits of nanoseconds cannot say.
    """
    (date,) = check_dates("horizons", [horizon])
    end = _find_end_of_data(origin, horizon).astype("datetime64[ns]")
    if not date > end:  # nor is NaT
        raise fail("horizons", f"dates after the data, which end at {end}", show_value(horizon))
    return date, end


def _convert_span_to_seconds(span: timedelta | np.timedelta64) -> float:
    """Return a span of time in seconds; raise ValueError if it is missing, has no unit, or is of months or years.

    A month has no length in seconds; a span that NumPy writes without a unit has none either.
    """
    if isinstance(span, timedelta):
        return span.total_seconds()
    unit, size = np.datetime_data(span)
    if unit == "generic" or unit in MONTHS_OF_UNIT or np.isnat(span):
        raise fail("horizons", "spans of weeks or shorter units: a month has no length in seconds", show_value(span))
    # Compute with Python's integers, since NumPy's would overflow.
    seconds = float(np.array(1, f"timedelta64[{unit}]") / np.timedelta64(1, "s"))
    return int(span.astype(np.int64)) * size * seconds


def _find_end_of_data(origin: Origin, horizon: datetime | np.datetime64) -> np.datetime64:
    """Return the date at which the data end, which must be the same for all sources.

    Args:
        origin: where the data end; several sources have a time each.
        horizon: the horizon that asks for it, for messages.

    Raises:
        ValueError: data without dates, or sources that end at different dates.
    """
    ends = np.unique(np.asarray(origin.time))
    if ends.dtype.kind != "M":
        raise fail("horizons", "how far ahead, as the data have no dates", show_value(horizon))
    if len(ends) > 1:
        raise fail("horizons", "how far ahead, as the sources end at different dates", show_value(horizon))
    end: np.datetime64 = ends[0]
    return end


def _complete_inputs(
    origin: Origin, names: Sequence[str], others: Sequence[str], inputs: Inputs, count: int
) -> tuple[np.ndarray, InputsAhead]:
    """Return the inputs of the rows ahead but dt, ([plants,] count, others), and whether they were given or held.

    Args:
        origin: where the forecast begins: it has the inputs of the last row ([plants,] inputs); `several` is whether it
            is of several plants.
        names: names of all inputs.
        others: names of the inputs other than dt, the length of a step.
        inputs: an array (count, others), or one for each plant; "held" to repeat the last row's; None for none.
        count: number of rows ahead.
    """
    plants = (len(origin.inputs),) if origin.several else ()  # leading axis of several plants
    if isinstance(inputs, str) and inputs != "held":
        raise fail("inputs ahead", 'an array, or "held"', repr(inputs))
    if not others:
        if inputs is not None and not isinstance(inputs, str) and np.size(inputs):
            raise fail("inputs ahead", "none, as the plant has none but dt", f"shape {np.shape(inputs)}")
        return np.zeros((*plants, count, 0)), "none"
    if inputs is None:
        raise fail("inputs ahead", f'rows of {list(others)} for {count} steps, or "held"', "none")
    # Given: one axis is one input over the rows; the same rows hold for all plants unless there are three axes.
    if not isinstance(inputs, str):
        axes = rank("inputs ahead", inputs)
        rows = np.reshape(inputs, (-1, 1)) if len(others) == 1 and axes == 1 else inputs
        of_one_plant = (count, len(others))
        of_all_plants = (*plants, *of_one_plant)
        given = array("inputs ahead", rows, of_all_plants if axes == 3 and plants else of_one_plant)
        return np.broadcast_to(given, of_all_plants), "given"
    # Held: those of the last row, again and again.
    last = origin.inputs[..., [list(names).index(name) for name in others]]
    if np.isnan(last).any():
        raise fail("inputs ahead", "rows, as there is no last step whose inputs could be held", '"held"')
    return np.repeat(last[..., None, :], count, axis=-2), "held"


def check_inputs_ahead(names: Sequence[str], ahead: RowsAhead, models: object, step: int | np.ndarray) -> None:
    """Raise ValueError if a function of the models returns an invalid value for the inputs ahead.

    Models may hold functions of the inputs, such as a matrix A(u). They are called with each row of `ahead.u`.

    Args:
        names: names of the inputs.
        ahead: the rows ahead with their inputs.
        models: a tree of plant, sensor and channel, or a filter that holds them.
        step: number of the first row ahead, or one for each plant.
    """
    count, width = ahead.u.shape[-2:]
    if width:
        steps = np.asarray(step)[..., None] + np.arange(count)
        check_inputs(names, ahead.u.reshape(-1, width), models, np.ravel(steps))


def _place_on_clock(origin: Origin, distances: np.ndarray, continuous: bool) -> np.ndarray:
    """Return the time of each horizon on the clock of the data ([plants,] horizons): numbers or dates.

    Args:
        origin: where the data end: `time` of the last row; `spacing`, the length of a step, of dates in seconds, NaN
            where none is usual; `months`, how many whole months a step has, 0 if it is none.
        distances: how far ahead each horizon is (horizons,), in steps or if `continuous` in the unit of dt.
        continuous: whether the plant has an input dt, the time to the next step.
    """
    spacing = 1.0 if continuous else origin.spacing
    end = np.asarray(origin.time)[..., None]
    if end.dtype.kind != "M":
        return np.asarray(end + (1.0 if np.isnan(spacing) else spacing) * distances)
    if origin.months and not continuous:
        last = end.astype("datetime64[M]")
        ahead = (origin.months * distances).astype(int).astype("timedelta64[M]")
        return check_dates("horizons", last + ahead)
    if np.isnan(spacing):
        return np.full((*end.shape[:-1], len(distances)), np.datetime64("NaT", "ns"))
    # The result is in nanoseconds, which end in 2262. Whole seconds are added first, as in seconds no date overflows.
    # `check_dates` tests the sum with 2 s to spare, as the fractions of the end and of the distance are added last.
    seconds = np.minimum(spacing * distances, MOST_SECONDS_AHEAD)
    whole_seconds = np.floor(seconds)
    last_second = end.astype("datetime64[s]")
    spare = np.timedelta64(2, "s")
    dates = last_second + whole_seconds.astype(np.int64).astype("timedelta64[s]")
    checked = check_dates("horizons", dates + spare) - spare
    fraction_of_end = end.astype("datetime64[ns]") - last_second
    fraction = np.round(NANOSECONDS * (seconds - whole_seconds)).astype(np.int64).astype("timedelta64[ns]")
    return np.asarray(checked + fraction_of_end + fraction)
