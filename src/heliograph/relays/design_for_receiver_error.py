"""Relays and receiver tuned together, over a horizon, so that the receiver's error is small; power may be bounded."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RelayNetwork, RelaySteps
from heliograph.numerics.check import array, check_count, fail, instance
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float, Int
from heliograph.relays.design import (
    RelayDesign,
    given_design,
    initial_error_covariance,
    join_gains,
    local_error_design,
    make_receiver_cost,
    split_gains,
)
from heliograph.relays.error_moments import (
    correct_moments,
    minimise_cost_ahead,
    moment_adjoint,
    propagate_error_moments,
    step_moments,
)
from heliograph.relays.power_limit import PowerLimitedProblem, make_power_limit, minimise_within_limit

QUASI_NEWTON_STEPS = 4  # of a descent within a power limit, for each sweep that the caller asks for


def receiver_error_design(
    network: RelayNetwork,
    horizon: int,
    weights: "Float[ArrayLike, ' horizon'] | None" = None,
    power_limit: "Float[ArrayLike, '*horizon'] | None" = None,
    sweeps: int = 200,
) -> RelayDesign:
    """Design gains of relays and receiver that make sum_k weight_k tr P_k small, P_k the receiver's covariance.

    The cost is quadratic in the gains K of one step k while those of other steps stay: tr Lam_k [I -K] Z_k [I -K]'.
    Z_k is the covariance of (state and errors before the correction, innovations), which the steps before give, and
    Lam_k the gradient of the cost of later steps by the covariance after step k. A sweep goes backward for Lam and then
    forward for Z, and minimises exactly at each step, so the cost never rises; it starts from `local_error_design`. The
    result is a local minimum, so an upper bound on the best.

    With a power limit the gains of all steps move at once, inside a logarithmic barrier that is lowered bit by bit, in
    four quasi-Newton steps for a sweep; the own-error design stays the result where it meets the limit and is better. A
    limit changed by 1e-14 to 1e-8 changes the remaining error by 0.1 % over the published example's 100 steps.

    Args:
        network: the relay network.
        horizon: number of steps.
        weights: weight_k (horizon,); those that give the mean of tr P_k / tr P_k(own-error design) unless given.
        power_limit: bound on the power that all relays send at each step, a number or (horizon,), in squared units of
            the sensor, met to 1e-6; none unless given. It can't be less than the power of the mean state, which every
            unbiased estimate sends.
        sweeps: number of sweeps, 200 unless given.

    Raises:
        ValueError: weights or limits of the wrong shape, negative weights, no sweeps, a limit that no design meets.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    check_count("sweeps", sweeps)
    design = local_error_design(network, horizon)
    weights = 1 / (horizon * design.trace("receiver")[1:]) if weights is None else array("weights", weights, (horizon,))
    if np.any(weights < 0) or sweeps < 1:
        raise fail("weights and sweeps", "no negative weight and at least one sweep", f"{np.min(weights):g}, {sweeps}")
    steps, start = network.steps(horizon), initial_error_covariance(network)
    cost = make_receiver_cost(weights, len(network.filters), len(network.states))
    # Both searches begin with the gains with which each filter minimises its own error.
    local_gains = join_gains(network, design.gains)
    if power_limit is None:
        gains = _alternate_sweeps(steps, start, cost, local_gains, np.arange(sweeps))
    else:
        limit = make_power_limit(steps, power_limit, start.shape[0])
        problem = PowerLimitedProblem(steps=steps, start=start, cost=cost, power=limit)
        gains = minimise_within_limit(problem, local_gains, QUASI_NEWTON_STEPS * sweeps)
    return given_design(network, split_gains(network, np.asarray(gains)))


def _sweep_backward(
    steps: RelaySteps, start: Array, cost: Float[Array, "time d d"], gains: jax.Array
) -> Float[jax.Array, "time d d"]:
    """Return the gradient Lam_k of the cost by the moments after each step, found from the last step to the first.

    The moments are Cov(x, e_1 .. e_F), of the state and the filters' errors. Each step back takes the gains that are
    best for its Lam and for the moments that the given `gains` lead to. `start` are the moments before the first step,
    and the cost is sum_k <cost_k, moments after step k>, with <A, B> = sum A_ij B_ij.
    """

    def predict(moments: jax.Array, row: tuple[RelaySteps, jax.Array]) -> tuple[jax.Array, jax.Array]:
        """Return the moments after a step, to go on with, and before its correction; row: the step and its gain."""
        step, gain = row
        uncorrected, _ = step_moments(step, moments)
        return correct_moments(uncorrected, gain), uncorrected

    def step_back(
        later: jax.Array, row: tuple[RelaySteps, jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        """Return the cost's gradient by the moments before a step, to go on with, and that by the moments after it.

        `later` is the gradient of the cost of later steps by the moments after this one. A row has the step, its old
        gain, the moments before the correction, and the matrix of the step's own cost.
        """
        step, gain, uncorrected, own_cost = row
        lam = later + own_cost  # the gradient by the moments after this step, of later steps' cost and its own
        best_gain = minimise_cost_ahead(uncorrected, lam, gain, step)
        return moment_adjoint(step, best_gain, lam), lam

    _, uncorrected = jax.lax.scan(predict, jnp.asarray(start), (steps, gains))
    items = (steps, gains, uncorrected, jnp.asarray(cost))
    _, lams = jax.lax.scan(step_back, jnp.zeros_like(start), items, reverse=True)
    return lams


def _sweep_forward(
    steps: RelaySteps, start: Array, gains: jax.Array, gradients: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the best gains for given gradients of later cost, step by step from the first, and moments after steps.

    The moments are Cov(x, e_1 .. e_F), of the state and the filters' errors. Better gains at one step change the
    moments, and so the best gains, of the next.

    Args:
        steps: the network's steps.
        start: moments before the first step (d, d).
        gains: the old gains (time, F n, R), which decide only entries on which the cost does not depend.
        gradients: Lam, gradient of the cost by the moments after each step (time, d, d).
    """

    def improve_step(
        moments: jax.Array, row: tuple[RelaySteps, jax.Array, jax.Array]
    ) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Return the moments after a step with its best gain, and the pair (best gain, these moments) to collect.

        `moments` are those before the step; a row has the step, its old gain, and the gradient of the cost.
        """
        step, old_gain, gradient = row  # the gradient of the cost by the moments after the step
        uncorrected, _ = step_moments(step, moments)
        gain = minimise_cost_ahead(uncorrected, gradient, old_gain, step)
        corrected = correct_moments(uncorrected, gain)
        return corrected, (gain, corrected)

    return jax.lax.scan(improve_step, jnp.asarray(start), (steps, gains, gradients))[1]


class SweepState(NamedTuple):
    """Gains of the last sweep, and the best gains so far with their cost, which rounding may raise at the end."""

    gains: Float[jax.Array, "time Fn R"]
    best: Float[jax.Array, "time Fn R"]
    cost: Float[jax.Array, ""]


@compile_in_float64
def _alternate_sweeps(
    steps: RelaySteps,
    start: Float[Array, "d d"],
    cost: Float[Array, "time d d"],
    local_gains: Float[Array, "time Fn R"],
    count: Int[Array, "sweeps"],
) -> Float[Array, "time Fn R"]:
    """Return the best gains of `len(count)` backward and forward sweeps that begin with `local_gains`.

    `start` is the covariance of (x, e_1 .. e_F) before the first step, and the cost is sum_k <cost_k, covariance after
    step k>. Gains of all filters stand in one block matrix (F n, R) for each step.
    """

    def sweep(search: SweepState, _: jax.Array) -> tuple[SweepState, None]:
        """Return the search after one more sweep backward and forward, with the best gains so far and their cost.

        The cost is sum_k <cost_k, covariance after step k>, <A, B> the sum of A_ij B_ij.
        """
        gradients = _sweep_backward(steps, start, cost, search.gains)  # of the cost by the covariance after each step
        gains, moments = _sweep_forward(steps, start, search.gains, gradients)
        new_cost = jnp.sum(cost * moments)
        is_better = new_cost < search.cost
        best = jnp.where(is_better, gains, search.best)
        return SweepState(gains, best, jnp.where(is_better, new_cost, search.cost)), None

    first = jnp.asarray(local_gains)
    value = jnp.sum(cost * propagate_error_moments(steps, start, first).moments[1:])
    search, _ = jax.lax.scan(sweep, SweepState(first, first, value), jnp.asarray(count))
    return search.best
