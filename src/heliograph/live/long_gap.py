"""Many silent steps in bounded work: some real steps, then powers of the affine map that a step is."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.factors.covariance_factors import unit_lower
from heliograph.live.stored.old_layout import LOWER, VARIANCES, factorise_covariance, split_by_path
from heliograph.numerics.types import Float, PyTree

Step = Callable[[Float[np.ndarray, "row state"], int], Float[np.ndarray, "row state"]]
"""Takes several states, each by itself, through the silent step with this number."""

LONG = 10_000  # steps: a longer gap is not stepped through one by one
PROBED = 256  # steps of a probe: so many are computed one by one, to see how the state moves
PROBES = 32  # most probes: a state that then neither rests nor moves by an affine map is extrapolated
TAIL = 4  # steps taken one by one at the end, for what a filter remembers of the step before
SETTLED = 1e-13  # a relative change of a number over a probe up to this is rounding
AGREES = 1e-8  # relative error up to which the affine map has to predict a probe
LEAST = 2.0**-40  # the map's entries are rounded to multiples of this, in units of the numbers' movements
STEADY = 0.01  # relative difference up to which two changes count as equal: the number goes on at this rate


class FactorIndices(NamedTuple):
    """Where a row has the factors of one covariance, or several: lower (..., n (n - 1) / 2), variances (..., n)."""

    lower: np.ndarray
    variances: np.ndarray


def find_factor_indices(indices: PyTree) -> list[FactorIndices]:
    """Return the indices in a row of all factors L and D of covariances.

    `indices` is a state's tree whose leaves hold their own indices in the row. The path of a factor L ends with LOWER,
    and that of a factor D with VARIANCES.
    """
    indices_by_path = {path: leaf.astype(int) for path, leaf in split_by_path(indices).items()}
    stems = [path.removesuffix(VARIANCES) for path in indices_by_path if path.endswith(VARIANCES)]
    return [
        FactorIndices(indices_by_path[stem + LOWER], indices_by_path[stem + VARIANCES])
        for stem in stems
        if stem + LOWER in indices_by_path
    ]


def convert_to_covariances(
    rows: Float[np.ndarray, "row state"], factors: Sequence[FactorIndices]
) -> Float[np.ndarray, "row state"]:
    """Return rows in which entries of P = L D L' replace the factors: below the diagonal L's, and on it D's."""
    rows = rows.copy()
    for lower, variances in factors:
        factor, diagonal = unit_lower(rows[:, lower]), rows[:, variances]  # L, and the diagonal of D
        covariance = (factor * diagonal[..., None, :]) @ np.swapaxes(factor, -1, -2)  # (L D) L'
        rows[:, lower] = covariance[..., *np.tril_indices(variances.shape[-1], -1)]
        rows[:, variances] = np.diagonal(covariance, axis1=-2, axis2=-1)
    return rows


def convert_to_factors(
    rows: Float[np.ndarray, "row state"], factors: Sequence[FactorIndices]
) -> Float[np.ndarray, "row state"]:
    """Return rows with the factors L and D of each covariance L D L' where the covariance stood.

    The covariance stands where its factors do: entries below its diagonal in those of L (`lower`), and its
    diagonal in those of D (`variances`).
    """
    rows = rows.copy()
    for lower, variances in factors:
        n = variances.shape[-1]
        covariance = np.zeros((len(rows), *variances.shape, n))
        below = np.tril_indices(n, -1)  # entries (i, j) below the diagonal; (j, i) are equal
        covariance[..., *below] = covariance[..., *below[::-1]] = rows[:, lower]
        covariance[..., np.arange(n), np.arange(n)] = rows[:, variances]
        rows[:, lower], rows[:, variances] = factorise_covariance(covariance)
    return rows


def pass_long_gap(step: Step, start: Float[np.ndarray, " state"], state: Float[np.ndarray, " state"], at: int,
                 count: int, factors: Sequence[FactorIndices] = ()) -> Float[np.ndarray, " state"]:  # fmt: skip
    """Return the state after `count` silent steps from one after step number `at`, in bounded work.

    A silent step g (one without a measurement) of a linear plant is affine in mean and covariance: x' = F x,
    P' = F P F' + Q. So a few real steps (a probe) show how the rest go. Numbers that do not move over a probe stay. Of
    the others g(s + d) = g(s) + A d, A by differences. The map d' = A d + c, c = g(s) - s, is repeated by doubling,
    d_2n = A^n d_n + d_n, and used only if it predicts the probe. Without such a map up to PROBES * PROBED real steps
    are made; then a number that moves equally in each probe, as a variance of a random walk, is extrapolated, and all
    others stay. A result that is not finite is replaced by `start`, the initial law.

    Args:
        step: the silent step g.
        start: state by the initial law.
        state: state before the gap.
        at: number of the step that led to it.
        count: number of steps, at least 0.
        factors: where a state holds factors L, D of a covariance. These are not affine, but P = L D L' is.
    """
    after = _pass_silent_steps(step, state, at, count, factors)
    stays_finite = np.isfinite(after[np.isfinite(state)]).all()  # what was finite is so still
    return after if stays_finite else start


def _pass_silent_steps(
    step: Step, state: Float[np.ndarray, " state"], at: int, count: int, factors: Sequence[FactorIndices]
) -> Float[np.ndarray, " state"]:
    """Return the state after `count` steps of silence: a few probes, and the rest at once by what these show.

    Silence is a gap without data, in which a filter only predicts. It may last millions of steps, so a few are really
    computed. A probe is PROBED (256) real steps in a row. If a probe changes no number, the state stays. If an affine
    map of the state predicts a probe, the map is applied for all later steps. Else the probes are extrapolated. A state
    holds factors L, D of covariances at `factors`; states are compared and extrapolated with L D L' there, since
    P' = F P F' + Q is affine in P and not in its factors.

    Args:
        step: computes one step of silence, of states with factors.
        state: state before the gap: means, factors and all else of the filters, in one array.
        at: number of the step that led to `state`.
        count: number of steps of silence.
        factors: where the factors of covariances stand in a state.
    """
    after_probes = [state]  # the states after 0, 1, 2, ... probes

    def with_covariances(states: Sequence[Float[np.ndarray, " state"]]) -> Sequence[Float[np.ndarray, " state"]]:
        """Return states with covariances in place of their factors."""
        return list(convert_to_covariances(np.stack(states), factors))

    def step_covariances(states: Float[np.ndarray, "row state"], k: int) -> Float[np.ndarray, "row state"]:
        """Return states with covariances after the silent step with number k."""
        return convert_to_covariances(step(convert_to_factors(states, factors), k), factors)

    for i in range(min(PROBES, count // PROBED)):
        after_probes.append(_step_through(step, after_probes[-1], at + i * PROBED, PROBED))
        probe = with_covariances(after_probes[-2:])
        entries_moving = _find_moving(*probe)
        if not entries_moving.any():
            return after_probes[-1]
        # After 1, 2, 4, ... probes (i + 1 is a power of two) the map is tried, which costs a step for each entry. It
        # starts from the state before the newest probe, which it has to predict.
        if i & (i + 1) == 0:
            begin, left = at + i * PROBED, count - i * PROBED
            jumped = _jump_by_affine_map(step_covariances, probe, entries_moving, begin, left)
            if jumped is not None:
                return _restore_factors(jumped, factors)
    done = PROBED * (len(after_probes) - 1)
    if count - done < PROBED:  # few enough to be stepped one by one
        return _step_through(step, after_probes[-1], at + done, count - done)
    return _restore_factors(_extrapolate_state(with_covariances(after_probes), count - done), factors)


def _restore_factors(
    state: Float[np.ndarray, " state"], factors: Sequence[FactorIndices]
) -> Float[np.ndarray, " state"]:
    """Return one state with factors L and D in place of covariances L D L'."""
    with_factors: Float[np.ndarray, " state"] = convert_to_factors(state[None], factors)[0]  # of several, here of one
    return with_factors


def _extrapolate_state(passed: Sequence[Float[np.ndarray, " state"]], count: int) -> Float[np.ndarray, " state"]:
    """Return the state `count` steps after the last of the states `passed`, which are PROBED steps apart.

    A number that changed by as much in the last quarter of the states as in the quarter before goes on at this rate.
    All other numbers stay. STEADY is the relative difference up to which two changes count as equal.
    """
    quarter = len(passed) // 4
    end, middle, begin = passed[-1], passed[-1 - quarter], passed[-1 - 2 * quarter]
    with np.errstate(invalid="ignore"):
        last_change, change_before = end - middle, middle - begin
        changes_are_equal = np.abs(last_change - change_before) <= STEADY * np.abs(change_before)
        goes_on = np.isfinite(end) & changes_are_equal & _find_moving(middle, end)
    extrapolated = end.copy()
    steps_of_change = quarter * PROBED
    extrapolated[goes_on] += last_change[goes_on] * (count / steps_of_change)
    return extrapolated


def _step_through(step: Step, state: Float[np.ndarray, " state"], at: int, count: int) -> Float[np.ndarray, " state"]:
    """Return the state after `count` steps, taken one by one after step number `at`."""
    states = state[None]
    for k in range(at + 1, at + count + 1):
        states = step(states, k)
    stepped: Float[np.ndarray, " state"] = states[0].copy()
    return stepped


def _find_moving(before: Float[np.ndarray, " state"], after: Float[np.ndarray, " state"]) -> np.ndarray:
    """Return the mask of a state's numbers that changed by more than rounding.

    A relative change up to SETTLED counts as rounding. NaN that stays NaN did not change.
    """
    with np.errstate(invalid="ignore"):
        is_rounding = np.abs(after - before) <= SETTLED * np.maximum(np.abs(before), np.abs(after))
    is_equal, stays_nan = before == after, np.isnan(before) & np.isnan(after)  # is_equal also covers two infinities
    moving: np.ndarray = ~(is_rounding | is_equal | stays_nan)
    return moving


def _jump_by_affine_map(step: Step, probe: Sequence[Float[np.ndarray, " state"]], moving: np.ndarray,
            at: int, count: int) -> Float[np.ndarray, " state"] | None:  # fmt: skip
    """Return the state `count` steps after the begin of a probe by the affine map there; None if it fails the probe.

    A filter without messages repeats the same step many times; a long gap is jumped over in one go. With s the state
    before the probe (some real steps) and g the step, g(s + d) = g(s) + A d nearly, so that the distance d from s goes
    on by d' = A d + c, c = g(s) - s. The map must predict the result of the probe, else None is returned.

    Args:
        step: the silent step g, of states with covariances.
        probe: the state s before, and the state after, PROBED real steps; (state,) each.
        moving: indices or mask of the numbers that changed over the probe; the map is of these alone.
        at: number of the step before the probe.
        count: how many steps to go on from there.
    """
    state, probed = probe
    if not (np.isfinite(state[moving]) & np.isfinite(probed[moving])).all():
        return None
    # Measure A and c by differences.
    columns = np.flatnonzero(moving)
    A, c = _measure_affine_map(step, state, probed - state, columns, at)
    if not np.isfinite(A).all():
        return None
    # The map has to predict the probe, to AGREES of the movement; rounding of the numbers themselves does not count.
    with np.errstate(over="ignore", invalid="ignore"):
        predicted, movement = _iterate_affine_map(A, c, PROBED), (probed - state)[columns]
        scale = np.abs(movement) + AGREES * np.abs(state)[columns]
        rounding = SETTLED * np.abs(probed)[columns]
        if not (np.abs(predicted - movement) <= AGREES * scale + rounding).all():
            return None
        # Go on by the map from s: s + d after `count` steps.
        jumped = state.copy()
        jumped[columns] += _iterate_affine_map(A, c, count)
    return jumped


def _measure_affine_map(
    step: Step, state: Float[np.ndarray, " state"], movement: Float[np.ndarray, " state"], columns: np.ndarray, at: int
) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, " m"]]:
    """Return A and c = g(s) - s of the step g(s + d) = g(s) + A d, by differences along each of the m `columns`.

    Args:
        step: the step g of the filter without a measurement.
        state: the state s.
        movement: by how much each number moved over some real steps: the scale of the difference along it.
        columns: numbers of the state that move; A and c are of these alone.
        at: number of the step before.
    """
    # h: by how much each number is changed. A power of two of about the size of the movement, so that the division is
    # exact, and not less than 2^-20 of the number itself, so that rounding does not count.
    h = np.exp2(np.ceil(np.log2(np.maximum(np.abs(movement), np.abs(state) * 2.0**-20)[columns])))
    tried = np.repeat(state[None], len(columns) + 1, axis=0)  # s itself, then s with one number changed
    tried[np.arange(1, len(columns) + 1), columns] += h
    after = step(tried, at + 1)[:, columns]
    g_of_s, g_of_changed = after[0], after[1:]
    A = ((g_of_changed - g_of_s) / h[:, None]).T  # A_ij = (g_i(s + h_j e_j) - g_i(s)) / h_j
    # Round A to LEAST, in units of the movements: an entry 0 computed as 1e-15 would make a number at rest grow with
    # one that grows for ever.
    units = h[:, None] / h
    c = g_of_s - state[columns]
    return np.round(A / units / LEAST) * LEAST * units, c


def _iterate_affine_map(A: Float[np.ndarray, "m m"], c: Float[np.ndarray, " m"], count: int) -> Float[np.ndarray, " m"]:
    """Return d after `count` steps d' = A d + c from d = 0, by squaring the map.

    Before turn i of the loop, (A, c) is the map of 2^i steps, which is applied if bit i of `count` is 1. Twice the map
    d' = A d + c is A (A d + c) + c = A^2 d + (A c + c).
    """
    d = np.zeros_like(c)
    while count:
        lowest_bit = count & 1
        if lowest_bit:
            d = A @ d + c
        A, c = A @ A, A @ c + c
        count >>= 1
    return d
