"""Trust-region search for the maximum of a likelihood, bounded in standard errors, from several starts side by side.

A climb is one of these searches. Coordinates are unconstrained: logarithms and logits, or plain real numbers, which are
called free. A point is a vector of them (p,).
"""

from collections.abc import Callable

import numpy as np

from heliograph.learning.likelihood.climbs import NOISE, ClimbEnds, Climbs, Evaluate, Evaluated, OpenEnds, join_climbs
from heliograph.learning.likelihood.trust_region_step import (
    expected_gain,
    find_errors_and_flat_directions,
    multiply_each,
    trust_region_step,
)
from heliograph.numerics.types import Bool, Float

MOST_STEPS = 200
FIRST_RADIUS = 10.0  # of the trust region, in standard errors
WIDENING, NARROWING = 3.0, 0.25  # factors of the radius after a step that the model predicted well, and badly
CONVERGED_GAIN = 1e-15  # g' H^-1 g: twice the log-likelihood that a full step gains, 3e-8 standard errors away
CONVERGED_GAIN_BY_ROUNDING = 1e-8  # the same where rounding lets nothing better be found: 1e-4 standard errors
LEAST_SHARE_OF_GAIN = 1e-4  # share of the predicted gain that a step has to bring to be taken
LEAST_UPDATE_DIVISOR = 1e-8  # |r' p| / (|r| |p|) below which r' p is rounding, in the update of the Hessian
GAIN_TO_LIMIT = 1e-6  # nats that remain to be gained on the way to the end of a domain
SMALLEST_RADIUS = 1e-12
LEAST_INFORMATION = 1e-6  # information of a logarithm or a logit of which the likelihood sees next to nothing


def maximise_from_starts(
    evaluate: Evaluate,
    start: Float[np.ndarray, "climbs p"],
    active: Bool[np.ndarray, "climbs p"] | None = None,
    watch: Callable[[ClimbEnds], None] | None = None,
    domains: OpenEnds | None = None,
    close: float = CONVERGED_GAIN,
    joining: bool = False,
) -> ClimbEnds:
    """Return where climbs of the log-likelihood l end, one from each start, all side by side.

    Each step p maximises the model g' p - p' B p / 2 of the gain over |D p| <= radius: g is the gradient of
    l, and D scales p to standard errors. B is the Gauss-Newton information I, or I corrected by what steps taught of
    its error (SR1), whichever predicted the last gain better. A step is taken where l rises by a share of what was
    predicted; else the radius falls. So l never falls, and the units of the numbers do not matter.

    A climb has converged when g' I^-1 g, twice the gain of the step without bounds, is less than rounding sees. This
    leaves out coordinates whose domain ends where l still rises, by no more than GAIN_TO_LIMIT in all.

    Args:
        evaluate: l (climbs,), its gradient (climbs, p) and information (climbs, p, p) at points (climbs, p).
        start: points at which to begin (climbs, p).
        active: coordinates that move, the others stay (climbs, p); all unless given.
        watch: called with the best so far before each step.
        domains: coordinates whose domains end at infinity (logarithms, logits); plain real numbers unless given.
        close: g' I^-1 g at which a climb has arrived.
        joining: whether a climb ends where a higher one goes to the same top.
    Source: Moré and Sorensen (1983) for the step; Dennis, Gay and Welsch (1981) for the choice of the model; Conn,
    Gould and Toint, Trust-Region Methods (2000).
    """
    moving = np.ones(start.shape, dtype=bool) if active is None else active
    domains = OpenEnds.unbounded(start.shape[1]) if domains is None else domains
    with np.errstate(all="ignore"):
        state = _start_climbs(evaluate, start, moving, domains, close)
        for count in range(MOST_STEPS):
            best = state.ends(count)
            if watch is not None:
                watch(best)
            if state.done.all():
                return best
            state = _step_climbs(evaluate, state, moving, domains, close)
            state = join_climbs(state, moving, domains) if joining else state
    return state.ends(MOST_STEPS)


def _start_climbs(evaluate: Evaluate, start: np.ndarray, moving: np.ndarray, domains: OpenEnds, close: float) -> Climbs:
    """Return the state of all climbs before the first step.

    A climb is done from the beginning where l, or a derivative in a coordinate that moves, is not finite.

    Args:
        evaluate: log-likelihood l (climbs,), gradient (climbs, p) and information (climbs, p, p) at points (climbs, p).
        start: points at which the climbs begin (climbs, p).
        moving: coordinates that move (climbs, p).
        domains: coordinates whose domains end at infinity.
        close: a climb has arrived where g' I^-1 g of gradient g and information I is below this.
    """
    total, gradient, information = evaluate(start)
    state = Climbs(
        x=start.copy(),
        total=total,
        gradient=gradient,
        information=information,
        model=information,
        radius=np.full(len(start), FIRST_RADIUS),
        remaining=np.full(len(start), np.inf),
        done=~_is_finite(total, gradient, information, moving),
        converged=np.zeros(len(start), dtype=bool),
        joined=np.arange(len(start)),
    )
    return _mark_arrived(state, moving, domains, close)


def _is_finite(total: np.ndarray, gradient: np.ndarray, information: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """Return for each climb whether log-likelihood, gradient and information are finite in moving coordinates.

    Args:
        total: log-likelihood (climbs,).
        gradient: (climbs, p).
        information: (climbs, p, p).
        moving: coordinates that move (climbs, p); derivatives by others may be anything.
    """
    finite_gradient = np.all(np.isfinite(gradient) | ~moving, axis=1)
    finite_information = np.isfinite(information) | ~(moving[:, :, None] & moving[:, None, :])
    return np.asarray(np.isfinite(total) & finite_gradient & np.all(finite_information, axis=(1, 2)))


def _mark_arrived(state: Climbs, moving: np.ndarray, domains: OpenEnds, close: float) -> Climbs:
    """Return the state with climbs marked as done that have arrived, or whose radius is below SMALLEST_RADIUS.

    A climb has arrived if g' I^-1 g, twice what a full step would still gain, is below `close`; it has then converged.
    At so small a radius rounding hides the gain, and CONVERGED_GAIN_BY_ROUNDING takes the place of `close`.

    Args:
        state: the climbs, with gradient g and information I.
        moving: coordinates that move (climbs, p); those at an end of their domain count no more.
        domains: coordinates whose domains end at infinity.
        close: bound of g' I^-1 g.
    """
    counting = moving & ~find_coordinates_at_limits(state.x, state.gradient, domains)
    remaining = np.where(state.done, state.remaining, expected_gain(state.gradient, state.information, counting) / 2)
    is_stuck = state.radius < SMALLEST_RADIUS
    has_arrived = ~state.done & (2 * remaining < np.where(is_stuck, CONVERGED_GAIN_BY_ROUNDING, close))
    return state._replace(
        remaining=remaining, done=state.done | is_stuck | has_arrived, converged=state.converged | has_arrived
    )


def find_coordinates_at_limits(x: np.ndarray, gradient: np.ndarray, domains: OpenEnds) -> Bool[np.ndarray, "climbs p"]:
    """Return which coordinates count as at an end of their domain (climbs, p), as l hardly gains on the way there.

    A number v = exp(x) has its end v = 0 at x = -inf (`domains.low`). A logit also has one at x = inf (`domains.high`).
    To first order, the log-likelihood l gains l(0) - l(v) = -v l'(v) = -dl/dx up to the end; a gain below GAIN_TO_LIMIT
    (1e-6 nats) counts as none. `outward` is -1 or 1, the direction of the nearer end, 0 for a real number.

    Args:
        x: points (climbs, p).
        gradient: gradient of l there (climbs, p).
        domains: coordinates whose domains end at infinity.
    """
    outward = np.where(domains.high & (x > 0), 1.0, np.where(domains.low, -1.0, 0.0))
    rise = outward * gradient
    return np.asarray((outward != 0) & (rise >= 0) & (rise < GAIN_TO_LIMIT))


def _step_climbs(evaluate: Evaluate, state: Climbs, moving: np.ndarray, domains: OpenEnds, close: float) -> Climbs:
    """Return the state after one step of each climb that is not done: propose, evaluate, accept or reject, adapt.

    Args:
        evaluate: log-likelihood (climbs,), gradient (climbs, p) and information (climbs, p, p) at points (climbs, p).
        state: climbs (searches side by side) before the step: points x, values, gradients g, informations I, models B
            of minus the Hessian, radii, and which are `done`.
        moving: coordinates that move (climbs, p).
        domains: coordinates whose domains end at infinity.
        close: a climb has arrived where g' I^-1 g of gradient g and information I is below this.
    """
    going = ~state.done
    # The step p of greatest g' p - p' B p / 2 within the radius, its length in standard errors, and the gain predicted.
    # Coordinates at an end of their domain stay.
    counting = moving & ~find_coordinates_at_limits(state.x, state.gradient, domains)
    step, length, predicted = trust_region_step(
        state.gradient, state.information, state.model, state.radius, counting, domains.free
    )
    tried = np.where(going[:, None], state.x + step, state.x)  # climbs that are done stay
    total, gradient, information = _evaluate_at(evaluate, tried, going, state)
    # Accept it or not, and adapt the radius, by how well the gain was predicted.
    is_finite = going & _is_finite(total, gradient, information, moving)
    # `expected_gain` is g' I^-1 g, twice the gain of a full step.
    gradient_fell = expected_gain(gradient, information, counting) < expected_gain(
        state.gradient, state.information, counting
    )
    accepted, radius = _accept_or_reject_steps(state, total, length, predicted, is_finite, gradient_fell)
    model = _update_hessian(state, step, total - state.total, gradient, information, is_finite, accepted, domains.free)
    after = state._replace(
        x=np.where(accepted[:, None], tried, state.x),
        total=np.where(accepted, total, state.total),
        gradient=np.where(accepted[:, None], gradient, state.gradient),
        information=np.where(accepted[:, None, None], information, state.information),
        model=model,
        radius=radius,
    )
    return _mark_arrived(after, moving, domains, close)


def _accept_or_reject_steps(
    state: Climbs,
    total: np.ndarray,
    length: np.ndarray,
    predicted: np.ndarray,
    is_finite: np.ndarray,
    gradient_fell: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return which climbs accept their step, and the radius for the next one, (climbs,) each.

    A step is accepted where the log-likelihood l rises by a share of the gain that the model predicted. Where that gain
    is below the rounding of l, the gradient decides: the step is accepted if the gradient fell, or if the step went to
    the edge of the region, as across a plateau; and l must not fall by more than rounding. The rounding of l is NOISE
    of its size. After a bad step the radius is NARROWING times the step's length (or the radius, if that is less),
    after a good one to the edge WIDENING times the old one. LEAST_SHARE_OF_GAIN is 1e-4.

    Args:
        state: the climbs before the step, with l (`total`), the radius, and `done` for climbs that go no further.
        total: l at the end of the step.
        length: of the step in the units of the radius.
        predicted: gain of l by the model.
        is_finite: whether l and its derivatives are finite at the end of the step; false of climbs that are done.
        gradient_fell: whether g' I^-1 g is less there than before.
    """
    gain = total - state.total
    at_edge = length > 0.9 * state.radius
    is_hidden = predicted < NOISE * np.abs(state.total)
    accepted_if_hidden = (gradient_fell | at_edge) & (gain >= -NOISE * np.abs(total))
    accepted = is_finite & np.where(is_hidden, accepted_if_hidden, gain > LEAST_SHARE_OF_GAIN * predicted)
    # Wider after a step to the edge that gained three quarters of what was predicted; narrower below one quarter.
    predicted_well = accepted & ((gain > 0.75 * predicted) | is_hidden)
    predicted_badly = ~state.done & ~(is_finite & ((gain > 0.25 * predicted) | (is_hidden & accepted)))
    widened = np.where(predicted_well & at_edge, WIDENING * state.radius, state.radius)
    return accepted, np.where(predicted_badly, NARROWING * np.minimum(length, state.radius), widened)


def _evaluate_at(evaluate: Evaluate, x: np.ndarray, going: np.ndarray, state: Climbs) -> Evaluated:
    """Return log-likelihood, gradient and information at x (climbs, p) of climbs `going` on, else the last ones.

    Args:
        evaluate: function of points (points, p) that returns the three.
        x: a point for each climb (climbs, p).
        going: climbs that are evaluated (climbs,); the others are done.
        state: the climbs, with their last values.
    """
    arrays = state.total.copy(), state.gradient.copy(), state.information.copy()
    for array, new_values in zip(arrays, evaluate(x[going]), strict=True):
        array[going] = new_values
    return arrays


def _update_hessian(
    state: Climbs,
    step: np.ndarray,
    gain: np.ndarray,
    gradient: np.ndarray,
    information: np.ndarray,
    is_finite: np.ndarray,
    accepted: np.ndarray,
    free: np.ndarray,
) -> np.ndarray:
    """Return the model B of minus the Hessian of the log-likelihood l for the next step, (climbs, p, p).

    In each climb (one of several searches side by side) B is the information at its next point, or the last B
    corrected by this step: whichever would have predicted the gain of the step p, g' p - p' B p / 2, better. The last B
    stays where l is not finite at the end of the step.

    Args:
        state: climbs before the step: gradient g (climbs, p), information and model B (climbs, p, p).
        step: p (climbs, p).
        gain: actual gain of l by the step (climbs,).
        gradient: of l at the end of the step (climbs, p).
        information: information at the end of the step (climbs, p, p).
        is_finite: whether l and its derivatives are finite there (climbs,).
        accepted: whether the climb moves to the end of the step (climbs,).
        free: coordinates that are plain real numbers, no logarithms or logits (p,).
    """
    last_model = np.nan_to_num(state.model)
    last_information = np.nan_to_num(state.information)
    # The gain that each of the two models would have predicted, g' p - p' B p / 2.
    slope = np.sum(state.gradient * step, axis=1)
    by_model = slope - np.sum(step * multiply_each(last_model, step), axis=1) / 2
    by_information = slope - np.sum(step * multiply_each(last_information, step), axis=1) / 2
    keeps_model = ~is_finite | (np.abs(gain - by_model) <= np.abs(gain - by_information))
    # B corrected so that B p is the change of the gradient (symmetric rank-one update).
    corrected = _correct_by_secant(last_model, step, state, gradient, is_finite, free)
    # A rejected step leaves the climb where it was, with the information of that point.
    current_information = np.where(accepted[:, None, None], information, state.information)
    return np.where(keeps_model[:, None, None], corrected, current_information)


def _correct_by_secant(
    model: np.ndarray,
    step: np.ndarray,
    state: Climbs,
    gradient: np.ndarray,
    is_finite: np.ndarray,
    free: np.ndarray,
) -> np.ndarray:
    """Return B + r r' / (r' p) with r = y - B p (the symmetric rank-one update, SR1), (climbs, p, p).

    Climbs are searches for a maximum side by side; B is each one's model of minus the Hessian. The new B maps the step
    p to y, the gradient before the step less that after it, as minus the Hessian does along p. B stays where the
    gradient after the step is not finite, or r' p is rounding.

    Args:
        model: B (climbs, p, p).
        step: p (climbs, p).
        state: the climbs before the step, with gradient and information.
        gradient: after the step (climbs, p).
        is_finite: whether it is finite (climbs,).
        free: coordinates that are plain real numbers, no logarithms or logits (p,).
    """
    y = np.where(is_finite[:, None], np.nan_to_num(state.gradient - gradient), 0.0)
    r = y - multiply_each(model, step)
    # A logarithm or logit with information below LEAST_INFORMATION hardly changes the likelihood: there y is only
    # rounding.
    information_of_each = np.diagonal(state.information, axis1=1, axis2=2)
    r = np.where(free | (information_of_each > LEAST_INFORMATION), r, 0.0)
    # The update is defined where |r' p| > LEAST_UPDATE_DIVISOR |r| |p|; less is rounding. Sizes are in units of each
    # coordinate's standard error u = 1 / sqrt(I_ii), so that units of the numbers do not matter: |r| of r u, and |p| of
    # p / u.
    r_times_p = np.sum(r * step, axis=1)
    standard_error, _ = find_errors_and_flat_directions(state.information, moving=step != 0)
    squared_r = np.sum((r * standard_error) ** 2, axis=1)
    squared_p = np.sum((step / np.where(standard_error > 0, standard_error, 1.0)) ** 2, axis=1)
    is_defined = is_finite & (np.abs(r_times_p) > LEAST_UPDATE_DIVISOR * np.sqrt(squared_r * squared_p))
    update = r[:, :, None] * r[:, None, :] / np.where(is_defined, r_times_p, 1.0)[:, None, None]
    return model + np.where(is_defined[:, None, None], update, 0.0)
