"""Likelihood of a recording with the laws of gains in full, not by two moments alone, and a test of its fit."""

from functools import cache
from typing import Any, NamedTuple, TypeVar

import jax
import numpy as np
import scipy
from scipy.special import logsumexp, ndtr

from heliograph.factors.square_root_update import covariance_of_root, observe_root, roots_of
from heliograph.filters.filter_for_likelihood import likelihood_filter
from heliograph.model.checks.row_times import read_row_dates
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.module import readable
from heliograph.numerics.times.data_row_checks import check_rows
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets
from heliograph.random_affine.laws.law import AbstractLaw, Discrete
from heliograph.random_affine.moments.mixture_components import AffineComponent

REACH = 5.5  # standard deviations of the normal score: 4e-8 of a law lie beyond
Map = TypeVar("Map", bound=AbstractRandomAffine)


def approximate_law_by_nodes(law: AbstractLaw, count: int) -> Discrete:
    """Return a law of `count` gains with probabilities that approximates this one, far into its tails.

    It computes int f(g) dF(g) = int f(F^-1(Phi(t))) phi(t) dt by the trapezoidal rule on |t| <= REACH, with Phi and phi
    the normal distribution function and density. The error falls as exp(-2 pi^2 / h^2) with the nodes' distance h.
    A law of finitely many values is returned as it is. A user's law has no F^-1, so its nodes are quantiles of samples
    (`AbstractLaw.quantile`).

    Raises:
        ValueError: fewer than 2 nodes, a law that cannot be sampled.
    """
    check_count("nodes of a law", count, 2)
    if isinstance(law, Discrete):
        return Discrete(law.values, law.probabilities)
    if law.constant is not None:
        return Discrete([float(law.constant)], [1.0])
    probabilities, weights = _make_normal_nodes(count)
    return Discrete(law.quantile(probabilities), weights)


def discretise_laws(channel: Map, count: int) -> Map:
    """Return the channel with the law of each random gain replaced by `count` values; constant gains stay.

    What arrives then is a mixture of finitely many Gaussians, whose density can be computed.

    Args:
        channel: the channel, a tree with laws of gains among its leaves.
        count: number of values of each law.
    """

    def is_law(leaf: object) -> bool:
        """Return whether a part of the channel is a law, which is replaced as a whole."""
        return isinstance(leaf, AbstractLaw)

    def discretise(leaf: object) -> object:
        """Return `count` values with probabilities in place of a random law; anything else as it is."""
        if isinstance(leaf, AbstractLaw) and leaf.constant is None:
            return approximate_law_by_nodes(leaf, count)
        return leaf

    discrete: Map = jax.tree.map(discretise, channel, is_leaf=is_law)
    return discrete


@cache
def _make_normal_nodes(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return Phi(t), the normal distribution function, at `count` equally spaced nodes t in |t| <= REACH, and weights.

    The weights are the normal density at the nodes, scaled to sum to 1.
    """
    t = np.linspace(-REACH, REACH, count)
    weights = np.exp(-(t**2) / 2)
    return np.asarray(ndtr(t)), weights / weights.sum()


NODES = 64  # values of each law: a hop's density to three digits where its noise is a tenth of its spread
ROWS = 256  # steps whose densities are computed at once


@readable
class Predictive(NamedTuple):
    """Predictive density of each measurement, given the steps before, under a law of the gains.

    Args:
        log_likelihood: log p of what arrived (steps,); 0 where nothing did.
        pit: probability integral transform, P(less than what arrived) of each component given those before it (steps,
            received): uniform and independent where the law is right; NaN where the component did not arrive.
    """

    log_likelihood: Float[np.ndarray, " steps"]
    pit: Float[np.ndarray, "steps received"]

    def uniform(self) -> tuple[float, float]:
        """Test all transforms for uniformity: return Kolmogorov's distance and its p-value if the law is right.

        Raises:
            ValueError: nothing arrived.
        """
        values = self.pit[~np.isnan(self.pit)]
        if not len(values):
            raise fail("pits", "at least one measurement that arrived", "none")
        test = scipy.stats.kstest(values, "uniform")
        return float(test.statistic), float(test.pvalue)


def make_signal_filter(plant: AnyPlant, sensor: AnySensor, channel: AbstractRandomAffine) -> Any:
    """Return the filter that predicts what the sensor sends (`expect_signals`).

    It is the filter of the conditional form of a fit: it knows mean and covariance of gains, and its prior is
    Gaussian.

    Args:
        plant: the plant.
        sensor: the sensor.
        channel: the channel, given that something arrives.

    Raises:
        ValueError: a plant or sensor with modes, or an unknown start.
    """
    filter = likelihood_filter(plant, sensor, channel, linear=False)
    if not hasattr(type(filter), "expect_signals"):
        raise fail("predictive likelihood", "one law of motion, from a known start", type(filter).__name__)
    return filter


def predictive(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: AbstractRandomAffine,
    measurements: "Float[ArrayLike, 'steps received']",
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
    nodes: int = NODES,
) -> Predictive:
    """Return the density of each measurement with the laws of the channel's gains as `nodes` values each.

    p(z_k | past) = sum_j w_j N(z; G_j y + c_j, G_j P_y G_j' + N_j): y and P_y are mean and covariance of the sensor's
    signal as the cubature filter that knows the channel's moments expects it, and j runs over the combinations of
    gains. Parts of a stack (channels side by side) are used one after another: y and P_y are corrected by each, moments
    matched. Observed losses carry no information. The density is nominal, as the filter is: its prior is taken for
    Gaussian.

    Args:
        plant: the plant, which does not vary over time.
        sensor: the sensor, which does not vary over time.
        channel: the channel, without memory.
        measurements: z (steps, received), NaN where a component did not arrive.
        inputs: inputs of the plant (steps, inputs); a plant without inputs needs none.
        nodes: number of values of each law, 64 by default.

    Raises:
        ValueError: a channel that remembers or varies over time, too many combinations of gains in one part, data of
            the wrong shape.
    """
    # Check the parts, the rows and the inputs.
    instance("plant", plant, AbstractPlant, "one plant, that does not vary over time")
    instance("sensor", sensor, AbstractSensor, "one sensor, that does not vary over time")
    instance("channel", channel, AbstractRandomAffine, "one channel, that does not vary over time")
    check_forgets("channel of a predictive likelihood", channel)
    # The channel given that something arrived: rows in which nothing did say nothing of the gains.
    received = channel.condition_on_arrival()
    filter = make_signal_filter(plant, sensor, received)
    read_row_dates(filter.inputs, {"measurements": measurements, "inputs": inputs})
    z = check_rows("measurements", measurements, None, filter.received, missing=True)
    given_inputs = np.zeros((len(z), 0)) if inputs is None else inputs
    u = check_rows("inputs", given_inputs, len(z), len(filter.inputs), missing=False)
    # Mean and covariance of the sensor's signal before each step, and z with angles in the turn next to their mean.
    expected = ExpectedSignals(*map(np.asarray, filter.expect_signals(z, u)))
    return evaluate_predictive(expected, ChannelDensities.of(received, nodes))


class ExpectedSignals(NamedTuple):
    """What a filter expects of the sensor's signal y before each step, and what was measured.

    Args:
        mean: mean of y, given the earlier steps (steps, p).
        covariance: its covariance P_y (steps, p, p).
        z: measurements (steps, m), NaN where a component did not arrive; angles in the turn next to their mean.
    """

    mean: np.ndarray
    covariance: np.ndarray
    z: np.ndarray


class StackPartDensity(NamedTuple):
    """Law of one part of a channel, a mixture: in each combination of values of its gains, z = G y + offset + noise.

    y (p,) is the sensor's signal and z (m,) what arrives of this part.

    Args:
        log_weight: log of the probability of each combination a (a,).
        gain: G (a, m, p).
        offset: (a, m).
        noise: covariance of the noise (a, m, m).
    """

    log_weight: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray


class ChannelDensities(tuple[StackPartDensity, ...]):
    """Parts of a channel, from the first output to the last."""

    @staticmethod
    def of(channel: AbstractRandomAffine, nodes: int) -> "ChannelDensities":
        """Return the densities of a channel whose laws of gains are replaced by `nodes` support points each.

        Independent channels in parallel (a stack) stay apart; each has all combinations of its gains' support points,
        with their probabilities.
        """
        parts = channel.in_parallel
        return ChannelDensities(_stack_combinations(discretise_laws(affine, nodes).list_atoms()) for affine in parts)


def _stack_combinations(components: list[AffineComponent]) -> StackPartDensity:
    """Return the components of one part of a channel as arrays with a first axis of components.

    A component is one combination of values of the gains and noises, weighted by its probability. Components of
    probability zero are left out.
    """
    possible = [component for component in components if component.weight > 0]
    return StackPartDensity(
        log_weight=np.log(np.array([component.weight for component in possible])),
        gain=np.array([component.gain for component in possible]),
        offset=np.array([component.offset for component in possible]),
        noise=np.array([component.noise for component in possible]),
    )


def evaluate_predictive(expected: ExpectedSignals, parts: ChannelDensities) -> Predictive:
    """Return the density and the probability integral transform of each measurement, given the steps before.

    `expected` are mean y (steps, p) and covariance P_y (steps, p, p) of the signal, and z (steps, m). ROWS is 256.

    Args:
        expected: what is expected of the signal before each step, and what was measured.
        parts: law of each part of the channel, a mixture over the values of its gains.
    """
    y, P_y, z = expected
    # Score ROWS steps at a time, so that memory stays bounded. Without steps there is one empty block.
    blocks = [
        _score_stack_parts(y[i : i + ROWS], P_y[i : i + ROWS], z[i : i + ROWS], parts)
        for i in range(0, max(len(z), 1), ROWS)
    ]
    return Predictive(*(np.concatenate(column) for column in zip(*blocks, strict=True)))


def _score_stack_parts(
    y: np.ndarray, P_y: np.ndarray, z: np.ndarray, parts: ChannelDensities
) -> tuple[np.ndarray, np.ndarray]:
    """Return log-densities (steps,) and transforms (steps, m) of all parts of a stack, each given those before it.

    A channel is a stack of independent parts, one after another in z. In each part the random gain has finitely many
    values ("combinations" a of its components' gains, with probabilities), so z has a mixture of Gaussians as its law.
    The transform of a component is its probability integral transform, P(less than what came); NaN where none came.

    Args:
        y: mean (steps, p) of the sensor's signal before each step.
        P_y: its covariance (steps, p, p).
        z: measurements (steps, m), NaN where a component did not arrive.
        parts: gains (a, outputs, p), offsets, noises and probabilities of each part's combinations.
    """
    log_density, transforms, start = np.zeros(len(z)), [], 0
    for i, law in enumerate(parts):
        stop = start + law.gain.shape[1]
        # log_weight[..., j] = log(P(a) p(components before j | a)); error: standardised, given a and those before.
        log_weight, error = _weigh_combinations(y, P_y, z[:, start:stop], law)
        # The transform is sum_a P(a | components before) Phi(error of it in combination a of gains).
        for j in range(stop - start):
            weight = np.exp(log_weight[..., j] - logsumexp(log_weight[..., j], axis=1, keepdims=True))
            below = np.sum(weight * ndtr(error[..., j]), axis=1)
            transforms.append(np.where(np.isnan(z[:, start + j]), np.nan, below))
        # The part's log-density log sum_a P(a) p(part | a), and the signal's moments given this part, for the next one.
        of_part = logsumexp(log_weight[..., -1], axis=1)
        log_density += of_part
        if i + 1 < len(parts):
            log_posterior = log_weight[..., -1] - of_part[:, None]
            posterior = np.exp(log_posterior)
            y, P_y = _correct_signal(y, P_y, z[:, start:stop], law, posterior)
        start = stop
    return log_density, np.stack(transforms, axis=1)


def _weigh_combinations(
    y: np.ndarray, P_y: np.ndarray, z: np.ndarray, law: StackPartDensity
) -> tuple[np.ndarray, np.ndarray]:
    """Return log-weights of combinations of gains, and the errors L^-1 (z - E z), standard normal given those before.

    z = G y + offset + n is a mixture over the gain's values a. Log-weights (t, a, m + 1) before each component and
    after the last, and errors (t, a, m), for step t and combination a: log of its probability and of the density of the
    components so far. L L' = G P_y G' + N is the covariance of z; components that did not arrive stand apart with
    variance 1.

    Args:
        y: mean of the signal (t, p).
        P_y: its covariance (t, p, p).
        z: measured components of this part (t, m), NaN where none arrived.
        law: gain G, offset and noise N of each combination.
    """
    # G P_y G' + N (t, a, m, m), and 1 on the diagonal for components that did not arrive; L is its Cholesky factor.
    present = ~np.isnan(z)[:, None]
    both = present[..., None] & present[..., None, :]
    total = np.einsum("amp,tpq,anq->tamn", law.gain, P_y, law.gain) + law.noise
    total = np.where(both, total, np.where(np.eye(z.shape[1], dtype=bool), 1.0, 0.0))
    try:
        root = np.linalg.cholesky(total)
    except np.linalg.LinAlgError as why:
        expected = "one behind which every measurement has a density, whatever the gain"
        raise fail("channel of a predictive density", expected, "one that delivers a number without noise") from why
    # z - G y - offset, and L^-1 times it: component i less what those before it foretold, in deviations L_ii.
    value = np.where(present, z[:, None] - np.einsum("amp,tp->tam", law.gain, y) - law.offset, 0.0)
    error = np.linalg.solve(root, value[..., None])[..., 0]
    scale = np.diagonal(root, axis1=-2, axis2=-1)
    # Log-densities of the components, summed up from the first on: 0 before any, then after each.
    density = np.where(present, -(error**2 + np.log(2 * np.pi)) / 2 - np.log(scale), 0.0)
    gained = np.concatenate([np.zeros((*density.shape[:2], 1)), np.cumsum(density, axis=2)], axis=2)
    return law.log_weight[:, None] + gained, error


def _correct_signal(
    y: np.ndarray, P_y: np.ndarray, z: np.ndarray, law: StackPartDensity, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return mean (t, p) and covariance (t, p, p) of the signal given this part's measurements too.

    The signal y is what enters the channel (p numbers), t counts time steps, and a part is some of the channel's
    outputs, which arrives as z = gain y + offset + noise. Gain and noise are random and have finitely many
    combinations. Each combination a gives a Kalman update with mean m_a and covariance P_a. Their mixture has the
    mean m = sum_a w_a m_a and the covariance sum_a w_a (P_a + (m_a - m) (m_a - m)').

    Args:
        y: mean of the signal (t, p).
        P_y: its covariance (t, p, p).
        z: measured components (t, m), NaN where none arrived.
        law: gain, offset and noise of each combination.
        weight: w, the probability of each combination given z (t, a).
    """
    # Innovations z - gain y - offset of each combination (t, a, m). A component that did not arrive gets innovation,
    # gain and noise 0, so it changes nothing. The update is by roots: covariance = root root'.
    present = ~np.isnan(z)[:, None, :, None]
    value = np.where(present[..., 0], z[:, None] - np.einsum("amp,tp->tam", law.gain, y) - law.offset, 0.0)
    gain, noise = (np.where(present, rows, 0.0) for rows in (law.gain, roots_of(law.noise)))
    updated = observe_root(roots_of(P_y)[:, None], gain, noise)
    # m_a - y = gain (innovation) of each combination, and m - y, their mean.
    moves = np.einsum("tapm,tam->tap", updated.gain, value)
    mean_move = np.einsum("ta,tap->tp", weight, moves)
    # P_a + (m_a - m) (m_a - m)': a further column m_a - m in the root of P_a adds the second term.
    with_distance = np.append(updated.root, (moves - mean_move[:, None])[..., None], axis=-1)
    return y + mean_move, np.einsum("ta,tapq->tpq", weight, covariance_of_root(with_distance))
