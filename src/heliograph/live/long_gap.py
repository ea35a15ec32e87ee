"""Many silent steps in bounded work: by real steps while they last, then by powers of the affine map that a step is."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.factors.columns import unit_lower
from heliograph.live.stored.old_layout import LOWER, VARIANCES, factorise, split_by_path
from heliograph.numerics.types import Float, PyTree

Step = Callable[[Float[np.ndarray, "row state"], int], Float[np.ndarray, "row state"]]
"""Silent step with a number from several states, each by itself."""

LONG = 10_000  # steps: a longer gap is not stepped through one by one
PROBED = 256  # steps by which a jump is proved
PROBES = 32  # after so many a state neither settles nor moves by an affine map
TAIL = 4  # steps taken one by one at the end, for what a filter remembers of the step before
SETTLED = 1e-13  # relative change over a probe: rounding
AGREES = 1e-8  # relative: what rounding leaves of a probe's differences
LEAST = 2.0**-40  # of an entry of the map, in units of the movements
STEADY = 0.01  # relative: a number that moves on by as much as before


class Factors(NamedTuple):
    """Places of the factors of one covariance, or several, in a row: lower (..., n (n - 1) / 2), variances (..., n)."""

    lower: np.ndarray
    variances: np.ndarray


def factors_in(places: PyTree) -> list[Factors]:
    """Return the places of all factors in a row, from the tree of a state whose leaves are their own places."""
    parts = {path: part.astype(int) for path, part in split_by_path(places).items()}
    stems = [path.removesuffix(VARIANCES) for path in parts if path.endswith(VARIANCES)]
    return [Factors(parts[stem + LOWER], parts[stem + VARIANCES]) for stem in stems if stem + LOWER in parts]


def convert_to_covariances(
    rows: Float[np.ndarray, "row state"], places: Sequence[Factors]
) -> Float[np.ndarray, "row state"]:
    """Return rows with the entries of L D L' in the places of those of L below its diagonal, and of D."""
    rows = rows.copy()
    for lower, variances in places:
        root, n = unit_lower(rows[:, lower]), variances.shape[-1]
        covariance = (root * rows[:, variances][..., None, :]) @ np.swapaxes(root, -1, -2)
        rows[:, lower] = covariance[..., *np.tril_indices(n, -1)]
        rows[:, variances] = np.diagonal(covariance, axis1=-2, axis2=-1)
    return rows


def convert_to_factors(
    rows: Float[np.ndarray, "row state"], places: Sequence[Factors]
) -> Float[np.ndarray, "row state"]:
    """Return what `convert_to_covariances` was given."""
    rows = rows.copy()
    for lower, variances in places:
        n = variances.shape[-1]
        covariance = np.zeros((len(rows), *variances.shape, n))
        below = np.tril_indices(n, -1)
        covariance[..., *below] = covariance[..., *below[::-1]] = rows[:, lower]
        covariance[..., np.arange(n), np.arange(n)] = rows[:, variances]
        rows[:, lower], rows[:, variances] = factorise(covariance)
    return rows


def pass_long_gap(step: Step, start: Float[np.ndarray, " state"], state: Float[np.ndarray, " state"], at: int,
                 count: int, places: Sequence[Factors] = ()) -> Float[np.ndarray, " state"]:  # fmt: skip
    """Return the state after `count` silent steps from one after step number `at`, in bounded work.

    A silent step s' = g(s) is affine in means and covariances where the plant is linear: P' = F P F' + Q. Numbers that
    do not move over a probe of real steps stay; for the others g(s + d) = g(s) + A d, with A by differences along each
    of them, and d' = A d + c with c = g(s) - s is raised to the power by squaring, d_2n = A^n d_n + d_n. The map is
    used only if it predicts the probe; factors L, D of a covariance are no affine map's, and are taken as L D L'.
    Otherwise real steps go on, PROBES times PROBED of them; what then moves on by
    as much as before, as the variance of a random walk does, is taken to go on so, and all else to stay. A state of
    which a number is not finite after that begins anew with `start`, the initial law.

    Args:
        step: the silent step.
        start: state by the initial law.
        state: state before the gap.
        at: number of the step that led to it.
        count: number of steps, at least 0.
        places: of the factors of covariances in a state.
    """
    after = _pass_silent_steps(step, state, at, count, places)
    return after if np.isfinite(after[np.isfinite(state)]).all() else start


def _pass_silent_steps(
    step: Step, state: Float[np.ndarray, " state"], at: int, count: int, places: Sequence[Factors]
) -> Float[np.ndarray, " state"]:
    """Take `count` steps of silence: a few probes, PROBED real steps each, and the rest at once by what these show.

    Where a probe moves nothing the state rests; where covariances follow an affine map it is applied as often as is
    left; else the probes are extrapolated. A state holds factors of covariances at `places`; affine are covariances.
    """
    passed = [state]

    def as_covariances(states: Sequence[Float[np.ndarray, " state"]]) -> Sequence[Float[np.ndarray, " state"]]:
        return list(convert_to_covariances(np.stack(states), places))

    def by_covariances(states: Float[np.ndarray, "row state"], k: int) -> Float[np.ndarray, "row state"]:
        return convert_to_covariances(step(convert_to_factors(states, places), k), places)

    for i in range(min(PROBES, count // PROBED)):
        passed.append(_step_through(step, passed[-1], at + i * PROBED, PROBED))
        if not (moving := _find_moving(*as_covariances(passed[-2:]))).any():
            return passed[-1]
        if i & (i + 1) == 0:  # after 1, 2, 4, ... probes
            jumped = _jump_by_affine_map(
                by_covariances, as_covariances(passed[-2:]), moving, at + i * PROBED, count - i * PROBED
            )
            if jumped is not None:
                return _restore_factors(jumped, places)
    done = PROBED * (len(passed) - 1)
    if count - done < PROBED:
        return _step_through(step, passed[-1], at + done, count - done)
    return _restore_factors(_extrapolate(as_covariances(passed), count - done), places)


def _restore_factors(state: Float[np.ndarray, " state"], places: Sequence[Factors]) -> Float[np.ndarray, " state"]:
    """Return one state with factors in the places of covariances."""
    alone: Float[np.ndarray, " state"] = convert_to_factors(state[None], places)[0]
    return alone


def _extrapolate(passed: Sequence[Float[np.ndarray, " state"]], count: int) -> Float[np.ndarray, " state"]:
    """Let go on what moved over the last quarter of some probes as it did over the quarter before."""
    quarter = len(passed) // 4
    end, middle, begin = (passed[-1 - i * quarter] for i in range(3))
    with np.errstate(invalid="ignore"):
        now, before = end - middle, middle - begin
        steady = np.isfinite(end) & (np.abs(now - before) <= STEADY * np.abs(before)) & _find_moving(middle, end)
    moved = end.copy()
    moved[steady] += now[steady] * (count / (quarter * PROBED))
    return moved


def _step_through(step: Step, state: Float[np.ndarray, " state"], at: int, count: int) -> Float[np.ndarray, " state"]:
    """Take `count` steps one by one."""
    states = state[None]
    for k in range(at + 1, at + count + 1):
        states = step(states, k)
    walked: Float[np.ndarray, " state"] = states[0].copy()
    return walked


def _find_moving(before: Float[np.ndarray, " state"], after: Float[np.ndarray, " state"]) -> np.ndarray:
    """Return the mask of the numbers that changed by more than rounding."""
    with np.errstate(invalid="ignore"):
        close = np.abs(after - before) <= SETTLED * np.maximum(np.abs(before), np.abs(after))
    moving: np.ndarray = ~(close | (before == after) | (np.isnan(before) & np.isnan(after)))
    return moving


def _jump_by_affine_map(step: Step, probe: Sequence[Float[np.ndarray, " state"]], moving: np.ndarray,
            at: int, count: int) -> Float[np.ndarray, " state"] | None:  # fmt: skip
    """Return the state `count` steps after the begin of a probe by the affine map there; None if the step is none."""
    state, probed = probe
    if not (np.isfinite(state[moving]) & np.isfinite(probed[moving])).all():
        return None
    # Differences along each number that moves, of the size of its own movement, which is a change that it makes.
    columns = np.flatnonzero(moving)
    size = np.exp2(np.ceil(np.log2(np.maximum(np.abs(probed - state), np.abs(state) * 2.0**-20)[columns])))
    tried = np.repeat(state[None], len(columns) + 1, axis=0)
    tried[np.arange(1, len(columns) + 1), columns] += size
    after = step(tried, at + 1)[:, columns]
    matrix, moved = ((after[1:] - after[0]) / size[:, None]).T, after[0] - state[columns]
    if not np.isfinite(matrix).all():
        return None
    # In units of the movements, rounding is taken off: a zero that is 1e-15 would couple what grows with what does not.
    units = size[:, None] / size
    matrix = np.round(matrix / units / LEAST) * LEAST * units
    # It has to predict the probe.
    with np.errstate(over="ignore", invalid="ignore"):
        expected = _iterate_affine_map(matrix, moved, PROBED)
        scale = np.abs(probed - state)[columns] + AGREES * np.abs(state)[columns]
        if not (
            np.abs(expected - (probed - state)[columns]) <= AGREES * scale + SETTLED * np.abs(probed)[columns]
        ).all():
            return None
        jumped = state.copy()
        jumped[columns] += _iterate_affine_map(matrix, moved, count)
    return jumped


def _iterate_affine_map(
    matrix: Float[np.ndarray, "m m"], moved: Float[np.ndarray, " m"], count: int
) -> Float[np.ndarray, " m"]:
    """Return d after `count` steps d' = A d + c from d = 0, by squaring the map."""
    total = np.zeros_like(moved)
    while count:
        if count & 1:
            total = matrix @ total + moved
        moved, matrix, count = matrix @ moved + moved, matrix @ matrix, count >> 1
    return total
