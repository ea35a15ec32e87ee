"""The periodic steady state of a relay network, slots in turn for ever, and gains tuned for it by descent."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.linear.jump_system import make_matrix_on_triangle_entries, propagate_by_mode, solve_fixed_point
from heliograph.model.over_time import steps_covered
from heliograph.model.relays import RECEIVER, RelayNetwork, RelaySteps
from heliograph.numerics.check import fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.relays.design import (
    GainsByFilter,
    RelayDesign,
    initial_error_covariance,
    join_gains,
    make_design,
    relay_gains,
    split_gains,
)
from heliograph.relays.error_moments import PropagatedMoments, correct_moments, propagate_error_moments, regression_gain
from heliograph.relays.power_limited_descent import Cost, SteadyErrors, make_penalised_cost, minimise_over_gains
from heliograph.relays.receiver import ReceiverViewOfRelays, make_receiver_view

CONVERGED = 1e-13  # relative change of the moments over a period
PERIODS = 100_000
GAINS_CONVERGED = 1e-9  # the same for a covariance that only gives gains: their error enters it squared
INDEFINITE = 1e-9  # relative: a fixed point below this is no covariance, so the moments would diverge

RepeatedPeriods = tuple[jax.Array, jax.Array, jax.Array]  # a value, its last relative change, and the periods so far


def periodic_steps(network: RelayNetwork) -> RelaySteps:
    """Return the steps of one period, one for each slot of the schedule, at the stationary mean of the state.

    Slots change links only, so the plant's step is that of the first slot, and the mean solves m = A m + b.

    Raises:
        ValueError: a network that varies beyond its slots, a plant that is not stable.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    if steps_covered(network) is not None:
        raise fail("steady state", "a network that varies with its slots only", "parts that are OverTime")
    steps = network.steps(len(network.slots))
    radius = spectral_radius(steps.transition[0])
    if radius >= 1:
        raise fail("steady state", "a plant with spectral radius below 1", f"{radius:.6g}")
    mean = np.linalg.solve(np.eye(len(network.states)) - steps.transition[0], steps.drift[0])
    # The steps with E x = m before each in place of the mean that runs in from the start.
    steady_steps: RelaySteps = eqx.tree_at(lambda s: s.state_mean, steps, np.broadcast_to(mean, steps.state_mean.shape))
    return steady_steps


def periodic_local_error_design(network: RelayNetwork) -> RelayDesign:
    """Return the steady state of `local_error_design` of a `network`: gains and moments over one period of its slots.

    Each filter minimises its own next error in each slot. The period is repeated until the moments are steady, at most
    PERIODS times.

    Args:
        network: relays that filter, in slots that repeat.

    Raises:
        ValueError: what `periodic_steps` refuses, or moments that do not converge.
    """
    propagated, change = _iterate_local_design(periodic_steps(network), initial_error_covariance(network))
    if not change <= CONVERGED:
        raise fail("steady state", "moments that converge", f"a change of {float(change):.2g} after {PERIODS} periods")
    return make_design(network, propagated)


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
    return make_design(network, _steady(_make_converging_steps(network, joined), joined))


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
    # Of (x, errors of the relays), which the receiver estimates, x comes first.
    return np.asarray(_steady_behind(_make_converging_steps(network, joined), joined))[:, :n, :n]


def _make_converging_steps(network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]) -> RelaySteps:
    """Return the steps of one period, one for each slot; raise ValueError if moments diverge under these gains.

    Second moments follow an affine map over a period; they converge if its linear part has a spectral radius below 1.
    """
    check_gains_of_slots(network, gains)
    steps = periodic_steps(network)
    radius = spectral_radius(np.asarray(_period_operator(steps, gains)))
    if not radius < 1:
        raise fail("periodic gains", "second moments that converge", f"growth by {radius:.4g} per period")
    return steps


def check_gains_of_slots(network: RelayNetwork, gains: Float[np.ndarray, "slots Fn R"]) -> None:
    """Raise ValueError unless `gains` has one block matrix of all filters' gains for each slot of the schedule."""
    if len(gains) != len(network.slots):
        raise fail("periodic gains", f"one for each of the {len(network.slots)} slots", len(gains))


def affine_fixed_point(step: Callable[[jax.Array], jax.Array], d: int) -> Float[jax.Array, "{d} {d}"]:
    """Return M = step(M) for an affine map of symmetric (d, d) matrices, M -> constant + linear(M), by a linear solve.

    The map is linearised at 0: its value there is the constant, its derivative there the linear part.
    """
    constant, linear = jax.linearize(step, jnp.zeros((d, d)))
    return jnp.asarray(solve_fixed_point(jax.vmap(linear), constant))


def steady_moments(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> PropagatedMoments:
    """Return the moments over a period that ends with the moments with which it begins.

    The moments, of size d (x and all filters' errors), after a period are an affine map of those before it. The start
    is the fixed point of this map, and is differentiable in the gains. If the moments diverge, there is a fixed point
    too, but it is no covariance (`is_covariance`).
    """
    d = gains.shape[1] + steps.transition.shape[-1]  # F n for the errors, and n for x
    start = affine_fixed_point(lambda m: propagate_error_moments(steps, m, gains).moments[-1], d)
    return propagate_error_moments(steps, start, gains)


def is_covariance(moments: Float[Array, "... d d"]) -> Bool[jax.Array, ""]:
    """Return whether the moments at a fixed point over a period are positive semidefinite up to rounding (INDEFINITE).

    If they are, moments converge to this fixed point; if not, they diverge.
    """
    fixed = jax.lax.stop_gradient(moments)  # only decided: nothing is differentiated
    smallest: jax.Array = jnp.min(jnp.linalg.eigvalsh(fixed))
    return smallest > -INDEFINITE * jnp.max(jnp.abs(fixed))


def steady_receiver_covariance(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> Float[jax.Array, "slots d d"]:
    """Return the steady error covariances of the best linear estimate of (x, e_relays) from the receiver's data.

    In each slot the receiver observes zeta+ = A zeta + noise, z = C zeta + noise with zeta = (x, e_relays) (d,). The
    result has the covariances of zeta - its estimate at the end of each slot of a period. The receiver's gains are held
    while differentiating: they minimise the error, so their change has no first-order effect, and the fixed point with
    given gains is affine.

    Args:
        steps: of one period.
        gains: of all filters as one block matrix for each slot; those of the receiver are not used.
    """
    moments = steady_moments(steps, gains).moments[:-1]
    views = jax.vmap(make_receiver_view)(steps, moments, gains)
    d = views.transition.shape[-1]

    def predict(covariance: jax.Array, view: ReceiverViewOfRelays) -> jax.Array:
        """Return the error covariance [A; C] P [A; C]' + Cov noise of (zeta+, z), before the correction."""
        both = jnp.concatenate([view.transition, view.output])
        return jnp.asarray(propagate_by_mode(both, covariance, view.noise))

    def correct_best(covariance: jax.Array, view: ReceiverViewOfRelays) -> tuple[jax.Array, jax.Array]:
        """Take one Riccati step: return the error covariance of zeta after a slot, and the receiver's best gain."""
        joint = predict(covariance, view)  # with the measurement, before the correction
        gain = regression_gain(joint[:d, d:], joint[d:, d:])  # zero in a slot without data for the receiver
        return correct_moments(joint, gain), gain

    def correct_with(covariance: jax.Array, row: tuple[ReceiverViewOfRelays, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Take one step with a given gain: return the covariance after a slot twice, to go on with and to collect."""
        view, gain = row
        corrected = correct_moments(predict(covariance, view), gain)
        return corrected, corrected

    # The receiver's steady gains: its Riccati recursion over periods, without derivatives.
    constant_views = jax.lax.stop_gradient(views)

    def run_best_period(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the covariance at the end of a period, and the best gain of each of its slots."""
        return jax.lax.scan(correct_best, covariance, constant_views)

    start = jax.lax.stop_gradient(moments[0][:d, :d])
    steady_start, _ = _repeat_until_steady(lambda e: run_best_period(e)[0], start, GAINS_CONVERGED)
    best_gains = jax.lax.stop_gradient(run_best_period(steady_start)[1])

    # With these gains the fixed point is one linear solve.
    def run_period(covariance: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the covariances at the end of a period, and of each of its slots."""
        return jax.lax.scan(correct_with, covariance, (views, best_gains))

    _, covariances = run_period(affine_fixed_point(lambda e: run_period(e)[0], d))
    return jnp.asarray(covariances)


_steady = compile_in_float64(steady_moments)
_steady_behind = compile_in_float64(steady_receiver_covariance)


@compile_in_float64
def _period_operator(steps: RelaySteps, gains: Float[Array, "slots Fn R"]) -> Float[jax.Array, "e e"]:
    """Return the linear part of the map of second moments over one period, a matrix on the entries of a triangle.

    The moments are Cov(x, e_1 .. e_F), of the state and all filters' errors; a symmetric matrix is given by the e
    entries of its upper triangle. The map is affine, so it may be linearised anywhere, here at 0. Its spectral radius
    says whether moments converge under these `gains`, one block matrix for each of the period's `steps`.
    """
    d = gains.shape[1] + steps.transition.shape[-1]
    _, linear = jax.linearize(lambda m: propagate_error_moments(steps, m, gains).moments[-1], jnp.zeros((d, d)))
    return jnp.asarray(make_matrix_on_triangle_entries(jax.vmap(linear), (d, d)))


@compile_in_float64
def _iterate_local_design(
    steps: RelaySteps, start: Float[Array, "d d"]
) -> tuple[PropagatedMoments, Float[jax.Array, ""]]:
    """Repeat a period in which each filter minimises its own next error, until it ends with the covariance it began.

    `start` is a covariance of (x, e_1 .. e_F), of the state and the filters' errors. It is steady where it changes over
    a period by less than CONVERGED, relative to its largest entry.

    Returns:
        Gains, covariances and the senders' powers over the last period, and the last relative change.
    """

    def run_period(covariance: jax.Array) -> jax.Array:
        """Return the covariance after a period, with the gains that minimise each filter's own next error."""
        return propagate_error_moments(steps, covariance).moments[-1]

    steady_covariance, change = _repeat_until_steady(run_period, jnp.asarray(start), CONVERGED)
    return propagate_error_moments(steps, steady_covariance), change


def _repeat_until_steady(
    period: Callable[[jax.Array], jax.Array], start: jax.Array, tolerance: float
) -> tuple[jax.Array, jax.Array]:
    """Repeat a period until its relative change is below `tolerance`; return the last value and its change.

    Args:
        period: from the covariance before a period to that after it.
        start: the covariance before the first.
        tolerance: on the change of a covariance over a period, relative to its largest entry. After PERIODS periods the
            last value is returned whatever its change is.
    """

    def repeat(carry: RepeatedPeriods) -> RepeatedPeriods:
        """Return the value after one more `period`, its change (relative to its largest entry), and their count."""
        value, _change_before, count = carry  # a matrix, its last change, and the number of periods so far
        value_after = period(value)
        size = jnp.maximum(jnp.max(jnp.abs(value_after)), np.finfo(float).tiny)
        change = jnp.max(jnp.abs(value_after - value)) / size
        return value_after, change, count + 1

    def changes(carry: RepeatedPeriods) -> jax.Array:
        """Return whether to repeat once more: the last change is above the tolerance, and periods are left."""
        _, change, count = carry
        return (change > tolerance) & (count < PERIODS)

    value, change, _ = jax.lax.while_loop(changes, repeat, (start, jnp.asarray(jnp.inf), jnp.asarray(0)))
    return value, change


def periodic_receiver_error_design(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> RelayDesign:
    """Design gains of relays and receiver that together make the steady sum over the slots of tr P small.

    P is the receiver's error covariance. Slots are turns of the senders, which repeat. The descent goes through the
    fixed point of the second moments, and ends in a local minimum.

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
    free = np.ones(gains.shape[-1], dtype=bool)
    tuned = _tune_gains(network, gains, free, _receiver_cost, power_limit)
    return periodic_given_design(network, split_gains(network, tuned))


def periodic_relays_for_best_receiver(
    network: RelayNetwork, start: GainsByFilter | None = None, power_limit: "Float[ArrayLike, '*slots'] | None" = None
) -> dict[str, Float[np.ndarray, "slots n _"]]:
    """Design relay gains with which the best linear receiver behind them has a small steady sum over the slots of tr P.

    P is the error covariance of the best linear receiver. Relays that filter well for themselves need not be the best
    for the receiver: these gains are tuned for it, by a search that begins at `start`. A slot is one step of the period
    in which links repeat.

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
    # Relay gains at the start as one matrix for each slot.
    gains = relay_gains(network, periodic_local_error_design(network).gains if start is None else start)
    # Columns of the matrix are received numbers, those of the receiver last. Its gains are not free: it is the best
    # receiver whatever the relays do.
    received = gains.shape[-1]
    is_free = np.arange(received) < received - network.received[-1]
    tuned = _tune_gains(network, gains, is_free, _best_receiver_cost, power_limit)
    return {name: gain for name, gain in split_gains(network, tuned).items() if name != RECEIVER}


def _tune_gains(
    network: RelayNetwork,
    start: Float[np.ndarray, "slots Fn R"],
    free: Bool[np.ndarray, "R"],
    cost: Cost,
    power_limit: ArrayLike | None,
) -> Float[np.ndarray, "slots Fn R"]:
    """Return the gains of least cost that a descent from `start` finds, for the periodic steady state.

    Args:
        network: the relay network, which varies with its slots only.
        start: gains of all filters, one block matrix for each slot.
        free: True for the received numbers whose gains may change.
        cost: the cost of gains, with a penalty of power.
        power_limit: of all relays together in each slot; None for no limit.

    Raises:
        ValueError: what `periodic_steps` and `minimise_over_gains` refuse, another number of gains than slots.
    """
    steps = periodic_steps(network)
    check_gains_of_slots(network, start)
    return minimise_over_gains(network, steps, start, free, cost, power_limit)


def _trace_receiver_errors(steps: RelaySteps, gains: jax.Array) -> SteadyErrors:
    """Return tr P of the receiver in the steady state by slot, whether errors converge to it, and the relays' powers.

    P is the receiver's error covariance after a slot, with the `gains` of relays and receiver. Errors converge if the
    fixed point of their covariance is positive semidefinite.
    """
    steady, n = steady_moments(steps, gains), steps.transition.shape[-1]
    # Covariances of (x, e_1 .. e_F) before the first slot and after each, of which the last n entries are the
    # receiver's error.
    receiver = steady.moments[1:, -n:, -n:]
    relay_powers = jnp.sum(steady.power[:, 1:], axis=1)  # sender 0 is the sensor
    return SteadyErrors(
        traces=jnp.trace(receiver, axis1=1, axis2=2), converge=is_covariance(steady.moments), power=relay_powers
    )


def _trace_best_receiver_errors(steps: RelaySteps, gains: jax.Array) -> SteadyErrors:
    """Return tr P of the best receiver in the steady state by slot, whether errors converge, and the relays' powers.

    P is the error covariance of the best linear estimate from what the receiver gets, behind relays with these `gains`.
    Errors converge if the fixed points of their covariances are positive semidefinite.
    """
    steady, n = steady_moments(steps, gains), steps.transition.shape[-1]
    covariance = steady_receiver_covariance(steps, gains)
    # The last n entries of each covariance are left out: they are of a receiver with its part of `gains`.
    do_converge = is_covariance(steady.moments[:, :-n, :-n]) & is_covariance(covariance)
    relay_powers = jnp.sum(steady.power[:, 1:], axis=1)  # sender 0 is the sensor
    traces = jnp.trace(covariance[:, :n, :n], axis1=1, axis2=2)  # of x, which stands before the relays' errors
    return SteadyErrors(traces=traces, converge=do_converge, power=relay_powers)


_receiver_cost = make_penalised_cost(_trace_receiver_errors)
_best_receiver_cost = make_penalised_cost(_trace_best_receiver_errors)
