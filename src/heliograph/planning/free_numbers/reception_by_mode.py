"""Reception in each mode that a receiver observes: mean gains, noises, sent powers, for the best linear filter.

All of it follows from numbers that may be traced. An observed loss, and the observed mode of a link with memory, are
modes; in a known mode a channel forgets. Where probabilities are uncertain, and with them a mean gain M_v, the error
has a part K (M_v - M) y whose correlation with the rest nobody knows. Young's inequality, with one scalar b > 0 for
each step, bounds what a gain K leaves by
    (1 + b) [(I - K H) X (I - K H)' + K M R M' K'] + K [Spread + Shift / b] K',
a step of the filter with (1 + b) A X A', (1 + b) Q and another noise; b is one more free number.
"""

from collections.abc import Callable
from functools import reduce
from itertools import product
from math import prod
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at, first, steps_covered
from heliograph.model.sensor import AnySensor, LinearSensor, refuse_angles
from heliograph.numerics.check import check_horizon, fail
from heliograph.numerics.types import Array, Bool, Float
from heliograph.planning.error_objective import Error
from heliograph.planning.free_numbers.mode_riccati import ModeSystem
from heliograph.planning.plant_moments import (
    measured_moment_with_one,
    moments_with_one_over,
    require_design_plant,
    steady_moment_with_one,
)
from heliograph.planning.transmitters import compute_powers_of_law, transmitter_names
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.markov_chain_and_autoregression import find_stationary_law
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import JointModes, ModeOutput, joint_modes
from heliograph.random_affine.moments.second_moments import has_known_mean, second_order
from heliograph.random_affine.series_and_stack import Stack
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

MOST_MODES = 64  # of all nodes together


class SensorAndChannel(NamedTuple):
    """A sensor and the channel behind it, each of one step or OverTime."""

    sensor: AnySensor
    channel: Channel


class NodeReception(NamedTuple):
    """Reception of one node with M observed modes: z = H x + noise of covariance N in each.

    Args:
        chain: [k, i, j] = P(mode j at step k | mode i at the step before) (time, M, M).
        law: probability of each mode at each step (time, M).
        output: H = E[G] C, with the channel's gain G and the sensor's matrix C (time, M, m, n).
        noise: N (time, M, m, m).
        powers: what the node's transmitters send (time, hops).
    """

    chain: Float[Array, "time M M"]
    law: Float[Array, "time M"]
    output: Float[Array, "time M m n"]
    noise: Float[Array, "time M m m"]
    powers: Float[Array, "time hops"]


class _StepsReception(NamedTuple):
    """H, N and sent powers over steps with one sensor and channel; fields as of `NodeReception`."""

    output: Float[Array, "time M m n"]
    noise: Float[Array, "time M m m"]
    powers: Float[Array, "time hops"]


class _ObservedModes(NamedTuple):
    """A channel by its modes that the receiver observes, such as arrived and lost.

    Args:
        onward: [i, j] = P(mode j at the next step | mode i) (M, M).
        initial: law of the first mode (M,).
        maps: the channel in each mode.
        arrived: which outputs arrive in each mode.
        forgets: whether the next mode is independent of the mode.
    """

    onward: Array
    initial: Array
    maps: list[AbstractRandomAffine]
    arrived: list[Bool[np.ndarray, "m"]]
    forgets: bool


def list_sources(network: Network) -> dict[str, SensorAndChannel]:
    """Return the sensors with their channels by node.

    Raises:
        ValueError: relays that filter, sensors that are not linear, delays.
    """
    if network.relays is not None:
        raise fail("network of a design", "nodes that receive sensors through channels", "relays that filter")
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    sources = {name: SensorAndChannel(node.sensor, node.channel) for name, node in nodes.items()}
    if network.common is not None:
        sources["common"] = SensorAndChannel(network.common.sensor, network.common.channel)
    for name, source in sources.items():
        sensor, channel = first(source.sensor), first(source.channel)
        if not isinstance(sensor, LinearSensor) or channel.past:
            got = "a channel with delays" if isinstance(sensor, LinearSensor) else type(sensor).__name__
            raise fail(f"node {name!r}", "a LinearSensor and a channel without delays", got)
        refuse_angles("design", sensor)
    return sources


def list_transmitters(network: Network) -> tuple[str, ...]:
    """Return the names of all transmitters, in the order of `ModeSystem.powers`."""
    sources = list_sources(network).items()
    return tuple(f"{name}.{hop}" for name, source in sources for hop in transmitter_names(first(source.channel)))


def check_time_variation(network: Network, error: Error) -> None:
    """Raise ValueError unless everything that varies over time in a network fits the error's horizon or period."""
    require_design_plant(network.plant)
    covered = steps_covered((network.plant, list_sources(network)))
    if error.horizon is not None:
        check_horizon(error.horizon, covered)
    elif steps_covered(network.plant) is not None:
        raise fail("steady error", "a plant that does not vary (give a horizon)", "one that is an OverTime")
    elif covered is not None and covered != error.period:
        raise fail("parts that are OverTime", f"as many steps as the error's period, {error.period}", covered)


def make_mode_system(network: Network, error: Error, young: Array | None = None) -> ModeSystem:
    """Return the system of a network's best linear filter over the steps of an error, by the modes that it observes.

    A mode is a state of the links' Markov chains, such as which packets are lost. The system has for each step the
    plant's A and Q, the transition and law of the modes, and by mode H and N of z = H x + n, Cov n = N. Noises are
    exact, or upper bounds where probabilities are uncertain.

    Args:
        network: the network at some values of its free numbers, which may be traced.
        error: says over which steps: a period that repeats for ever, or a horizon.
        young: scalar b of Young's inequality at each step, (steps,) or (), for mean gains that are uncertain; None
            where they are known.

    Raises:
        ValueError: a channel with memory whose mode is not observed, more than MOST_MODES modes together.
    """
    steps = error.steps
    forever = error.horizon is None
    plants = [at(network.plant, k) for k in range(steps)]
    a = jnp.stack([jnp.asarray(plant.matrix) for plant in plants])
    q = jnp.stack([jnp.asarray(plant.noise.covariance) for plant in plants])
    # What each node receives: H = E[G] C and the noise N by mode. Random gains make N depend on the second moment
    # E (x, 1)(x, 1)' of the state, which is steady where the steps repeat for ever.
    seconds = [steady_moment_with_one(plants[0])] * steps if forever else moments_with_one_over(network.plant, steps)
    states = jnp.stack([jnp.asarray(second) for second in seconds])
    b = None if young is None else jnp.broadcast_to(young, (steps,))
    nodes = [compute_node_reception(name, source, states, forever, b) for name, source in list_sources(network).items()]
    count = prod(node.law.shape[1] for node in nodes)
    if count > MOST_MODES:
        raise fail("modes of a design", f"at most {MOST_MODES} together", count)
    # All nodes together have a mode for each combination of theirs. As nodes are independent, its probabilities are
    # products of theirs: Kronecker products of laws and of chains, in the order of `_stack_nodes`.
    output, noise = _stack_nodes(nodes)
    # Young's bound is a step of the filter with (1 + b) A X A' and (1 + b) Q; without uncertain gains b = 0.
    scale = jnp.ones((steps, 1, 1)) * (1.0 if b is None else 1 + b[:, None, None])
    return ModeSystem(
        transition=jnp.sqrt(scale) * a,
        process=scale * q,
        chain=reduce(jax.vmap(jnp.kron), [node.chain for node in nodes]),
        law=reduce(jax.vmap(jnp.kron), [node.law for node in nodes]),
        output=output,
        noise=noise,
        powers=jnp.concatenate([node.powers for node in nodes], axis=1),
        start=None if forever else jnp.asarray(first(network.plant).initial_covariance),
    )


def _stack_nodes(nodes: list[NodeReception]) -> tuple[Array, Array]:
    """Return H (time, M, m, n) and N (time, M, m, m) of all nodes together, for each of M joint modes.

    A joint mode is a combination of one mode of each node; the mode of the last node varies fastest.
    """
    outputs, noises = [], []
    make_block_diagonal_at_each_time: Callable[..., Array] = jax.vmap(
        lambda *blocks: jax.scipy.linalg.block_diag(*blocks)
    )
    for combination in product(*(range(node.law.shape[1]) for node in nodes)):
        node_modes = list(zip(nodes, combination, strict=True))
        outputs.append(jnp.concatenate([node.output[:, mode] for node, mode in node_modes], axis=1))
        noises.append(make_block_diagonal_at_each_time(*[node.noise[:, mode] for node, mode in node_modes]))
    return jnp.stack(outputs, axis=1), jnp.stack(noises, axis=1)


def compute_node_reception(
    name: str, source: SensorAndChannel, states: Float[Array, "time n1 n1"], forever: bool, young: Array | None
) -> NodeReception:
    """Return what a node receives at each step: the chain of its channel's observed modes, H, N and sent powers.

    In each mode the node receives z = H x + noise of covariance N, which depends on the state's second moments since
    gains are random. Planners compute the error of the best linear filter from these.

    Args:
        name: name of the node, for messages.
        source: its sensor and channel.
        states: E (x, 1)(x, 1)' of the state at each step.
        forever: whether the steps repeat for ever, or begin with the first.
        young: the scalar b at each step (time,) of Young's inequality, by which uncertain gains are bounded, or None.

    Raises:
        ValueError: a channel with memory whose mode is not observed.
    """
    # Spans of steps with one sensor and channel each: every step by itself if either varies, else all of them.
    steps, varies = len(states), isinstance(source.sensor, OverTime) or isinstance(source.channel, OverTime)
    spans = [range(k, k + 1) for k in range(steps)] if varies else [range(steps)]
    # The channel over each span and its modes; then probabilities of the modes at each step, and their transitions.
    channels = [at(source.channel, span[0]) for span in spans]
    modes = [_find_observed_modes(name, channel) for channel in channels]
    law, chain = _find_laws_and_chain(modes, [len(span) for span in spans], forever)
    # H, N and powers over each span.
    parts = []
    for span, channel, of_channel in zip(spans, channels, modes, strict=True):
        now = np.array(span)
        b = None if young is None else young[now]
        parts.append(
            _compute_steps_reception(at(source.sensor, span[0]), channel, of_channel, states[now], b, law[now])
        )
    over_time = _StepsReception(*(jnp.concatenate(of_spans) for of_spans in zip(*parts, strict=True)))
    return NodeReception(chain=chain, law=law, **over_time._asdict())


def _find_laws_and_chain(
    modes: list[_ObservedModes], lengths: list[int], forever: bool
) -> tuple[Float[Array, "time M"], Float[Array, "time M M"]]:
    """Return the law of the modes at each step, and the chain [k, i, j] = P(mode j at step k | mode i at step k - 1).

    Args:
        modes: the observed modes of each span of steps with one channel.
        lengths: number of steps of each span.
        forever: True if the steps repeat for ever, False if they begin with the first.
    """
    pairs = list(zip(modes, lengths, strict=True))
    if modes[0].forgets:
        # The modes are drawn anew at each step, so that the chain's rows are all this law.
        law: Array = jnp.concatenate([jnp.tile(of_span.initial, (length, 1)) for of_span, length in pairs])
        chain: Array = jnp.tile(law[:, None, :], (1, law.shape[1], 1))
        return law, chain
    onward = jnp.concatenate([jnp.tile(of_span.onward, (length, 1, 1)) for of_span, length in pairs])
    return _propagate_laws(onward, modes[0].initial, forever)


def means_are_known(name: str, channel: AbstractRandomAffine) -> bool:
    """Return whether all mean gains of a channel are known; uncertain probabilities may leave them within bounds only.

    If they are known, Young's inequality, and its scalar, is not needed to bound the error.
    """
    return all(has_known_mean(second_order(mode_map)) for mode_map in _find_observed_modes(name, channel).maps)


def _find_observed_modes(name: str, channel: AbstractRandomAffine) -> _ObservedModes:
    """Return the modes of a channel that its receiver observes, their Markov chain, and what arrives in each.

    If the channel has no memory, a mode is a set of outputs that arrive together, drawn anew at each step (`forgets`).
    If it has memory, a mode is the joint state of its Markov chains, which it delivers to the receiver; then everything
    arrives. `name` names the channel in errors.
    """
    if not memories(channel):
        cases = channel.list_outcomes()
        law = jnp.stack([jnp.asarray(case.probability) for case in cases])
        return _ObservedModes(
            onward=jnp.tile(law, (len(cases), 1)),  # each row is the same law: independent of the mode before
            initial=law,
            maps=[case.map for case in cases],
            arrived=[case.arrived for case in cases],
            forgets=True,
        )
    joint = _make_flagged_modes(name, channel)
    everything = np.ones(joint.maps[0].outputs, dtype=bool)
    return _ObservedModes(
        onward=joint.transition,
        initial=joint.initial,
        maps=list(joint.maps),
        arrived=[everything] * len(joint.maps),
        forgets=False,
    )


def _make_flagged_modes(name: str, channel: AbstractRandomAffine) -> JointModes:
    """Return the joint modes of a channel with memory whose receiver sees the mode of each of its Markov chains.

    The channel is a stack of maps side by side: some carry the signal, the others (`ModeOutput`, "flags") deliver the
    mode of a chain as a number. A joint mode is one mode of each chain. The result has their chain, and the channel of
    the signal in each joint mode, which then has no memory.

    Raises:
        ValueError: a chain whose mode is not delivered, or a gain that drifts, which has no modes.
    """
    maps = channel.in_parallel
    maps_of_signal = [affine for affine in maps if not isinstance(affine, ModeOutput)]
    flag_count = len(maps) - len(maps_of_signal)
    chains = memories(channel).values()  # Markov chains, and gains that drift
    delivers_all_modes = flag_count == len(chains) and not any(memory.drifts for memory in chains)
    if not maps_of_signal or not delivers_all_modes:
        raise fail(f"channel of {name!r}", "chains whose modes are observed (hg.model.with_flag)", "one with memory")
    channel_of_signal = maps_of_signal[0] if len(maps_of_signal) == 1 else Stack(maps_of_signal)
    return joint_modes(channel_of_signal, order=2)  # exact for second moments of its gains and noises


def _propagate_laws(
    onward: Float[Array, "time M M"], initial: Float[Array, "M"], forever: bool
) -> tuple[Float[Array, "time M"], Float[Array, "time M M"]]:
    """Return the law of the modes at each step, and the chain into each step, from the chain `onward` from each step.

    Entry [k, i, j] of a chain is the probability of mode j after mode i. If `forever` is True, laws are periodic and
    the last step leads to the first. Otherwise they start with the initial law, whatever the mode was before.
    """
    over_period = reduce(jnp.matmul, onward)
    mode_count = len(over_period)
    laws = [find_stationary_law(over_period) if forever and mode_count > 1 else jnp.asarray(initial)]
    for transition in onward[:-1]:
        laws.append(laws[-1] @ transition)
    into_first_step = onward[-1] if forever else jnp.tile(laws[0], (mode_count, 1))
    return jnp.stack(laws), jnp.concatenate([into_first_step[None], onward[:-1]])


def _compute_steps_reception(
    sensor: LinearSensor,
    channel: AbstractRandomAffine,
    modes: _ObservedModes,
    states: Array,
    young: Array | None,
    law: Array,
) -> _StepsReception:
    """Return H (time, M, m, n), N (time, M, m, m) and powers (time, hops) over steps with one sensor and channel.

    The channel has M modes that the receiver observes, such as arrived and lost. H is the mean map from state to what
    arrives in each mode, N the covariance of its noise, which depends on the state's second moment for random gains.

    Args:
        sensor: the sensor, with m outputs.
        channel: the channel.
        modes: the modes of the channel that the receiver observes: the channel in each (`maps`), and what arrives.
        states: E (x, 1)(x, 1)' of each step (time, n1, n1).
        young: the scalar b of Young's inequality at each step (time,); None where mean gains are known.
        law: probabilities of the modes at each step (time, M).
    """
    # H and N of each mode, from E (y, 1)(y, 1)' of what the sensor measures at each step.
    y = jax.vmap(lambda second: measured_moment_with_one(sensor, second))(states)
    pairs = zip(modes.maps, modes.arrived, strict=True)
    described = [_compute_mode_reception(mode_map, arrived, y, sensor, young) for mode_map, arrived in pairs]
    outputs = [jnp.tile(h, (len(y), 1, 1)) for h, _ in described]  # H of a mode is the same at each step

    def compute_powers(moment: Array, law: Array) -> Array:
        """Return the powers (hops,) of a step with E (y, 1)(y, 1)' = moment, and this law of the modes (M,)."""
        powers = [jnp.asarray(power) for power in compute_powers_of_law(channel, moment, law).values()]
        return jnp.stack(powers) if powers else jnp.zeros(0)

    # Modes of a channel without memory are its losses. A lost message is sent nevertheless, so for the powers they do
    # not matter: take a single mode of probability 1.
    law_of_sending = jnp.ones((len(y), 1)) if modes.forgets else law
    return _StepsReception(
        output=jnp.stack(outputs, axis=1),
        noise=jnp.stack([noise for _, noise in described], axis=1),
        powers=jax.vmap(compute_powers)(y, law_of_sending),
    )


def _compute_mode_reception(
    channel: AbstractRandomAffine, arrived: Bool[np.ndarray, "m"], y: Array, sensor: LinearSensor, young: Array | None
) -> tuple[Float[Array, "m n"], Float[Array, "time m m"]]:
    """Return H (m, n) and N (time, m, m) of one mode, in which z = H x + noise with covariance N is received.

    H = M C with M the channel's mean gain and C the sensor's matrix. N = Spread + M R M', where R is the covariance of
    the sensor's noise and Spread = E[dG Y dG'] the noise that the random part dG of (gain, offset) makes, given
    Y = E (y, 1)(y, 1)' (`y`) at each step. If M is uncertain (`young`: a scalar b > 0 for each step), N =
    Spread + Shift / b + (1 + b) M R M', with Shift the bound of what the error of M makes. Lost outputs: H = 0, N = 1.

    Args:
        channel: the channel in this mode, without memory.
        arrived: which outputs arrive in it (m,).
        y: E (y, 1)(y, 1)' of what the sensor measures at each step (time, m1, m1).
        sensor: the sensor.
        young: b at each step (time,), or None.
    """
    moments, present = second_order(channel), jnp.asarray(arrived)
    gain = jnp.where(present[:, None], jnp.asarray(moments.mean_gain), 0.0)
    sensor_noise = gain @ jnp.asarray(sensor.noise.covariance) @ gain.T + jnp.zeros((len(y), 1, 1))
    noise = jax.vmap(lambda moment: moments.spread(moment, present))(y)
    if young is None:
        noise = noise + sensor_noise
    else:
        noise = noise + (1 + young)[:, None, None] * sensor_noise
        if moments.uncertain:
            noise = noise + jax.vmap(lambda moment: moments.shift(moment, present))(y) / young[:, None, None]
    return gain @ jnp.asarray(sensor.matrix), noise + jnp.diag(jnp.where(present, 0.0, 1.0))
