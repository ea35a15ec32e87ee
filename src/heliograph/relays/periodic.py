"""The periodic steady state of a relay network, slots in turn for ever, and gains tuned for it by descent."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.jump_system import make_entry_matrix, propagate_by_mode, solve_fixed_point
from heliograph.model.over_time import steps_covered
from heliograph.model.relays import RECEIVER, RelayNetwork, RelaySteps
from heliograph.numerics.check import fail, instance, repeat_per_step
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.relays.bfgs import bfgs
from heliograph.relays.design import (
    GainsByFilter,
    RelayDesign,
    RelaySide,
    as_design,
    join_gains,
    relay_gains,
    relay_side,
    split_gains,
    start_moments,
)
from heliograph.relays.error_moments import Propagated, correct_moments, gain_mask, propagate_slots, regression_gain

CONVERGED = 1e-13  # relative change of the moments over a period
PERIODS = 100_000
HELD = 1e-9  # the same for a covariance that only gives gains: their error enters it squared
INDEFINITE = 1e-9  # relative: a fixed point below this is no covariance, so the moments would diverge

SteadyState = tuple[jax.Array, jax.Array, jax.Array]  # a value, its last relative change, and the periods so far


def periodic_steps(network: RelayNetwork) -> RelaySteps:
    """Return the steps of one period, at the stationary mean of the state."""
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    if steps_covered(network) is not None:
        raise fail("steady state", "a network that varies with its slots only", "parts that are OverTime")
    steps = network.steps(len(network.slots))
    radius = spectral_radius(steps.transition[0])
    if radius >= 1:
        raise fail("steady state", "a plant with spectral radius below 1", f"{radius:.6g}")
    mean = np.linalg.solve(np.eye(len(network.states)) - steps.transition[0], steps.drift[0])
    steady_steps: RelaySteps = eqx.tree_at(lambda s: s.state_mean, steps, np.broadcast_to(mean, steps.state_mean.shape))
    return steady_steps


def periodic_local_error_design(network: RelayNetwork) -> RelayDesign:
    """Return the steady state of `local_error_design` of a `network`: gains and moments over one period.

    Args:
        network: relays that filter, in slots that repeat.

    Raises:
        ValueError: what `periodic_steps` refuses, or moments that do not converge.
    """
    propagated, change = _solve_local_steady(periodic_steps(network), start_moments(network))
    if not change <= CONVERGED:
        raise fail("steady state", "moments that converge", f"a change of {float(change):.2g} after {PERIODS} periods")
    return as_design(network, propagated)


def periodic_given_design(network: RelayNetwork, gains: GainsByFilter) -> RelayDesign:
    """Return the steady state of a `network` under given gains, one entry per slot: {filter: (slots, n, received)}.

    The moments over a period are an affine map of those before; its fixed point is found by one linear solve.

    Args:
        network: relays that filter, in slots that repeat.
        gains: K by filter, (slots, n, received).

    Raises:
        ValueError: gains of the wrong shape, or gains under which the second moments diverge.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    joined = join_gains(network, gains)
    return as_design(network, _steady(_check_converging(network, joined), joined))


def periodic_behind_relays(network: RelayNetwork, gains: GainsByFilter) -> Float[np.ndarray, "slots n n"]:
    """Return the steady error covariance of the best linear receiver behind given relays, at the end of each slot.

    Args:
        network: the network, which varies with its slots only.
        gains: relay gains by name (slots, n, received).

    Raises:
        ValueError: gains of the wrong shape, or gains under which the second moments diverge.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    joined, n = relay_gains(network, gains), len(network.states)
    return np.asarray(_steady_behind(_check_converging(network, joined), joined))[:, :n, :n]


def _check_converging(network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]) -> RelaySteps:
    """Return the steps of one period, checked for gains under which the second moments converge."""
    check_slots(network, gains)
    steps = periodic_steps(network)
    radius = spectral_radius(np.asarray(_period_operator(steps, gains)))
    if not radius < 1:
        raise fail("periodic gains", "second moments that converge", f"growth by {radius:.4g} per period")
    return steps


def check_slots(network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]) -> None:
    """Raise ValueError where there is not one gain for each slot."""
    if len(gains) != len(network.slots):
        raise fail("periodic gains", f"one for each of the {len(network.slots)} slots", len(gains))


def affine_fixed_point(step: Callable[[jax.Array], jax.Array], d: int) -> Float[jax.Array, "{d} {d}"]:
    """Return M = step(M) for an affine map of symmetric (d, d) matrices."""
    constant, linear = jax.linearize(step, jnp.zeros((d, d)))
    return jnp.asarray(solve_fixed_point(jax.vmap(linear), constant))


def steady_moments(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> Propagated:
    """Return moments over a period that ends as it begins; differentiable in the gains, valid where `is_covariance`."""
    d = gains.shape[1] + steps.transition.shape[-1]
    return propagate_slots(steps, affine_fixed_point(lambda m: propagate_slots(steps, m, gains).moments[-1], d), gains)


def is_covariance(moments: Float[Array, "... d d"]) -> Bool[jax.Array, ""]:
    """Return whether all moments are positive semidefinite to rounding: the fixed point is then the limit."""
    fixed = jax.lax.stop_gradient(moments)
    smallest: jax.Array = jnp.min(jnp.linalg.eigvalsh(fixed))
    return smallest > -INDEFINITE * jnp.max(jnp.abs(fixed))


def steady_receiver_covariance(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> Float[jax.Array, "slots d d"]:
    """Return the steady error covariances of the best linear estimate of (x, e_relays) from the receiver's data.

    The receiver's gains are held while differentiating: they minimise the error, so their change has no first-order
    effect, and the fixed point with given gains is affine.
    """
    moments = steady_moments(steps, gains).moments[:-1]
    side = jax.vmap(relay_side)(steps, moments, gains)
    d = side.transition.shape[-1]

    def predict(spread: jax.Array, at_slot: RelaySide) -> jax.Array:
        both = jnp.concatenate([at_slot.transition, at_slot.output])
        return jnp.asarray(propagate_by_mode(both, spread, at_slot.noise))

    # Riccati recursion of the receiver, held constant under differentiation.
    def best(spread: jax.Array, at_slot: RelaySide) -> tuple[jax.Array, jax.Array]:
        z = predict(spread, at_slot)
        gain = regression_gain(z[:d, d:], z[d:, d:])  # zero in a slot in which nobody transmits to the receiver
        return correct_moments(z, gain), gain

    held = jax.lax.stop_gradient(side)
    converged = _solve_steady(
        lambda e: jax.lax.scan(best, e, held)[0], jax.lax.stop_gradient(moments[0][:d, :d]), HELD
    )[0]
    # Best gains over one period, from the converged covariance.
    best_gains = jax.lax.stop_gradient(jax.lax.scan(best, converged, held)[1])

    # With these gains the fixed point is one linear solve.
    def given(spread: jax.Array, row: tuple[RelaySide, jax.Array]) -> tuple[jax.Array, jax.Array]:
        at_slot, gain = row
        after = correct_moments(predict(spread, at_slot), gain)
        return after, after

    def period(spread: jax.Array) -> tuple[jax.Array, jax.Array]:
        return jax.lax.scan(given, spread, (side, best_gains))

    return jnp.asarray(period(affine_fixed_point(lambda e: period(e)[0], d))[1])


_steady = compile_in_float64(steady_moments)
_steady_behind = compile_in_float64(steady_receiver_covariance)


@compile_in_float64
def _period_operator(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> Float[jax.Array, "e e"]:
    """Return the linear part of the map of second moments over one period."""
    d = gains.shape[1] + steps.transition.shape[-1]
    _, linear = jax.linearize(lambda m: propagate_slots(steps, m, gains).moments[-1], jnp.zeros((d, d)))
    return jnp.asarray(make_entry_matrix(jax.vmap(linear), (d, d)))


@compile_in_float64
def _solve_local_steady(steps: RelaySteps, start: Float[Array, "d d"]) -> tuple[Propagated, Float[jax.Array, ""]]:
    """Repeat the period until its moments change by less than CONVERGED."""

    moments, change = _solve_steady(lambda m: propagate_slots(steps, m).moments[-1], jnp.asarray(start), CONVERGED)
    return propagate_slots(steps, moments), change


def _solve_steady(
    period: Callable[[jax.Array], jax.Array], start: jax.Array, tolerance: float
) -> tuple[jax.Array, jax.Array]:
    """Repeat until the relative change is below `tolerance`; returns the last value and its change."""

    def again(carry: SteadyState) -> SteadyState:
        value, _, count = carry
        after = period(value)
        size = jnp.maximum(jnp.max(jnp.abs(after)), np.finfo(float).tiny)
        return after, jnp.max(jnp.abs(after - value)) / size, count + 1

    def going(carry: SteadyState) -> jax.Array:
        return (carry[1] > tolerance) & (carry[2] < PERIODS)

    value, change, _ = jax.lax.while_loop(going, again, (start, jnp.asarray(jnp.inf), jnp.asarray(0)))
    return value, change


POWER_TOLERANCE = 1e-6  # relative excess over a limit that counts as met
MARGIN = 1e-5  # the search aims this much below a limit, so that what is left of the multipliers' error does not matter
ROUNDS = 10  # of the multipliers
STIFFNESS = 1000.0  # of the augmented Lagrangian, against a cost that is a logarithm

# value, gradient and power of gains base + x unit at `where`, from x, steps, base, where, unit, limit, multipliers
Cost = Callable[[Array, RelaySteps, Array, tuple[Array, ...], Array, Array, Array], tuple[Array, Array, Array]]


def periodic_receiver_error_design(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> RelayDesign:
    """Design gains of relays and receiver that together make the steady sum over the slots of tr P small.

    Descent through the fixed point of the second moments; the result is a local minimum.

    Args:
        network: the network, which varies with its slots only.
        start: gains to begin with, {filter: (slots, n, received)}; the steady `local_error_design` unless given.
        power_limit: bound on the power that all relays send in each slot, a number or (slots,); none unless given.

    Raises:
        ValueError: what `periodic_steps` refuses, a start of the wrong shape or under which the moments diverge, a
            limit that no gains were found to meet.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    design = periodic_local_error_design(network)
    gains = join_gains(network, design.gains if start is None else start)
    return periodic_given_design(
        network, split_gains(network, _minimise_over_gains(network, gains, _receiver_cost, power_limit))
    )


def periodic_relays_for_best_receiver(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> dict[str, Float[np.ndarray, "slots n _"]]:
    """Design relay gains with which the best linear receiver behind them has a small steady sum over the slots of tr P.

    Args:
        network: the network, which varies with its slots only.
        start: relay gains to begin with, {relay: (slots, n, received)}; the steady `local_error_design` unless given.
        power_limit: bound on the power that all relays send in each slot, a number or (slots,); none unless given.

    Returns:
        Gains by relay (slots, n, received); the receiver is `periodic_behind_relays`.

    Raises:
        ValueError: as for `periodic_receiver_error_design`; no relays.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    gains = relay_gains(network, periodic_local_error_design(network).gains if start is None else start)
    tuned = split_gains(network, _minimise_over_gains(network, gains, _behind_cost, power_limit))
    return {name: gain for name, gain in tuned.items() if name != RECEIVER}


def _minimise_over_gains(
    network: RelayNetwork, start: Float[np.ndarray, "slots Fn R"], cost: Cost, power_limit: ArrayLike | None
) -> Float[np.ndarray, "slots Fn R"]:
    """Minimise a cost over the free entries of the gains by descent, those of each filter in units of its largest.

    A limit of power is kept by an augmented Lagrangian: with g_s = power_s / limit_s - 1 in slot s the cost is that of
    `_penalise`, and after each descent lambda_s = max(0, lambda_s + STIFFNESS g_s).
    """
    steps = periodic_steps(network)
    check_slots(network, start)
    # Free entries: those that multiply a received number.
    used = gain_mask(steps) & (steps.receives_in_slot[:, None, :] > 0)
    if cost is _behind_cost:  # the receiver, whose columns are the last, is the best one whatever the relays do
        used[:, :, -network.received[-1] :] = False
    where = np.nonzero(used)
    unit = _find_largest_entries(network, start)[where]
    # Scaled gains x, and a multiplier for the power of each slot.
    slots = len(network.slots)
    limit = np.full(slots, np.inf) if power_limit is None else repeat_per_step("power limit", power_limit, slots)
    limit = np.where(
        steps.transmits_in_slot[:, 1:].any(axis=1), limit, np.inf
    )  # silent relays send nothing, whatever they may
    multipliers, x = np.zeros(slots), np.zeros(len(unit))
    if not np.isfinite(cost(x, steps, start, where, unit, np.full(slots, np.inf), multipliers)[0]):
        raise fail("start of the search", "gains under which second moments converge", "some under which they diverge")
    # Augmented Lagrangian: descend, then raise the multipliers of slots above their limit.
    for _ in range(ROUNDS if power_limit is not None else 1):

        def function(x: np.ndarray, multipliers: np.ndarray = multipliers) -> tuple[float, np.ndarray]:
            # Within the limit by a margin, since the multipliers only come near it.
            value, gradient, _ = cost(x, steps, start, where, unit, limit * (1 - MARGIN), multipliers)
            return float(value), np.asarray(gradient)

        x = bfgs(function, x)
        power = np.asarray(cost(x, steps, start, where, unit, limit, multipliers)[2])
        if _within_limits(power / (limit * (1 - MARGIN)) - 1, multipliers):
            break
        multipliers = np.maximum(0.0, multipliers + STIFFNESS * (power / (limit * (1 - MARGIN)) - 1))
    # Gains in their units again.
    if np.any(power > limit * (1 + POWER_TOLERANCE)):
        raise fail("power limit", "one that some gains meet", f"an excess of {np.max(power / limit) - 1:.2g}")
    tuned: np.ndarray = start.copy()
    tuned[where] += x * unit
    return tuned


def _within_limits(excess: Float[np.ndarray, "slots"], multipliers: Float[np.ndarray, "slots"]) -> bool:
    """Return whether no slot is above its limit, and those with a multiplier are at it."""
    return bool(np.all(excess < MARGIN / 2) and np.all(excess[multipliers > 0] > -MARGIN))


def _find_largest_entries(
    network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]
) -> Float[np.ndarray, "slots Fn R"]:
    """Return the largest entry of each filter's gain in each slot, at every entry of that gain."""
    largest = {name: np.max(np.abs(gain), axis=(1, 2)) for name, gain in split_gains(network, gains).items()}
    floor = 1e-3 * max(float(np.max(value)) for value in largest.values())
    return join_gains(
        network,
        {
            name: np.broadcast_to(np.maximum(value, floor)[:, None, None], (len(gains), len(network.states), size))
            for (name, value), size in zip(largest.items(), network.received, strict=True)
        },
    )


def _penalise(
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


def _make_penalised_cost(traces: Callable[[RelaySteps, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]) -> Cost:
    """Return the value, gradient and power of a cost given by its traces, soundness and power."""

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

        def inner(x: jax.Array) -> tuple[jax.Array, jax.Array]:
            trace, sound, power = traces(steps, jnp.asarray(base).at[where].add(x * unit))
            return _penalise(trace, sound, power, limit, multipliers), power

        (cost, power), gradient = jax.value_and_grad(inner, has_aux=True)(x)
        return cost, gradient, power

    return compile_in_float64(evaluate)


def _receiver_traces(steps: RelaySteps, gains: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    end, n = steady_moments(steps, gains), steps.transition.shape[-1]
    last = end.moments[1:, -n:, -n:]
    return jnp.trace(last, axis1=1, axis2=2), is_covariance(end.moments), jnp.sum(end.power[:, 1:], axis=1)


def _trace_receiver_errors(steps: RelaySteps, gains: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the traces of the receiver's error, whether its covariances are sound, and the relays' powers."""
    end, n = steady_moments(steps, gains), steps.transition.shape[-1]
    spread = steady_receiver_covariance(steps, gains)
    sound = is_covariance(end.moments[:, :-n, :-n]) & is_covariance(spread)
    return jnp.trace(spread[:, :n, :n], axis1=1, axis2=2), sound, jnp.sum(end.power[:, 1:], axis=1)


_receiver_cost = _make_penalised_cost(_receiver_traces)
_behind_cost = _make_penalised_cost(_trace_receiver_errors)
