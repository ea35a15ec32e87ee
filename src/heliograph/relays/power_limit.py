"""Minimum of a quadratic cost of relay gains within a limit of their mean power."""

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.relays import RelaySteps
from heliograph.numerics.check import fail, repeat_per_step
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.relays.bfgs import bfgs
from heliograph.relays.error_moments import (
    gain_hessian,
    gain_mask,
    moment_adjoint,
    propagate_error_moments,
    step_moments,
)

POWER_TOLERANCE = 1e-6  # relative excess over a limit that counts as met
BARRIERS = np.geomspace(1e-1, 1e-4, 32)  # of the cost at the start, for all steps together
ROOM = 0.1  # part of each limit that the first gains leave free
HALVINGS = 30
DAMPING = 1e-6  # relative, of the normal matrices that scale the gains
MEMORY = 30  # updates that stand for the inverse Hessian of all steps' gains
PRECISION = 1e-8  # of the cost at the start: five iterations in a row that gain less end a descent


class PowerLimit(NamedTuple):
    """Each step's gains must keep <form_k, moments after step k> below limit_k, <A, B> the sum of A_ij B_ij.

    The moments are Cov(x, e_1 .. e_F), of the state and the filters' errors; what relays send at step k + 1 are
    estimates of step k. Form and limit leave out the power of the mean state, which every unbiased estimate sends. The
    form is 0 where no relay sends at the next step.
    """

    form: Float[Array, "*time d d"]
    limit: Float[Array, "*time"]


class PowerLimitedProblem(NamedTuple):
    """Minimise sum_k <cost_k, moments after step k> within a power limit, from the moments `start` before the first.

    The moments are Cov(x, e_1 .. e_F) (d, d), of the state and the errors of all filters; <A, B> = sum of A_ij B_ij.
    """

    steps: RelaySteps
    start: Float[Array, "d d"]
    cost: Float[Array, "time d d"]
    power: PowerLimit


def make_power_limit(steps: RelaySteps, value: ArrayLike, d: int) -> PowerLimit:
    """Return a limit `value` on the power of all relays together at each step as one on Cov(x, e_1 .. e_F) (d, d).

    <form_k, covariance after step k> <= limit_k limits what relays send at step k + 1, as they send estimates of the
    step before.

    Args:
        steps: the network's steps.
        value: the limit, a number or one for each step.
        d: length of (x, e_1 .. e_F), the state and all filters' errors.

    Raises:
        ValueError: a limit below what the mean state takes.
    """
    horizon = len(steps.receives_in_slot)
    limit = repeat_per_step("power limit", value, horizon) * (1 + POWER_TOLERANCE)
    # A relay sends C s: E |C s|^2 = |C E x|^2 + tr Cov(C s), since estimates are unbiased, E s = E x.
    mean_signal = np.sum((steps.sensing @ steps.state_mean[..., None]) ** 2, axis=(1, 2))
    transmitting = steps.transmits_in_slot[:, 1:].sum(axis=1)  # how many relays do
    fixed = mean_signal * transmitting
    low = np.flatnonzero((limit <= fixed) & (transmitting > 0))
    if len(low):
        step = int(low[0])
        text = f"more than {fixed[step]:.6g} at step {step}, the power of the mean state"
        raise fail("power limit", text, limit[step] / (1 + POWER_TOLERANCE))
    # The limit on sum tr Cov(C s). Where no relay sends, and after the last step, 0 <= 1 limits nothing.
    forms = make_power_matrices(steps, d)
    limit_of_variances = np.where(transmitting > 0, limit - fixed, 1.0)
    forms_of_next_step = np.concatenate([forms[1:], np.zeros((1, d, d))])
    return PowerLimit(form=forms_of_next_step, limit=np.append(limit_of_variances[1:], 1.0))


def make_power_matrices(steps: RelaySteps, d: int) -> Float[np.ndarray, "time {d} {d}"]:
    """Return form_k: <form_k, moments before step k> is the sum over the transmitting relays of tr Cov(C s_r).

    <A, B> = tr A' B. Relay r sends C s_r of its estimate s_r = x - e_r, at those of the network's `steps` at which it
    transmits. The moments are Cov(x, e_1 .. e_F) (d, d), of the state and all filters' errors.
    """
    time, n = steps.state_mean.shape
    forms = np.zeros((time, d, d))
    for r in range(len(steps.received) - 1):  # the last filter is the receiver, which sends nothing
        estimate = np.zeros((n, d))  # s_r = x - e_r, as a matrix that acts on (x, e_1 .. e_F)
        estimate[:, :n], estimate[:, (1 + r) * n : (2 + r) * n] = np.eye(n), -np.eye(n)
        sent = steps.sensing @ estimate
        forms += np.swapaxes(sent, 1, 2) @ sent * steps.transmits_in_slot[:, 1 + r, None, None]
    return forms


def minimise_within_limit(
    problem: PowerLimitedProblem, local_gains: Float[np.ndarray, "time Fn R"], iterations: int
) -> Float[np.ndarray, "time Fn R"]:
    """Return the gains of small cost that meet the limit; never dearer than `local_gains`, if those meet it.

    By an interior point method: f - t sum_k log(1 - p_k / limit_k) is descended over the gains of all steps at once,
    for ever smaller t, where f is the cost in units of that of `local_gains` and p_k a step's power. Every point on the
    way is strictly inside the limits. t falls little at a time, since long descents multiply what rounding leaves.

    Args:
        problem: the relays' steps, the cost by second moments of states and errors, and the limits on their powers.
        local_gains: gains of all filters (Fn, R) at each step, from which, scaled into the limits, descents begin.
        iterations: steps of all descents together.
    """
    local_cost, _slack = _compute_cost_and_slack(problem, local_gains)
    problem = problem._replace(cost=problem.cost / max(float(local_cost), np.finfo(float).tiny))
    # Designs to choose from: the local gains, these scaled into the limit, and the end of each descent.
    designs = [local_gains, _scale_into_limit(problem, local_gains)]
    for barrier in BARRIERS / len(local_gains):
        gains = designs[-1]
        # The variables x (time, r): changes of the r free gains of each step, in units in which the cost curves alike.
        units = np.asarray(_choose_step_units(problem, gains, barrier))
        evaluate = partial(_evaluate_barrier, problem, gains, units, barrier)
        shape = units.shape[:2]
        steps_of_descent = math.ceil(iterations / len(BARRIERS))
        no_change = np.zeros(math.prod(shape))
        x = bfgs(evaluate, start=no_change, iterations=steps_of_descent, tolerance=PRECISION, memory=MEMORY)
        designs.append(np.asarray(_change_gains(gains, units, x.reshape(shape), problem.steps)))
    # The cheapest that meets all limits, without those at which a descent overflowed.
    judged = [_compute_cost_and_slack(problem, gains) for gains in designs]
    costs = [float(cost) if np.isfinite(cost) and np.all(slack >= 0) else np.inf for cost, slack in judged]
    best = int(np.argmin(costs))
    if not np.isfinite(costs[best]):
        raise fail("power limit", "one that some design meets", "one for which none was found")
    return designs[best]


def _scale_into_limit(
    problem: PowerLimitedProblem, local_gains: Float[np.ndarray, "time Fn R"]
) -> Float[np.ndarray, "time Fn R"]:
    """Return the gains with the relays' scaled by one factor, at most 1, so that the share ROOM of each limit is free.

    Without gains relays send the mean state alone, and all of the limit is free: so a factor exists, found by bisection
    in HALVINGS steps. A descent with a logarithmic barrier needs such a start inside the limits.
    """
    relay_rows = local_gains.shape[1] - problem.steps.transition.shape[-1]  # without the receiver's, the last

    def scale_relays(factor: float) -> np.ndarray:
        """Return the gains with the relays' multiplied by a factor."""
        return np.concatenate([factor * local_gains[:, :relay_rows], local_gains[:, relay_rows:]], axis=1)

    low, high = 0.0, 2.0  # the first middle is 1, the gains as they are
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        _cost, free_shares = _compute_cost_and_slack(problem, scale_relays(middle))
        if np.min(free_shares) < ROOM:
            high = middle
        elif middle == 1.0:  # the gains as they are leave room
            return local_gains
        else:
            low = middle
    return scale_relays(low)


@compile_in_float64
def _compute_cost_and_slack(
    problem: PowerLimitedProblem, gains: Float[Array, "time Fn R"]
) -> tuple[Float[Array, ""], Float[Array, "time"]]:
    """Return the cost of given gains in a `problem`, and the share of each step's power limit that they leave free.

    With <A, B> = sum of A_ij B_ij: the cost is sum_k <cost_k, moments after step k>, and the power <form_k, the same>.
    """
    moments = propagate_error_moments(problem.steps, problem.start, gains).moments[1:]
    form, limit = problem.power
    return jnp.sum(problem.cost * moments), 1 - jnp.sum(form * moments, axis=(1, 2)) / limit


@compile_in_float64
def _change_gains(
    gains: Float[Array, "time Fn R"], units: Float[Array, "time r r"], x: Float[Array, "time r"], steps: RelaySteps
) -> Float[Array, "time Fn R"]:
    """Return the gains with their r free entries changed by units_k x_k at each step k; x is (time, r).

    An entry is free if it multiplies what its filter receives itself (`gain_mask`, the same at all `steps`). All other
    entries are always zero. Column j of units_k is the change of the free entries for one unit of x_kj.
    """
    rows, columns = np.nonzero(gain_mask(steps))
    return jnp.asarray(gains).at[:, rows, columns].add(jnp.einsum("kij,kj->ki", units, x))


@compile_in_float64
def _compute_cost_with_barrier(
    problem: PowerLimitedProblem,
    gains: Float[Array, "time Fn R"],
    units: Float[Array, "time r r"],
    barrier: float,
    x: Array,
) -> tuple[Float[Array, ""], Float[Array, "time r"]]:
    """Return the cost and barrier at gains moved by x, infinite outside the limit, and its gradient by x (time, r).

    The gains are those of `_change_gains`: x changes the r free entries of each step in `units`. `barrier` is the
    weight t of -log(free share of a power limit), summed over the steps.
    """

    def value(x: jax.Array) -> jax.Array:
        """Return cost - barrier sum log(slack) at gains moved by x, `slack` the free share of each power limit.

        The value is infinite where a limit is passed. `gains`, `units`, `barrier` (a weight) and `problem` are fixed.
        """
        cost, slack = _compute_cost_and_slack(problem, _change_gains(gains, units, x, problem.steps))
        meets_limits = jnp.all(slack > 0)  # where not, the logarithm is of 1, so that no gradient becomes NaN
        logarithms = jnp.log(jnp.where(meets_limits, slack, 1.0))
        return jnp.where(meets_limits, cost - barrier * jnp.sum(logarithms), jnp.inf)

    value_and_slope: tuple[jax.Array, jax.Array] = jax.value_and_grad(value)(x)
    return value_and_slope


def _evaluate_barrier(
    problem: PowerLimitedProblem,
    gains: np.ndarray,
    units: np.ndarray,
    barrier: float,
    x: Float[np.ndarray, "variables"],
) -> tuple[float, Float[np.ndarray, "variables"]]:
    """Return cost - barrier sum log(slack) and its gradient at one vector x, as a descent needs it.

    slack_k is the free share of the power limit at step k.

    Args:
        problem: the relays' steps, the cost, and the limits on their powers.
        gains: gains that x changes (time, F n, R).
        units: units_k (time, r, r): x_k changes the r free gains of step k by units_k x_k.
        barrier: weight of the logarithm.
        x: all x_k, one after another (time r,).
    """
    value, gradient = _compute_cost_with_barrier(problem, gains, units, barrier, x.reshape(units.shape[:2]))
    return float(value), np.asarray(gradient).ravel()


@compile_in_float64
def _choose_step_units(
    problem: PowerLimitedProblem, gains: Float[Array, "time Fn R"], barrier: float
) -> Float[Array, "time r r"]:
    """Return units (columns) of the r free gains of each step, in which the cost curves alike in all directions.

    They are L'^-1, with L L' the Hessian of cost and barrier by the step's gains while those of other steps stay. It
    needs Lam, the gradient of cost and barrier by the moments after the step, which is found step by step from the
    last.
    """
    steps, start, cost, (form, limit) = problem
    moments = jnp.asarray(propagate_error_moments(steps, start, gains).moments)
    # Cost and barrier of step k alone, by the moments after it: d/dp of -t log(limit - p) is t / (limit - p).
    slack = limit - jnp.sum(form * moments[1:], axis=(1, 2))
    gradients_of_steps = jnp.asarray(cost) + (barrier / slack)[:, None, None] * form

    def step_back(
        later: jax.Array, row: tuple[RelaySteps, jax.Array, jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        """Return the cost's gradient by the moments before a step, and the units in which the step's gains change.

        `later` is the gradient of the cost of later steps by the moments after this one. A row has the step, its gain,
        the moments before it, and the gradient of its own cost and barrier by the moments after it.
        """
        step, gain, moments_before, gradient_of_step = row
        # Lam, the gradient by the moments after the step: of the cost of later steps, and of this step's own.
        lam = later + gradient_of_step
        uncorrected, _ = step_moments(step, moments_before)
        hessian, _ = gain_hessian(uncorrected, lam, step, DAMPING)
        # 1 for a gain on what is transmitted, else 0: such a gain stays.
        _gain_rows, received = np.nonzero(gain_mask(step))
        is_free = jnp.asarray(step.receives_in_slot)[received]
        # Units are the columns of L'^-1, with L L' the Hessian: along each the cost curves alike.
        unit = jax.scipy.linalg.solve_triangular(jnp.linalg.cholesky(hessian).T, jnp.diag(is_free))
        return moment_adjoint(step, gain, lam), is_free[:, None] * unit

    items = (steps, jnp.asarray(gains), moments[:-1], gradients_of_steps)
    _, units = jax.lax.scan(step_back, jnp.zeros_like(jnp.asarray(start)), items, reverse=True)
    return units
