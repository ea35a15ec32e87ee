"""A network as its best linear filter has it, from numbers that may be traced: mean gains, noises, modes, powers.

Where probabilities are uncertain, and with them a mean gain M_v, the error has a part K (M_v - M) y that is correlated
with the rest in a way that nobody knows. Young's inequality, with one scalar b > 0 for each step, bounds what a gain K
leaves by
  (1 + b) [(I - K H) X (I - K H)' + K M R M' K'] + K [Spread + Shift / b] K',
a step of the filter with (1 + b) A X A', (1 + b) Q and another noise; b is one more free number.
"""

from functools import reduce
from itertools import product
from math import prod
from typing import Any

import jax
import jax.numpy as jnp

from heliograph.model.over_time import at, first, steps_covered
from heliograph.model.sensor import LinearSensor, refuse_angles
from heliograph.numerics.check import check_horizon, fail
from heliograph.numerics.types import Array
from heliograph.planning.criterion import Error
from heliograph.planning.hearing import Heard, World, heard
from heliograph.planning.modes_told import Measured
from heliograph.planning.state_power import check_constant_noise
from heliograph.planning.transmitters import names_of
from heliograph.simulation.network import Network
from heliograph.simulation.node import Common, Node

LISTED = 64  # modes of all nodes together


def transmitters_of(network: Network) -> tuple[str, ...]:
    """Names of all transmitters, in the order of `Measured.powers`."""
    return tuple(f"{name}.{hop}" for name, one in worlds_of(network).items() for hop in names_of(first(one.channel)))


def worlds_of(network: Network) -> dict[str, World]:
    """What is sent and how, by node.

    Raises:
        ValueError: relays that filter, sensors that are not linear, delays.
    """
    if network.relays is not None:
        raise fail("network of a design", "nodes that hear sensors through channels", "relays that filter")
    shared = {} if network.common is None else {"common": network.common}
    found = {}
    for name, one in (network.nodes | shared).items():
        if isinstance(one, Node | Common):
            sensor, channel = first(one.sensor), first(one.channel)
            if not isinstance(sensor, LinearSensor) or channel.past:
                got = "a channel with delays" if isinstance(sensor, LinearSensor) else type(sensor).__name__
                raise fail(f"node {name!r}", "a LinearSensor and a channel without delays", got)
            if isinstance(one, Node) and one.told_by is not None:
                raise fail(f"node {name!r}", "a sensor that hears nothing back", "one that does")
            refuse_angles("design", sensor)
            found[name] = World(one.sensor, one.channel)
    return found


def check_time(network: Network, error: Error) -> None:
    """Raise ValueError where what varies in a network does not fit the steps of an error, or none of it is steady."""
    check_constant_noise(network.plant)
    plant = first(network.plant)
    if plant.inputs:
        raise fail("plant of a design", "no inputs", list(plant.inputs))
    refuse_angles("design", plant)
    covered = steps_covered((network.plant, worlds_of(network)))
    if error.horizon is not None:
        check_horizon(error.horizon, covered)
    elif steps_covered(network.plant) is not None:
        raise fail("steady error", "a plant that does not vary (give a horizon)", "one that is an OverTime")
    elif covered is not None and covered != error.period:
        raise fail("parts that are OverTime", f"as many steps as the error's period, {error.period}", covered)


def measured(network: Network, error: Error, young: Array | None = None) -> Measured:
    """What the error needs. Exact noises; where probabilities are uncertain, some that dominate them.

    `young` is the scalar b of each step, None where the mean gains are known.

    Raises:
        ValueError: a channel that remembers and tells nobody of its mode.
    """
    steps, forever = error.steps, error.horizon is None
    plants = [at(network.plant, k) for k in range(steps)]
    a = jnp.stack([jnp.asarray(plant.matrix) for plant in plants])
    q = jnp.stack([jnp.asarray(plant.noise.covariance) for plant in plants])
    states = _steady(plants[0], steps) if forever else _from_start(plants)
    more = 1.0 if young is None else 1 + jnp.broadcast_to(young, (steps,))
    each = [heard(name, one, states, forever, None if young is None else jnp.asarray(more - 1))
            for name, one in worlds_of(network).items()]  # fmt: skip
    if prod(one.law.shape[1] for one in each) > LISTED:
        raise fail("modes of a design", f"at most {LISTED} together", prod(one.law.shape[1] for one in each))
    output, noise = _together(each)
    scale = jnp.ones(steps) * more
    return Measured(
        transition=jnp.sqrt(scale)[:, None, None] * a,
        process=scale[:, None, None] * q,
        chain=reduce(jax.vmap(jnp.kron), [one.chain for one in each]),
        law=reduce(jax.vmap(jnp.kron), [one.law for one in each]),
        output=output,
        noise=noise,
        powers=jnp.concatenate([one.powers for one in each], axis=1),
        start=None if forever else jnp.asarray(first(network.plant).initial_covariance),
    )


def _together(each: list[Heard]) -> tuple[Array, Array]:
    """H and N of all nodes in each choice of a mode for each."""
    outputs, noises = [], []
    for chosen in product(*(range(one.law.shape[1]) for one in each)):
        outputs.append(jnp.concatenate([one.output[:, j] for one, j in zip(each, chosen, strict=True)], axis=1))
        apart = [one.noise[:, j] for one, j in zip(each, chosen, strict=True)]
        noises.append(jax.vmap(lambda *own: jax.scipy.linalg.block_diag(*own))(*apart))
    return jnp.stack(outputs, axis=1), jnp.stack(noises, axis=1)


def _steady(plant: Any, steps: int) -> Array:
    """E (x, 1)(x, 1)' in the long run, for each step."""
    a, q, n = jnp.asarray(plant.matrix), jnp.asarray(plant.noise.covariance), len(plant.states)
    mean = jnp.linalg.solve(jnp.eye(n) - a, jnp.asarray(plant.noise.mean))
    spread = jnp.linalg.solve(jnp.eye(n * n) - jnp.kron(a, a), q.ravel()).reshape(n, n)
    return jnp.tile(_joined(mean, (spread + spread.T) / 2), (steps, 1, 1))


def _from_start(plants: list[Any]) -> Array:
    """E (x, 1)(x, 1)' at each step from the plant's initial law, the first after x_0 has moved once."""
    mean, spread = jnp.asarray(plants[0].initial_mean), jnp.asarray(plants[0].initial_covariance)
    found = []
    for plant in plants:
        a = jnp.asarray(plant.matrix)
        mean = a @ mean + jnp.asarray(plant.noise.mean)
        spread = a @ spread @ a.T + jnp.asarray(plant.noise.covariance)
        found.append(_joined(mean, spread))
    return jnp.stack(found)


def _joined(mean: Array, spread: Array) -> Array:
    whole = jnp.append(mean, 1.0)
    return jnp.outer(whole, whole) + jnp.pad(spread, ((0, 1), (0, 1)))
