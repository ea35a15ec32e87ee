"""How often words are overloaded before any data, and by how much a claim may be off for it."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.engine.choice import compile_on_call
from heliograph.linear.lmmse_recursion import lmmse
from heliograph.linear.system import LinearSystem, Steps
from heliograph.model.channel import Channel
from heliograph.model.over_time import at, steps_covered, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.model.words.encoder import Words
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order
from heliograph.random_affine.words.rounding_noise import RoundedNoise

STEPS = 500  # that are looked at, if the models do not end before
MOST = 1e-3  # probability of an overload at a step that is not refused
BEYOND = 40  # steps of words beyond the range that are counted
NODES, WEIGHTS = np.polynomial.legendre.leggauss(24)


class Motion(NamedTuple):
    """A plant over one step with inputs zero: x+ = matrix x + shift + w, `covariance` = Cov w."""

    matrix: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray


class Sensing(NamedTuple):
    """What is sent of x: y - c = matrix x + shift + v, `covariance` = Cov v, `rounding` that of the words' error."""

    matrix: np.ndarray
    shift: np.ndarray
    covariance: np.ndarray
    rounding: np.ndarray


@readable
class Overload(NamedTuple):
    """Overload of a sender's words before any data.

    probability: of each component at the step at which it is largest (outputs,). bound: by how much the rms error may
    differ from that claimed, relative to it, the largest of the states; nan where it is not known.
    """

    probability: Float[np.ndarray, " outputs"]
    bound: Float[np.ndarray, ""]

    def describe(self, node: str, filter: str) -> str:
        """Return a line that says how often words are overloaded, and what that may do to the claim of a filter.

        A word is overloaded if its number lies beyond the range. `self.bound` bounds its effect, as a share of the rms
        error.

        Args:
            node: name of the sender's node.
            filter: name of the filter.
        """
        share, bound = float(np.max(self.probability)), float(self.bound)
        frequency = f"words of node {node!r} are overloaded in at most {share:.2g} of the steps"
        if not np.isfinite(bound):
            return f"{frequency}, what that does to the claim of filter {filter!r} is not bounded"
        error = f"the rms error of filter {filter!r} differs from its claim by at most {100 * bound:.2g}% for it"
        return f"{frequency}, {error}"


def bound_overload(
    plant: AnyPlant, sensor: AnySensor, numbers: Channel, encoder: Words, places: tuple[int, ...]
) -> Overload:
    """Return how often words overload, and a bound on what that does to a linear filter.

    The difference of the rms errors is at most

        sum_j |((I - K H) A)^j K| sqrt(E g^2) D sqrt(sum_{m >= 1} (2m - 1) P(|y + d - c| > a + (m - 1/2) D))

    (Minkowski's inequality), with y Gaussian of the moments before any data and inputs zero, d averaged over.

    Args:
        plant: linear.
        sensor: of y - c, with the noise of rounding.
        numbers: the channel of words as numbers about c.
        encoder: of the words.
        places: component of each output of the channel.
    """
    link = at(numbers, k=0)
    no_bound = link.past or link.remembers or any(place < 0 for place in places)
    horizon = min(STEPS, steps_covered((plant, sensor, numbers)) or STEPS)
    outputs = len(at(sensor, k=0).outputs)
    step, half = encoder.each(encoder.step, outputs), encoder.each(encoder.high - encoder.low, outputs) / 2
    links = None if no_bound else _list_links(numbers, horizon)
    system, signals = _describe_system(plant, sensor, links, horizon)
    tails = np.array([_count_beyond(mean, variance, half, step, encoder.dither) for mean, variance in signals])
    probability = tails[:, 0].max(axis=0)
    excess = step * np.sqrt(np.sum((2 * np.arange(1, BEYOND + 1)[:, None] - 1) * tails, axis=1))
    if links is None or system is None:
        return Overload(probability, np.asarray(0.0 if probability.max() < RARE else np.nan))
    return Overload(probability, np.asarray(_bound_error(system, excess, links, places)))


RARE = 1e-9  # probability below which an overload is left out, behind links of which the bound is not known


def _describe_system(
    plant: AnyPlant, sensor: AnySensor, links: list[SecondOrder] | None, horizon: int
) -> tuple[LinearSystem | None, list[tuple[np.ndarray, np.ndarray]]]:
    """Return plant, sensor and links, where given, as a linear system, and mean and variance of y - c at each step."""
    start = at(plant, k=0)
    mean, covariance = np.asarray(start.initial_mean), np.asarray(start.initial_covariance)
    x, spread = mean, covariance
    parts, signals = list[Steps](), list[tuple[np.ndarray, np.ndarray]]()
    for k in range(horizon):
        motion, sensing, link = _find_models_of_step(plant, sensor, links, k)
        x, spread = motion.matrix @ x + motion.shift, motion.matrix @ spread @ motion.matrix.T + motion.covariance
        y, explained = sensing.matrix @ x + sensing.shift, sensing.matrix @ spread @ sensing.matrix.T
        signals.append((y, np.diag(explained + sensing.covariance)))
        if link is not None:
            second = explained + sensing.covariance + sensing.rounding + np.outer(y, y)
            parts.append(_describe_step(motion, sensing, link, y, second))
    stacked = Steps(*(np.array(field) for field in zip(*parts, strict=True))) if parts else None
    system = None if stacked is None else LinearSystem(stacked, mean, covariance, np.eye(len(mean)))
    return system, signals


def _list_links(numbers: Channel, horizon: int) -> list[SecondOrder]:
    """Return the second moments of the channel at each step."""
    links = [second_order(link) for link in unstack(numbers)]
    return links if len(links) > 1 else links * horizon


def _find_models_of_step(
    plant: AnyPlant, sensor: AnySensor, links: list[SecondOrder] | None, k: int
) -> tuple[Motion, Sensing, SecondOrder | None]:
    """Return the motion, the sensing and the link at step k.

    `links` holds the link's moments at each step, or is None if there is no link.
    """
    link = None if links is None else links[k]
    return _find_motion(at(plant, k)), _find_sensing(at(sensor, k)), link


@cache_by_object
def _find_motion(plant: LinearPlant) -> Motion:
    """Return A, b and Cov w with inputs zero."""
    matrix, shift, covariance = _evaluate_motion(plant)
    return Motion(matrix=np.asarray(matrix), shift=np.asarray(shift), covariance=np.asarray(covariance))


@compile_on_call
def _evaluate_motion(plant: LinearPlant) -> tuple[Array, Array, Array]:
    """Return A, b and Cov w with inputs zero, by one program."""
    u = jnp.zeros(len(plant.inputs))
    return plant.transition_matrix(u), plant.shift(u), plant.noise_covariance(u)


@cache_by_object
def _find_sensing(sensor: LinearSensor) -> Sensing:
    """Return C, the mean of y - c - C x, Cov v and the covariance of the rounding error.

    y = C x + noise, and c is the centre of the words. v is the sensor's own noise. The covariance of the rounding error
    is that of the whole noise less Cov v.
    """
    law = sensor.noise
    assert isinstance(law, RoundedNoise)
    source = np.asarray(law.source.covariance)
    return Sensing(
        matrix=np.asarray(sensor.matrix),
        shift=np.asarray(law.mean),
        covariance=source,
        rounding=np.asarray(law.covariance) - source,
    )


def _describe_step(motion: Motion, sensing: Sensing, link: SecondOrder, mean: np.ndarray, second: np.ndarray) -> Steps:
    """Return one step of the linear system; a random gain acts as a noise, by the moments of what is sent.

    `mean` (outputs,) and `second` (outputs, outputs): E and E[.. ..'] of y - c with the error of rounding.
    """
    # Second moments of (y - c, 1).
    moments = np.block([[second, mean[:, None]], [mean[None], np.ones((1, 1))]])
    gain, spread = np.asarray(link.mean_gain), np.einsum("ijkl,kl->ij", np.asarray(link.gain_spread), moments)
    columns = np.asarray(link.noise.matrix)
    covariance = sensing.covariance + sensing.rounding
    noise = gain @ covariance @ gain.T + (columns * np.asarray(link.noise.weights)) @ columns.T
    return Steps(
        transition=motion.matrix,
        drift=motion.shift,
        process=motion.covariance,
        output=gain @ sensing.matrix,
        offset=gain @ sensing.shift + np.asarray(link.offset),
        noise=noise + spread,
    )


def _count_beyond(
    mean: np.ndarray, variance: np.ndarray, half: np.ndarray, step: np.ndarray, dither: str
) -> Float[np.ndarray, "beyond outputs"]:
    """Return P(|y + d - c| > a + (m - 1/2) D), m = 1, 2, ..., of a Gaussian y - c, averaged over the dither d.

    `mean`, `variance`: of y - c (outputs,); `half`: a; `step`: D.
    """
    ends = half + (np.arange(1, BEYOND + 1)[:, None] - 0.5) * step
    deviation = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    if dither == "none":
        shifts, shares = np.zeros(1), np.ones(1)
    elif dither == "triangular":  # density (1 - |v|) / D of d = D v
        shifts = np.concatenate([(NODES - 1) / 2, (NODES + 1) / 2])
        shares = np.concatenate([WEIGHTS, WEIGHTS]) / 2 * (1 - np.abs(shifts))
    else:
        shifts, shares = NODES / 2, WEIGHTS / 2
    total: np.ndarray = np.zeros_like(ends)
    for shift, share in zip(shifts, shares, strict=True):
        centre = mean + shift * step
        below, above = ((side * centre - ends) / deviation for side in (1, -1))
        total += share * (scipy.special.ndtr(below) + scipy.special.ndtr(above))
    return total


def _bound_error(
    system: LinearSystem, excess: Float[np.ndarray, "steps outputs"], links: list[SecondOrder], places: tuple[int, ...]
) -> float:
    """Return the bound of the error relative to the rms, the largest over states and steps.

    `excess`: D sqrt(sum_m (2m - 1) P(...)) of each component at each step.
    """
    gains = lmmse(system).gains
    worst, n = 0.0, system.mean.size
    terms = np.zeros((0, n, len(places)))  # ((I - K H) A)^j K e of each output, one row for each j
    for k in range(system.horizon):
        power = np.asarray(links[k].power.center)
        root_power = np.sqrt(np.maximum(np.einsum("iikk->i", power[..., :-1, :-1]), 0.0))  # sqrt(E g^2)
        newest = gains.gain[k] * (root_power * excess[k][list(places)])
        # Terms that have become rounding are left out.
        counts = np.abs(terms).max(axis=(1, 2), initial=0.0) > 1e-12 * np.abs(newest).max()
        terms = np.concatenate([gains.transition[k] @ terms[counts], newest[None]])
        rms, most = np.sqrt(np.diag(gains.covariance[k])), np.abs(terms).sum(axis=(0, 2))
        worst = max(worst, float(np.max(np.divide(most, rms, out=np.zeros(n), where=rms > 0))))
    return worst


def refuse_overload(overload: Overload) -> None:
    """Raise ValueError where words are overloaded more often than once in a thousand steps.

    A word is overloaded if its number lies beyond the range. MOST is 1e-3. `overload.bound` is the bound of the error
    that overloads make, as a share of the rms error. It is infinite if there is no bound.
    """
    largest = float(np.max(overload.probability))
    if largest > MOST:
        bound = float(overload.bound)
        consequence = f"; the claim may be off by {100 * bound:.3g}%" if np.isfinite(bound) else ""
        expected = "an overload in at most 1 of 1000 steps: widen low and high, or centre them (hg.model.centred)"
        raise fail("range of the words", expected, f"{largest:.2g} a step{consequence}")
