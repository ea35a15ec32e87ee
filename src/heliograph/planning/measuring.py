"""A network as its best linear filter has it, from numbers that may be traced: mean gains, noises, modes, powers.

Where probabilities are uncertain, and with them a mean gain M_v, the error has a part K (M_v - M) y that is correlated
with the rest in a way that nobody knows. Young's inequality, with one scalar b > 0, bounds what a gain K leaves by
  (1 + b) [(I - K H) X (I - K H)' + K M R M' K'] + K [Spread + Shift / b] K',
a step of the filter with (1 + b) A X A', (1 + b) Q and another noise; b is one more free number.
"""

from functools import reduce
from itertools import product
from math import prod

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first, steps_covered
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import fail
from heliograph.numerics.types import Array, Bool, Float, Scalar
from heliograph.planning.modes_told import Measured
from heliograph.planning.state_power import check_constant_noise
from heliograph.planning.transmitters import names_of, sent_powers
from heliograph.random_affine.base import AbstractRandomAffine, memories
from heliograph.random_affine.chain import MarkovChain, stationary
from heliograph.random_affine.combine import Stack
from heliograph.random_affine.modes import JointModes, Revealed, joint_modes
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


def means_are_known(network: Network) -> bool:
    """Whether no uncertain probability moves a mean gain, so that no scalar of Young's is needed."""
    for _, channel in _worlds(network).values():
        maps = [one.map for one in outcomes(channel)] if not memories(channel) else _told_maps("", channel).maps
        if not all(has_known_mean(second_order(one)) for one in maps):
            return False
    return True


def measured(network: Network, young: Scalar = 0.0) -> Measured:
    """What the steady error needs. Exact noises; where probabilities are uncertain, some that dominate them.

    `young` is the scalar b, zero where the mean gains are known.

    Raises:
        ValueError: a plant that is not linear, a channel that remembers and tells nobody of its mode.
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
        chain, modes = _modes(name, channel, y, c, r, young)
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
    more = 1 + young
    return Measured(jnp.sqrt(more) * a, more * q, chain, law, output, noises, jnp.stack(list(map(jnp.asarray, powers))))


def _modes(
    name: str, channel: AbstractRandomAffine, y: Array, c: Array, r: Array, young: Scalar
) -> tuple[Float[Array, "M M"], list[Mode]]:
    """The chain of what the receiver of a node is told, and H and N in each of its modes."""
    if not memories(channel):
        found = outcomes(channel)
        law = jnp.stack([jnp.asarray(one.probability) for one in found])
        return jnp.tile(law, (len(found), 1)), [_heard(one.map, y, c, r, one.arrived, young) for one in found]
    joint = _told_maps(name, channel)
    everything = np.ones(joint.maps[0].outputs, dtype=bool)
    return jnp.asarray(joint.transition), [_heard(one, y, c, r, everything, young) for one in joint.maps]


def _told_maps(name: str, channel: AbstractRandomAffine) -> JointModes:
    """What is heard in each mode of a channel whose modes are all told."""
    held = memories(channel)
    parts = channel.maps if isinstance(channel, Stack) else ()
    rest = [part for part in parts if not isinstance(part, Revealed)]
    chains = all(isinstance(memory, MarkovChain) for memory in held.values())
    if not chains or len(parts) - len(rest) != len(held):
        raise fail(f"channel of {name!r}", "chains whose modes are told (hg.model.with_flag)", "one that remembers")
    return joint_modes(rest[0] if len(rest) == 1 else Stack(rest), order=2)


def _heard(
    channel: AbstractRandomAffine, y: Array, c: Array, r: Array, arrived: Bool[np.ndarray, "m"], young: Scalar
) -> Mode:
    """H = E[G] C, and N: what random gains make of E (y, 1)(y, 1)', and the sensor's noise; of what is lost, noise."""
    described, there = second_order(channel), jnp.asarray(arrived)
    gain = jnp.where(there[:, None], jnp.asarray(described.mean_gain), 0.0)
    noise = described.spread(jnp.asarray(y), there) + (1 + young) * (gain @ r @ gain.T)
    if described.uncertain and not has_known_mean(described):
        noise = noise + described.shift(jnp.asarray(y), there) / young
    return gain @ c, noise + jnp.diag(jnp.where(there, 0.0, 1.0))


def _joined(mean: Array, spread: Array) -> Array:
    whole = jnp.append(mean, 1.0)
    return jnp.outer(whole, whole) + jnp.pad(spread, ((0, 1), (0, 1)))
