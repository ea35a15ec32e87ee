"""Descent over the gains of a relay network's period, with the power of each slot kept below a limit."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RelayNetwork, RelaySteps
from heliograph.numerics.check import fail, repeat_per_step
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.relays.bfgs import bfgs
from heliograph.relays.design import join_gains, split_gains
from heliograph.relays.error_moments import gain_mask

POWER_TOLERANCE = 1e-6  # relative excess over a limit that counts as met
MARGIN = 1e-5  # the search aims this much below a limit, so that what is left of the multipliers' error does not matter
ROUNDS = 10  # of the multipliers
STIFFNESS = 1000.0  # of the augmented Lagrangian, against a cost that is a logarithm

# value, gradient and power of gains base + x unit at `where`, from x, steps, base, where, unit, limit, multipliers
Cost = Callable[[Array, RelaySteps, Array, tuple[Array, ...], Array, Array, Array], tuple[Array, Array, Array]]


def minimise_over_gains(
    network: RelayNetwork,
    steps: RelaySteps,
    start: Float[np.ndarray, "slots Fn R"],
    free: Bool[np.ndarray, "R"],
    cost: Cost,
    power_limit: ArrayLike | None,
) -> Float[np.ndarray, "slots Fn R"]:
    """Return the gains of least cost, by descent over the entries that multiply `free` received numbers.

    `steps`: those of one period. Entries of each filter are in units of its largest. A limit of power is kept by an
    augmented Lagrangian: with g_s = power_s / limit_s - 1 in slot s the cost is that of `_penalise_power`, and after
    each descent lambda_s = max(0, lambda_s + STIFFNESS g_s).
    """
    # Free entries: those that multiply a received number, and their units.
    where = np.nonzero(gain_mask(steps) & (steps.receives_in_slot[:, None, :] > 0) & free)
    unit = _find_largest_entries(network, start)[where]
    # A limit for each slot, without effect where no relay transmits. The search aims a margin below it.
    slots = len(network.slots)
    limit = np.full(slots, np.inf) if power_limit is None else repeat_per_step("power limit", power_limit, slots)
    limit = np.where(steps.transmits_in_slot[:, 1:].any(axis=1), limit, np.inf)
    aim = limit * (1 - MARGIN)
    # Scaled changes x of the gains, and a multiplier for the power of each slot.
    multipliers, x = np.zeros(slots), np.zeros(len(unit))
    if not np.isfinite(cost(x, steps, start, where, unit, np.full(slots, np.inf), multipliers)[0]):
        raise fail("start of the search", "gains under which second moments converge", "some under which they diverge")
    # Descend, then raise the multipliers of slots above their limit.
    for _ in range(ROUNDS if power_limit is not None else 1):

        def function(x: np.ndarray, multipliers: np.ndarray = multipliers) -> tuple[float, np.ndarray]:
            value, gradient, _ = cost(x, steps, start, where, unit, aim, multipliers)
            return float(value), np.asarray(gradient)

        x = bfgs(function, x)
        power = np.asarray(cost(x, steps, start, where, unit, limit, multipliers)[2])
        excess = power / aim - 1
        if _within_limits(excess, multipliers):
            break
        multipliers = np.maximum(0.0, multipliers + STIFFNESS * excess)
    # Gains in their units again.
    if np.any(power > limit * (1 + POWER_TOLERANCE)):
        raise fail("power limit", "one that some gains meet", f"an excess of {np.max(power / limit) - 1:.2g}")
    tuned: np.ndarray = start.copy()
    tuned[where] += x * unit
    return tuned


def _within_limits(excess: Float[np.ndarray, "slots"], multipliers: Float[np.ndarray, "slots"]) -> bool:
    """Decide whether no slot is above its limit, and those with a multiplier are at it; `excess`: power / limit - 1."""
    return bool(np.all(excess < MARGIN / 2) and np.all(excess[multipliers > 0] > -MARGIN))


def _find_largest_entries(
    network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]
) -> Float[np.ndarray, "slots Fn R"]:
    """Return the largest entry of each filter's gain in each slot, at every entry of that gain."""
    largest = {name: np.max(np.abs(gain), axis=(1, 2)) for name, gain in split_gains(network, gains).items()}
    # Of a filter whose gains are small or zero in a slot, a thousandth of the largest of all.
    floor = 1e-3 * max(float(np.max(value)) for value in largest.values())
    return join_gains(
        network,
        {
            name: np.broadcast_to(np.maximum(value, floor)[:, None, None], (len(gains), len(network.states), size))
            for (name, value), size in zip(largest.items(), network.received, strict=True)
        },
    )


def _penalise_power(
    traces: Float[jax.Array, "slots"],
    sound: Bool[jax.Array, ""],
    power: Float[jax.Array, "slots"],
    limit: Float[Array, "slots"],
    multipliers: Float[Array, "slots"],
) -> Float[jax.Array, ""]:
    """Return log sum_s trace_s + sum_s max(0, lambda_s + c g_s)^2 / 2c, g = power / limit - 1, c the STIFFNESS.

    Infinite where the moments are not `sound`, so that a search turns back.
    """
    total = jnp.sum(traces)
    sound = sound & (total > 0)
    pressure = jnp.maximum(0.0, multipliers + STIFFNESS * (power / limit - 1))
    penalty = jnp.sum(pressure**2) / (2 * STIFFNESS)
    return jnp.where(sound, jnp.log(jnp.where(sound, total, 1.0)) + penalty, jnp.inf)


def make_penalised_cost(traces: Callable[[RelaySteps, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]) -> Cost:
    """Return the penalised cost of `traces(steps, gains)`, which returns tr P by slot, soundness and powers."""

    def evaluate(
        x: Array,
        steps: RelaySteps,
        base: Array,
        where: tuple[Array, ...],
        unit: Array,
        limit: Array,
        multipliers: Array,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the penalised cost of gains x, its gradient, and the powers that they send."""

        def cost_and_power(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            trace, sound, power = traces(steps, jnp.asarray(base).at[where].add(x * unit))
            return _penalise_power(trace, sound, power, limit, multipliers), power

        (cost, power), gradient = jax.value_and_grad(cost_and_power, has_aux=True)(x)
        return cost, gradient, power

    return compile_in_float64(evaluate)
