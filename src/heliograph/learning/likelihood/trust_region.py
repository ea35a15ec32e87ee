"""Trust-region search for the maximum of a likelihood, bounded in standard errors, from several starts side by side."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.learning.likelihood.trust_region_step import (
    expected_gain,
    find_flat_directions,
    multiply_lanes,
    trust_region_step,
)
from heliograph.numerics.types import Bool, Float

MOST_STEPS = 200
FIRST_RADIUS = 10.0  # of the trust region, in standard errors
WIDER, NARROWER = 3.0, 0.25  # factors of the radius after a step that the model foretold well, and badly
CLOSE = 1e-15  # g' H^-1 g: twice the log-likelihood that a full step gains, 3e-8 standard errors away
NEAR = 1e-8  # the same where rounding lets nothing better be found: 1e-4 standard errors
NOISE = 1e-13  # rounding of a log-likelihood, as a share of its size
TAKEN = 1e-4  # share of the foretold gain that a step has to bring to be taken
DEFINED = 1e-8  # r' p / |r| |p| below which it is rounding
AT_LIMIT = 1e-6  # nats that remain to be gained on the way to the end of a domain
SMALLEST_RADIUS = 1e-12
JOINED = 0.1  # standard errors between two lanes that climb to one top, and of either from it
BENT = 0.5  # of the information between two such lanes, that the likelihood bends by at least
ALIKE = 0.1  # of the gain between two such lanes, that their slopes may leave unexplained
NEIGHBOURS = 1.0  # between logarithms or logits of two such lanes, whatever the information says
INVISIBLE = 1e-6  # information of a logarithm or a logit of which the likelihood sees next to nothing

Evaluated = tuple[Float[np.ndarray, " lanes"], Float[np.ndarray, "lanes p"], Float[np.ndarray, "lanes p p"]]
Evaluate = Callable[[Float[np.ndarray, "lanes p"]], Evaluated]


class OpenEnds(NamedTuple):
    """Coordinates by which an end of a domain is at infinity.

    A variance of 0 is at minus infinity of its logarithm, probabilities of 0 and 1 are at both ends of their logit.

    Shapes: low, high, single (p,); single: numbers whose end can be tried alone.
    """

    low: Bool[np.ndarray, " p"]
    high: Bool[np.ndarray, " p"]
    single: Bool[np.ndarray, " p"]

    @staticmethod
    def unbounded(count: int) -> "OpenEnds":
        """Return the domains of so many real numbers, without ends."""
        none = np.zeros(count, dtype=bool)
        return OpenEnds(none, none, none)

    @property
    def free(self) -> Bool[np.ndarray, " p"]:
        """Coordinates that are real numbers, without an end and without a scale of their own."""
        return np.asarray(~(self.low | self.high))


class Maximum(NamedTuple):
    """Ends of the searches: point, likelihood, whether it converged, what a full step would still gain, and the steps.

    Shapes: x, gradient (lanes, p), total, converged, remaining (lanes,).
    """

    x: Float[np.ndarray, "lanes p"]
    total: Float[np.ndarray, " lanes"]
    gradient: Float[np.ndarray, "lanes p"]
    converged: Bool[np.ndarray, " lanes"]
    remaining: Float[np.ndarray, " lanes"]
    steps: int

    @property
    def order(self) -> np.ndarray:
        """Lanes from the highest likelihood to the lowest."""
        return np.argsort(-np.nan_to_num(self.total, nan=-np.inf), kind="stable")


class _State(NamedTuple):
    """Lanes of a search: B is the model of the Hessian of -l, radius that of the trust region.

    remaining: g' I^-1 g / 2. done: lanes that go no further. joined: the lane that one of them has joined, itself if
    none.
    """

    x: np.ndarray
    total: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    model: np.ndarray
    radius: np.ndarray
    remaining: np.ndarray
    done: np.ndarray
    converged: np.ndarray
    joined: np.ndarray

    def ends(self, steps: int) -> Maximum:
        """Return where lanes are, those that have joined another where that one is."""
        lane = self.joined
        for _ in range(len(lane)):  # a lane may join one that joins a third
            lane = lane[lane]
        x, total, gradient = self.x[lane], self.total[lane], self.gradient[lane]
        return Maximum(x, total, gradient, self.converged[lane], self.remaining[lane], steps)


def maximise(
    evaluate: Evaluate,
    start: Float[np.ndarray, "lanes p"],
    active: Bool[np.ndarray, "lanes p"] | None = None,
    watch: Callable[[Maximum], None] | None = None,
    domains: OpenEnds | None = None,
    close: float = CLOSE,
    joining: bool = False,
) -> Maximum:
    """Search from each start: the step maximises g' p - p' B p / 2 over |D p| <= radius, in units of standard errors.

    B is the Gauss-Newton information I, or I corrected by what steps taught of its error (SR1),
    whichever foretold the last gain better. A step is taken where the likelihood rises by a share of what was
    foretold; else the radius falls. So the likelihood never falls, and the units of the numbers do not matter.

    A lane has converged when g' I^-1 g, of the step without bounds, is nothing: less than rounding sees. Coordinates
    whose domain ends where the likelihood still rises, by no more than AT_LIMIT in all, do not count.

    Args:
        evaluate: likelihood, gradient and information at points.
        start: points at which to begin (lanes, p).
        active: coordinates that move, the others stay (lanes, p); all unless given.
        watch: called with the best so far before each step.
        domains: what the coordinates are; plain real numbers unless given.
        close: g' I^-1 g at which a lane has arrived.
        joining: whether a lane that has come so near another that both have one top before them is left to it.
    Source: Moré and Sorensen (1983) for the step; Dennis, Gay and Welsch (1981) for the choice of the model; Conn,
    Gould and Toint, Trust-Region Methods (2000).
    """
    moving = np.ones(start.shape, dtype=bool) if active is None else active
    domains = OpenEnds.unbounded(start.shape[1]) if domains is None else domains
    with np.errstate(all="ignore"):
        state = _init_lanes(evaluate, start, moving, domains, close)
        for count in range(MOST_STEPS):
            best = state.ends(count)
            if watch is not None:
                watch(best)
            if state.done.all():
                return best
            state = _step_lanes(evaluate, state, moving, domains, close)
            state = _join_lanes(state, moving, domains) if joining else state
    return state.ends(MOST_STEPS)


def _init_lanes(evaluate: Evaluate, start: np.ndarray, moving: np.ndarray, domains: OpenEnds, close: float) -> _State:
    """Return the state before the first step; lanes whose likelihood or slope is no number at the start are done."""
    total, gradient, information = evaluate(start)
    state = _State(
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
    """Return for each lane whether likelihood, and gradient and information of what moves, are finite, (lanes,)."""
    pairs = moving[:, :, None] & moving[:, None, :]
    derivatives = np.all(np.isfinite(gradient) | ~moving, axis=1)
    return np.asarray(np.isfinite(total) & derivatives & np.all(np.isfinite(information) | ~pairs, axis=(1, 2)))


def _mark_arrived(state: _State, moving: np.ndarray, domains: OpenEnds, close: float) -> _State:
    """Return the state with lanes done that have arrived, or are stuck since rounding hides what is left to gain."""
    counting = moving & ~find_at_limits(state.x, state.gradient, domains)
    remaining = np.where(state.done, state.remaining, expected_gain(state.gradient, state.information, counting) / 2)
    stuck = state.radius < SMALLEST_RADIUS
    arrived = ~state.done & (2 * remaining < np.where(stuck, NEAR, close))
    return state._replace(remaining=remaining, done=state.done | stuck | arrived, converged=state.converged | arrived)


def find_at_limits(x: np.ndarray, gradient: np.ndarray, domains: OpenEnds) -> Bool[np.ndarray, "lanes p"]:
    """Return the coordinates at an end of their domain: on the way there the log-likelihood gains less than AT_LIMIT.

    A number v = exp(x) has its end v = 0 at x = -inf (`low`), or v = inf at x = inf (`high`). To first order what is
    left to gain is l(0) - l(v) = -v l'(v) = -dl/dx.
    """
    outward = np.where(domains.high & (x > 0), 1.0, np.where(domains.low, -1.0, 0.0))
    rise = outward * gradient
    return np.asarray((outward != 0) & (rise >= 0) & (rise < AT_LIMIT))


def _step_lanes(evaluate: Evaluate, state: _State, moving: np.ndarray, domains: OpenEnds, close: float) -> _State:
    """Take one trust-region step in every lane: propose, evaluate, accept or not, then adapt radius and model."""
    going = ~state.done
    counting = moving & ~find_at_limits(state.x, state.gradient, domains)
    step, length, foretold = trust_region_step(
        state.gradient, state.information, state.model, state.radius, counting, domains.free
    )
    tried = np.where(going[:, None], state.x + step, state.x)
    total, gradient, information = _evaluate_lanes(evaluate, tried, going, state)
    # Taken where the likelihood rises by a share of the foretold gain; where rounding hides that, if the gradient falls
    # or the step crosses a plateau.
    gain = total - state.total
    sound = going & _is_finite(total, gradient, information, moving)
    far = length > 0.9 * state.radius
    hidden = foretold < NOISE * np.abs(state.total)
    fell = expected_gain(gradient, information, counting) < expected_gain(state.gradient, state.information, counting)
    taken = sound & np.where(hidden, (fell | far) & (gain >= -NOISE * np.abs(total)), gain > TAKEN * foretold)
    # The radius by how well the gain was foretold.
    well = taken & ((gain > 0.75 * foretold) | hidden)
    badly = going & ~(sound & ((gain > 0.25 * foretold) | (hidden & taken)))
    wider = np.where(well & far, WIDER * state.radius, state.radius)
    radius = np.where(badly, NARROWER * np.minimum(length, state.radius), wider)
    model = _update_hessian(state, domains, step, gradient, information, gain, sound, taken)
    after = state._replace(
        x=np.where(taken[:, None], tried, state.x),
        total=np.where(taken, total, state.total),
        gradient=np.where(taken[:, None], gradient, state.gradient),
        information=np.where(taken[:, None, None], information, state.information),
        model=model,
        radius=radius,
    )
    return _mark_arrived(after, moving, domains, close)


def _join_lanes(state: _State, moving: np.ndarray, domains: OpenEnds) -> _State:
    """End each lane a that climbs to the same top as a lane b that is higher: it would learn nothing that b does not.

    By the information I of either, both are within JOINED standard errors of a top and of each other, and neighbours in
    every logarithm and logit. On the way d from a to b the likelihood rises as the slopes at both ends say,
    (g_a + g_b)' d / 2, exact of a quadratic, and bends down, (g_a - g_b)' d, by BENT of d' I d at least: between them
    is no saddle.
    """
    lanes, g = np.arange(len(state.x)), np.nan_to_num(state.gradient)
    d = state.x[None, :] - state.x[:, None]  # (a, b, p)
    both = np.einsum("abi,cij,abj->cab", d, np.nan_to_num(state.information), d)
    apart = np.maximum(both[lanes, lanes, :], both[lanes, :, lanes].T)  # d' I d by the information of a, and of b
    gain = state.total[None] - state.total[:, None]
    foretold = np.einsum("abi,abi->ab", d, g[:, None] + g[None]) / 2
    bend = np.einsum("abi,abi->ab", d, g[:, None] - g[None])
    # Both are before a top, and before the same one.
    before = (2 * state.remaining < JOINED**2) & (state.joined == lanes)
    beside = np.all(domains.free | (np.abs(d) < NEIGHBOURS), axis=2) & np.all(moving[:, None] == moving[None], axis=2)
    smooth = (np.abs(gain - foretold) <= ALIKE * gain + NOISE * np.abs(state.total)) & (bend >= BENT * apart)
    same = before[:, None] & before[None] & beside & (apart < JOINED**2) & smooth
    # The higher one goes on; of two that are as high the first.
    higher = same & ((gain > 0) | ((gain == 0) & (lanes[None] < lanes[:, None])))
    joins = ~state.done & np.any(higher, axis=1)
    best = np.argmax(np.where(higher, state.total[None], -np.inf), axis=1)
    return state._replace(joined=np.where(joins, best, state.joined), done=state.done | joins)


def _evaluate_lanes(evaluate: Evaluate, x: np.ndarray, going: np.ndarray, state: _State) -> Evaluated:
    """Return likelihood, gradient and information at x in the lanes that go on, and as they were in the others."""
    values = state.total.copy(), state.gradient.copy(), state.information.copy()
    for value, new in zip(values, evaluate(x[going]), strict=True):
        value[going] = new
    return values


def _update_hessian(
    state: _State,
    domains: OpenEnds,
    step: np.ndarray,
    gradient: np.ndarray,
    information: np.ndarray,
    gain: np.ndarray,
    sound: np.ndarray,
    taken: np.ndarray,
) -> np.ndarray:
    """Return the model B of minus the Hessian after a step p, in each lane.

    Of the information and the last model, corrected by the step (SR1), it is the one that would have foretold the gain
    g' p - p' B p / 2 better.

    Args:
        state: before the step.
        domains: of the numbers.
        step: p (lanes, numbers).
        gradient: at the end of the step.
        information: at the end of the step.
        gain: of the log-likelihood by the step.
        sound: whether what was found there is finite.
        taken: whether the step is.
    """
    # B+ = B + r r' / r' p with r = y - B p, so that B+ p = y, y the gradient before less that after the step.
    base = np.nan_to_num(state.model)
    residual = np.where(sound[:, None], np.nan_to_num(state.gradient - gradient), 0.0) - multiply_lanes(base, step)
    diagonal = np.diagonal(state.information, axis1=1, axis2=2)
    residual = np.where(domains.free | (diagonal > INVISIBLE), residual, 0.0)  # elsewhere y is but rounding
    along = np.sum(residual * step, axis=1)
    unit, _ = find_flat_directions(state.information, step != 0)
    size = np.sqrt(np.sum((residual * unit) ** 2, axis=1) * np.sum((step / np.where(unit > 0, unit, 1.0)) ** 2, axis=1))
    # r' p must be more than rounding of |r| |p|, both in standard errors.
    is_defined = sound & (np.abs(along) > DEFINED * size)
    update = residual[:, :, None] * residual[:, None, :] / np.where(is_defined, along, 1.0)[:, None, None]
    secant = base + np.where(is_defined[:, None, None], update, 0.0)
    # Of the two the one that would have foretold this gain.
    slope = np.sum(state.gradient * step, axis=1)
    by_model = slope - np.sum(step * multiply_lanes(base, step), axis=1) / 2
    by_information = slope - np.sum(step * multiply_lanes(np.nan_to_num(state.information), step), axis=1) / 2
    current_information = np.where(taken[:, None, None], information, state.information)
    model_is_better = sound & (np.abs(gain - by_model) <= np.abs(gain - by_information))
    corrected = np.where(sound[:, None, None], secant, base)
    return np.where((model_is_better | ~sound)[:, None, None], corrected, current_information)
