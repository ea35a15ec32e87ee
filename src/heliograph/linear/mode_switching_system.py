"""Linear system of a state whose motion and measurement are random maps that share modes of a Markov chain."""

import numpy as np

from heliograph.linear.jump_system import mix_moments_of_modes, propagate_by_mode
from heliograph.linear.plant_and_measurement_maps import list_checked_steps
from heliograph.linear.system import LinearSystem, Steps
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.numerics.check import array, covariance, fail
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, check_maps
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.moments.second_moments import nominal_covariance
from heliograph.random_affine.series_and_stack import Stack

Moments = tuple[Float[np.ndarray, "M m n1"], Float[np.ndarray, "M m m n1 n1"]]  # E[(G, n)] and its covariance, by mode


def modal_system(
    move: Channel,
    measure: Channel,
    initial_mean: "Float[ArrayLike, ' n']",
    initial_covariance: "Float[ArrayLike, 'n n']",
    horizon: int,
    projection: "Float[ArrayLike, 'q n'] | None" = None,
) -> LinearSystem:
    """Return the system of y 1{mode} for a state y+ = `move`(y) and z = `measure`(y+), both random affine maps.

    Its state stacks y~ = (y, 1) times the indicator 1{j} of each joint mode j of the two maps' memories; the modes are
    a chain, Pi[i, j] = P(next mode j | mode i).

    A plant that depends on a mode is a `move` with modes; a relay that filters behind a shared fading is a `move` of
    (x, its estimate), and the receiver behind the same fading a `measure` with the same chain. The two maps of a step
    are independent given its modes. With H_j the move in mode j and E_i = E[y~ y~' 1{i}],

        F[j, i] = Pi[i, j] E H_j,
        Cov(w)[j, l] = sum_i Pi_ij (delta_jl - Pi_il) E H_j E_i E H_l' + delta_jl sum_i Pi_ij Spread_j(E_i),

    where Spread_j(E[y~ y~']) = E[(H_j - E H_j) y~ y~' (H_j - E H_j)'] is the part of Cov(H_j y~) that the randomness of
    H_j adds. `LinearSystemFilter` filters the result, exactly.

    Args:
        move: motion of y, from n to n numbers; its memories are chains.
        measure: measurement of y.
        initial_mean: mean of y before the first step (n,).
        initial_covariance: its covariance (n, n).
        horizon: number of steps.
        projection: matrix W (q, n) of the estimated W y; all of y unless given.

    Raises:
        ValueError: maps whose sizes do not fit, gains in `move` that drift (no finitely many functions of them are
            closed), fewer steps than the horizon.
    """
    n = _find_state_size(move, measure)
    # Mean and covariance of the homogeneous coordinates y~ = (y, 1).
    mean = np.append(array("initial mean", initial_mean, (n,)), 1.0)
    initial = np.pad(covariance("initial covariance", initial_covariance, n), ((0, 1), (0, 1)))
    wanted = np.eye(n) if projection is None else array("what is to be known", projection, (None, n))
    pairs = zip(list_checked_steps(move, horizon), list_checked_steps(measure, horizon), strict=True)
    modes_by_step = [joint_modes(Stack(pair)) for pair in pairs]
    # E_i = E[y~ y~' 1{i}] and Cov(y~ 1{i}) at the start, where the chain of the modes has not moved yet.
    law = np.asarray(modes_by_step[0].initial)
    chain = np.eye(len(law))
    moments = law[:, None, None] * (np.outer(mean, mean) + initial)
    start = np.kron(np.diag(law), initial) + np.kron(np.diag(law) - np.outer(law, law), np.outer(mean, mean))
    steps = list[Steps]()
    for modes in modes_by_step:
        # In each mode the map is a pair (move, measure), a Stack of both; mean and covariance of each one's entries.
        moves, measures = zip(*(m.maps for m in modes.maps if isinstance(m, Stack)), strict=True)
        transition, process, moments = _propagate_modes(_take_moments_by_mode(list(moves)), chain, moments)
        measure_mean, measure_covariance = _take_moments_by_mode(list(measures))
        noise = np.einsum("jabcd,jcd->ab", measure_covariance, moments)  # Cov(v) = sum_j Spread_j(E_j)
        output = np.concatenate(list(measure_mean), axis=1)
        no_drift, no_offset = np.zeros(len(transition)), np.zeros(len(output))
        steps.append(Steps(transition, no_drift, process, output, no_offset, noise))
        chain = np.asarray(modes.transition)
    return LinearSystem(
        Steps(*map(np.array, zip(*steps, strict=True))),
        mean=np.kron(law, mean),
        covariance=start,
        projection=np.tile(np.pad(wanted, ((0, 0), (0, 1))), (1, len(law))),
    )


def _find_state_size(move: Channel, measure: Channel) -> int:
    """Return the number of states n, and check that `move` maps n numbers to n and that `measure` takes n numbers.

    Raises:
        ValueError: maps of other sizes, or gains in `move` that drift (Gaussian ones, instead of chains of modes).
    """
    for what, affine in (("move", move), ("measure", measure)):
        check_maps(what, [first(affine)])
    n = int(first(move).inputs)
    sizes = {"outputs of the move": first(move).outputs, "inputs of the measurement": first(measure).inputs}
    for name, size in sizes.items():
        if size != n:
            raise fail(name, f"{n}, the move's inputs", size)
    if any(memory.drifts for memory in memories(move).values()):
        raise fail("move", "chains as its memories", "a gain that drifts")
    return n


def _take_moments_by_mode(maps: list[AbstractRandomAffine]) -> Moments:
    """Return, for the map y -> G y + n of each mode, E[(G, n)] and the covariances of the entries of (G, n).

    `moments(1).mean` is E of the homogeneous matrix [G, n; 0, 1], whose last row is dropped.
    """
    means = [affine.moments(1).mean[:-1] for affine in maps]
    covariances = [nominal_covariance(affine).center for affine in maps]
    return np.array(means), np.array(covariances)


def _propagate_modes(
    move: Moments, rows: np.ndarray, moments: np.ndarray
) -> tuple[Float[np.ndarray, "N N"], Float[np.ndarray, "N N"], Float[np.ndarray, "M n1 n1"]]:
    """Return the transition F, Cov(w) and the next second moments of the stacked state (y~ 1{mode j})_j.

    y is the state of a system that switches between modes of a Markov chain; stacked with the modes' indicators it
    follows a linear system with white noise w. In a step to mode j, y~ = (y, 1) becomes H_j y~ with a random H_j. Given
    mode i before, the next mode is j with probability Pi_ij. So

        F[j, i] = Pi_ij E H_j,   E_j+ = E H_j Y_j E H_j' + S_j,   Y_j = sum_i Pi_ij E_i,
        Cov(w)[j, l] = sum_i Pi_ij (delta_jl - Pi_il) E H_j E_i E H_l' + delta_jl S_j,

    where E_i = E[y~ y~' 1{i}] and S_j = sum_cd Cov(H_ac, H_bd) Y_j[c, d] is the noise of the random H_j.

    Args:
        move: E H_j without its last row, and the covariances of the entries of H_j, by mode.
        rows: Pi (modes, modes).
        moments: E_i (modes, n + 1, n + 1) before the step.
    """
    mean, covariance_of_move = move
    modes, size = len(moments), moments.shape[-1]
    # E H_j (modes, n + 1, n + 1), with the last row (0, ..., 0, 1), which keeps the constant of y~.
    EH = np.concatenate([mean, np.tile(np.eye(1, size, size - 1), (modes, 1, 1))], axis=1)
    Y = mix_moments_of_modes(rows, moments)
    S = np.pad(np.einsum("jabcd,jcd->jab", covariance_of_move, Y), ((0, 0), (0, 1), (0, 1)))
    # Pi_ij (delta_jl - Pi_il): covariance of the indicators of the next modes j and l, given mode i.
    indicator_covariance = rows[:, :, None] * (np.eye(modes)[None] - rows[:, None, :])
    # Blocks [j, a, l, b] of Cov(w) and [j, a, i, b] of F: entry (a, b) of block (j, l) or (j, i).
    process = np.einsum("ijl,jac,icd,lbd->jalb", indicator_covariance, EH, moments, EH)
    process[np.arange(modes), :, np.arange(modes), :] += S
    transition = np.einsum("ij,jab->jaib", rows, EH).reshape(modes * size, modes * size)
    return transition, process.reshape(modes * size, modes * size), propagate_by_mode(EH, Y, S)
