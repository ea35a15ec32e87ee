"""Likelihood, scores and information of recordings at points of the line, of long ones in chunks side by side."""

from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.learning.likelihood.data import LikelihoodData
from heliograph.learning.likelihood.objective import Objective, filter_of
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.gaussian_density import differentiate_log_density
from heliograph.numerics.types import Array, Float


class Evaluation(NamedTuple):
    """Log-likelihoods and scores of blocks of rows at points of the line, and the Gauss-Newton information of halves.

    A block is a row, or all rows of a long recording.

    Shapes: density (points, recordings, blocks), score (points, recordings, blocks, p), halves (points, 2, p, p).
    """

    density: Float[Array, "points recordings blocks"]
    score: Float[Array, "points recordings blocks p"]
    halves: Float[Array, "points 2 p p"]

    @property
    def information(self) -> Float[np.ndarray, "points p p"]:
        """Gauss-Newton information of all data."""
        return np.asarray(self.halves.sum(axis=1))

    @property
    def late(self) -> Float[np.ndarray, "points p p"]:
        """Information of the second half, to which the initial state adds nothing."""
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
    """Return likelihood, scores and information at points: all side by side in native code, or one by one by XLA.

    Long recordings are taken one by one, in chunks side by side, where the filter forgets how it began.

    Args:
        objective: the likelihood.
        x: the points.
        data: the recordings.
        by_row: whether densities and scores of each row are needed; else there may be sums over all rows.
    """
    with jax.enable_x64(True):
        chunked = [_evaluate_in_chunks(objective, point, data, by_row) for point in x]
        rest = [i for i, one in enumerate(chunked) if one is None]
        if len(rest) == len(x):
            return _evaluate_side_by_side(objective, x, data)
        if rest:
            whole = _evaluate_side_by_side(objective, x[rest], data)
            whole = whole if by_row else _sum_rows(whole)
            for n, i in enumerate(rest):
                chunked[i] = Evaluation(*(leaf[n : n + 1] for leaf in whole))
    return Evaluation(*(np.concatenate(leaves) for leaves in zip(*(one for one in chunked if one), strict=True)))


def _evaluate_in_chunks(objective: Objective, x: np.ndarray, data: LikelihoodData, by_row: bool) -> Evaluation | None:
    """Evaluate one point by chunks of each recording; None where these are short, or cannot be divided."""
    kalman = _kalman_of(objective) if data.truth is None else None
    if kalman is None:
        return None
    rows, parts = kalman.score_rows(objective.filter, x, np.asarray(data.measurements.shape[1] // 2)), []
    for z, u in zip(data.measurements, data.inputs, strict=True):
        kept = rows.scan_long(z, u) if by_row else rows.sum_long(z, u)
        if kept is None:
            return None
        parts.append(kept)
    density, score, halves = (np.stack(leaves) for leaves in zip(*parts, strict=True))
    whole = Evaluation(density[None], score[None], halves.sum(axis=0)[None])
    return whole if by_row else whole._replace(density=density[None, :, None], score=score[None, :, None])


def _sum_rows(rows: Evaluation) -> Evaluation:
    """Return the same by sums over all rows."""
    density, score = (leaf.sum(axis=2, keepdims=True) for leaf in (rows.density, rows.score))
    return Evaluation(density, score, rows.halves)


def _evaluate_side_by_side(objective: Objective, x: np.ndarray, data: LikelihoodData) -> Evaluation:
    """Evaluate all points and recordings row by row, side by side."""
    data_rows = [rows for rows in (data.measurements, data.inputs, data.truth) if rows is not None]
    count, copies = len(data.measurements), (len(x), 1, 1)
    runs = np.repeat(x, count, axis=0), *(np.tile(data_row, copies) for data_row in data_rows)
    choice = choose_code(evaluate_recording, (objective, *runs), [False, *(True for _ in runs)])
    if choice.code is not None:
        results = choice.results()
    else:
        parts = [to_numpy(_by_xla(objective, *run)) for run in zip(*runs, strict=True)]
        results = jax.tree.map(lambda *leaves: np.stack(leaves), *parts)
    density, score, halves = (leaf.reshape(len(x), count, *leaf.shape[1:]) for leaf in results)
    return Evaluation(density, score, halves.sum(axis=1))


def evaluate_recording(objective: Objective, x: Array, z: Array, u: Array, truth: Array | None = None) -> Evaluation:
    """Evaluate one recording: density (steps,), score (steps, p) and information (2, p, p); derivatives run forward.

    With the true states e is the error of the estimates and S what they claim.
    """
    half = jnp.asarray(len(z) // 2)
    kalman = _kalman_of(objective) if truth is None else None
    if kalman is not None:
        return Evaluation(*kalman.score_rows(objective.filter, x, half).scan(z, u))

    def along(x: Array) -> tuple[jax.Array, jax.Array]:
        return objective.innovations(x, z, u) if truth is None else objective.errors(x, z, u, truth)

    (e, s), (de, ds) = jax.vmap(lambda axis: jax.jvp(along, (x,), (axis,)), out_axes=(None, 1))(jnp.eye(len(x)))

    def judge(halves: jax.Array, row: tuple[jax.Array, ...]) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        k, e, s, de, ds, z = row
        size = jnp.abs(z[: len(e)]) + jnp.abs(z[: len(e)] - e)
        density, score, information = differentiate_log_density(e, s, (de, ds), size, ~jnp.isnan(e))
        within = jnp.stack([k < half, k >= half])
        return halves + jnp.where(within[:, None, None], information, 0.0), (density, score)

    rows = jnp.arange(len(z)), e, s, de, ds, jnp.asarray(z if truth is None else truth)
    halves, (density, score) = jax.lax.scan(judge, jnp.zeros((2, len(x), len(x))), rows)
    return Evaluation(density, score, halves)


@lru_cache
def _kalman_of(objective: Objective) -> Any:
    """Return the filter at the start where it is a linear one behind a known gain; None of others."""
    start = filter_of(objective.description.start, objective.form)
    return start if start.has_known_gain else None


_by_xla = quickly_compiled(evaluate_recording)
