"""Whether variances that messages declare are true: sizes and memory of innovations, and what a refit says of both."""

from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import numpy as np
import scipy

from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.check import fail, instance, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Float, Int
from heliograph.random_affine.channel_state_information import AbstractToldMap
from heliograph.simulation.declared_noise.innovation_tests import LEVEL, InnovationTests, examine_innovations
from heliograph.simulation.declared_noise.refit import (
    DeclaredRows,
    ReceivedLinkColumns,
    Refit,
    find_interval_end,
    find_link_columns,
    list_links_declaring_noise,
    list_noise_variances,
    refit_filter,
    refit_scales,
    refit_with_bias,
)
from heliograph.simulation.runs.map_over_runs import over_runs

FEWEST = 20  # rows with values, below which nothing is judged
MOST = 2000  # rows that decide
CLASSES = 4  # of declared variances, at most
EACH = 60  # numbers in a class at least, which show a factor of 2 of the innovations' variance in 9 of 10 recordings
LEAST = 1.1  # ratio of variances from which one is worth a sentence


@readable
class DeclaredClass(NamedTuple):
    """Messages of similar declared variances, and what the innovations say of these.

    Args:
        low: smallest declared variance, the geometric mean over the outputs.
        high: largest one.
        numbers: values that arrived.
        nis: mean square of the innovations over their claimed variance; 1 where the claim holds.
        nis_low: lower end of the interval in which it is for a true claim, in 99 of 100 recordings for all classes.
        nis_high: upper end.
        scale: factor of the declared variances that fits best, without a bias; 1 if none is needed, NaN if none fits.
        scale_low: lower end of its 95 % interval.
        scale_high: upper end.
    """

    low: float
    high: float
    numbers: int
    nis: float
    nis_low: float
    nis_high: float
    scale: float
    scale_low: float
    scale_high: float


@readable
class DeclaredBias(NamedTuple):
    """A bias of each output that explains what no scale of the declared variances does.

    Args:
        deviation: its deviation, of each output (outputs,).
        time: its memory, in the time of the plant.
        time_low: lower end of the 95 % interval of the memory.
        time_high: upper end; infinite where the recording does not bound it.
        times_white: declared deviation over that of the white part, of all classes the smallest.
        times_white_low: lower end of its interval.
        gain: nats by which the likelihood is higher with it.
    """

    deviation: Float[np.ndarray, " outputs"]
    time: float
    time_low: float
    time_high: float
    times_white: float
    times_white_low: float
    gain: float


@readable
@dataclass(frozen=True)
class DeclaredJudgement:
    """Judgement of the variances that messages of one link declare, by a recording.

    Args:
        outputs: names of the outputs that the link carries; none where its values are not outputs one by one.
        classes: messages by declared variance, in its order.
        correlation: of innovations one message apart, as declared.
        p_value: of correlations over up to ten messages, if there were none.
        refit_correlation: the same after the variances are scaled.
        refit_p_value: p-value of these.
        bias: what explains the innovations where no scale does; None where one does, or nothing is wrong.
    """

    outputs: tuple[str, ...]
    classes: tuple[DeclaredClass, ...]
    correlation: float
    p_value: float
    refit_correlation: float
    refit_p_value: float
    bias: DeclaredBias | None

    @property
    def contradicted(self) -> bool:
        """True if sizes or memory of the innovations contradict what was declared, at 1 % each."""
        sizes = any(not c.nis_low <= c.nis <= c.nis_high for c in self.classes)
        return sizes or self.p_value < LEVEL

    def sentences(self, unit: str = "steps") -> list[str]:
        """Return what the user should know of the declared variances, a line each; nothing where they may be true.

        Args:
            unit: of the plant's time; steps by default.
        """
        if not self.contradicted:
            return []
        if self.bias is not None:
            return _describe_bias(self.bias, unit)
        if self.refit_p_value < LEVEL:
            return [
                "neither a scale of the declared variances nor a bias explains the innovations: correlated over one "
                f"message ({self.refit_correlation:.2f}) after a refit, by something that the model forgets"
            ]
        # Scales of the classes' variances; where none is found, innovations that are far too large in some class.
        lines = [line for one in self.classes for line in _describe_scale(one, len(self.classes) > 1)]
        worst = max((one.nis for one in self.classes if not one.nis <= LEAST * one.nis_high), default=0.0)
        if lines or not worst:
            return lines
        return [f"no scale explains the innovations, whose squares are {worst:.3g} times what is claimed"]


def judge_declared(
    filter: AbstractFilter,
    data: "Float[ArrayLike, 'steps received']",
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
) -> DeclaredJudgement:
    """Judge the variances that messages declare by a recording, with the plant as it is.

    Each message declares the variance a of its noise. Innovations over their claimed deviations, u, are tested twice at
    1 %: the mean of u^2 in each class of declared variances (messages of similar a), and the correlation over up to ten
    messages, r_l = sum u_k u_(k-l) / sum u^2, on which the scale of a has no effect. Small innovations alone mean
    nothing: variances that are too large, and an error that changes slowly, look alike. So variances are scaled to fit
    best, R = s a with one s for each class, and the tests repeated. If they pass, a scale was wrong; if not, a
    Gauss-Markov bias of each output is fitted beside the scales, and taken if the likelihood says so.

    Args:
        filter: a filter behind a link whose Gaussian noise is told (`hg.model.told`).
        data: values and what was declared of them (steps, received), NaN where none came; the first 2,000 rows count.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: a filter that is told no noise, or by several links (`judge_declared_links`), data or inputs of the
            wrong shape, fewer than 20 rows with values.
    Source: Ljung and Box (1978) for the correlations; Newey and West (1987) for errors where gains are random.
    """
    links = list_links_declaring_noise(filter) if isinstance(filter, ToldFilter) else []
    if len(links) != 1:
        got = type(filter).__name__ if isinstance(filter, AbstractFilter) else show_value(filter)
        expected = "one whose link tells the variance of its Gaussian noise (hg.model.told)"
        several = f"one of {len(links)} such links, which judge_declared_links judges"
        raise fail("filter", expected, several if links else got)
    assert isinstance(filter, ToldFilter)  # it has a link that declares
    z, u = (np.asarray(rows)[:MOST] for rows in check_data(filter, data, inputs))
    judgement, heard = _judge_link(filter, links[0], z, u)
    if judgement is None:
        raise fail("data", f"at least {FEWEST} rows with values and what is declared of them", heard)
    return judgement


def judge_declared_links(
    filter: AbstractFilter,
    data: "Float[ArrayLike, 'steps received']",
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
) -> tuple[DeclaredJudgement, ...]:
    """Judge what each link declares of its noise, as `judge_declared` does, while the other links are believed.

    They come in the order of the filter's nodes. A link of fewer than 20 rows with values has none.

    Args:
        filter: a filter.
        data: values and what was declared of them (steps, received), NaN where none came; the first 2,000 rows count.
        inputs: rows (steps, inputs); by default a filter without inputs is assumed.

    Raises:
        ValueError: no filter, data or inputs of the wrong shape.
    """
    instance("filter", filter, AbstractFilter, "a filter")
    z, u = (np.asarray(rows)[:MOST] for rows in check_data(filter, data, inputs))
    if not isinstance(filter, ToldFilter):
        return ()
    judgements = [_judge_link(filter, link, z, u)[0] for link in list_links_declaring_noise(filter)]
    return tuple(judgement for judgement in judgements if judgement is not None)


def _judge_link(
    filter: ToldFilter, link: int, z: Float[np.ndarray, "steps received"], u: Float[np.ndarray, "steps inputs"]
) -> tuple[DeclaredJudgement | None, int]:
    """Return the judgement of what one link declares of its noise, None of too few rows; and how many rows it had.

    Messages are divided into classes by their declared variances. If their innovations contradict these, a scale of the
    variances of each class is fitted; if innovations are still correlated over time, a bias of the outputs beside it.
    `link`: number of the link among those that report numbers with each message. `z`, `u`: measurements and inputs.
    """
    declared, classes = _classify_rows(filter, link, z, u)
    rows_with_values = int(np.sum(classes >= 0))
    if rows_with_values < FEWEST:
        return None, rows_with_values
    # The variances as declared. Where the innovations do not contradict them, all scales are 1.
    tests = examine_innovations(declared, filter, classes)
    if not tests.contradicts:
        ones = np.ones(declared.classes)
        return _make_judgement(declared, classes, (tests, tests), (ones, ones, ones), bias=None), rows_with_values
    # Scales of the classes; a bias too if the innovations are still correlated.
    refit = refit_scales(declared)
    tests_of_refit = examine_innovations(declared, refit_filter(declared, refit.logs), classes)
    bias = _find_bias(declared, refit) if tests_of_refit.p_value < LEVEL else None
    # The scale of each class, with the ends of its interval.
    low, high = ([find_interval_end(declared, refit, c, sign) for c in range(declared.classes)] for sign in (-1, 1))
    scales = np.exp(refit.logs if refit.found else np.nan * refit.logs), np.exp(low), np.exp(high)
    return _make_judgement(declared, classes, (tests, tests_of_refit), scales, bias), rows_with_values


class _DeclaredVariances(eqx.Module):
    """The noise variances of a link as a function of the numbers that are reported with each message."""

    told: AbstractToldMap  # the link whose law depends on reported numbers

    def __call__(self, numbers: Array) -> Array:
        """Return the variances of all noises of the link whose law these numbers report."""
        return list_noise_variances(self.told.believed(numbers))


def _compute_declared_variances(
    link_columns: ReceivedLinkColumns, z: Float[np.ndarray, "steps received"]
) -> Float[np.ndarray, "steps outputs"]:
    """Return the noise variances that each row's message reports, NaN where one of its numbers is missing.

    Variances are a function of the reported numbers. Where these are missing it is computed of the values that the link
    assumes for them (`typical`), so that it never fails.
    """
    numbers = z[:, link_columns.numbers]
    is_complete = ~np.isnan(numbers).any(axis=1)[:, None]
    assumed_numbers = np.asarray(link_columns.told.typical)
    variances = over_runs(_DeclaredVariances(link_columns.told), np.where(is_complete, numbers, assumed_numbers))
    return np.asarray(np.where(is_complete, np.asarray(variances), np.nan))


def _classify_rows(
    filter: ToldFilter, link: int, z: Float[np.ndarray, "steps received"], u: Float[np.ndarray, "steps inputs"]
) -> tuple[DeclaredRows, Int[np.ndarray, " steps"]]:
    """Divide the rows with messages of a link into classes by the mean logarithm of the variances that they declare.

    `link`: its number among the links of `filter` that report variances with each message. `z`, `u`: the recording.

    Returns:
        `DeclaredRows`, the recording with the edges between classes (log-variances) and the usual declared deviation of
        each output; and the class of each row, -1 of a row that is not used.
    """
    z, columns = z.copy(), find_link_columns(filter, link)
    with np.errstate(all="ignore"):
        # Messages whose numbers give no positive variance count as lost: they would spoil the filter's state.
        for number in list_links_declaring_noise(filter):
            declaring = find_link_columns(filter, number)
            valid = np.all(_compute_declared_variances(declaring, z) > 0, axis=1, keepdims=True)
            z[~valid & np.isin(np.arange(z.shape[1]), declaring.values + declaring.numbers)] = np.nan
        variances = _compute_declared_variances(columns, z)
        log_size = np.mean(np.log(variances), axis=1)
    # Rows in which the link reported a variance and one of its values (`columns.values` of z) came.
    heard = ~np.isnan(log_size) & ~np.isnan(z[:, columns.values]).all(axis=1)
    # Edges at quantiles, so that each class has as many rows, and at least EACH numbers.
    sizes, numbers = log_size[heard], int(np.count_nonzero(~np.isnan(z[heard][:, columns.values])))
    classes = min(CLASSES, len(np.unique(sizes)), max(numbers // EACH, 1))
    inner = np.quantile(sizes, np.arange(1, classes) / classes, method="lower") if classes else np.empty(0)
    edges = np.unique(inner[inner < np.max(sizes, initial=-np.inf)])
    # Median deviation of each output; of values that are no outputs one by one the geometric mean for all.
    outputs = variances.shape[1] if columns.outputs is None else len(columns.outputs)
    usual = np.sqrt(np.median(variances[heard], axis=0)) if heard.any() else np.ones(variances.shape[1])
    deviation = usual if len(usual) == outputs else np.full(outputs, np.exp(np.mean(np.log(usual))))
    return DeclaredRows(filter, link, edges, deviation, z, u), np.where(heard, np.searchsorted(edges, log_size), -1)


def _find_bias(declared: DeclaredRows, scales: Refit) -> DeclaredBias | None:
    """Return the slowly varying bias of the outputs that fits beside scaled white noise; None if not significant."""
    filter = declared.filter
    # A bias is a further state: it needs a model constant over time, and a link whose values are outputs one by one.
    varies = not (isinstance(filter.plant, AbstractPlant) and isinstance(filter.sensor, AbstractSensor))
    if varies or declared.columns.outputs is None:
        return None
    best = refit_with_bias(declared, scales)
    gain = best.likelihood - scales.likelihood
    # With two numbers more and no bias in truth, twice the gain is chi-squared (two degrees of freedom; tested at 1 %).
    if gain < scipy.special.gammainccinv(1, LEVEL):
        return None
    # best.logs: scale of each class, then the bias's deviation over the root of its memory, then the memory.
    count = declared.classes
    rate, time = np.exp(best.logs[count:])
    at_memory = count + 1
    time_low, time_high = (float(np.exp(find_interval_end(declared, best, at_memory, sign))) for sign in (-1, 1))
    # A scale is s = (deviation of the white noise / declared deviation)^2. The ratio declared / white is s^-1/2.
    largest = np.max(best.logs[:count])
    largest_end = max(find_interval_end(declared, best, number, 1) for number in range(count))
    return DeclaredBias(
        deviation=rate * np.sqrt(time) * declared.deviation,
        time=float(time),
        time_low=time_low,
        time_high=time_high,
        times_white=float(np.exp(-largest / 2)),
        times_white_low=float(np.exp(-largest_end / 2)),
        gain=gain,
    )


def _make_judgement(
    declared: DeclaredRows,
    classes: Int[np.ndarray, " steps"],
    tested: tuple[InnovationTests, InnovationTests],
    scales: tuple[np.ndarray, np.ndarray, np.ndarray],
    bias: DeclaredBias | None,
) -> DeclaredJudgement:
    """Return the judgement of a link from the tests of its innovations (`tested`), before and after the refit.

    A class has messages that declare similar variances, which the refit scales. `declared`: filter and recording.
    `classes`: class of each row, -1 of unused ones. `scales`: of each class, with the lower and the upper ends of
    their intervals, (classes,) each. `bias`: a slow error that explains innovations where no scale does, or None.
    """
    before, after = tested
    columns, judged_classes = declared.columns, []
    for class_index, (nis, nis_low, nis_high) in enumerate(before.nis):
        # What each message of the class declares: one variance, the geometric mean over the outputs.
        rows = declared.z[classes == class_index]
        variances = np.exp(np.mean(np.log(_compute_declared_variances(columns, rows)), axis=1))
        scale, scale_low, scale_high = (float(values[class_index]) for values in scales)
        judged = DeclaredClass(
            low=float(variances.min()),
            high=float(variances.max()),
            numbers=int(np.sum(~np.isnan(rows[:, columns.values]))),
            nis=nis,
            nis_low=nis_low,
            nis_high=nis_high,
            scale=scale,
            scale_low=scale_low,
            scale_high=scale_high,
        )
        judged_classes.append(judged)
    names = first(declared.filter.sensor).outputs
    return DeclaredJudgement(
        outputs=tuple(names[i] for i in columns.outputs or ()),  # none where values are not outputs one by one
        classes=tuple(judged_classes),
        correlation=before.correlation,
        p_value=before.p_value,
        refit_correlation=after.correlation,
        refit_p_value=after.p_value,
        bias=bias,
    )


def _describe_bias(bias: DeclaredBias, unit: str) -> list[str]:
    """Return lines that say how large a bias is if its size matters, how long its memory is, and what to do."""
    lines = []
    if bias.times_white_low > np.sqrt(LEAST):
        is_bounded = bias.times_white < 2 * bias.times_white_low
        times = f"{_two_digits(bias.times_white)}" if is_bounded else f"at least {_two_digits(bias.times_white_low)}"
        lines.append(f"the declared deviation is {times} times the white part of the error")
    low = _two_digits(bias.time_low)
    interval = f"{low} to {_two_digits(bias.time_high)}" if np.isfinite(bias.time_high) else f"at least {low}"
    memory = f"the error has a memory of about {_two_digits(bias.time)} {unit} ({interval})"
    lines.append(f"{memory}: give it a bias state (with_bias)")
    return lines


def _describe_scale(declared_class: DeclaredClass, are_several: bool) -> list[str]:
    """Return a line on how much too large or small a class's declared variances are, or no line if they are right.

    The line tells the class's range if there are several classes (`are_several`).
    """
    if np.isnan(declared_class.scale) or (declared_class.scale_low < LEAST and declared_class.scale_high > 1 / LEAST):
        return []
    times, low, high, kind = declared_class.scale, declared_class.scale_low, declared_class.scale_high, "small"
    if times < 1:
        times, low, high, kind = 1 / times, 1 / high, 1 / low, "large"
    range_of_class = f" from {declared_class.low:.3g} to {declared_class.high:.3g}" if are_several else ""
    factor = f"{_two_digits(times)} times too {kind} ({_two_digits(low)} to {_two_digits(high)})"
    return [f"declared variances{range_of_class} are {factor}; scaled so, the innovations pass"]


def _two_digits(value: float) -> str:
    """Return a number, rounded to two digits, as text."""
    return f"{float(f'{value:.2g}'):,.15g}"
