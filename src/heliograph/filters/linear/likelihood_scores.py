"""Log-likelihood, scores and information of recordings under a linear filter."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.filters.linear.innovation_derivatives import (
    EstimateWithDerivatives,
    differentiate_start,
    differentiate_step,
)
from heliograph.filters.rows.chunks import is_long, scan_in_chunks, sum_in_chunks
from heliograph.filters.rows.linear_recursion import Recursion
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.gaussian_density import differentiate_log_density
from heliograph.numerics.types import Array, PyTree

Scores = tuple[Array, Array, Array]  # log-densities, scores, information by half of the recording


class ScoreRecursion(Recursion):
    """A filter with free numbers x over rows: log-density and score of each row, with the derivatives of its estimate.

    Free numbers are those of the model that a fit searches, p of them. The score is the derivative of the log-density
    by them. Where it is `informed` also Fisher's information (2, p, p), by halves of the recording.

    Args:
        make: the filter by the free numbers, a `LinearFilter` with `has_score_recursion`.
        x: the free numbers (p,).
        half: number of the first row of the second half.
        known_gain: whether the channel's gain is known.
        informed: whether the information is computed, too.
    """

    make: Callable[[Array], Any] = eqx.field(static=True)
    x: Array
    half: Array
    known_gain: bool = eqx.field(static=True)
    informed: bool = eqx.field(static=True)

    def step(
        self, state: EstimateWithDerivatives, row: tuple[Array, Array], k: Array
    ) -> tuple[EstimateWithDerivatives, PyTree]:
        """Return the estimate and its derivatives after row k, and what is kept of the row.

        Kept are the innovation's log-density, its derivatives by the p free numbers, and where `informed` the
        information (2, p, p): of rows before `half`, and from it on, zero for the half to which the row does not
        belong.
        """
        after, (innovation, covariance, *slopes, present, is_invalid) = differentiate_step(
            self.make, self.x, state, row, k
        )
        z, _ = row
        innovation_slopes, covariance_slopes = slopes
        size = jnp.abs(z) + jnp.abs(z - innovation)  # of the terms whose difference is the innovation
        kept = differentiate_log_density(innovation, covariance, (innovation_slopes, covariance_slopes), size, present)
        # Where the estimate is no number, no likelihood is taken for that of silence.
        density, score, information = (jnp.where(is_invalid, jnp.nan, value) for value in kept)
        if not self.informed:
            return after, (density, score)
        in_half = jnp.stack([k < self.half, k >= self.half])
        return after, (density, score, jnp.where(in_half[:, None, None], information, 0.0))

    def scan(self, z: Array, u: Array) -> Scores:
        """Return log-densities (rows,) and scores (rows, p) row by row, and the information; it may be traced.

        p: free numbers. The information (2, p, p) is summed over each half of the rows.
        """
        Now = tuple[EstimateWithDerivatives, jax.Array]  # the estimate, and the information (2, p, p) so far

        def body(now: Now, row: tuple[Array, Array, Array]) -> tuple[Now, tuple[jax.Array, jax.Array]]:
            """Step over one row: add its information, and put out its log-density and score.

            `now` holds the estimate with its derivatives, and the information summed so far, for each half of the
            recording.
            """
            estimate, information = now
            k, z, u = row
            after, (density, score, information_of_row) = self.step(estimate, (z, u), k)
            return (after, information + information_of_row), (density, score)

        start: Now = (differentiate_start(self.make, self.x, self.known_gain), jnp.zeros((2, len(self.x), len(self.x))))
        (_, halves), (density, score) = jax.lax.scan(body, start, (jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u)))
        return density, score, halves

    def sum_long(self, z: np.ndarray, u: np.ndarray) -> Scores | None:
        """Return sums over all rows of a long recording, of log-densities, scores and information, by chunks of rows.

        Chunks run side by side, each from an estimate that has forgotten its start. Returns None if the recording is
        short or cannot be divided so. `self._start()` is the estimate before the first row, with its derivatives.
        """
        if not is_long(len(z)):
            return None
        by_chunk = sum_in_chunks(self, self._start(), (z, u))
        if by_chunk is None:
            return None
        summed: Scores = jax.tree.map(lambda sums: sums.sum(axis=0), by_chunk.outputs)
        return summed

    def scan_long(self, z: np.ndarray, u: np.ndarray) -> Scores | None:
        """Return log-densities, scores row by row and information, as `scan`, of a long recording: in chunks of rows.

        Returns None if the recording is short or cannot be divided into chunks.
        """
        sums = self.sum_long(z, u)
        if sums is None:
            return None
        # A second pass gives log-densities and scores row by row. It leaves out information, which is summed already.
        rows = scan_in_chunks(replace(self, informed=False), self._start(), (z, u))
        *_, information = sums
        return None if rows is None else (*rows.outputs, information)

    def _start(self) -> EstimateWithDerivatives:
        """Return the estimate before the first row with its derivatives, computed in double precision by XLA."""
        start: EstimateWithDerivatives = compute_once(_start_of, _start_by_xla, (self,))
        return start


def _start_of(recursion: ScoreRecursion) -> EstimateWithDerivatives:
    """Return the estimate before the first row, with its derivatives by the free numbers.

    A function of its own, so that it can be compiled: the body of `ScoreRecursion._start`.
    """
    return differentiate_start(recursion.make, recursion.x, recursion.known_gain)


_start_by_xla = quickly_compiled(_start_of)
