"""Refit of declared noise to a recording: a scale for each class of messages, and a bias beside it, by likelihood.

Messages that declare noise tell their receiver how precise they are; such numbers are called told. Classes are messages
of similar declared variance. A bias is an error of an output that fades with a time constant, its memory.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.filters.wrappers.told_link_law import ToldFilter
from heliograph.model.augmented.bias import with_bias
from heliograph.model.channel_side_information import LinkGivenNumbers
from heliograph.model.over_time import first
from heliograph.model.plant import TIME_STEP, AbstractPlant
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import Array, Bool, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.channel_state_information import (
    AbstractToldMap,
    ToldGainHop,
    ToldMap,
    list_told_maps,
    list_told_numbers_of_outputs,
)
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian
from heliograph.simulation.likelihood import log_likelihood
from heliograph.simulation.runs.map_over_runs import over_runs

ALMOST = 2**-20  # by which typical numbers are moved, to see whether a noise depends on them
REACH = 1.92  # nats below the maximum at the ends of a 95 % interval of one number: half of chi-squared's 3.84
FARTHEST = 40.0  # of a logarithm, beyond which a scale has no end
FAST, SLOW = 0.5, 1e4  # of a bias's memory: shortest in steps, longest in lengths of the recording
TIMES = (5.0, 50.0)  # steps: memories from which the search begins
DIFFERENCE = 1e-4  # of logarithms, for slopes
SLOPE = 3e-3  # nats for a factor of e in a number, at which it is at its best
CLOSE = 0.05  # of a logarithm: as near as the end of an interval is found
LOST = 1e12  # nats by which numbers that give no likelihood (NaN, or one of 0) are worse than any


class DeclaredRows(NamedTuple):
    """A filter of messages that declare noise, with what those of one link declared in the rows of a recording.

    Args:
        filter: the filter.
        link: which of the links that tell numbers (`list_told_maps`): its noise is judged, that of others is as
            declared.
        edges: logarithms of declared variances at which one class of messages ends and the next begins (classes - 1,).
        deviation: usual declared deviation of each output of the link (outputs,).
        z: measurements (steps, received).
        u: inputs (steps, inputs).
    """

    filter: ToldFilter
    link: int
    edges: Float[np.ndarray, " edges"]
    deviation: Float[np.ndarray, " outputs"]
    z: Float[np.ndarray, "steps received"]
    u: Float[np.ndarray, "steps inputs"]

    @property
    def classes(self) -> int:
        """Number of classes of messages."""
        return len(self.edges) + 1

    @property
    def columns(self) -> "ReceivedLinkColumns":
        """Which columns of z are the judged link's reported numbers and values, and which outputs it carries."""
        return find_link_columns(self.filter, self.link)


class ReceivedLinkColumns(NamedTuple):
    """Which received numbers belong to a link that reports numbers of its law, and which outputs the link carries.

    Args:
        told: the link's map, whose law depends on reported numbers such as a noise variance.
        numbers: indices of these numbers in a row of z.
        values: indices in a row of z of the values whose law they give.
        outputs: outputs of the sensor that the link carries; None where values are not outputs one by one.
    """

    told: AbstractToldMap
    numbers: list[int]
    values: list[int]
    outputs: list[int] | None


def find_link_columns(filter: ToldFilter, link: int) -> ReceivedLinkColumns:
    """Return which received numbers belong to one of the links that report numbers of their law with each message.

    Each message brings values, and numbers such as the variance of their noise. A row of z has the values and numbers
    of all links: `filter.values` and `filter.numbers` are their indices in it.

    Args:
        filter: the filter of all links.
        link: number of the link among those that report numbers, in the filter's order (`list_told_maps`).
    """
    # The links as maps; `memory.announced` is how many numbers each message of a link reports.
    maps, sensor = list_told_maps(first(filter.link)), first(filter.sensor)
    # The link's numbers among all reported numbers: those of the links before it come first.
    begin = sum(affine.memory.announced for affine in maps[:link])
    numbers_of_link = list(range(begin, begin + maps[link].memory.announced))
    # The values that come over the link are those whose law depends on its numbers.
    has_effect = list_told_numbers_of_outputs(first(filter.link))[:, numbers_of_link].any(axis=1)
    values_of_link = np.flatnonzero(has_effect).tolist()
    # A link that carries all values carries all outputs, mixed or not. Otherwise value i has to be output i.
    carries_all = len(values_of_link) == len(filter.values)
    outputs = list(range(len(sensor.outputs))) if carries_all else values_of_link
    has_value_for_each_output = len(sensor.outputs) == len(filter.values)
    return ReceivedLinkColumns(
        told=maps[link],
        numbers=[filter.numbers[number] for number in numbers_of_link],
        values=[filter.values[value] for value in values_of_link],
        outputs=outputs if carries_all or has_value_for_each_output else None,
    )


class LinkWithScaledNoise(eqx.Module):
    """The link that declared numbers give, its noise times the scale of their class.

    Args:
        make: the link of these numbers, as it is declared.
        edges: logarithms of variances between classes (classes - 1,).
        scales: of the classes (classes,).
    """

    make: LinkGivenNumbers
    edges: Array
    scales: Array

    def __call__(self, numbers: Array) -> AbstractRandomAffine:
        """Return the link of these declared numbers, with its noise scaled by the scale of the message's class.

        `self.edges` are the borders of the classes, on the mean logarithm of the noise variances. `self.scales`: by
        class.
        """
        link = self.make(numbers)
        # The class of the message is the number of edges below the mean logarithm of its variances.
        log_variance = jnp.mean(jnp.log(list_noise_variances(link)))
        class_number = jnp.sum(log_variance > jnp.asarray(self.edges))
        scale = jnp.asarray(self.scales)[class_number]

        def rescale(leaf: object) -> object:
            """Return a noise with its covariance scaled; anything else as it is."""
            return Gaussian(scale * leaf.covariance, leaf.mean) if isinstance(leaf, AbstractNoise) else leaf

        scaled: AbstractRandomAffine = jax.tree.map(rescale, link, is_leaf=_is_noise)
        return scaled


def list_noise_variances(link: AbstractRandomAffine) -> jax.Array:
    """Return the variances of all noises inside a link, one after another."""
    return jnp.concatenate([jnp.diagonal(jnp.asarray(noise.covariance)) for noise in _list_link_noises(link)])


def list_links_declaring_noise(filter: ToldFilter) -> list[int]:
    """Return which links report with each message the variance of their Gaussian noise; a scale may correct these.

    Links are numbered among those that report any numbers, in the filter's order (`list_told_maps`).
    """
    if not isinstance(filter.link, AbstractRandomAffine):  # one that varies over time is not judged
        return []
    reporting_links = list_told_maps(filter.link)
    return [i for i, link in enumerate(reporting_links) if isinstance(link, ToldMap) and _declares_noise(link)]


@in_float64
def _declares_noise(affine: ToldMap) -> bool:
    """Return whether the noise of a link is Gaussian, with a variance that the numbers reported with a message give.

    To see whether they do, the noise is compared at the numbers that are assumed where none are reported (`typical`),
    and at numbers that are larger by the share ALMOST. A link whose reported number is its gain declares no noise.
    """
    if isinstance(affine.make, ToldGainHop):
        return False
    assumed_numbers = np.asarray(affine.typical)
    noises = _list_link_noises(affine.believed(assumed_numbers))
    changed_noises = _list_link_noises(affine.believed(assumed_numbers * (1 + ALMOST)))
    has_changed = any(
        not np.array_equal(a.covariance, b.covariance) for a, b in zip(noises, changed_noises, strict=True)
    )
    return has_changed and all(isinstance(noise, Gaussian) for noise in noises)


def _list_link_noises(link: AbstractRandomAffine) -> list[AbstractNoise]:
    """Return all noises inside a link."""
    return [leaf for leaf in jax.tree.leaves(link, is_leaf=_is_noise) if _is_noise(leaf)]


def _is_noise(leaf: object) -> bool:
    """Return whether a part of a link is a noise."""
    return isinstance(leaf, AbstractNoise)


def refit_filter(declared: DeclaredRows, logs: Array) -> ToldFilter:
    """Return the filter with the link's noise scaled, and a bias of each of its outputs where two numbers describe one.

    Messages declare the variance of their own noise, which may be wrong; how a recording fits scaled variances tells by
    how much. Messages are classed by the variance that they declare, and each class has a scale.

    Args:
        declared: the filter, the link that is judged (`columns`), the edges of the classes and the recording.
        logs: logarithms of the scale of each class (classes,). With a bias (classes + 2,) two more logarithms: of its
            deviation over the root of its memory, in units of the declared deviation, which data tell better than the
            deviation itself; and of its memory (the time after which it is forgotten), in the time of the plant.
    """
    filter, numbers, columns = declared.filter, jnp.exp(jnp.asarray(logs)), declared.columns

    def rescale(leaf: object) -> object:
        """Return the judged link's map with its noise scaled; anything else as it is.

        The link is known by its memory. `numbers`: the scale of each class of its messages, which `edges` part.
        """
        if not isinstance(leaf, ToldMap) or leaf.memory.identity != columns.told.memory.identity:
            return leaf
        scaled = LinkWithScaledNoise(leaf.make, declared.edges, numbers[: declared.classes])
        return eqx.tree_at(lambda affine: affine.make, leaf, scaled)

    # The filter's channel may hold several links whose messages tell their law (ToldMap): only one is judged.
    link = jax.tree.map(rescale, filter.link, is_leaf=lambda leaf: isinstance(leaf, ToldMap))
    plant, sensor = filter.plant, filter.sensor
    # A bias of the outputs that the link carries: one more state of the plant for each.
    has_bias = len(logs) > declared.classes
    if has_bias:
        assert isinstance(plant, AbstractPlant) and isinstance(sensor, AbstractSensor)
        rate, time = numbers[declared.classes :]
        dt = TIME_STEP if TIME_STEP in plant.inputs else 1.0
        deviation, loading = rate * jnp.sqrt(time) * declared.deviation, np.eye(len(sensor.outputs))[:, columns.outputs]
        plant, sensor = with_bias(plant, sensor, deviation, time, dt, loading=loading)
    return filter.with_models(plant, sensor, link)


class RefitLikelihood(eqx.Module):
    """The log-likelihood of a recording as a function of the numbers that `refit_filter` takes."""

    declared: DeclaredRows

    def __call__(self, logs: Array) -> Array:
        """Return the log-likelihood of the recording, in nats, with the noise of the judged link rescaled.

        `logs`: logarithms of the scale of each class and, with a bias of the outputs, of two numbers more: its
        deviation over the root of its memory, and its memory.
        """
        refit = refit_filter(self.declared, logs)
        return jnp.asarray(log_likelihood(refit, self.declared.z, self.declared.u))


class Refit(NamedTuple):
    """Numbers by which declared noise fits a recording best.

    Args:
        logs: their logarithms, as `refit_filter` takes them.
        likelihood: log-likelihood there, in nats.
    """

    logs: Float[np.ndarray, " numbers"]
    likelihood: float

    @property
    def found(self) -> bool:
        """Whether the search found numbers under which the recording is possible: its likelihood is neither 0 nor NaN.

        Others count as a log-likelihood of -LOST nats.
        """
        return self.likelihood > -LOST


def refit_scales(declared: DeclaredRows) -> Refit:
    """Return the scale of each class that fits best, with everything else as the filter has it."""
    return _maximise_likelihood(declared, np.zeros(declared.classes))


def refit_with_bias(declared: DeclaredRows, scales: Refit) -> Refit:
    """Return the best scales of the classes together with the best bias of the outputs, all as logarithms.

    A bias has a deviation s (in units of the declared one) and a memory T, its time constant. After the logarithms of
    the scales come those of s / sqrt(T), which the data tell better than s, and of T. `scales`: the best scales without
    a bias. The search begins from them, once for each memory of TIMES (in steps).
    """
    time_step = find_median_step(declared)
    start_scales = scales.logs - np.log(4)  # the search begins with three quarters of the variance in the bias
    log_deviation = (np.mean(scales.logs) - np.log(time_step)) / 2  # of s / sqrt(T)
    starts = [np.append(start_scales, [log_deviation, np.log(memory * time_step)]) for memory in TIMES]
    refits = [_maximise_likelihood(declared, start) for start in starts]
    return max(refits, key=lambda refit: refit.likelihood)


def find_median_step(declared: DeclaredRows) -> float:
    """Return the median time of a step of the recording; 1 where the plant counts steps."""
    inputs = declared.filter.inputs
    return float(np.median(declared.u[:, inputs.index(TIME_STEP)])) if TIME_STEP in inputs else 1.0


def find_interval_end(declared: DeclaredRows, best: Refit, number: int, sign: int) -> float:
    """Return an end of the 95 % interval of the logarithm of a number; infinite where the likelihood never falls.

    The numbers are scales of the noise that messages declare, and with a bias its deviation and memory. At the end the
    likelihood, with the other numbers at their best (profile likelihood), is 1.92 nats (REACH) below its maximum: half
    the 95 % point of chi-squared with one degree of freedom.

    Args:
        declared: the filter and the recording.
        best: the logarithms of the numbers at the maximum, and the log-likelihood there.
        number: index of the number in these logarithms.
        sign: 1 for the upper end, -1 for the lower one.
    """
    constrained = best

    def compute_excess_fall(distance: float) -> float:
        """Return by how much the log-likelihood falls at this distance from the maximum, minus REACH (1.92 nats).

        The distance is along logarithm number `number`, upwards if `sign` is 1 and downwards if it is -1. All other
        logarithms are at their best. From outside: `best`, the maximum, and `declared`, the filter and its recording.
        """
        nonlocal constrained  # each search starts from the last one's result
        start = constrained.logs.copy()
        start[number] = best.logs[number] + sign * distance
        constrained = _maximise_likelihood(declared, start, fixed=number)
        return best.likelihood - constrained.likelihood - REACH

    # The distance is doubled until the end is passed; then the span that holds the end is halved.
    near, far = 0.0, 0.25
    while compute_excess_fall(far) < 0:
        near, far = far, 2 * far
        if far > FARTHEST:
            return sign * np.inf
    while far - near > CLOSE:
        middle = (near + far) / 2
        near, far = (middle, far) if compute_excess_fall(middle) < 0 else (near, middle)
    return float(best.logs[number] + sign * far)


def _maximise_likelihood(
    declared: DeclaredRows, start: Float[np.ndarray, " numbers"], fixed: int | None = None
) -> Refit:
    """Return the maximum of the likelihood that a search finds from a start.

    Messages declare variances of their noise; the true ones are these times a scale, one for each class of messages.

    Args:
        declared: the filter and the recording.
        start: logarithms of the scales. With a slowly varying bias of the outputs two more: of the bias's deviation
            over the root of its memory, and of its memory (time constant).
        fixed: index of a logarithm that stays; None if all are free.
    """
    # Every logarithm is searched from -FARTHEST to FARTHEST; that of a bias's memory, the last, from FAST steps to SLOW
    # times the length of the recording.
    free = np.arange(len(start)) != fixed
    low, high = np.full(len(start), -FARTHEST), np.full(len(start), FARTHEST)
    has_bias = len(start) > declared.classes
    if has_bias:
        time_step = find_median_step(declared)
        low[-1], high[-1] = np.log(FAST * time_step), np.log(SLOW * len(declared.z) * time_step)
    fixed_arguments = RefitLikelihood(declared), start, free, (low, high)
    if not free.any():  # the only number is fixed: there is nothing to search
        loss, _ = _compute_loss(start[free], *fixed_arguments)
        return Refit(start, -loss)
    found = scipy.optimize.minimize(
        _compute_loss, start[free], args=fixed_arguments, jac=True, method="BFGS", options={"gtol": SLOPE}
    )
    logs = start.copy()
    logs[free] = found.x
    return Refit(np.clip(logs, low, high), -float(found.fun))


def _compute_loss(
    logs: Float[np.ndarray, " free"],
    likelihood: RefitLikelihood,
    start: Float[np.ndarray, " numbers"],
    free: Bool[np.ndarray, " numbers"],
    limits: tuple[Float[np.ndarray, " numbers"], Float[np.ndarray, " numbers"]],
) -> tuple[float, Float[np.ndarray, " free"]]:
    """Return minus the log-likelihood, and its slope by central differences; all points in one call.

    Args:
        logs: the free logarithms.
        likelihood: of all logarithms; one that is NaN counts as -LOST nats.
        start: all logarithms, of which those that are not free stay.
        free: which are free.
        limits: lowest and highest values of all, beyond which the likelihood is flat.
    """
    all_logs = start.copy()
    all_logs[free] = logs
    moves = DIFFERENCE * np.eye(len(start))[free]  # one row for each free number, which moves that number alone
    points = np.clip(np.stack([all_logs, *(all_logs + moves), *(all_logs - moves)]), *limits)
    losses = -np.maximum(np.nan_to_num(over_runs(likelihood, points), nan=-LOST), -LOST)
    above, below = np.split(losses[1:], 2)
    return float(losses[0]), (above - below) / (2 * DIFFERENCE)
