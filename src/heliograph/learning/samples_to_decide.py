"""Number of samples after which a likelihood ratio decides between two laws of a gain."""

from typing import NamedTuple

import jax
import numpy as np
import scipy

from heliograph.filters.gaussian.gaussian_prediction import open_loop_filter
from heliograph.learning.likelihood.predictive_density import (
    NODES,
    ChannelDensities,
    ExpectedSignals,
    evaluate_predictive,
    make_signal_filter,
)
from heliograph.learning.long_run_covariance import estimate_long_run_deviation
from heliograph.numerics.check import check_count, check_seed, fail, instance, scalar
from heliograph.numerics.module import are_same, readable
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.laws.law import AbstractLaw
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.simulate import monte_carlo

HORIZON, RUNS = 500, 32  # steps and runs that are simulated under each law


@readable
class SamplesToTell(NamedTuple):
    """Number of steps that the likelihood ratio needs to decide between two laws, and what it gains in each.

    Args:
        samples: steps after which both errors are at most `error`; infinite where the laws look alike.
        information: mean of log p_true - log p_other per step, in nats, where the first law is true and where the
            second is.
        deviation: standard deviation of the sum of these over n steps, over sqrt(n), for many steps.
    """

    samples: float
    information: tuple[float, float]
    deviation: tuple[float, float]


def samples_to_tell(
    law_a: AbstractLaw,
    law_b: AbstractLaw,
    network: Network,
    inputs: ArrayLike | None = None,
    error: float = 0.05,
    seed: int = 0,
    nodes: int = NODES,
) -> SamplesToTell:
    """Steps of a network after which the likelihood ratio decides which of two laws a gain has, both errors `error`.

    The gain is the network's only random one, or where it has several, those whose law equals one of the two. The
    network is simulated under each law, and `predictive` computes log p_a - log p_b. Its sum over n steps is about
    normal, with mean n I_a and variance n V_a under the first law, -n I_b and n V_b under the second; the threshold
    between them that makes both errors equal gives n = (z (sqrt V_a + sqrt V_b) / (I_a + I_b))^2.

    Args:
        law_a: the first law.
        law_b: the second law.
        network: a network of one node that receives its sensor through a channel.
        inputs: inputs of the plant (steps, inputs); their length is that of the runs, 500 steps unless given.
        error: probability of either wrong decision, in (0, 0.5); 0.05 by default.
        seed: seed of the simulation (default 0).
        nodes: number of values that stand for each law (default 64).

    Raises:
        ValueError: a network with several nodes or none that receives through a channel, a node with a trigger, words
            or feedback, no gain to put the laws in, an error outside (0, 0.5).
    """
    for name, law in (("first law", law_a), ("second law", law_b)):
        instance(name, law, AbstractLaw, "a law such as Rayleigh(1.0)")
    check_seed("seed", seed)
    check_count("nodes", nodes)
    level = float(scalar("error", error, 0.0, 0.5))
    if level in (0.0, 0.5):
        raise fail("error", "a number between 0 and 0.5", level)
    name, node = _find_only_node(network)
    steps = HORIZON if inputs is None else len(np.asarray(inputs))
    u = np.zeros((steps, len(network.inputs))) if inputs is None else np.asarray(inputs, dtype=float)
    # Mean I and long-run deviation sqrt V of the log-likelihood ratio per step, where either law is true.
    # Channels in which every gain of one of the two laws has the first, and the second.
    channels = [_replace_law(node.channel, (law_a, law_b), law) for law in (law_a, law_b)]
    means = list[float]()
    deviations = list[float]()
    any_filter = {"open_loop": open_loop_filter(network.plant)}  # of the runs only the measurements are used
    for true, other in (channels, channels[::-1]):
        # Measurements z (runs, steps, received) under the true law, and log p_true - log p_other of each (runs, steps).
        world = Network(network.plant, {name: Node(node.sensor, true, any_filter)})
        z = monte_carlo(world, steps, RUNS, seed, inputs=inputs).measurements[name]
        of_true, of_other = (_predict_densities(network, node, channel, z, u, nodes) for channel in (true, other))
        log_ratio = np.asarray(of_true - of_other)
        means.append(float(log_ratio.mean()))
        deviations.append(float(np.sqrt(np.mean([estimate_long_run_deviation(run) ** 2 for run in log_ratio]))))
    # n = (z (sqrt V_a + sqrt V_b) / (I_a + I_b))^2, with the normal quantile z that is exceeded with probability
    # `error`; no number of steps is enough where the laws look alike.
    information = sum(means)
    needed = (scipy.stats.norm.isf(level) * sum(deviations) / information) ** 2 if information > 0 else np.inf
    return SamplesToTell(
        samples=float(needed), information=(means[0], means[1]), deviation=(deviations[0], deviations[1])
    )


def _find_only_node(network: Network) -> tuple[str, Node]:
    """Return the name and the node of a network with one node that receives a sensor through a channel, or raise.

    Raises:
        ValueError: any other network.
    """
    instance("network", network, Network, "a Network").check_sends_each_step("samples to tell two laws")
    network.check_sends_numbers("samples to tell two laws")
    received = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    if len(received) != 1 or len(network.nodes) != 1:
        raise fail("network", "one node that receives its sensor through a channel", f"{len(network.nodes)} nodes")
    return next(iter(received.items()))


def _replace_law(channel: object, pair: tuple[AbstractLaw, AbstractLaw], law: AbstractLaw) -> AbstractRandomAffine:
    """Return the channel with `law` as the law of the gains in question, for which the `pair` is compared.

    They are those whose law is one of the pair; where there is none, all random gains, if they have one law. A channel
    is a tree, with laws of gains among its leaves; `constant` is None for a random one.

    Raises:
        ValueError: a channel that varies over time, or with no random gain, or with several laws, none of the pair.
    """
    single = instance("channel", channel, AbstractRandomAffine, "one channel, that does not vary over time")
    leaves = jax.tree.leaves(single, is_leaf=_is_law)
    random_gains = [leaf for leaf in leaves if _is_law(leaf) and leaf.constant is None]
    of_pair = [gain for gain in random_gains if any(are_same(gain, law) for law in pair)]
    like_first = [gain for gain in random_gains if are_same(gain, random_gains[0])]
    if not of_pair and not 0 < len(like_first) == len(random_gains):
        expected = "gains of one law, or some whose law is one of the two"
        raise fail("network", expected, f"{len(random_gains)} random gains")
    replaced = of_pair or like_first

    def replace_if_chosen(leaf: object) -> object:
        """Return the new law in place of a gain in question, and anything else as it is."""
        return law if any(leaf is gain for gain in replaced) else leaf

    changed: AbstractRandomAffine = jax.tree.map(replace_if_chosen, single, is_leaf=_is_law)
    return changed


def _is_law(leaf: object) -> bool:
    """Return whether a leaf of a channel's tree is the law of a gain, rather than a number."""
    return isinstance(leaf, AbstractLaw)


def _predict_densities(
    network: Network, node: Node, channel: AbstractRandomAffine, z: np.ndarray, u: np.ndarray, nodes: int
) -> np.ndarray:
    """Return log p of each measurement given the earlier ones (runs, steps), if it came through this channel.

    Args:
        network: the network, for its plant.
        node: the node, for its sensor.
        channel: the channel with the law of gains to be judged.
        z: measurements (runs, steps, received).
        u: inputs of the plant (steps, inputs).
        nodes: number of values that stand for the law.
    """
    # The channel given that something arrives, since losses say nothing of the gains.
    received = channel.condition_on_arrival()
    filter = make_signal_filter(network.plant, node.sensor, received)
    parts = ChannelDensities.of(received, nodes)
    # Mean and covariance of the expected signal, and the measurement, with all steps of all runs in one axis.
    by_run = filter.expect_signals(z, u)
    expected = ExpectedSignals(*(np.asarray(array).reshape(-1, *array.shape[2:]) for array in by_run))
    return evaluate_predictive(expected, parts).log_likelihood.reshape(z.shape[:2])
