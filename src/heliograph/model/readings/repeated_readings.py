"""Readings that repeat: how many equal ones in a row a sensor's noise allows, and how many there have been."""

from collections.abc import Sequence
from math import ceil
from typing import NamedTuple

import numpy as np
import scipy
from typing_extensions import TypeAliasType

from heliograph.model.channel import Channel
from heliograph.model.over_time import unstack
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.check import fail, is_whole, show_value
from heliograph.numerics.types import ArrayLike, Float, Int
from heliograph.random_affine.base import AbstractRandomAffine, all_inner_maps
from heliograph.random_affine.hop import AbstractHop
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Independent
from heliograph.random_affine.noises.outlier_noise import Contaminated, StudentT
from heliograph.random_affine.words.rounding_noise import RoundedNoise

SELDOM = 1e-9  # probability that a run as long begins at a reading by chance: one in a year at 32 Hz
LEAST = 3  # equal readings: two may be one that was sent twice
MOST = 10**6  # equal readings: a run as long is not waited for

StuckLike = TypeAliasType("StuckLike", "bool | int | Sequence[bool | int | None] | ArrayLike | None")


class Repeats(NamedTuple):
    """Runs of equal readings: the newest of each received number, and how many in a row equal it; () before the first.

    Args:
        newest: newest readings (m,), NaN before the first.
        lengths: of the runs of equal readings that end with them (m,).
        steps: least differences of two successive readings that differ (m,), infinite where all were equal. This and
            the next three are of sensors of which nobody said when they are stuck; () of others.
        readings: how many there were (m,).
        equal: how many of them were equal to the one before (m,).
        found: runs that were found to be longer than noise allows (m,).
    """

    newest: tuple[float, ...] = ()
    lengths: tuple[int, ...] = ()
    steps: tuple[float, ...] = ()
    readings: tuple[int, ...] = ()
    equal: tuple[int, ...] = ()
    found: tuple[int, ...] = ()

    @staticmethod
    def read(stored: object) -> "Repeats":
        """Return stored runs of equal readings, from a list of their fields, or from such runs themselves.

        Version 0.4.0 and earlier stored two fields; the others are then empty.

        Raises:
            ValueError: no such list.
        """
        parts = stored if isinstance(stored, tuple | list) else ()
        if len(parts) not in (2, len(Repeats._fields)) or not all(isinstance(part, tuple | list) for part in parts):
            raise fail("repeats", "newest readings, and how many in a row are equal to them", show_value(stored))
        return Repeats(*map(tuple, parts))


def count_repeats(z: Float[np.ndarray, "time m"], before: Repeats) -> tuple[Int[np.ndarray, "time m"], Repeats]:
    """Count how many equal readings in a row end with each one; 0 where nothing arrived, which ends no run.

    Args:
        z: what was received (time, m), NaN where nothing arrived.
        before: runs that end with the readings before these.
    """
    counts: Int[np.ndarray, "time m"] = np.zeros(z.shape, dtype=np.int64)
    newest = list(before.newest or [np.nan] * z.shape[1])
    lengths = list(before.lengths or [0] * z.shape[1])
    for i in range(z.shape[1]):
        rows = np.flatnonzero(~np.isnan(z[:, i]))
        if len(rows) == 0:
            continue
        readings = z[rows, i]  # of this component, those that arrived
        number = np.arange(len(rows))
        begins = readings != np.concatenate([[newest[i]], readings[:-1]])  # a run: another reading than before it
        # Number of the reading with which the present run began. A run that goes on from before these readings began
        # with number -length: its readings before have the numbers -length to -1.
        start = np.maximum.accumulate(np.where(begins, number, -lengths[i]))
        counts[rows, i] = number - start + 1
        newest[i] = float(readings[-1])
        lengths[i] = int(counts[rows[-1], i])
    return counts, Repeats(tuple(newest), tuple(lengths))


def bound_probability_of_equal_readings(
    noise: AbstractNoise, steps: Float[np.ndarray, " outputs"] | None = None
) -> Float[np.ndarray, " outputs"]:
    """Bound the probability that a reading equals the one before it, whatever the sensor measures, of each output.

    With this bound a run of equal readings can be found too long for chance: the sensor is stuck. A reading y = h(x) +
    v is reported as the nearest multiple of its resolution q, and equals the one before where v lies in one certain
    interval of length q. Under a density that falls from its centre no interval of length q has a larger probability
    than the one about the centre: erf(q / sqrt(8 r)) for Gaussian noise of variance r. That of a mixture is at most the
    mean over its branches (the Gaussians of the mixture).

    Args:
        noise: the law of v, which may hold the resolution (`RoundedNoise`), or be of independent outputs.
        steps: the resolution of each output that declares none; by default each has to.

    Raises:
        ValueError: readings without a resolution, or noise that is not Gaussian, Student's or contaminated.
    """
    if isinstance(noise, RoundedNoise):
        return bound_probability_of_equal_readings(noise.source, np.asarray(noise.step))
    if isinstance(noise, Independent):
        ends = np.cumsum([part.dimension for part in noise.parts])[:-1]
        of_parts = [None] * len(noise.parts) if steps is None else np.split(steps, ends)
        return np.concatenate(
            [bound_probability_of_equal_readings(*part) for part in zip(noise.parts, of_parts, strict=True)]
        )
    if steps is None:
        raise fail("stuck", "a sensor with resolution=, or after how many equal readings", "no resolution")
    return _bound_probability_within_step(noise, steps)


def _bound_probability_within_step(
    noise: AbstractNoise, step: Float[np.ndarray, " outputs"]
) -> Float[np.ndarray, " outputs"]:
    """Return the largest probability that the noise of each output lies in an interval as long as its `step`.

    It is that of the interval around the mean, P(|v| <= step / 2). `step`: the least difference of two readings, such
    as a converter's.
    """
    # Student's law: 1 - 2 F(-step / (2 scale)), F its distribution function.
    if isinstance(noise, StudentT):
        scale = np.sqrt(np.diagonal(np.asarray(noise.scale)))
        return np.asarray(1 - 2 * scipy.special.stdtr(float(noise.degrees), -step / (2 * scale)))
    if not isinstance(noise, Gaussian | Contaminated):
        raise fail("stuck", "Gaussian, Student's or contaminated noise, or a number of readings", type(noise).__name__)
    # A mixture of Gaussians with these shares (as logarithms) and variances r: erf(step / sqrt(8 r)) of each.
    log_share, _mean, variance = (np.asarray(numbers) for numbers in noise.branches())
    with np.errstate(divide="ignore"):
        within_step = scipy.special.erf(step[:, None] / np.sqrt(8 * variance))
    return np.asarray(np.sum(np.exp(log_share) * within_step, axis=1))


def longest_run_by_chance(equal: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return the least n for which n equal readings in a row have a probability of at most SELDOM.

    Noise is independent between readings, so n equal ones in a row have probability at most p^(n - 1).

    Args:
        equal: p, a bound of the probability that a reading equals the previous one.
    """
    with np.errstate(divide="ignore"):
        n = 1 + np.ceil(np.log(SELDOM) / np.log(np.clip(equal, 0.0, 1 - 1e-12)))
    return np.asarray(np.maximum(n, LEAST))  # LEAST is 3, since two equal readings may be one that was sent twice


def find_stuck_counts(
    received: int, stuck: StuckLike, sensor: AnySensor | None, channel: Channel | None, values: Sequence[int]
) -> Float[np.ndarray, " received"] | None:
    """Return of each received number how many equal readings in a row mean that its sensor is stuck.

    Noise makes long runs of exactly equal readings improbable, so such a run tells of a sensor that is stuck.

    Args:
        received: how many numbers are received.
        stuck: True for as many as noise and resolution of the sensor give once in 10^9 readings; or a whole number; or
            None or False for a number that may repeat; or a list with one of these for each received number, as one
            alone is for all measured values.
        sensor: the sensor, whose noise and resolution are needed if `stuck` is True.
        channel: its channel, which must deliver the outputs as they were sent.
        values: which of the received numbers are measured values; what is told about the link may repeat.

    Returns:
        Counts (received,), infinite for a number that may repeat; None where all may.

    Raises:
        ValueError: another count of them, fewer than 2 readings, a sensor or a channel that does not say.
    """
    # One answer for all values, or one for each received number.
    expected = f"True, a whole number of equal readings from 2 to {MOST:,}, None, or a list of {received} of these"
    is_for_all = stuck is None or isinstance(stuck, bool | np.bool_) or is_whole(stuck)
    if not is_for_all and not isinstance(stuck, Sequence | np.ndarray):
        raise fail("stuck", expected, show_value(stuck))
    for_all = [stuck if i in values else None for i in range(received)]
    each = for_all if is_for_all else list(stuck)  # type: ignore[arg-type]
    if isinstance(stuck, str) or len(each) != received:  # a text is a sequence too
        raise fail("stuck", expected, show_value(stuck))
    counts = np.full(received, np.inf)
    for i, wanted in enumerate(each):
        may_repeat = wanted is None or (isinstance(wanted, bool | np.bool_) and not wanted)
        if may_repeat:
            continue
        if isinstance(wanted, bool | np.bool_):  # True: by the law of the noise
            counts[i] = _find_counts_by_noise_law(received, sensor, channel)[i]
        elif is_whole(wanted) and 2 <= wanted <= MOST:
            counts[i] = wanted
        else:
            raise fail("stuck", expected, show_value(stuck))
    return None if np.all(np.isinf(counts)) else counts


def _find_counts_by_noise_law(
    received: int, sensor: AnySensor | None, channel: Channel | None
) -> Float[np.ndarray, " received"]:
    """Return after how many equal readings each output of a sensor counts as stuck, by its noise and resolution.

    Runs as long have the probability SELDOM by chance; of a sensor that varies over time the largest count holds.

    Args:
        received: how many numbers are received.
        sensor: the sensor, with a resolution.
        channel: its channel.

    Raises:
        ValueError: no sensor or channel, a channel that changes readings, noise by which equal readings are usual.
    """
    steps = [step for step in unstack(sensor) if isinstance(step, AbstractSensor)]
    if not steps or channel is None:
        raise fail("stuck", "a number of equal readings, of what is received from no sensor", "True")
    outputs = tuple(range(len(steps[0].outputs)))
    for link in unstack(channel):
        if received != len(outputs) or not delivers_as_sent(link, outputs):
            raise fail("stuck", "a link that delivers readings as they are, or a number of equal readings", "True")
    counts = np.max([longest_run_by_chance(bound_probability_of_equal_readings(step.noise)) for step in steps], axis=0)
    if np.any(counts > MOST):
        longest = ceil(np.max(counts))
        raise fail("stuck", f"noise that ends a run of equal readings before {MOST:,}", f"{longest:,}")
    return np.asarray(counts)


def delivers_as_sent(link: AbstractRandomAffine, outputs: tuple[int, ...]) -> bool:
    """Return whether a link delivers each output, given by its index, unchanged and in order, or loses it.

    It must have no radio hop, which has a random gain or noise. Of what remains, `carry_angles` returns the indices of
    received angles if these outputs are angles, and refuses a gain other than 1. So equal indices mean z = y.
    """
    has_radio_hop = any(isinstance(hop, AbstractHop) and hop.transmits for hop in (link, *all_inner_maps(link)))
    if has_radio_hop:
        return False
    try:
        return link.carry_angles(outputs) == outputs
    except ValueError:
        return False
