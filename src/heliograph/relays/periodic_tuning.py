"""Gains tuned for the periodic steady state by descent through its fixed point; power may be bounded."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RECEIVER, RelayNetwork, Steps
from heliograph.numerics.check import fail, instance, per_step
from heliograph.numerics.float64 import compiled
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.relays.descent import bfgs
from heliograph.relays.design import GainsByFilter, RelayDesign, join_gains, split_gains
from heliograph.relays.periodic import (
    check_slots,
    is_covariance,
    periodic_given_design,
    periodic_own_error_design,
    periodic_steps,
    steady,
    steady_behind,
)
from heliograph.relays.receiver import relay_gains
from heliograph.relays.second_moments import gain_mask

POWER_TOLERANCE = 1e-6  # relative excess over a limit that counts as met
MARGIN = 1e-5  # the search aims this much below a limit, so that what is left of the multipliers' error does not matter
ROUNDS = 10  # of the multipliers
STIFFNESS = 1000.0  # of the augmented Lagrangian, against a cost that is a logarithm

# value, gradient and power of gains base + x unit at `where`, from x, steps, base, where, unit, limit, multipliers
Cost = Callable[[Array, Steps, Array, tuple[Array, ...], Array, Array, Array], tuple[Array, Array, Array]]


def periodic_receiver_error_design(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> RelayDesign:
    """Design gains of relays and receiver that together make the steady sum over the slots of tr P small.

    Descent through the fixed point of the second moments; the result is a local minimum.

    Args:
        network: the network, which varies with its slots only.
        start: gains to begin with, {filter: (slots, n, received)}; the steady `own_error_design` unless given.
        power_limit: bound on the power that all relays send in each slot, a number or (slots,); none unless given.

    Raises:
        ValueError: what `periodic_steps` refuses, a start of the wrong shape or under which the moments diverge, a
            limit that no gains were found to meet.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    design = periodic_own_error_design(network)
    gains = join_gains(network, design.gains if start is None else start)
    return periodic_given_design(network, split_gains(network, _tune(network, gains, _receiver_cost, power_limit)))


def periodic_relays_for_best_receiver(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> dict[str, Float[np.ndarray, "slots n _"]]:
    """Design relay gains with which the best linear receiver behind them has a small steady sum over the slots of tr P.

    Args:
        network: the network, which varies with its slots only.
        start: relay gains to begin with, {relay: (slots, n, received)}; the steady `own_error_design` unless given.
        power_limit: bound on the power that all relays send in each slot, a number or (slots,); none unless given.

    Returns:
        Gains by relay (slots, n, received); the receiver is `periodic_behind_relays`.

    Raises:
        ValueError: as for `periodic_receiver_error_design`; no relays.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    gains = relay_gains(network, periodic_own_error_design(network).gains if start is None else start)
    tuned = split_gains(network, _tune(network, gains, _behind_cost, power_limit))
    return {name: gain for name, gain in tuned.items() if name != RECEIVER}


def _tune(
    network: RelayNetwork, start: Float[np.ndarray, "slots Fn R"], cost: Cost, power_limit: ArrayLike | None
) -> Float[np.ndarray, "slots Fn R"]:
    """Descend over the free entries of the gains, those of each filter in units of its largest."""
    steps = periodic_steps(network)
    check_slots(network, start)
    # Free entries: those that multiply a received number.
    used = gain_mask(steps) & (steps.live[:, None, :] > 0)
    if cost is _behind_cost:
        used[:, :, -network.received[-1] :] = False
    where = np.nonzero(used)
    unit = _units(network, start)[where]
    slots = len(network.slots)
    limit = np.full(slots, np.inf) if power_limit is None else per_step("power limit", power_limit, slots)
    multipliers, x = np.zeros(slots), np.zeros(len(unit))
    if not np.isfinite(cost(x, steps, start, where, unit, np.full(slots, np.inf), multipliers)[0]):
        raise fail("start of the search", "gains under which second moments converge", "some under which they diverge")
    for _ in range(ROUNDS if power_limit is not None else 1):

        def function(x: np.ndarray, multipliers: np.ndarray = multipliers) -> tuple[float, np.ndarray]:
            value, gradient, _ = cost(x, steps, start, where, unit, limit * (1 - MARGIN), multipliers)
            return float(value), np.asarray(gradient)

        x = bfgs(function, x)
        power = np.asarray(cost(x, steps, start, where, unit, limit, multipliers)[2])
        if _within_limits(power / (limit * (1 - MARGIN)) - 1, multipliers):
            break
        multipliers = np.maximum(0.0, multipliers + STIFFNESS * (power / (limit * (1 - MARGIN)) - 1))
    if np.any(power > limit * (1 + POWER_TOLERANCE)):
        raise fail("power limit", "one that some gains meet", f"an excess of {np.max(power / limit) - 1:.2g}")
    tuned: np.ndarray = start.copy()
    tuned[where] += x * unit
    return tuned


def _within_limits(excess: Float[np.ndarray, "slots"], multipliers: Float[np.ndarray, "slots"]) -> bool:
    """Return whether no slot is above its limit, and those with a multiplier are at it."""
    return bool(np.all(excess < MARGIN / 2) and np.all(excess[multipliers > 0] > -MARGIN))


def _units(network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]) -> Float[np.ndarray, "slots Fn R"]:
    """The largest entry of each filter's gain in each slot, at every entry of that gain."""
    largest = {name: np.max(np.abs(gain), axis=(1, 2)) for name, gain in split_gains(network, gains).items()}
    floor = 1e-3 * max(float(np.max(value)) for value in largest.values())
    return join_gains(
        network,
        {
            name: np.broadcast_to(np.maximum(value, floor)[:, None, None], (len(gains), len(network.states), item))
            for (name, value), item in zip(largest.items(), network.received, strict=True)
        },
    )


def _penalised(
    traces: Float[jax.Array, "slots"],
    sound: Bool[jax.Array, ""],
    power: Float[jax.Array, "slots"],
    limit: Float[Array, "slots"],
    multipliers: Float[Array, "slots"],
) -> Float[jax.Array, ""]:
    """log sum of traces plus sum_k max(0, lambda_k + c g_k)^2 / 2c, g the relative excess; infinite where unsound."""
    total = jnp.sum(traces)
    sound = sound & (total > 0)
    shortage = jnp.maximum(0.0, multipliers + STIFFNESS * (power / limit - 1))
    penalty = jnp.sum(shortage**2) / (2 * STIFFNESS)
    return jnp.where(sound, jnp.log(jnp.where(sound, total, 1.0)) + penalty, jnp.inf)


def _value(traces: Callable[[Steps, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]) -> Cost:
    """Value, gradient and power of a cost given by its traces, soundness and power."""

    def value(
        x: Array, steps: Steps, base: Array, where: tuple[Array, ...], unit: Array, limit: Array, multipliers: Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        def inner(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            trace, sound, power = traces(steps, jnp.asarray(base).at[where].add(x * unit))
            return _penalised(trace, sound, power, limit, multipliers), power

        (result, power), gradient = jax.value_and_grad(inner, has_aux=True)(x)
        return result, gradient, power

    return compiled(value)


def _receiver_traces(steps: Steps, gains: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    result, n = steady(steps, gains), steps.transition.shape[-1]
    last = result.moments[1:, -n:, -n:]
    return jnp.trace(last, axis1=1, axis2=2), is_covariance(result.moments), jnp.sum(result.power[:, 1:], axis=1)


def _behind_traces(steps: Steps, gains: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    result, n = steady(steps, gains), steps.transition.shape[-1]
    spread = steady_behind(steps, gains)
    sound = is_covariance(result.moments[:, :-n, :-n]) & is_covariance(spread)
    return jnp.trace(spread[:, :n, :n], axis1=1, axis2=2), sound, jnp.sum(result.power[:, 1:], axis=1)


_receiver_cost = _value(_receiver_traces)
_behind_cost = _value(_behind_traces)
