"""Levenberg-Marquardt on the Gauss-Newton information, from several starts side by side."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from heliograph.numerics.types import Bool, Float

MOST_STEPS = 100
LONGEST = 1.5  # of a step, in each coordinate
FLAT = 1e-10  # eigenvalue of the scaled information below which nothing is to be gained in a direction
CLOSE = 1e-15  # twice the likelihood that a full step would gain: 3e-8 standard errors away
NEAR = 1e-8  # the same where rounding lets nothing better be found: 1e-4 standard errors
NOISE = 1e-13  # of a log-likelihood's own size: its rounding
SOFTEST, HARDEST = 1e-7, 1e8  # damping that is none, and at which a start is given up

Evaluated = tuple[Float[np.ndarray, " lanes"], Float[np.ndarray, "lanes p"], Float[np.ndarray, "lanes p p"]]
Evaluate = Callable[[Float[np.ndarray, "lanes p"]], Evaluated]


class Maximum(NamedTuple):
    """Ends of the climbs: the point of each lane, its likelihood, whether it converged, and the steps taken.

    Shapes: x (lanes, p), total (lanes,), converged (lanes,).
    """

    x: Float[np.ndarray, "lanes p"]
    total: Float[np.ndarray, " lanes"]
    converged: Bool[np.ndarray, " lanes"]
    steps: int


class _State(NamedTuple):
    x: np.ndarray
    total: np.ndarray
    gradient: np.ndarray
    information: np.ndarray
    damping: np.ndarray
    growth: np.ndarray
    done: np.ndarray
    converged: np.ndarray


def maximise(
    evaluate: Evaluate,
    start: Float[np.ndarray, "lanes p"],
    active: Bool[np.ndarray, "lanes p"] | None = None,
    watch: Callable[[Maximum], None] | None = None,
) -> Maximum:
    """Climb from each start by (I + damping diag I)^-1 s; `active` coordinates move, the others stay.

    A lane has converged when a full step would gain less than rounding sees. `watch` sees the best so far.
    """
    moving = np.ones(start.shape, dtype=bool) if active is None else active
    with np.errstate(all="ignore"):
        state = _begin(evaluate, start, moving)
        for count in range(MOST_STEPS):
            best = Maximum(state.x, state.total, state.converged, count)
            if watch is not None:
                watch(best)
            if state.done.all():
                return best
            state = _step(evaluate, state, moving)
    return Maximum(state.x, state.total, state.converged, MOST_STEPS)


def _begin(evaluate: Evaluate, start: np.ndarray, moving: np.ndarray) -> _State:
    total, gradient, information = evaluate(start)
    none = ~np.isfinite(total)
    damping, growth = np.full(len(start), 1e-2), np.full(len(start), 2.0)
    state = _State(start.copy(), total, gradient, information, damping, growth, none, np.zeros(len(start), dtype=bool))
    return _judged(state, moving)


def _judged(state: _State, moving: np.ndarray) -> _State:
    """Mark the lanes that have arrived: the gain that an undamped step promises is nothing."""
    whole = steps_of(state.gradient, state.information, np.zeros(len(state.x)), moving)
    promised = np.sum(np.clip(whole, -LONGEST, LONGEST) * np.nan_to_num(state.gradient), axis=1)
    stuck = state.damping > HARDEST
    arrived = ~state.done & (promised < np.where(stuck, NEAR, CLOSE))
    return state._replace(done=state.done | stuck | arrived, converged=state.converged | arrived)


def _step(evaluate: Evaluate, state: _State, moving: np.ndarray) -> _State:
    step = np.clip(steps_of(state.gradient, state.information, state.damping, moving), -LONGEST, LONGEST)
    going = ~state.done
    tried = np.where(going[:, None] & (step != 0), state.x + step, state.x)
    # a damped step, accepted where the likelihood does not fall
    total, gradient, information = evaluate(tried)
    sound = np.isfinite(total) & np.isfinite(gradient).all(axis=1) & np.isfinite(information).all(axis=(1, 2))
    gain = total - state.total
    better = going & sound & (gain >= -NOISE * np.abs(state.total))
    # damping by the ratio of gain and promise
    promised = np.sum(step * (state.gradient - np.einsum("lij,lj->li", state.information, step) / 2), axis=1)
    softer = np.clip(1 - (2 * gain / np.maximum(promised, 1e-300) - 1) ** 3, 1 / 5, 4.0)  # Nielsen's rule
    harder = np.where(going, np.maximum(state.damping, 1e-3) * state.growth, state.damping)
    damping = np.where(better, state.damping * softer, harder)
    pick = better[:, None]
    after = _State(
        np.where(pick, tried, state.x),
        np.where(better, total, state.total),
        np.where(pick, gradient, state.gradient),
        np.where(pick[:, None], information, state.information),
        np.where(damping < SOFTEST, 0.0, damping),
        np.where(better, 2.0, np.where(going, state.growth * 2, state.growth)),
        state.done,
        state.converged,
    )
    return _judged(after, moving)


def steps_of(
    gradient: np.ndarray, information: np.ndarray, damping: np.ndarray, moving: np.ndarray
) -> Float[np.ndarray, "lanes p"]:
    """Steps (I + damping diag I)^-1 s of the coordinates that move; none in directions that are flat."""
    there = moving & (np.diagonal(information, axis1=1, axis2=2) > 0)
    unit = np.where(there, 1 / np.sqrt(np.where(there, np.diagonal(information, axis1=1, axis2=2), 1.0)), 0.0)
    scaled = np.nan_to_num(information * unit[:, :, None] * unit[:, None, :])
    values, vectors = np.linalg.eigh((scaled + scaled.swapaxes(1, 2)) / 2)
    inverse = np.where(values > FLAT, 1 / (np.where(values > FLAT, values, 1.0) + damping[:, None]), 0.0)
    along = np.einsum("lij,li->lj", vectors, np.nan_to_num(gradient) * unit)
    return np.asarray(np.einsum("lij,lj->li", vectors, along * inverse) * unit)
