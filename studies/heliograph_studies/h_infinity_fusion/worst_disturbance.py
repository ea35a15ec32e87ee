"""The disturbance that a filter stands worst: a lower bound on its true H-infinity level, whatever a design claims.

The ratio sum E|M e|^2 / (sum |v|^2 + |rho|^2 + xi_0' W xi_0) is climbed over all w = (x_0, e_0, v, rho) of one energy,
E over a fixed set of draws of the channel. At w the direction is the gradient: if the error were linear in w this is
the power method. What is found is judged on new draws, so the search cannot flatter it.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

import heliograph as hg
from heliograph.filters.wrappers.fed_back import BeliefAndPrior
from heliograph.numerics.module import Module

SHARES = np.array([1.0, 0.5, 0.1, 0.01])  # of the way to the gradient's direction; the best one is taken
FIRST = (1.0, 1.0, 0.1, 1e-3)  # sizes of x_0, e_0, v, rho where a climb starts; where it ends they are what they are


class World(Module):
    """x+ = f(x, k) + B v, y = h(x) + D v, received = G y + N rho, z = M x, over the steps of `inputs`.

    Shapes: disturbance (n, v), feedthrough (y, v), wanted (z, n), weight (2n, 2n), inputs (time, inputs) of the filter.
    """

    dynamics: Callable[[jax.Array, jax.Array], jax.Array] = eqx.field(static=True)
    measure: Callable[[jax.Array], jax.Array] = eqx.field(static=True)
    disturbance: np.ndarray
    feedthrough: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    inputs: np.ndarray


class Draws(NamedTuple):
    """Gains G (draw, time, m, y) and noise gains N (draw, time, m, r) of a channel."""

    gain: np.ndarray
    noise: np.ndarray


class Disturbance(NamedTuple):
    """x_0, e_0 (n,), v (time, v), rho (time, r)."""

    state: jax.Array | np.ndarray
    error: jax.Array | np.ndarray
    plant: jax.Array | np.ndarray
    channel: jax.Array | np.ndarray


class Worst(NamedTuple):
    """The root of the largest ratio found, on new draws, its standard error, and the disturbance."""

    level: float
    standard_error: float
    disturbance: Disturbance


def worst_disturbance(
    filter: hg.filters.AbstractFilter,
    world: World,
    draws: Draws,
    new_draws: Draws,
    energies: ArrayLike,
    seed: int = 0,
    starts: int = 4,
    rounds: int = 60,
) -> Worst:
    """Climb from `starts` random disturbances of each of the energies, and judge the best one on new draws."""
    (time, _), n = world.inputs.shape, world.target.shape[1]
    sizes = (n,), (n,), (time, world.disturbance.shape[1]), (time, draws.noise.shape[-1])
    random, items = np.random.default_rng(seed), np.repeat(np.asarray(energies, dtype=float), starts)
    points = Disturbance(*(s * random.normal(size=(len(items), *size)) for s, size in zip(FIRST, sizes, strict=True)))
    climbed = hg.simulation.over_runs(_Climb(filter, world, draws, rounds), *points, items)
    best = Disturbance(*(part[int(np.argmax(climbed.reached))] for part in climbed.disturbance))
    output = hg.simulation.over_runs(_Output(filter, world, best), *new_draws)
    with jax.enable_x64(True):
        energy = float(_energy(world, best))
    ratio = output / energy
    level = float(np.sqrt(ratio.mean()))
    return Worst(level, float(ratio.std(ddof=1) / np.sqrt(len(ratio)) / (2 * level)), best)


class Climbed(NamedTuple):
    """Where a climb ends, and the ratio reached."""

    disturbance: Disturbance
    reached: jax.Array | np.ndarray


class _Climb(Module):
    """The climb from one disturbance of one energy; draw after draw, so that a program has the filter's step once."""

    filter: hg.filters.AbstractFilter
    world: World
    draws: Draws
    rounds: int = eqx.field(static=True)

    def __call__(
        self, state: jax.Array, error: jax.Array, plant: jax.Array, channel: jax.Array, energy: jax.Array
    ) -> Climbed:
        world = self.world

        @jax.jit  # traced once for its value and its gradient
        def gained(w: Disturbance) -> jax.Array:
            drawn = jnp.asarray(self.draws.gain), jnp.asarray(self.draws.noise)
            return jnp.mean(jax.lax.map(lambda draw: _Output(self.filter, world, w)(*draw), drawn))

        def improve(w: Disturbance, _: None) -> tuple[Disturbance, jax.Array]:
            # The gradient of E sum |M e|^2 at the same energy, and the best point on the way there.
            uphill = _scaled(world, _raised(world, jax.grad(gained)(w)), energy)
            tries = jax.vmap(lambda t: _scaled(world, _between(w, uphill, t), energy))(jnp.append(0.0, SHARES))
            values = jax.lax.map(gained, tries)
            best = jnp.argmax(values)
            return jax.tree.map(lambda leaf: leaf[best], tries), values[best]

        start = _scaled(world, Disturbance(state, error, plant, channel), energy)
        w, values = jax.lax.scan(improve, start, None, length=self.rounds)
        return Climbed(w, values[-1] / energy)


def _between(a: Disturbance, b: Disturbance, share: jax.Array) -> Disturbance:
    return Disturbance(*((1 - share) * p + share * q for p, q in zip(a, b, strict=True)))


def _stacked(w: Disturbance) -> jax.Array:
    return jnp.concatenate([w.state, w.error])


def _energy(world: World, w: Disturbance) -> jax.Array:
    start = _stacked(w)
    return jnp.sum(w.plant**2) + jnp.sum(w.channel**2) + start @ world.weight @ start


def _scaled(world: World, w: Disturbance, energy: jax.Array) -> Disturbance:
    factor = jnp.sqrt(energy / _energy(world, w))
    return Disturbance(*(factor * part for part in w))


def _raised(world: World, gradient: Disturbance) -> Disturbance:
    """The gradient as a disturbance: in the metric in which energy is measured."""
    state, error = jnp.split(jnp.linalg.solve(world.weight, _stacked(gradient)), 2)
    return gradient._replace(state=state, error=error)


class _Output(Module):
    """sum |M e|^2 of one draw."""

    filter: hg.filters.AbstractFilter
    world: World
    disturbance: Disturbance

    def __call__(self, gains: jax.Array, noises: jax.Array) -> jax.Array:
        filter, world, w = self.filter, self.world, self.disturbance

        def step(carry: PyTree, item: PyTree) -> tuple[PyTree, jax.Array]:
            x, state = carry
            k, u, v, rho, gain, noise = item
            z = gain @ (world.measure(x) + world.feedthrough @ v) + noise @ rho
            state, estimate = filter.step(state, z, u, k)
            missed = world.target @ (x - estimate.mean)
            return (world.dynamics(x, k) + world.disturbance @ v, state), missed @ missed

        begin = _from(filter, jnp.asarray(w.state - w.error))
        items = jnp.arange(len(gains)), jnp.asarray(world.inputs), w.plant, w.channel, gains, noises
        return jnp.sum(jax.lax.scan(step, (jnp.asarray(w.state), begin), items)[1])


def _from(filter: hg.filters.AbstractFilter, mean: jax.Array) -> PyTree:
    """The state of a filter that starts from another initial mean."""
    state = jax.tree.map(jnp.asarray, filter.init())
    if isinstance(state, BeliefAndPrior):
        return state._replace(belief=state.belief._replace(mean=mean))
    return state._replace(mean=mean)
