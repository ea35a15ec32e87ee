"""A network as its best linear filter has it, from numbers that may be traced: mean gains, noises, modes, powers."""

from collections.abc import Sequence
from functools import reduce
from itertools import product
from math import prod

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first, steps_covered
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import fail
from heliograph.numerics.types import Array, Float
from heliograph.planning.modes_told import Measured
from heliograph.planning.state_power import check_constant_noise
from heliograph.planning.transmitters import names_of, sent_powers
from heliograph.random_affine.base import AbstractRandomAffine, memories
from heliograph.random_affine.chain import MarkovChain, stationary
from heliograph.random_affine.combine import Stack
from heliograph.random_affine.modes import Revealed, joint_modes
from heliograph.random_affine.second_moments import has_known_mean, second_order
from heliograph.random_affine.told import outcomes
from heliograph.simulation.network import Network
from heliograph.simulation.node import Common, Node

LISTED = 64  # modes of all nodes together

Mode = tuple[Array, Array]  # H and N


def transmitters_of(network: Network) -> tuple[str, ...]:
    """Names of all transmitters, in the order of `Measured.powers`."""
    return tuple(f"{name}.{hop}" for name, (_, channel) in _worlds(network).items() for hop in names_of(channel))


def _worlds(network: Network) -> dict[str, tuple[LinearSensor, AbstractRandomAffine]]:
    if network.relays is not None:
        raise fail("network of a design", "nodes that hear sensors through channels", "relays that filter")
    if steps_covered((network.plant, network.nodes, network.common)) is not None:
        raise fail("network of a design", "one that does not vary", "parts that are OverTime")
    shared = {} if network.common is None else {"common": network.common}
    found = {}
    for name, one in (network.nodes | shared).items():
        if isinstance(one, Node | Common):
            sensor, channel = first(one.sensor), first(one.channel)
            if not isinstance(sensor, LinearSensor) or channel.past:
                raise fail(f"node {name!r}", "a LinearSensor and a channel without delays", type(sensor).__name__)
            refuse_angles("design", sensor)
            found[name] = sensor, channel
    return found


def measured(network: Network) -> Measured:
    """What the steady error needs. Exact noises; where probabilities are uncertain, some that dominate them.

    Raises:
        ValueError: a plant that is not linear, a channel that remembers and tells nobody of its mode, uncertain
            probabilities of which the mean gain depends.
    """
    plant, noise = check_constant_noise(network.plant)
    if plant.inputs:
        raise fail("plant of a design", "no inputs", list(plant.inputs))
    a, q = jnp.asarray(plant.matrix), jnp.asarray(noise.covariance)
    n = len(plant.states)
    mean = jnp.linalg.solve(jnp.eye(n) - a, jnp.asarray(noise.mean))
    spread = jnp.linalg.solve(jnp.eye(n * n) - jnp.kron(a, a), q.ravel()).reshape(n, n)
    state = _joined(mean, (spread + spread.T) / 2)
    powers, chains, each = [], [], []
    for name, (sensor, channel) in _worlds(network).items():
        c, offset, r = (jnp.asarray(part) for part in (sensor.matrix, sensor.noise.mean, sensor.noise.covariance))
        rows = jnp.concatenate([jnp.concatenate([c, offset[:, None]], axis=1), jnp.eye(1, n + 1, n)])
        y = rows @ state @ rows.T + jnp.pad(r, ((0, 1), (0, 1)))
        powers += list(sent_powers(channel, y).values())
        chain, modes = _modes(name, channel, y, c, r)
        chains.append(chain)
        each.append(modes)
    if prod(len(modes) for modes in each) > LISTED:
        raise fail("modes of a design", f"at most {LISTED} together", prod(len(modes) for modes in each))
    together = [
        (jnp.concatenate([h for h, _ in chosen]), jax.scipy.linalg.block_diag(*(own for _, own in chosen)))
        for chosen in product(*each)
    ]
    chain = reduce(jnp.kron, chains)
    law = reduce(jnp.kron, [stationary(one) if len(one) > 1 else jnp.ones(1) for one in chains])
    output, noises = (jnp.stack(part) for part in zip(*together, strict=True))
    return Measured(a, q, chain, law, output, noises, jnp.stack([jnp.asarray(p) for p in powers]))


def _modes(
    name: str, channel: AbstractRandomAffine, y: Array, c: Array, r: Array
) -> tuple[Float[Array, "M M"], list[Mode]]:
    """The chain of what the receiver of a node is told, and H and N in each of its modes."""
    held = memories(channel)
    if not held:
        found = outcomes(channel)
        law = jnp.stack([jnp.asarray(one.probability) for one in found])
        modes = [_heard(name, one.map, y, c, r, one.arrived) for one in found]
        return jnp.tile(law, (len(found), 1)), modes
    told = [part for part in channel.maps if isinstance(part, Revealed)] if isinstance(channel, Stack) else []
    if (
        not isinstance(channel, Stack)
        or len(told) != len(held)
        or not all(isinstance(m, MarkovChain) for m in held.values())
    ):
        raise fail(f"channel of {name!r}", "chains whose modes are told (hg.model.with_flag)", "one that remembers")
    rest = [part for part in channel.maps if not isinstance(part, Revealed)]
    joint = joint_modes(rest[0] if len(rest) == 1 else Stack(rest), order=2)
    everything = np.ones(joint.maps[0].outputs, dtype=bool)
    return jnp.asarray(joint.transition), [_heard(name, one, y, c, r, everything) for one in joint.maps]


def _heard(
    name: str, channel: AbstractRandomAffine, y: Array, c: Array, r: Array, arrived: Sequence[bool] | np.ndarray
) -> Mode:
    """H = E[G] C, and N: what random gains make of E (y, 1)(y, 1)', and the sensor's noise; of what is lost, noise."""
    described = second_order(channel)
    if described.uncertain and not has_known_mean(described):
        raise fail(f"channel of {name!r}", "uncertain probabilities that leave the mean gain as it is", "others")
    there = np.asarray(arrived)
    gain = jnp.where(there[:, None], jnp.asarray(described.mean_gain), 0.0)
    noise = described.spread(jnp.asarray(y), jnp.asarray(there)) + gain @ r @ gain.T
    return gain @ c, noise + jnp.diag(jnp.where(there, 0.0, 1.0))


def _joined(mean: Array, spread: Array) -> Array:
    whole = jnp.append(mean, 1.0)
    return jnp.outer(whole, whole) + jnp.pad(spread, ((0, 1), (0, 1)))
