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
    """A plant over one step with inputs zero: x+ = matrix x + offset + w, `covariance` = Cov w."""

    matrix: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray


class Sensing(NamedTuple):
    """The signal that is sent: y - c = matrix x + offset + v, about the centre c of the codewords.

    `covariance` = Cov v, `rounding`: covariance of the error of rounding y to a codeword.
    """

    matrix: np.ndarray
    offset: np.ndarray
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
        """Return a text that says how often codewords are overloaded, and how much a filter's error may differ for it.

        A codeword is overloaded if the number that it stands for lies beyond the encoder's range, so that the nearest
        number in the range is sent. `self.bound` bounds the change of the rms error, relative to the rms error that the
        filter claims.

        Args:
            node: name of the sender's node.
            filter: name of the filter.
        """
        probability, bound = float(np.max(self.probability)), float(self.bound)
        frequency = f"words of node {node!r} are overloaded in at most {probability:.2g} of the steps"
        if not np.isfinite(bound):
            return f"{frequency}, what that does to the claim of filter {filter!r} is not bounded"
        error = f"the rms error of filter {filter!r} differs from its claim by at most {100 * bound:.2g}% for it"
        return f"{frequency}, {error}"


def bound_overload(
    plant: AnyPlant, sensor: AnySensor, numbers: Channel, encoder: Words, indices: tuple[int, ...]
) -> Overload:
    """Return how often codewords overload, and a bound on what that does to the rms error of a linear filter.

    A linear filter behind quantised bits (codewords) takes the rounding for noise within the range. A signal beyond the
    range is sent as the end of the range, an error that the filter does not know of. This function says how often, and
    how much that may add to its error.

    y - c + d (y the sensor's signal, c the centre of the codewords, d the random dither) is rounded to steps D in the
    range [-a, a]. If it lies between a + (m - 1/2) D and a + (m + 1/2) D, the end of the range is sent, with an error
    e = m D in addition to that of rounding. So

        E e^2 = D^2 sum_{m >= 1} (2m - 1) P(|y - c + d| > a + (m - 1/2) D)

    since m^2 is the sum of the first m odd numbers. The link's gain g multiplies e, the filter's gain K adds g e to the
    estimate, and (I - K H) A takes it to the next step. By Minkowski's inequality the rms error changes by at most

        sum_j |((I - K H) A)^j K| sqrt(E g^2) sqrt(E e^2)

    y is taken for Gaussian, with its moments before any data and inputs zero.

    Args:
        plant: the linear plant.
        sensor: sensor of y - c, whose noise includes that of rounding.
        numbers: the channel that carries codewords, as a random affine map of y - c.
        encoder: rule that turns numbers into codewords: `step` D, range `low` to `high`, `dither`.
        indices: for each output of the channel the component of y that it carries; negative if it reports the channel's
            mode instead.
    """
    link = at(numbers, k=0)
    # The sum over j assumes one gain per step: no late messages, no link with memory, every output a signal component.
    no_bound = link.past or link.remembers or any(index < 0 for index in indices)
    # Steps that are looked at, as far as plant, sensor and channel are defined.
    horizon = min(STEPS, steps_covered((plant, sensor, numbers)) or STEPS)
    outputs = len(at(sensor, k=0).outputs)
    # D and a of each component (outputs,).
    step, half = encoder.each(encoder.step, outputs), encoder.each(encoder.high - encoder.low, outputs) / 2
    # Moments of the links, and mean and variance of y - c, at each step.
    links = None if no_bound else _list_links(numbers, horizon)
    system, signals = _describe_system(plant, sensor, links, horizon)
    # P(|y - c + d| > a + (m - 1/2) D) [k, m - 1, output]; m = 1 is an overload.
    tails = np.array([_find_tails(mean, variance, half, step, encoder.dither) for mean, variance in signals])
    # An overload is m = 1; its probability at the worst step.
    probability = tails[:, 0].max(axis=0)
    odd_numbers = 2 * np.arange(1, BEYOND + 1)[:, None] - 1
    rms_excess = step * np.sqrt(np.sum(odd_numbers * tails, axis=1))  # sqrt(E e^2) [k, output]
    # Without a bound the second number is NaN, unless overloads are so rare that they do not matter.
    if links is None or system is None:
        return Overload(probability, np.asarray(0.0 if probability.max() < RARE else np.nan))
    return Overload(probability, np.asarray(_bound_error(system, rms_excess, links, indices)))


RARE = 1e-9  # probability below which an overload is left out, behind links of which the bound is not known


def _describe_system(
    plant: AnyPlant, sensor: AnySensor, links: list[SecondOrder] | None, horizon: int
) -> tuple[LinearSystem | None, list[tuple[np.ndarray, np.ndarray]]]:
    """Return plant, sensor and links as a linear system, and mean and variance of y - c at each of `horizon` steps.

    A codeword counts quantisation steps of y - c, where y is the sensor's signal and c the centre of the codewords'
    range; y far from c overloads the quantizer. Mean and variance are unconditional, before any data, inputs zero.
    `links` has the moments of each step's link; without them (None) there is no system.
    """
    start = at(plant, k=0)
    initial_mean, initial_covariance = np.asarray(start.initial_mean), np.asarray(start.initial_covariance)
    mean, P = initial_mean, initial_covariance
    steps, signals = list[Steps](), list[tuple[np.ndarray, np.ndarray]]()
    for k in range(horizon):
        motion, sensing, link = _find_models_of_step(plant, sensor, links, k)
        # E x+ = A E x + b, P+ = A P A' + Q; E(y - c) = C E x + offset, Cov y = C P C' + Cov v.
        mean, P = motion.matrix @ mean + motion.offset, motion.matrix @ P @ motion.matrix.T + motion.covariance
        # `sensing.offset` includes -c, so that the y of the code is E(y - c); CPC = C P C'.
        y, CPC = sensing.matrix @ mean + sensing.offset, sensing.matrix @ P @ sensing.matrix.T
        signals.append((y, np.diag(CPC + sensing.covariance)))
        if link is not None:  # E[(y - c)(y - c)'], of the rounded signal that is sent
            second_moment = CPC + sensing.covariance + sensing.rounding + np.outer(y, y)
            steps.append(_describe_step(motion, sensing, link, y, second_moment))
    stacked = Steps(*(np.array(field) for field in zip(*steps, strict=True))) if steps else None
    n = len(initial_mean)
    system = None if stacked is None else LinearSystem(stacked, initial_mean, initial_covariance, np.eye(n))
    return system, signals


def _list_links(numbers: Channel, horizon: int) -> list[SecondOrder]:
    """Return the moments of gain and noise of the channel z = G y + n at each of `horizon` steps."""
    links = [second_order(link) for link in unstack(numbers)]
    return links if len(links) > 1 else links * horizon


def _find_models_of_step(
    plant: AnyPlant, sensor: AnySensor, links: list[SecondOrder] | None, k: int
) -> tuple[Motion, Sensing, SecondOrder | None]:
    """Return the matrices of plant and sensor at step k, and the moments of the link.

    `links` holds the link's moments at each step; None where they are not needed, and then the third result is None.
    """
    link = None if links is None else links[k]
    return _find_motion(at(plant, k)), _find_sensing(at(sensor, k)), link


@cache_by_object
def _find_motion(plant: LinearPlant) -> Motion:
    """Return A, b and Cov w of a plant x+ = A x + b + w whose inputs are zero, as NumPy arrays."""
    matrix, offset, covariance = _evaluate_motion(plant)
    return Motion(matrix=np.asarray(matrix), offset=np.asarray(offset), covariance=np.asarray(covariance))


@compile_on_call
def _evaluate_motion(plant: LinearPlant) -> tuple[Array, Array, Array]:
    """Return A, b and Cov w of a plant whose inputs are zero, computed by one compiled program."""
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
        offset=np.asarray(law.mean),
        covariance=source,
        rounding=np.asarray(law.covariance) - source,
    )


def _describe_step(motion: Motion, sensing: Sensing, link: SecondOrder, mean: np.ndarray, second: np.ndarray) -> Steps:
    """Return the matrices of one step of the linear system x+ = A x + b + w, z = E[G] C x + offset + noise.

    The sensor's signal about the centre c of the codewords is y - c = C x + offset + v. It is rounded with the error r,
    and the link makes z = G s + n of s = y - c + r. So the noise is E[G] (v + r) + (G - E G) s + (n - E n): what is
    random in G acts on all of s, of which E[s s'] is needed, not only its covariance.

    Args:
        motion: A, b and Cov w.
        sensing: C, offset, Cov v and Cov r.
        link: moments of G and n.
        mean: E s before any data (outputs,).
        second: E[s s'] before any data (outputs, outputs).
    """
    gain = np.asarray(link.mean_gain)  # E[G]
    sensed = gain @ (sensing.covariance + sensing.rounding) @ gain.T  # Cov(E[G] (v + r))
    columns, weights = np.asarray(link.noise.matrix), np.asarray(link.noise.weights)
    of_link = (columns * weights) @ columns.T  # Cov n
    # Cov((G - E G) s)_ij = sum_kl Cov(G_ik, G_jl) E[s_k s_l]; the index -1 of k and l is that of a 1 below s, whose
    # factor is n, which may be correlated with G.
    second_with_one = np.block([[second, mean[:, None]], [mean[None], np.ones((1, 1))]])  # E[(s, 1)(s, 1)']
    of_random_gain = np.einsum("ijkl,kl->ij", np.asarray(link.gain_covariance), second_with_one)
    return Steps(
        transition=motion.matrix,
        drift=motion.offset,
        process=motion.covariance,
        output=gain @ sensing.matrix,
        offset=gain @ sensing.offset + np.asarray(link.offset),
        noise=(sensed + of_link) + of_random_gain,
    )


def _find_tails(
    mean: np.ndarray, variance: np.ndarray, half: np.ndarray, step: np.ndarray, dither: str
) -> Float[np.ndarray, "beyond outputs"]:
    """Return P(|y - c + d| > a + (m - 1/2) D), m = 1, ..., BEYOND (40), for a Gaussian y - c and the dither d.

    A quantizer sends the signal y as a codeword, the nearest of values with the step D in the range [c - a, c + a]. A y
    beyond the range (an overload) has a larger error than D / 2, and these probabilities say how far beyond it lies: in
    multiples m of D. The encoder adds the dither d, a random number of the size of D, before it rounds. The probability
    given d is normal, and its mean over d a sum over nodes of Gauss-Legendre quadrature.

    Args:
        mean: mean of y - c (outputs,).
        variance: variance of y - c (outputs,).
        half: a, half of the range (outputs,).
        step: D, the step (outputs,).
        dither: law of the encoder's dither: "none", "triangular", or else uniform.
    """
    # a + (m - 1/2) D for each m (beyond, outputs).
    ends = half + (np.arange(1, BEYOND + 1)[:, None] - 0.5) * step
    deviation = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    # Nodes of d / D, and their probabilities. NODES lie in [-1, 1], with WEIGHTS that sum to 2.
    if dither == "none":
        nodes, probabilities = np.zeros(1), np.ones(1)
    elif dither == "triangular":  # density 1 - |v| of v = d / D on [-1, 0] and on [0, 1]
        nodes = np.concatenate([(NODES - 1) / 2, (NODES + 1) / 2])
        probabilities = np.concatenate([WEIGHTS, WEIGHTS]) / 2 * (1 - np.abs(nodes))
    else:  # uniform on [-1/2, 1/2]
        nodes, probabilities = NODES / 2, WEIGHTS / 2
    # sum over nodes of P(node) (P(y - c + d > end) + P(y - c + d < -end)) with d = node D.
    total: np.ndarray = np.zeros_like(ends)
    for node, probability in zip(nodes, probabilities, strict=True):
        shifted_mean = mean + node * step
        above, below = ((side * shifted_mean - ends) / deviation for side in (1, -1))
        total += probability * (scipy.special.ndtr(above) + scipy.special.ndtr(below))
    return total


def _bound_error(
    system: LinearSystem,
    rms_excess: Float[np.ndarray, "steps outputs"],
    links: list[SecondOrder],
    indices: tuple[int, ...],
) -> float:
    """Return a bound on the change of the rms error by overloads, relative to the rms error that the filter claims.

    An overload is a signal beyond the range of a codeword, which is then cut off. The bound is the largest over states
    i and steps k of sum_j |((I - K H) A)^j K s|_i / sqrt(P_ii), over overloads j steps ago: A moves the state, K is the
    filter's gain, H the measurement, P the filter's covariance, and s the rms of what an overload adds to each output.

    Args:
        system: plant, sensor and links.
        rms_excess: rms of the distance by which a codeword misses a signal beyond its range, at each step k.
        links: moments of the channel at each step.
        indices: for each output of the channel, the component of the signal that it carries.
    """
    gains = lmmse(system).gains
    largest, n = 0.0, system.mean.size
    terms = np.zeros((0, n, len(indices)))  # ((I - K H) A)^j K s, a row of (n, outputs) for each j
    for k in range(system.horizon):
        # s = sqrt(E g^2) (rms excess), with the link's gain g at each output.
        # `power` has E[G_ia G_jb] at [i, j, a, b]; the last a and b are those of a constant 1 below the signal.
        second_moments_of_gain = np.asarray(links[k].power.center)[..., :-1, :-1]
        rms_gain = np.sqrt(np.maximum(np.einsum("iikk->i", second_moments_of_gain), 0.0))
        newest = gains.gain[k] * (rms_gain * rms_excess[k][list(indices)])
        # Earlier terms move by (I - K H) A. Those that have become rounding are left out.
        is_used = np.abs(terms).max(axis=(1, 2), initial=0.0) > 1e-12 * np.abs(newest).max()
        terms = np.concatenate([gains.transition[k] @ terms[is_used], newest[None]])
        claimed_rms, bound = np.sqrt(np.diag(gains.covariance[k])), np.abs(terms).sum(axis=(0, 2))
        relative = np.divide(bound, claimed_rms, out=np.zeros(n), where=claimed_rms > 0)
        largest = max(largest, float(np.max(relative)))
    return largest


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
