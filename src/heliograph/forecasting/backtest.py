"""Backtests: forecasts from each row of a recording, against what came later."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.filters.angle_indices import FilterAngles
from heliograph.forecasting.forecast import ForecastTarget, list_targets
from heliograph.forecasting.mixture_moments import Moments
from heliograph.forecasting.scores import (
    LEVELS,
    MixtureLaws,
    ScoreMean,
    average_coverage,
    average_overlapping,
    compute_probability_below,
    crps,
    is_known_and_came,
    log_score,
    select_law,
)
from heliograph.model.forecast_origin import Origin
from heliograph.numerics.angles.angle import wrap_angles
from heliograph.numerics.check import check_count, fail, instance, items
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.recordings.filter_recording import run
from heliograph.simulation.results.record import Record

if TYPE_CHECKING:  # an extra
    import pandas as pd
from heliograph.forecasting.rolled_forecasts import roll_forecasts

ByNode = TypeAliasType("ByNode", Mapping[str, ArrayLike])
Rows = TypeAliasType("Rows", Float[ArrayLike, "steps ..."] | None)
Refit = TypeAliasType("Refit", Callable[[int], Network])  # of the first so many rows
Coverage = TypeAliasType("Coverage", tuple[ScoreMean, ...])  # of each level


@readable
class Score(NamedTuple):
    """How forecasts of one number at one horizon did, each mean with a standard error that knows their overlap.

    Args:
        node: of the filter.
        filter: its name.
        part: "state", against the true state, or "received", against what arrived.
        name: of the number.
        horizon: rows ahead.
        compared: number of forecasts whose number came; standard errors are NaN of a single one.
        bias: mean of what came less what was forecast.
        mse: mean square of it.
        coverage: share within the central intervals of 50, 80 and 95 %; its error is at least that of intervals that
            hold what they claim. A value that is known exactly, and comes, does not count.
        log_score: mean log density of what came, in nats; the larger the better; infinite of what is known exactly.
        crps: mean continuous ranked probability score, in the number's unit; the smaller the better.
    """

    node: str
    filter: str
    part: str
    name: str
    horizon: int
    compared: int
    bias: ScoreMean
    mse: ScoreMean
    coverage: Coverage
    log_score: ScoreMean
    crps: ScoreMean

    @property
    def rmse(self) -> float:
        """Root mean square error."""
        return float(np.sqrt(self.mse.value))

    def row(self) -> dict[str, object]:
        """Return the score as a row of a table, with standard errors in columns of their own."""
        means = {"bias": self.bias, "mse": self.mse}
        means |= {f"coverage {level:.0%}": share for level, share in zip(LEVELS, self.coverage, strict=True)}
        means |= {"log score": self.log_score, "crps": self.crps}
        what_and_how_many = ("node", "filter", "part", "name", "horizon", "compared")
        row: dict[str, object] = {**{name: getattr(self, name) for name in what_and_how_many}, "rmse": self.rmse}
        for name, mean in means.items():
            row[name], row[f"{name} error"] = mean.value, mean.error
        return row


@readable
@dataclass(frozen=True)
class Backtest:
    """Scores of a network's forecasts on a recording.

    Args:
        horizons: rows ahead.
        rows: of the recording.
        scores: one for each filter, number and horizon.
    """

    horizons: tuple[int, ...]
    rows: int
    scores: tuple[Score, ...]

    def of(self, node: str, filter: str, name: str, horizon: int) -> Score:
        """Return the score of one number at one horizon; a received number comes before a state of the same name.

        Args:
            node: node of the filter, "fused" for a central one.
            filter: name of the filter.
            name: name of a received number or a state.
            horizon: rows ahead.

        Raises:
            ValueError: there is no such score.
        """
        key = node, filter, name, horizon
        scores = [score for score in self.scores if (score.node, score.filter, score.name, score.horizon) == key]
        if not scores:
            known = ", ".join(dict.fromkeys(f"{score.node}/{score.filter} {score.name}" for score in self.scores))
            raise fail("score", f"one of {known} at {list(self.horizons)}", f"{node}/{filter} {name} at {horizon}")
        return scores[-1]  # received numbers come after states

    def to_pandas(self) -> "pd.DataFrame":
        """Return a table with a row for each score, and columns of means and their standard errors.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        import pandas as pd

        return pd.DataFrame([score.row() for score in self.scores])


def backtest(
    network: Network,
    measurements: ByNode,
    horizons: Sequence[int],
    inputs: Rows = None,
    time: Rows = None,
    truth: Rows = None,
    skip: int = 10,
    refit: Refit | None = None,
    every: int = 50,
) -> Backtest:
    """Return scores of the forecasts from each row of a recording, against what came later: a rolling origin.

    Filters run over the rows once, as by `hg.run`; behind each row they predict as if nothing more arrived, with the
    inputs that the recording has. Scored is what arrived later, and the true states where they are known.

    Args:
        network: the network.
        measurements: for each node an array (steps, received), as of `hg.run`.
        horizons: rows ahead, such as [1, 3, 12].
        inputs: (steps, inputs); by default a plant without inputs is assumed.
        time: (steps,); 0, 1, ... by default.
        truth: true states (steps, n), NaN where they are not known; None by default.
        skip: rows at the start from which nothing is forecast, while filters settle; 10 by default, 1 or more to refit.
        refit: function of a number of rows that returns the network as it is known from these first rows alone, such as
            `lambda n: hg.fit(build, {"a": y[:n]}).network`; None by default: `network` throughout.
        every: rows between refits, the first behind the skipped rows; 50 by default.

    Raises:
        ValueError: what `hg.run` refuses; horizons that reach beyond the data; no filter whose forecasts can be scored;
            a refit that returns no network, or one of other nodes and filters.

    Source: rolling-origin evaluation, Tashman, Out-of-sample tests of forecasting accuracy (2000).
    """
    ahead = sorted({check_count("horizon", h) for h in items("horizons", horizons, "numbers of rows")})
    first = check_count("skip", skip, 0 if refit is None else 1)
    record = run(network, measurements, inputs, time, truth)
    rows = len(record.time)
    if not ahead or ahead[-1] + first >= rows:
        raise fail("backtest", f"horizons that, behind {first} skipped rows, end within the {rows} rows of data", ahead)
    u = read_plant_inputs(network, inputs, rows)
    # The network that forecasts from each of these rows on, up to the next.
    networks = {0: network}
    if refit is not None:
        starts = range(first, rows, check_count("every", every))
        networks = {row: _call_refit(refit, row, network) for row in starts}
    data = _Recording(measurements, inputs, time, truth)
    origins = [_find_start_of_forecasts(fitted, record, data) for fitted in networks.values()]
    # Networks have the same filters in the same order: the scores of each filter, as the networks have it in turn.
    single_filters = list_single_filters(network)
    scores = list[Score]()
    for filter_by_network in zip(*(list_targets(origin) for origin in origins), strict=True):
        target = filter_by_network[0]
        if (target.node, target.filter) in single_filters:
            scores += _score_filter(list(zip(networks, filter_by_network, strict=True)), record, u, ahead, first)
    if not scores:
        raise fail("backtest", "a filter that claims a covariance, and data to compare with", "none")
    return Backtest(tuple(ahead), rows, tuple(scores))


def _call_refit(refit: Refit, rows: int, network: Network) -> Network:
    """Return the network as the user's function `refit` knows it from the first `rows` rows.

    Raises:
        ValueError: no network, or one with other nodes and filters.
    """
    fitted = instance(f"refit from {rows} rows", refit(rows), Network, "a Network")
    if (fitted.names, set(fitted.estimate_indices)) != (network.names, set(network.estimate_indices)):
        raise fail(f"refit from {rows} rows", f"the nodes and filters of {list(network.names)}", list(fitted.names))
    return fitted


class _Recording(NamedTuple):
    """The data of a backtest, as `backtest` takes them."""

    measurements: ByNode
    inputs: Rows
    time: Rows
    truth: Rows


def _find_start_of_forecasts(network: Network, record: Record, data: _Recording) -> Origin:
    """Return where a network's forecasts start: its model, and its filters' states after the recording.

    `record` has it if this network made it; a refitted network is run over the data.
    """
    origin = record.origin
    if not isinstance(origin, Origin) or origin.model is not network:
        origin = run(network, data.measurements, data.inputs, data.time, data.truth).origin
    assert isinstance(origin, Origin)  # hg.run sets it
    return origin


def list_single_filters(network: Network) -> set[tuple[str, str]]:
    """Return (node, filter) of the estimates made by a filter, which can be stepped by itself, not by a fusion rule."""
    central = {(FUSED, name) for name, fusion in network.fused.items() if hasattr(fusion, "predict")}
    return set(network.estimate_indices) | central


def select_measurements(target: ForecastTarget, record: Record) -> np.ndarray:
    """Return the measurements that a filter receives (steps, received); a central one receives those of all nodes.

    A filter that uses no measurements gets an array without columns. `target` is the filter at its node.
    """
    z = record.measurements.get(target.node)
    if z is None:  # a central filter
        z = np.concatenate([record.measurements[name] for name in record.measurements], axis=1)
    return z if target.predictor.filter.received else z[:, :0]


class _ComparedForecasts(NamedTuple):
    """Forecasts from each row, and what came: of the numbers that a filter receives, or of its states.

    Args:
        part: "received" or "state".
        names: names of the numbers.
        moments: moments of their forecasts (rows, horizons, ...).
        came: the numbers that came (rows, numbers), NaN where one did not.
        angles: indices of the angles among them.
    """

    part: str
    names: Sequence[str]
    moments: Moments
    came: np.ndarray
    angles: Sequence[int]


class _ScoredNumber(NamedTuple):
    """A number that is scored: node and filter that forecast it, "state" or "received", and its name."""

    node: str
    filter: str
    part: str
    name: str


def _score_filter(
    segments: list[tuple[int, ForecastTarget]], record: Record, u: np.ndarray, ahead: list[int], first: int
) -> list[Score]:
    """Return the scores of one filter: of each number that it receives, and each state whose truth is known.

    Args:
        segments: (row, filter as it is from that row on); several if the filter is fitted anew on the way.
        record: the recorded run whose values are compared with forecasts.
        u: inputs (rows, inputs).
        ahead: horizons, in rows.
        first: first row from which a forecast counts.
    """
    _, target = segments[0]  # names and claim are the same in all segments
    filter, node = target.predictor.filter, target.node
    if filter.claim == "none":  # no covariance, so no forecast of a law
        return []
    # Forecasts from each row, at each horizon, of states and received numbers; beside them the values that came.
    z = select_measurements(target, record)
    states, received = _roll_segments(segments, z, u, ahead)
    angles = filter.angles_used() or FilterAngles((), ())
    compared = list[_ComparedForecasts]()
    if received is not None:
        compared.append(_ComparedForecasts("received", target.received, received, z, angles.received))
    if record.truth is not None:
        compared.append(_ComparedForecasts("state", filter.states, states, record.truth, angles.states))
    # A score for each number at each horizon.
    scores = list[Score]()
    for forecasts in compared:
        for i, name in enumerate(forecasts.names):
            number = _ScoredNumber(node, target.filter, forecasts.part, name)
            came, is_angle = forecasts.came[:, i], i in forecasts.angles
            for j, horizon in enumerate(ahead):
                law = select_law(forecasts.moments, i, j)
                scores.append(_score_number(number, horizon, law, came, first, is_angle))
    return scores


def _roll_segments(
    segments: list[tuple[int, ForecastTarget]], z: np.ndarray, u: np.ndarray, ahead: list[int]
) -> tuple[Moments, Moments | None]:
    """Return the moments of states and received numbers forecast from each row (rows, horizons, K, ...).

    Rows are divided into segments, each with its own fit of the filter. Every fit forecasts from all rows, as
    `roll_forecasts` does, and its forecasts count in its own segment. Received numbers are None if not predicted.

    Args:
        segments: (first row, filter as it is from there on).
        z: measurements (rows, received).
        u: inputs (rows, inputs).
        ahead: horizons, in rows.
    """
    rolled = [roll_forecasts(target.predictor, z, u, ahead) for _, target in segments]
    ends = [*(row for row, _ in segments[1:]), len(z)]
    begins = [0, *ends[:-1]]

    def join(*arrays: np.ndarray) -> np.ndarray:
        """Return the rows of each segment from the array of its own filter, one segment after the other.

        Segment i has the rows `begins[i]` to `ends[i]` - 1.
        """
        rows_of_segments = zip(arrays, begins, ends, strict=True)
        return np.concatenate([np.asarray(array)[begin:end] for array, begin, end in rows_of_segments])

    joined: tuple[Moments, Moments | None] = jax.tree.map(join, *rolled)
    return joined


def _score_number(
    number: _ScoredNumber, horizon: int, law: MixtureLaws, values: np.ndarray, first: int, is_angle: bool
) -> Score:
    """Return the score of forecasts from each row of the number `horizon` rows later.

    Args:
        number: which number it is, and which filter forecasts it.
        horizon: rows ahead.
        law: the forecast from each row: mixtures of K Gaussians, weights, means and variances (rows, K).
        values: the number in each row (rows,), NaN where it did not come.
        first: first row from which a forecast counts.
        is_angle: whether it is an angle.
    """
    # The forecasts that count, and the values that came `horizon` rows later.
    law = MixtureLaws(*(part[first:-horizon] for part in law))
    came = values[first + horizon :]
    # An angle is taken within half a turn of its forecast.
    came = law.mean + wrap_angles((came - law.mean)[:, None], (0,) if is_angle else ())[:, 0]
    # Nothing was forecast yet where the start is unknown (infinite variances).
    came = np.where(np.isfinite(law.variances).all(axis=1), came, np.nan)
    error = came - law.mean
    probability_below = compute_probability_below(law, came)  # P(X < value)
    nan_if_absent = np.where(np.isnan(error), np.nan, 0.0)  # added to 0 or 1, so that absent rows do not count
    # A value that the forecast knows for certain is within any interval, so it does not test the share within.
    nan_if_untested = np.where(is_known_and_came(law, came), np.nan, nan_if_absent)
    # It is within the central interval of probability p if P(X < value) lies between (1 - p) / 2 and (1 + p) / 2.
    is_inside_by_level = {level: (np.abs(probability_below - 0.5) <= level / 2) + nan_if_untested for level in LEVELS}
    return Score(
        **number._asdict(),
        horizon=horizon,
        compared=int(np.sum(~np.isnan(error))),
        bias=average_overlapping(error, horizon),
        mse=average_overlapping(error**2, horizon),
        coverage=tuple(average_coverage(is_inside, horizon, level) for level, is_inside in is_inside_by_level.items()),
        log_score=average_overlapping(log_score(law, came), horizon),
        crps=average_overlapping(crps(law, came), horizon),
    )
