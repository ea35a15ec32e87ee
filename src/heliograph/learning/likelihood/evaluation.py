"""Log-likelihood, scores and information of recordings at points; long recordings in chunks side by side."""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.learning.likelihood.data import LikelihoodData
from heliograph.learning.likelihood.objective import Objective, choose_typical_network, make_filter_of_form
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.gaussian_density import differentiate_log_density
from heliograph.numerics.trace_settings import write_for_derivatives
from heliograph.numerics.types import Array, Float


class Evaluation(NamedTuple):
    """Log-likelihood l of recordings at some points, with its derivatives by the p free numbers.

    A point is a vector of the free numbers as unconstrained coordinates (p,). Values are given by block: a block is a
    row, or all rows together of a long recording.

    Args:
        density: log density of each block (points, recordings, blocks); their sum is l.
        score: gradient of each block's log density (points, recordings, blocks, p).
        halves: Gauss-Newton information, which approximates the Hessian of -l, of the first and the second half of the
            rows, summed over recordings (points, 2, p, p).
    """

    density: Float[Array, "points recordings blocks"]
    score: Float[Array, "points recordings blocks p"]
    halves: Float[Array, "points 2 p p"]

    @property
    def information(self) -> Float[np.ndarray, "points p p"]:
        """Gauss-Newton information of all data at each point (points, p, p)."""
        return np.asarray(self.halves.sum(axis=1))

    @property
    def late(self) -> Float[np.ndarray, "points p p"]:
        """Information of the second half of the rows alone, where the law of the initial state hardly matters."""
        return np.asarray(self.halves[:, 1])

    @property
    def total(self) -> Float[np.ndarray, " points"]:
        """Log-likelihood of all data at each point."""
        return np.asarray(self.density.sum(axis=(1, 2)))

    @property
    def gradient(self) -> Float[np.ndarray, "points p"]:
        """Gradient of the log-likelihood of all data at each point."""
        return np.asarray(self.score.sum(axis=(1, 2)))


def evaluate_at_points(
    objective: Objective, x: Float[np.ndarray, "points p"], data: LikelihoodData, by_row: bool = False
) -> Evaluation:
    """Return log-likelihoods, scores and information of all recordings at each of several points.

    A maximum search needs them (score: the gradient by the free numbers; information: the Gauss-Newton matrix). A long
    recording may be divided in chunks that are filtered side by side, point by point. All other points are taken side
    by side in native code, or one by one by XLA.

    Args:
        objective: makes the filter from the free numbers.
        x: the points (points, p): free numbers as unconstrained coordinates.
        data: the recordings: measurements (recordings, steps, received), inputs and lengths.
        by_row: whether densities and scores of each row are needed; else there may be sums over all rows.
    """
    with jax.enable_x64(True):
        # By chunks; None at points where that cannot be done.
        by_point = [_evaluate_in_chunks(objective, point, data, by_row) for point in x]
        remaining = [i for i, evaluation in enumerate(by_point) if evaluation is None]
        if len(remaining) == len(x):
            return _evaluate_side_by_side(objective, x, data)
        # The remaining points row by row, summed as the others are.
        if remaining:
            of_remaining = _evaluate_side_by_side(objective, x[remaining], data)
            of_remaining = of_remaining if by_row else _sum_rows(of_remaining)
            for n, i in enumerate(remaining):
                by_point[i] = Evaluation(*(leaf[n : n + 1] for leaf in of_remaining))
    # Join the points again, field by field.
    by_field = zip(*(evaluation for evaluation in by_point if evaluation), strict=True)
    return Evaluation(*(np.concatenate(leaves) for leaves in by_field))


def _evaluate_in_chunks(objective: Objective, x: np.ndarray, data: LikelihoodData, by_row: bool) -> Evaluation | None:
    """Return the evaluation at one point x (p,), each recording in chunks side by side; None where that cannot be done.

    A chunk is a part of a long recording that is filtered apart, which is possible if the filter forgets its start. It
    is not done where recordings are short, true states are learned from, or the filter forgets too late.

    Recursions over rows give log densities, their scores (gradients by x), and `halves`, the information (2, p, p)
    summed over the first and over the second half of the rows: by row, or summed over all rows.

    Args:
        objective: makes the filter from the free numbers.
        x: the free numbers as unconstrained coordinates (p,).
        data: the recordings.
        by_row: whether densities and scores of each row are needed; else they are sums over all rows, one block.
    """
    # Only a linear filter has such a recursion, `score_rows`; None for others.
    linear = _find_linear_filter(objective) if data.truth is None else None
    if linear is None:
        return None
    half = np.asarray(data.measurements.shape[1] // 2)  # number of the first row of the second half
    recursion = linear.score_rows(objective.filter, x, half)
    by_recording = []
    for z, u in zip(data.measurements, data.inputs, strict=True):
        evaluated = recursion.scan_long(z, u) if by_row else recursion.sum_long(z, u)
        if evaluated is None:  # too short, or slow to forget
            return None
        by_recording.append(evaluated)
    # (recordings, rows), (recordings, rows, p), (recordings, 2, p, p); without the axis of rows if these were summed.
    density, score, halves = (np.stack(leaves) for leaves in zip(*by_recording, strict=True))
    # Information is summed over recordings. A leading axis for the one point; sums over all rows are one block.
    whole = Evaluation(density=density[None], score=score[None], halves=halves.sum(axis=0)[None])
    return whole if by_row else whole._replace(density=density[None, :, None], score=score[None, :, None])


def _sum_rows(rows: Evaluation) -> Evaluation:
    """Return an evaluation by row with log densities and their gradients summed over all rows, as one block.

    The information (`halves`) is a sum over rows already.
    """
    density = rows.density.sum(axis=2, keepdims=True)  # (points, recordings, rows) -> (points, recordings, 1)
    score = rows.score.sum(axis=2, keepdims=True)  # (points, recordings, rows, p) -> (points, recordings, 1, p)
    return Evaluation(density, score, rows.halves)


def _evaluate_side_by_side(objective: Objective, x: np.ndarray, data: LikelihoodData) -> Evaluation:
    """Return the evaluation of all recordings, row by row, at all points x (points, p), each pair side by side.

    Our own compiled code computes it if `choose_code` finds some for these arguments, else XLA, pair by pair.

    Args:
        objective: makes the filter from the free numbers.
        x: the points (points, p).
        data: the recordings.
    """
    data_rows = [rows for rows in (data.measurements, data.inputs, data.truth) if rows is not None]
    # Pair each point with each recording, point after point.
    count, copies = len(data.measurements), (len(x), 1, 1)
    pairs = np.repeat(x, count, axis=0), *(np.tile(rows, copies) for rows in data_rows)
    choice = choose_code(evaluate_recording, (objective, *pairs), differs_by_run=[False, *(True for _ in pairs)])
    if choice.code is not None:
        results = choice.results()
    else:
        results_of_pairs = [to_numpy(_by_xla(objective, *pair)) for pair in zip(*pairs, strict=True)]
        results = jax.tree.map(lambda *leaves: np.stack(leaves), *results_of_pairs)
    density, score, halves = (leaf.reshape(len(x), count, *leaf.shape[1:]) for leaf in results)
    return Evaluation(density=density, score=score, halves=halves.sum(axis=1))


def evaluate_recording(objective: Objective, x: Array, z: Array, u: Array, truth: Array | None = None) -> Evaluation:
    """Return each row's log-likelihood and score in one recording, and the information of its two halves.

    Row k has the log density log N(e_k; 0, S_k), with the filter's innovation e_k and its covariance S_k; with `truth`,
    e_k is the error of the filter's estimate and S_k the covariance that the filter states. The score is the derivative
    of the log density in the p free numbers, the information that of Gauss and Newton. Information is summed over each
    half of the rows apart, because knowledge of the initial state adds to the first half alone: the second shows what
    data identify.

    Args:
        objective: makes the filter from the free numbers.
        x: the free numbers as unconstrained coordinates (p,).
        z: measurements (steps, received), NaN where nothing arrived.
        u: inputs of the plant (steps, inputs).
        truth: true states (steps, n), NaN where unknown; None for the likelihood of the measurements.

    Returns:
        `Evaluation` of shapes: density (steps,), score (steps, p), halves (2, p, p).
    """
    half = jnp.asarray(len(z) // 2)
    # A linear filter has a recursion of its own for these derivatives.
    linear = _find_linear_filter(objective) if truth is None else None
    if linear is not None:
        density, score, halves = linear.score_rows(objective.filter, x, half).scan(z, u)
        return Evaluation(density=density, score=score, halves=halves)
    # e_k and S_k of all rows, and their derivatives in x.
    e, s, de, ds = _differentiate_errors(objective, x, z, u, truth)

    def add_row(halves: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        """Return the information of both halves with that of a row added, and the row's log density and score.

        `half`: the row at which the second half begins. `row`: its number k, the error e with covariance s and their
        derivatives, and `compared`, the measurement or true state that is compared with the prediction.
        """
        k, e, s, de, ds, compared = row
        # A measurement may end in the modes of a channel, which are not predicted, so e may be shorter.
        compared = compared[: len(e)]
        size = jnp.abs(compared) + jnp.abs(compared - e)  # of what e is the difference of, which bounds its rounding
        density, score, information = differentiate_log_density(e, s, (de, ds), size, ~jnp.isnan(e))
        is_in_half = jnp.stack([k < half, k >= half])
        return halves + jnp.where(is_in_half[:, None, None], information, 0.0), (density, score)

    rows = jnp.arange(len(z)), e, s, de, ds, jnp.asarray(z if truth is None else truth)
    halves, (density, score) = jax.lax.scan(add_row, jnp.zeros((2, len(x), len(x))), rows)
    return Evaluation(density=density, score=score, halves=halves)


def _differentiate_errors(
    objective: Objective, x: Array, z: Array, u: Array, truth: Array | None
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return e (steps, m), its covariance S (steps, m, m), and their derivatives in the p numbers x.

    e are the innovations, or with `truth` the errors of the estimates. The derivatives de (steps, p, m) and dS (steps,
    p, m, m) are by forward mode.

    Args:
        objective: makes the filter from the free numbers.
        x: the free numbers as unconstrained coordinates (p,).
        z: measurements (steps, received).
        u: inputs (steps, inputs).
        truth: true states (steps, n), or None.
    """

    def errors_at(x: Array) -> tuple[jax.Array, jax.Array]:
        """Return e and S at x."""
        return objective.compute_innovations(x, z, u) if truth is None else objective.compute_errors(x, z, u, truth)

    def differentiate_along(axis: jax.Array) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]:
        """Return (e, S) at x, and their derivatives along one axis of x."""
        return jax.jvp(errors_at, (x,), (axis,))

    with write_for_derivatives():
        (e, s), (de, ds) = jax.vmap(differentiate_along, out_axes=(None, 1))(jnp.eye(len(x)))
    return e, s, de, ds


@lru_cache
def _find_linear_filter(objective: Objective) -> Any:
    """Return the filter of the objective if it computes the likelihood's gradient (score) itself; else None.

    The linear form filters by means and covariances of gains. Its network is the description's start, or one near it
    if a gain that is random near the start is not at the start itself.
    """
    description = objective.description
    is_linear = objective.form == "linear"
    network = choose_typical_network(description) if is_linear else description.start
    filter = make_filter_of_form(network, objective.form)
    return filter if filter.has_score_recursion else None


_by_xla = quickly_compiled(evaluate_recording)
