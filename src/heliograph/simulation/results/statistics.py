"""Claimed against actual error: RMSE, NEES and the worst direction of the covariance, each with its standard error."""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from heliograph.model.estimate import Claim, weakest
from heliograph.numerics.check import fail, instance, items
from heliograph.numerics.module import readable
from heliograph.simulation.centres.uplinks import Uplink

BATCHES = 50  # runs are dealt to this many batches; the spread between batch means gives every standard error


@readable
@dataclass(frozen=True)
class ErrorStatistics:
    """Error statistics of one filter of one node: sums over the runs of each batch, from which every figure follows.

    Where no covariance is claimed, figures of covariances are NaN.

    Args:
        count: number of runs (batch,).
        pairs: sums of e_i e_j (batch, time, pair i <= j, row by row).
        claimed_pairs: mean claimed covariance, in the form of `pairs`.
        nees: sums of e' B^-1 e (batch, time).
        claim: what the filter claims of its covariance.
        uplink: of a fusion that has quantizers; None by default.
        failed: number of runs without a valid estimate at each step (time,); None by default.
        failed_runs: number of runs without a valid estimate at some step, 0 by default; if there are any, figures are
            NaN, with a warning.
    """

    count: np.ndarray
    pairs: np.ndarray
    claimed_pairs: np.ndarray
    nees: np.ndarray
    claim: Claim
    uplink: Uplink | None = None
    failed: np.ndarray | None = None
    failed_runs: int = 0

    @property
    def failure(self) -> str:
        """From which step on, and in how many runs, estimates were not valid, in words; "" if all were valid."""
        if not self.failed_runs:
            return ""
        moment = "mean" if self.claim == "none" else "covariance"
        step = 0 if self.failed is None else int(np.argmax(self.failed > 0))
        return f"no valid {moment} from step {step} in {self.failed_runs} of {self.runs} runs"

    def _warn_of_failures(self) -> None:
        """Warn, at the caller of a public method, that figures are NaN where some run had no valid estimate."""
        if self.failed_runs:
            warnings.warn(self.failure, stacklevel=3)

    @property
    def outer(self) -> np.ndarray:
        """Sums of e e', (batch, time, n, n)."""
        return expand_pairs(self.pairs)

    @property
    def covariance(self) -> np.ndarray:
        """Sums of claimed covariances, (batch, time, n, n)."""
        sums: np.ndarray = expand_pairs(self.claimed_pairs) * self.count[:, None, None, None]
        return sums

    @property
    def runs(self) -> int:
        """Number of runs."""
        return int(self.count.sum())

    def actual(self) -> np.ndarray:
        """Return E[e e'] over the runs, (time, n, n)."""
        moments: np.ndarray = expand_pairs(self.pairs.sum(axis=0)) / self.runs
        return moments

    def claimed(self) -> np.ndarray:
        """Return the mean claimed covariance, (time, n, n)."""
        covariance: np.ndarray = self.covariance.sum(axis=0) / self.runs
        return covariance

    def mean_trace(self) -> float:
        """Return the mean over time of the trace of the claimed covariance."""
        self._warn_of_failures()
        return float(np.trace(self.claimed(), axis1=-2, axis2=-1).mean())

    def rmse(self) -> tuple[float, float]:
        """Return the root of the mean over runs and steps of the squared error of all states, and its standard error.

        The error of a root: se(mse) / (2 rmse), with se(mse) from the batch means.
        """
        self._warn_of_failures()
        # `outer`: e e' summed over the runs of each batch, (batch, time, n, n).
        squared = np.trace(self.outer, axis1=-2, axis2=-1).mean(axis=1)
        return _root_mean(squared, self.count)

    def rmse_by_state(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the root mean squared error of each state over runs and steps, and its standard error: (n,), (n,).

        The standard error comes from the scatter between batches of runs.
        """
        self._warn_of_failures()
        # `outer`: e e' summed over the runs of each batch, (batch, time, n, n).
        squared = np.diagonal(self.outer, axis1=-2, axis2=-1).mean(axis=1)
        roots, errors = [], []
        for squared_of_state in squared.T:
            root, error = _root_mean(squared_of_state, self.count)
            roots.append(root)
            errors.append(error)
        return np.array(roots), np.array(errors)

    def deviation_by_state(self) -> np.ndarray:
        """Return the root of the mean, over runs and steps, of the variance claimed of each state, (n,)."""
        self._warn_of_failures()
        variance = np.diagonal(self.claimed(), axis1=-2, axis2=-1).mean(axis=0)
        return np.sqrt(np.where(variance >= 0, variance, np.nan))  # NaN of what is no variance

    def rmse_over_time(self) -> np.ndarray:
        """Return the root of the mean over runs of the squared error of all states, at each step, (time,)."""
        self._warn_of_failures()
        rmse: np.ndarray = np.sqrt(np.trace(self.actual(), axis1=-2, axis2=-1))
        return rmse

    def nees_per_dimension(self, confidence: float = 0.95) -> tuple[float, float, float]:
        """Return the mean over runs and steps of e' B^-1 e / n (1 if the claim is exact), with its confidence interval.

        e is the error of all n states, and B the covariance that the filter claims. The interval comes from the scatter
        of batches of runs, so correlation over time within a run does not matter.
        """
        self._warn_of_failures()
        n = self.outer.shape[-1]
        mean, error = _average_batches(self.nees.mean(axis=1) / n, self.count)
        # Use Student's t for the number of batches with runs, since the error is estimated from their scatter.
        freedom = max(int(np.count_nonzero(self.count)) - 1, 1)
        width = float(scipy.special.stdtrit(freedom, (1 + confidence) / 2)) * error
        return mean, mean - width, mean + width

    def worst_direction(self) -> "WorstDirection":
        """Return the largest ratio d' E[e e'] d / d' E[B] d over steps and directions d, with B the claimed covariance.

        Even batches choose step and direction and odd batches measure the ratio there, and then the reverse, so that
        the search does not bias the ratio. `z` is the excess over 1 in standard errors. The ratio is NaN if some error
        or claim is not finite.

        Raises:
            ValueError: fewer than 4 runs.
        """
        if self.runs < 4:
            raise fail("worst direction", "at least 4 runs", self.runs)
        outer, covariance = self.outer, self.covariance
        is_invalid = ~(np.isfinite(outer) & np.isfinite(covariance)).all(axis=(0, 2, 3))  # by step
        self._warn_of_failures()
        if np.any(is_invalid):
            undefined = np.full(outer.shape[-1], np.nan)
            return WorstDirection(np.nan, np.nan, int(np.argmax(is_invalid)), undefined)
        estimates = [self._estimate_worst_ratio(np.arange(BATCHES) % 2 == side, outer, covariance) for side in (0, 1)]
        return max(estimates, key=lambda estimate: estimate.ratio)

    def _estimate_worst_ratio(
        self, held_out: np.ndarray, outer: np.ndarray, covariance: np.ndarray
    ) -> "WorstDirection":
        """Return the ratio in the batches held out, in the direction of largest error over claim in the others.

        The ratio d' E[e e'] d / d' E[P] d compares errors e with the covariance P that the filter states (the claim),
        at one step in one direction d. Chosen as the largest and judged on the same runs, it would be too large by
        chance; so batches of runs are split, and some choose, others judge.

        Args:
            held_out: whether each batch is held out (batch,).
            outer: sums of e e' (batch, time, n, n).
            covariance: sums of claimed covariances (batch, time, n, n).
        """
        # Step and direction of the largest ratio in the batches that choose.
        choosing = ~held_out & (self.count > 0)
        actual, claimed = outer[choosing].sum(axis=0), covariance[choosing].sum(axis=0)
        values, directions = _solve_generalised_eigen(actual, claimed)
        step = int(np.argmax(values[:, -1]))
        d = directions[step, :, -1]
        # Its ratio in those held out.
        judged = held_out & (self.count > 0)
        error = np.einsum("i,bij,j->b", d, outer[judged, step], d)
        bound = np.einsum("i,bij,j->b", d, covariance[judged, step], d)
        ratio = float(error.sum() / bound.sum())
        # Linearised error of a ratio of means, E[error] / E[bound]: that of the mean of error - ratio bound, which is 0
        # over all batches, over the mean bound.
        counts = self.count[judged]
        _, residual_error = _average_batches(error - ratio * bound, counts)
        mean_bound = bound.sum() / counts.sum()
        return WorstDirection(
            ratio=ratio,
            standard_error=float(residual_error / mean_bound),
            step=step,
            direction=d / np.linalg.norm(d),
        )


def expand_pairs(pairs: np.ndarray) -> np.ndarray:
    """Return the symmetric matrices (..., n, n) with these entries i <= j, row after row (..., n (n + 1) / 2)."""
    n = (math.isqrt(8 * pairs.shape[-1] + 1) - 1) // 2  # solves n (n + 1) / 2 = number of entries
    index = np.zeros((n, n), dtype=int)
    index[np.triu_indices(n)] = np.arange(pairs.shape[-1])
    return np.asarray(pairs[..., np.maximum(index, index.T)])


def pool(statistics: Sequence[ErrorStatistics]) -> ErrorStatistics:
    """Pool the statistics of several nodes, their steps joined: means run over nodes as over steps.

    So nodes are averaged like steps, and not like runs: errors that nodes share do not count as independent, and
    standard errors come from the scatter between runs alone.

    Args:
        statistics: one for each node, of the same runs: sums by batch of runs and step (batch, steps, ...) of error
            products, claimed covariances and NEES (e' P^-1 e of an error e with the claimed covariance P).

    Raises:
        ValueError: nothing to pool, or statistics of different runs.
    """
    nodes = items("pooled statistics", statistics, "ErrorStatistics")
    for of_node in nodes:
        instance("pooled statistics", of_node, ErrorStatistics, "ErrorStatistics")
    # Statistics of the same runs have equal counts of runs in each batch.
    if not nodes or any(not np.array_equal(s.count, nodes[0].count) for s in nodes):
        raise fail("pooled statistics", "statistics of the same runs", f"{len(nodes)} that differ")
    # Runs that failed at each step of each node; where none were counted, none failed.
    failed = [np.zeros(s.nees.shape[1]) if s.failed is None else s.failed for s in nodes]
    steps = 1  # the axis of steps in sums (batch, steps, ...)
    return ErrorStatistics(
        count=nodes[0].count,
        pairs=np.concatenate([s.pairs for s in nodes], axis=steps),
        claimed_pairs=np.concatenate([s.claimed_pairs for s in nodes], axis=steps),
        nees=np.concatenate([s.nees for s in nodes], axis=steps),
        claim=weakest([s.claim for s in nodes]),  # what holds of all: "exact" is stronger than "upper", "nominal"
        failed=np.concatenate(failed),
        failed_runs=max(s.failed_runs for s in nodes),  # runs that failed at some step, of the worst node
    )


@readable
@dataclass(frozen=True)
class WorstDirection:
    """Direction in which the actual covariance exceeds the claimed one most.

    Args:
        ratio: of the actual variance in this direction to the claimed one.
        standard_error: of the ratio.
        step: at which the ratio is largest, from 0.
        direction: unit vector (n,).
    """

    ratio: float
    standard_error: float
    step: int
    direction: np.ndarray

    @property
    def z(self) -> float:
        """Excess of the ratio, of the actual variance to the claimed one, over 1 in standard errors; 0 without any."""
        return (self.ratio - 1) / self.standard_error if self.standard_error else 0.0


def _average_batches(sums: np.ndarray, count: np.ndarray) -> tuple[float, float]:
    """Return the mean of per-run values from their sums over batches, and its standard error from the batches' scatter.

    With s_b the sum and c_b = `count` the runs of batch b, G batches with runs, and m the mean: the squared standard
    error is G / (G - 1) sum_b (s_b - m c_b)^2 / (sum_b c_b)^2. It is NaN for fewer than two batches.
    """
    has_runs = count > 0
    sums, count = sums[has_runs], count[has_runs]
    mean = float(sums.sum() / count.sum())
    groups = len(count)
    if groups < 2:
        return mean, float("nan")
    # Batches may differ in their number of runs, so each sum is compared with the mean times this number.
    scatter = np.sum((sums - mean * count) ** 2) * groups / (groups - 1)
    return mean, float(np.sqrt(scatter) / count.sum())


def _root_mean(sums: np.ndarray, count: np.ndarray) -> tuple[float, float]:
    """Return the root of the mean m of per-run values from their sums over batches, and its standard error.

    The error is se(sqrt(m)) = se(m) / (2 sqrt(m)), or 0 if m is 0. `count`: number of runs in each batch.
    """
    mean, error = _average_batches(sums, count)
    root = float(np.sqrt(mean))
    return root, error / (2 * root) if root else 0.0


def _solve_generalised_eigen(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the eigenvalues and vectors of A d = value B d for stacks of symmetric A and positive semidefinite B.

    Each component is scaled by sqrt(B_ii), or by sqrt(A_ii) if B_ii is 0. W is chosen so that W' B W = I. The
    eigenvalues are then those of W' A W, and the vectors d are W times its eigenvectors.
    """
    root_b, root_a = (np.sqrt(np.maximum(np.diagonal(matrix, axis1=-2, axis2=-1), 0.0)) for matrix in (b, a))
    unit = np.where(root_b > 0, root_b, np.where(root_a > 0, root_a, 1.0))
    scale = unit[..., :, None] * unit[..., None, :]
    eigenvalues, vectors = np.linalg.eigh(b / scale)
    # W: B's eigenvectors over the roots of its eigenvalues, which count as at least one rounding error.
    whitening = vectors / np.sqrt(np.maximum(eigenvalues, np.finfo(float).eps))[..., None, :]
    values, rotated = np.linalg.eigh(np.swapaxes(whitening, -1, -2) @ (a / scale) @ whitening)
    return values, (whitening @ rotated) / unit[..., None]
