"""How good estimates of the robot's place are, and whether their filter knew."""

from dataclasses import dataclass

import numpy as np

from heliograph.model.estimate import Estimate

INSIDE_95 = -2 * np.log(0.05)  # 95 % point of chi-square with two degrees of freedom


@dataclass(frozen=True)
class Score:
    """How far off the position is, and whether the filter knew.

    NEES e' B^-1 e / 2 of the 2-D position error e against the claimed covariance B; 1 is honest. claimed_rmse_m:
    root of the mean trace of B. inside_95: share of rows where the truth lies inside the claimed 95 % ellipse.
    """

    position_rmse_m: float
    claimed_rmse_m: float
    nees_per_dimension: float
    inside_95: float


def score(estimate: Estimate, truth: np.ndarray, first: int = 0) -> Score:
    """Score one filter's estimates of the position, from row `first` on."""
    estimate = Estimate(np.asarray(estimate.mean)[first:], np.asarray(estimate.covariance)[first:], estimate.claim)
    truth = truth[first:]
    nees = position_nees(estimate, truth)
    squared = np.sum((np.asarray(estimate.mean) - truth)[:, :2] ** 2, axis=1)
    claimed = np.trace(np.asarray(estimate.covariance)[:, :2, :2], axis1=1, axis2=2)
    inside = np.mean(2 * nees <= INSIDE_95)
    return Score(float(np.sqrt(squared.mean())), float(np.sqrt(claimed.mean())), float(nees.mean()), float(inside))


def position_nees(estimate: Estimate, truth: np.ndarray) -> np.ndarray:
    """e' B^-1 e / 2 of the position at each row, (rows,)."""
    error = (np.asarray(estimate.mean) - truth)[:, :2, None]
    weighted = np.linalg.solve(np.asarray(estimate.covariance)[:, :2, :2], error)
    result: np.ndarray = np.sum(error * weighted, axis=(1, 2)) / 2
    return result
