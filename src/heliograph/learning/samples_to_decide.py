"""Number of samples after which a likelihood ratio decides between two laws of a gain."""

from typing import NamedTuple

import jax
import numpy as np
import scipy

from heliograph.filters.gaussian.belief import open_loop_filter
from heliograph.learning.intervals import long_run_deviation
from heliograph.learning.likelihood.predictive_density import (
    NODES,
    ChannelDensities,
    evaluate_predictive,
    signal_filter,
)
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
    """Number of steps that the likelihood ratio needs, and what it gains in each.

    samples: steps after which both errors are at most `error`; infinite where the laws look alike. information: mean
    of log p_true - log p_other per step under the first law and under the second, nats; deviation: of that, in the long
    run.
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
        ValueError: a network with several nodes or none that receives through a channel, no gain to put the laws in, an
            error outside (0, 0.5).
    """
    for name, law in (("first law", law_a), ("second law", law_b)):
        instance(name, law, AbstractLaw, "a law such as Rayleigh(1.0)")
    check_seed("seed", seed), check_count("nodes", nodes)
    level = float(scalar("error", error, 0.0, 0.5))
    if level in (0.0, 0.5):
        raise fail("error", "a number between 0 and 0.5", level)
    name, node = _find_only_node(network)
    count = HORIZON if inputs is None else len(np.asarray(inputs))
    # Mean and long-run deviation of the ratio under each law.
    channels = [_replace_law(node.channel, (law_a, law_b), law) for law in (law_a, law_b)]
    of_laws = []
    for channel, alternative in (channels, channels[::-1]):
        ratio = _draw_likelihood_ratios(network, name, node, channel, alternative, inputs, count, seed, nodes)
        deviation = np.sqrt(np.mean([long_run_deviation(r) ** 2 for r in ratio]))
        of_laws.append((float(ratio.mean()), float(deviation)))
    (gain_a, deviation_a), (gain_b, deviation_b) = of_laws
    # n = (z (sqrt V_a + sqrt V_b) / (I_a + I_b))^2
    gain = gain_a + gain_b
    needed = (scipy.stats.norm.isf(level) * (deviation_a + deviation_b) / gain) ** 2 if gain > 0 else np.inf
    return SamplesToTell(float(needed), (gain_a, gain_b), (deviation_a, deviation_b))


def _find_only_node(network: Network) -> tuple[str, Node]:
    """Return the network's only node, which receives its sensor through a channel."""
    instance("network", network, Network, "a Network")
    received = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    if len(received) != 1 or len(network.nodes) != 1:
        raise fail("network", "one node that receives its sensor through a channel", f"{len(network.nodes)} nodes")
    return next(iter(received.items()))


def _replace_law(channel: object, pair: tuple[AbstractLaw, AbstractLaw], law: AbstractLaw) -> AbstractRandomAffine:
    """Return the channel with `law` in place of its gain in question: the one whose law is of the pair, or its only."""
    single = instance("channel", channel, AbstractRandomAffine, "one channel, that does not vary over time")
    leaves = jax.tree.leaves(single, is_leaf=_is_law_leaf)
    laws = [leaf for leaf in leaves if _is_law_leaf(leaf) and leaf.constant is None]
    of_pair = [leaf for leaf in laws if any(are_same(leaf, law) for law in pair)]
    chosen = of_pair or [leaf for leaf in laws if are_same(leaf, laws[0])]
    if not of_pair and not 0 < len(chosen) == len(laws):
        raise fail("network", "gains of one law, or some whose law is one of the two", f"{len(laws)} random gains")

    def replace_if_chosen(leaf: object) -> object:
        return law if any(leaf is gain for gain in chosen) else leaf

    changed: AbstractRandomAffine = jax.tree.map(replace_if_chosen, single, is_leaf=_is_law_leaf)
    return changed


def _is_law_leaf(leaf: object) -> bool:
    """Test whether a leaf of a tree is a law of a number."""
    return isinstance(leaf, AbstractLaw)


def _draw_likelihood_ratios(
    network: Network,
    name: str,
    node: Node,
    true: AbstractRandomAffine,
    other: AbstractRandomAffine,
    inputs: ArrayLike | None,
    count: int,
    seed: int,
    nodes: int,
) -> np.ndarray:
    """Return log p_true - log p_other (runs, steps) of data that a network of this node alone draws by the true law.

    Args:
        network: its plant and inputs.
        name: name of the node.
        node: gives the sensor.
        true: the channel by which data are drawn.
        other: the channel with the other law.
        inputs: of the plant (count, inputs); None for 0.
        count: number of steps.
        seed: seed of the simulation.
        nodes: number of values that stand for each law.
    """
    plain = Node(node.sensor, true, {"open_loop": open_loop_filter(network.plant)})
    world = Network(network.plant, {name: plain})
    z = monte_carlo(world, count, RUNS, seed, inputs=inputs).measurements[name]
    u = np.zeros((count, len(network.inputs))) if inputs is None else np.asarray(inputs, dtype=float)
    log_densities = []
    for channel in (true, other):
        received = channel.condition_on_arrival()
        filter, parts = signal_filter(network.plant, node.sensor, received), ChannelDensities.of(received, nodes)
        y, spread, near = (np.asarray(a).reshape(-1, *a.shape[2:]) for a in filter.expect_signals(z, u))
        log_densities.append(evaluate_predictive((y, spread, near), parts).log_likelihood.reshape(z.shape[:2]))
    return np.asarray(log_densities[0] - log_densities[1])
