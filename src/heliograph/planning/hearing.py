"""What the receiver of one node hears at each step, in each mode that it is told of, and what the node's senders send.

A loss that is told, and the mode of a link with memory that is told, are modes; given its mode a channel forgets.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.check import fail
from heliograph.numerics.types import Array, Bool, Float
from heliograph.planning.channel_power import by_mode
from heliograph.random_affine.base import AbstractRandomAffine, memories
from heliograph.random_affine.chain import MarkovChain, stationary
from heliograph.random_affine.combine import Stack
from heliograph.random_affine.modes import JointModes, Revealed, joint_modes
from heliograph.random_affine.second_moments import has_known_mean, second_order
from heliograph.random_affine.told import outcomes


class World(NamedTuple):
    """A sensor and the channel of what it sends, each of one step or OverTime."""

    sensor: AnySensor
    channel: Channel


class Heard(NamedTuple):
    """The chain into each step, its law, H = E[G] C and the noise N by mode, and powers of the transmitters."""

    chain: Float[Array, "time M M"]
    law: Float[Array, "time M"]
    output: Float[Array, "time M m n"]
    noise: Float[Array, "time M m m"]
    powers: Float[Array, "time hops"]


class _Told(NamedTuple):
    """A channel by what is told of it: a chain (onwards from a step), its first law, and what is heard in each mode."""

    onward: Array
    initial: Array
    maps: list[AbstractRandomAffine]
    arrived: list[Bool[np.ndarray, "m"]]
    forgets: bool


def heard(name: str, world: World, states: Float[Array, "time n1 n1"], forever: bool, young: Array | None) -> Heard:
    """What a node hears of states with E (x, 1)(x, 1)', in steps that repeat `forever` or begin with the first.

    Raises:
        ValueError: a channel that remembers and tells nobody of its mode.
    """
    steps, varies = len(states), isinstance(world.sensor, OverTime) or isinstance(world.channel, OverTime)
    spans = [range(k, k + 1) for k in range(steps)] if varies else [range(steps)]
    pairs = [(at(world.sensor, span[0]), at(world.channel, span[0])) for span in spans]
    told = [_told(name, channel) for _, channel in pairs]
    repeats = [steps] if not varies else [1] * steps
    onward = jnp.concatenate([jnp.tile(one.onward, (n, 1, 1)) for one, n in zip(told, repeats, strict=True)])
    if told[0].forgets:
        law: Array = jnp.concatenate([jnp.tile(one.initial, (n, 1)) for one, n in zip(told, repeats, strict=True)])
        chain: Array = jnp.tile(law[:, None, :], (1, law.shape[1], 1))
    else:
        law, chain = _laws(onward, told[0].initial, forever)
    parts = []
    for span, (sensor, channel), one in zip(spans, pairs, told, strict=True):
        now = np.array(span)
        mine = None if young is None else young[now]
        parts.append(_span(sensor, channel, one, states[now], mine, law[now]))
    return Heard(chain, law, *(jnp.concatenate(each) for each in zip(*parts, strict=True)))


def means_are_known(name: str, channel: AbstractRandomAffine) -> bool:
    """Whether no uncertain probability moves a mean gain, so that no scalar of Young's is needed."""
    return all(has_known_mean(second_order(one)) for one in _told(name, channel).maps)


def _told(name: str, channel: AbstractRandomAffine) -> _Told:
    if not memories(channel):
        found = outcomes(channel)
        law = jnp.stack([jnp.asarray(one.probability) for one in found])
        maps, arrived = [one.map for one in found], [one.arrived for one in found]
        return _Told(jnp.tile(law, (len(found), 1)), law, maps, arrived, forgets=True)
    joint = _joint(name, channel)
    everything = np.ones(joint.maps[0].outputs, dtype=bool)
    return _Told(joint.transition, joint.initial, list(joint.maps), [everything] * len(joint.maps), forgets=False)


def _joint(name: str, channel: AbstractRandomAffine) -> JointModes:
    """What is heard in each mode of a channel whose modes are all told."""
    held = memories(channel)
    parts = channel.maps if isinstance(channel, Stack) else ()
    rest = [part for part in parts if not isinstance(part, Revealed)]
    chains = all(isinstance(memory, MarkovChain) for memory in held.values())
    if not chains or len(parts) - len(rest) != len(held):
        raise fail(f"channel of {name!r}", "chains whose modes are told (hg.model.with_flag)", "one that remembers")
    return joint_modes(rest[0] if len(rest) == 1 else Stack(rest), order=2)


def _laws(
    onward: Float[Array, "time M M"], initial: Float[Array, "M"], forever: bool
) -> tuple[Float[Array, "time M"], Float[Array, "time M M"]]:
    """The law at each step, and the chain into it: around for ever, or from the initial law on."""
    around = onward[0]
    for one in onward[1:]:
        around = around @ one
    law = [stationary(around) if forever and len(around) > 1 else jnp.asarray(initial)]
    for one in onward[:-1]:
        law.append(law[-1] @ one)
    first = onward[-1] if forever else jnp.tile(law[0], (len(law[0]), 1))
    return jnp.stack(law), jnp.concatenate([first[None], onward[:-1]])


def _span(
    sensor: LinearSensor, channel: AbstractRandomAffine, told: _Told, states: Array, young: Array | None, law: Array
) -> tuple[Array, Array, Array]:
    """H, N and powers over steps with one sensor and one channel."""
    c, offset, r = (jnp.asarray(part) for part in (sensor.matrix, sensor.noise.mean, sensor.noise.covariance))
    n = c.shape[1]
    rows = jnp.concatenate([jnp.concatenate([c, offset[:, None]], axis=1), jnp.eye(1, n + 1, n)])
    y = rows @ states @ rows.T + jnp.pad(r, ((0, 1), (0, 1)))
    modes = [_mode(one, there, y, c, r, young) for one, there in zip(told.maps, told.arrived, strict=True)]
    output = jnp.stack([jnp.tile(h, (len(y), 1, 1)) for h, _ in modes], axis=1)

    def powers(now: Array, law: Array) -> Array:
        found = [jnp.asarray(power) for power in by_mode(channel, now, law).values()]
        return jnp.stack(found) if found else jnp.zeros(0)

    sent = jax.vmap(powers)(y, jnp.ones((len(y), 1)) if told.forgets else law)
    return output, jnp.stack([noise for _, noise in modes], axis=1), sent


def _mode(
    channel: AbstractRandomAffine, arrived: Bool[np.ndarray, "m"], y: Array, c: Array, r: Array, young: Array | None
) -> tuple[Float[Array, "m n"], Float[Array, "time m m"]]:
    """H, and N: what random gains make of E (y, 1)(y, 1)', and the sensor's noise; of what is lost, noise."""
    described, there = second_order(channel), jnp.asarray(arrived)
    gain = jnp.where(there[:, None], jnp.asarray(described.mean_gain), 0.0)
    noise = jax.vmap(lambda now: described.spread(now, there))(y)
    own = gain @ r @ gain.T + jnp.zeros((len(y), 1, 1))
    if young is None:
        noise = noise + own
    else:
        noise = noise + (1 + young)[:, None, None] * own
        if described.uncertain:
            noise = noise + jax.vmap(lambda now: described.shift(now, there))(y) / young[:, None, None]
    return gain @ c, noise + jnp.diag(jnp.where(there, 0.0, 1.0))
