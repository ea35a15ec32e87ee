"""Descent over the gains of a relay network's period, with the power of each slot kept below a limit."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

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


class FreeGains(NamedTuple):
    """Gains of a period with n free entries x: base, and base + x unit at the free entries.

    Args:
        steps: the network's steps of one period.
        base: gains of all filters that x changes, one block matrix for each slot.
        where: indices of the free entries in `base`, one array of indices (n,) for each of its three axes.
        unit: the size in which each free entry is measured (n,).
    """

    steps: RelaySteps
    base: Float[Array, "slots Fn R"]
    where: tuple[Array, ...]
    unit: Float[Array, "n"]


class CostOfGains(NamedTuple):
    """Cost of gains, its gradient by the free entries x, and the relays' power in each slot."""

    value: Float[Array, ""]
    gradient: Float[Array, "n"]
    power: Float[Array, "slots"]


class SteadyErrors(NamedTuple):
    """tr P of the receiver in each slot, whether errors converge to this P, and the relays' power in each slot."""

    traces: Float[jax.Array, "slots"]
    converge: Bool[jax.Array, ""]
    power: Float[jax.Array, "slots"]


class Cost(Protocol):
    """Cost of gains as a function of their free entries x, penalised where a slot's power exceeds its limit."""

    def __call__(self, x: Array, gains: FreeGains, limit: Array, multipliers: Array) -> CostOfGains:
        """Return the cost at x (n,) under power limits (slots,), with the multipliers lambda (slots,) of these."""


def minimise_over_gains(
    network: RelayNetwork,
    steps: RelaySteps,
    start: Float[np.ndarray, "slots Fn R"],
    free: Bool[np.ndarray, "R"],
    cost: Cost,
    power_limit: ArrayLike | None,
) -> Float[np.ndarray, "slots Fn R"]:
    """Return the gains of least cost, by descent over the entries that multiply `free` received numbers.

    A limit of power is kept by an augmented Lagrangian: with g_s = power_s / limit_s - 1 in slot s the cost is that of
    `_penalise_power`, and after each descent lambda_s = max(0, lambda_s + STIFFNESS g_s).

    Args:
        network: the relay network.
        steps: those of one period.
        start: gains of all filters with which the descent begins, one block matrix for each slot of the period.
        free: which of the received numbers have gains that may change.
        cost: the penalised cost of gains (`make_penalised_cost`).
        power_limit: of all relays together in each slot; None for no limit.

    Raises:
        ValueError: gains at the start under which moments diverge; a limit that no gains were found to meet.
    """
    # The entries that may change: a filter's own received numbers (`gain_mask`), which arrive in the slot, and are
    # free. The variables x are their changes in units of their filter's largest entry.
    is_free = gain_mask(steps) & (steps.receives_in_slot[:, None, :] > 0) & free  # (slots, F n, R)
    where = np.nonzero(is_free)
    unit = _find_largest_entries(network, start)[where]
    gains = FreeGains(steps=steps, base=start, where=where, unit=unit)
    # A limit for each slot, without effect where no relay transmits. The search aims a margin below it, since power
    # ends a little above or below what is aimed at.
    slots = len(network.slots)
    no_limit = np.full(slots, np.inf)
    limit = no_limit if power_limit is None else repeat_per_step("power limit", power_limit, slots)
    some_relay_transmits = steps.transmits_in_slot[:, 1:].any(axis=1)  # sender 0 is the sensor
    limit = np.where(some_relay_transmits, limit, np.inf)
    aimed_limit = limit * (1 - MARGIN)
    # lambda, a multiplier for the power of each slot.
    multipliers, x = np.zeros(slots), np.zeros(len(unit))
    if not np.isfinite(cost(x, gains, no_limit, multipliers).value):
        raise fail("start of the search", "gains under which second moments converge", "some under which they diverge")
    # Descend, then raise the multipliers of slots above their limit; once where there is no limit.
    for _ in range(ROUNDS if power_limit is not None else 1):
        x = _descend(cost, x, gains, aimed_limit, multipliers)
        power = np.asarray(cost(x, gains, limit, multipliers).power)
        excess = power / aimed_limit - 1
        if _are_within_limits(excess, multipliers):
            break
        multipliers = np.maximum(0.0, multipliers + STIFFNESS * excess)
    if np.any(power > limit * (1 + POWER_TOLERANCE)):
        raise fail("power limit", "one that some gains meet", f"an excess of {np.max(power / limit) - 1:.2g}")
    tuned: np.ndarray = start.copy()
    tuned[where] += x * unit
    return tuned


def _descend(
    cost: Cost,
    start: Float[np.ndarray, "n"],
    gains: FreeGains,
    limit: Float[np.ndarray, "slots"],
    multipliers: Float[np.ndarray, "slots"],
) -> Float[np.ndarray, "n"]:
    """Return the free entries x of the gains at which the cost has a local minimum, found by descent from `start`.

    The power limits and their multipliers lambda stay as they are.
    """

    def evaluate(x: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of x, and its gradient."""
        result = cost(x, gains, limit, multipliers)
        return float(result.value), np.asarray(result.gradient)

    return bfgs(evaluate, start)


def _are_within_limits(excess: Float[np.ndarray, "slots"], multipliers: Float[np.ndarray, "slots"]) -> bool:
    """Return whether no slot's power is above its limit, and the power of slots with a multiplier is at it.

    These are the conditions of a constrained minimum, to the search's MARGIN; `excess` is power / limit - 1.
    """
    return bool(np.all(excess < MARGIN / 2) and np.all(excess[multipliers > 0] > -MARGIN))


def _find_largest_entries(
    network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]
) -> Float[np.ndarray, "slots Fn R"]:
    """Return for every entry of the gains the largest magnitude in its filter's gain in its slot.

    These are the units in which a descent changes the gains.
    """
    largest = {name: np.max(np.abs(gain), axis=(1, 2)) for name, gain in split_gains(network, gains).items()}
    # No unit is below a thousandth of the largest one, since gains in a slot may be small or zero.
    floor = 1e-3 * max(float(np.max(value)) for value in largest.values())
    units = {}
    for (name, value), received in zip(largest.items(), network.received, strict=True):
        shape = len(gains), len(network.states), received
        units[name] = np.broadcast_to(np.maximum(value, floor)[:, None, None], shape)
    return join_gains(network, units)


def _penalise_power(
    traces: Float[jax.Array, "slots"],
    converges: Bool[jax.Array, ""],
    power: Float[jax.Array, "slots"],
    limit: Float[Array, "slots"],
    multipliers: Float[Array, "slots"],
) -> Float[jax.Array, ""]:
    """Return log sum_s trace_s + sum_s max(0, lambda_s + c g_s)^2 / 2c, g = power / limit - 1, c the STIFFNESS.

    In slot s, trace_s is that of the receiver's error covariance, g_s the relative excess over the limit of power, and
    lambda_s its multiplier in an augmented Lagrangian. The value is infinite unless the errors converge (`converges`),
    so that a search turns back.
    """
    total = jnp.sum(traces)
    has_cost = converges & (total > 0)
    excess = jnp.maximum(0.0, multipliers + STIFFNESS * (power / limit - 1))
    penalty = jnp.sum(excess**2) / (2 * STIFFNESS)
    # The logarithm is of 1 where there is no cost, so that no gradient becomes NaN.
    return jnp.where(has_cost, jnp.log(jnp.where(has_cost, total, 1.0)) + penalty, jnp.inf)


def make_penalised_cost(compute_errors: Callable[[RelaySteps, jax.Array], SteadyErrors]) -> Cost:
    """Return a compiled function that gives a period's gains their cost, its gradient, and the power of each slot.

    Relay gains are designed for a small error under power limits, by a descent of this cost. P_s is the error
    covariance in slot s of a period, and g_s = power_s / limit_s - 1 <= 0 its power limit. The cost is
    log sum_s tr P_s + sum_s max(0, lambda_s + c g_s)^2 / 2c, the augmented Lagrangian with multipliers lambda_s and a
    constant c; infinite where the moments do not converge.

    Args:
        compute_errors: from the steps of a period and its gains (slots, F n, R) to tr P_s of each slot, whether the
            moments converge, and the power of each slot.
    """

    def evaluate(x: Array, gains: FreeGains, limit: Array, multipliers: Array) -> CostOfGains:
        """Return the penalised cost of gains, its gradient by x (n,), and the slots' powers (slots,).

        Args:
            x: changes of the n free entries of the gains (n,), in units of `gains.unit`.
            gains: the gains that x changes, and which of their entries.
            limit: greatest power of each slot (slots,).
            multipliers: lambda_s (slots,).
        """

        def compute_cost_and_power(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return the penalised cost of the gains changed by x, and beside it the slots' powers."""
            changed_gains = jnp.asarray(gains.base).at[gains.where].add(x * gains.unit)
            errors = compute_errors(gains.steps, changed_gains)
            cost = _penalise_power(errors.traces, errors.converge, errors.power, limit, multipliers)
            return cost, errors.power

        (cost, power), gradient = jax.value_and_grad(compute_cost_and_power, has_aux=True)(x)
        return CostOfGains(value=cost, gradient=gradient, power=power)

    return compile_in_float64(evaluate)
