"""Auxiliary residuals: noises of plant and sensor estimated from all data, with the rows of breaks and outliers."""

from dataclasses import dataclass
from typing import Literal

import jax
import numpy as np
from scipy.special import ndtr

from heliograph.filters.base import AbstractFilter
from heliograph.filters.rows.run_over_data import check_data
from heliograph.forecasting.forecast_result import Array, Forecast
from heliograph.forecasting.one_step_predictions import predict_rows
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import fail, instance, scalar
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noises.noise import Gaussian

FALSE_SHOCK = 0.01  # probability of any false shock, of all tests together
RELATIVE_ROUNDING = 1e-10  # relative: means and covariances of what is measured and of what arrives that are the same
ROUNDING = 1e-12  # of a variance, below which nothing is known of a noise


@readable
@dataclass(frozen=True)
class Shock:
    """A row at which a noise is too large to be one.

    Args:
        row: its number, from 0.
        kind: "break" of a state, or "outlier" of an output.
        name: of the state or output.
        residual: the auxiliary residual there, in deviations.
        p: probability that any of all that were tested is as large, by Bonferroni, where the model is right.
    """

    row: int
    kind: Literal["break", "outlier"]
    name: str
    residual: float
    p: float


@readable
@dataclass(frozen=True)
class Disturbances:
    """Noises given all data, with the deviations that they have where the model is right; NaN where data say nothing.

    Args:
        outputs: names of the outputs, m of them.
        states: names of the states, n of them.
        output_noise: smoothed noise of each output, its mean given all data less that before any (steps, m).
        output_deviation: standard deviation with which that mean varies from one recording to another (steps, m).
        state_noise: smoothed noise of the plant on the way to each row, likewise (steps, n).
        state_deviation: standard deviation with which that mean varies (steps, n).
    """

    outputs: tuple[str, ...]
    states: tuple[str, ...]
    output_noise: Array
    output_deviation: Array
    state_noise: Array
    state_deviation: Array

    @property
    def output_residuals(self) -> Float[np.ndarray, "steps m"]:
        """Auxiliary residuals of the outputs, noise / deviation (steps, m); a large one marks an outlier.

        Where the model is right they are normal of variance 1, but not independent of each other.
        """
        residuals: np.ndarray = self.output_noise / self.output_deviation
        return residuals

    @property
    def state_residuals(self) -> Float[np.ndarray, "steps n"]:
        """Auxiliary residuals of the states, noise / deviation (steps, n); a large one marks a break of a state.

        Where the model is right they are normal of variance 1, but not independent of each other.
        """
        residuals: np.ndarray = self.state_noise / self.state_deviation
        return residuals

    def shocks(self, false: float = FALSE_SHOCK) -> list[Shock]:
        """List the breaks of states and the outliers of outputs in the order of their rows.

        Each residual is a test. A break also makes residuals of outputs large, an outlier also those of states, and
        both those of neighbouring rows. Of such neighbours the row with the largest residual stands for all.

        Args:
            false: probability of any shock where the model is right; 0.01 by default.

        Raises:
            ValueError: `false` is no probability.
        """
        level = float(scalar("false", false, 0, 1))
        residuals = np.concatenate([self.output_residuals, self.state_residuals], axis=1)
        size = np.nan_to_num(np.abs(residuals))  # (steps, m + n); 0 where data say nothing
        # Each finite residual is tested on both sides, and the tests share the probability (Bonferroni).
        tests = 2 * np.isfinite(residuals).sum()
        p = np.minimum(tests * ndtr(-size), 1.0)
        rows = _find_peaks(size.max(axis=1), is_candidate=p.min(axis=1) < level)
        return [self._make_shock(row, residuals[row], p[row], int(size[row].argmax())) for row in rows]

    def _make_shock(self, row: int, residuals: np.ndarray, p: np.ndarray, index: int) -> Shock:
        """Return the shock of a row, described by the residual with this index and its p-value.

        `residuals` and `p`: all of the row, first those of outputs and then those of states.
        """
        kind: Literal["break", "outlier"] = "outlier" if index < len(self.outputs) else "break"
        return Shock(
            row=row,
            kind=kind,
            name=(*self.outputs, *self.states)[index],
            residual=float(residuals[index]),
            p=float(p[index]),
        )


def disturbances(
    filter: AbstractFilter,
    z: Float[ArrayLike, "steps received"],
    u: Float[ArrayLike, "steps inputs"] | None = None,
) -> Disturbances:
    """Estimate the noises of plant and sensor at every row given all data, and how large they should be.

    Args:
        filter: a Kalman filter of a linear plant and sensor that do not vary, with Gaussian noises, whose channel hands
            on what is measured.
        z: measurements (steps, received), or (steps,) of one number; NaN for what did not arrive.
        u: inputs (steps, inputs), the one that led to each row; by default a filter without inputs is assumed.

    Raises:
        ValueError: another filter, data of another size, no rows.

    Source: Durbin and Koopman, Time Series Analysis by State Space Methods (2012), Sections 2.12 and 4.5.
    """
    instance("filter", filter, AbstractFilter, "a filter, such as kalman_filter(...)")
    plant, sensor = _require_linear_model(filter)
    rows, inputs = check_data(filter, z, u)
    predicted = predict_rows(filter, rows, inputs)
    if not _is_received_unchanged(predicted):
        raise fail("disturbances", "a filter whose channel hands on what is measured", "one with gains or noise")
    # Estimates of both noises given all data, with their covariances if the model is right, from the innovations e of
    # the filter's predictions. The filter predicts what arrives, which here is what is measured.
    C, R = np.asarray(sensor.matrix), np.asarray(sensor.noise.covariance)
    A, Q = np.asarray(plant.matrix), np.asarray(plant.noise.covariance)  # type: ignore[union-attr]  # a Gaussian's
    assert predicted.received is not None
    e = np.asarray(rows) - predicted.received.mean
    of_outputs, of_plant = _smooth_noises(A, C, Q, R, e, predicted.states.covariance)
    output_noise, output_deviation = _compute_deviations(*of_outputs)
    state_noise, state_deviation = _compute_deviations(*of_plant)
    return Disturbances(
        outputs=tuple(predicted.received.names),
        states=tuple(filter.states),
        output_noise=output_noise,
        output_deviation=output_deviation,
        state_noise=state_noise,
        state_deviation=state_deviation,
    )


def _require_linear_model(filter: AbstractFilter) -> tuple[LinearPlant, LinearSensor]:
    """Return plant and sensor of a filter for a linear Gaussian model that does not vary.

    Raises:
        ValueError: another filter.
    """
    assumed = filter.assumed
    plant, sensor = (None, None) if assumed is None else (assumed.plant, assumed.sensor)
    # A model that does not vary has arrays for matrices.
    if (
        filter.claim == "exact"
        and isinstance(plant, LinearPlant)
        and isinstance(sensor, LinearSensor)
        and all(isinstance(part, np.ndarray | jax.Array) for part in (plant.matrix, sensor.matrix))
        and all(isinstance(noise, Gaussian) for noise in (plant.noise, sensor.noise))
        and not (plant.circular or sensor.circular)
    ):
        return plant, sensor
    expected = "a Kalman filter, exact for a linear plant and sensor that do not vary, with Gaussian noises"
    raise fail("disturbances", expected, f"{type(filter).__name__}, {filter.claim}")


def _is_received_unchanged(predicted: Forecast) -> bool:
    """Return whether what arrives is predicted as what is measured, as if the channel hands it on unchanged.

    RELATIVE_ROUNDING: the largest relative difference that counts as rounding.
    """
    measured, received = predicted.outputs, predicted.received
    if measured is None or received is None or measured.mean.shape != received.mean.shape:
        return False
    has_same_covariance = np.allclose(measured.covariance, received.covariance, rtol=RELATIVE_ROUNDING, atol=0)
    return has_same_covariance and np.allclose(measured.mean, received.mean, rtol=RELATIVE_ROUNDING, atol=1e-300)


def _smooth_noises(
    A: np.ndarray, C: np.ndarray, Q: np.ndarray, R: np.ndarray, e: np.ndarray, P: np.ndarray
) -> tuple[tuple[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return the means of the outputs' noise and of the plant's given all data, and the covariances of these means.

    The covariances tell how far a mean strays from 0 where the model is right, not how well the noise is known: each is
    the noise's covariance less that of the noise given the data. Shapes: means (steps, size), covariances
    (steps, size, size).

    Given all data a noise v has the mean E[v | data], which varies with the data: its covariance is what is returned,
    not that of the noise given the data, Cov[v | data] = R - Cov E[v | data].

    Backward over the rows with r and N = Cov r, which hold what all later rows tell. At each row, with
    S = C P C' + R and K = P C' S^-1:

    - the outputs' noise has the mean R (S^-1 e - K' r), whose covariance is R (S^-1 + K' N K) R;
    - r <- C' S^-1 e + (I - K C)' r takes this row in;
    - the plant's noise on the way to the row has the mean Q r, whose covariance is Q N Q;
    - r <- A' r leads to the row before.

    A filter predicts before its first row too, so that row has a noise of the plant. Rows of C that did not arrive are
    left out. Rows before the first at which all of an unknown start had been heard stay NaN.

    Args:
        A: transition (n, n).
        C: matrix of the sensor (m, n).
        Q: covariance of the plant's noise (n, n).
        R: covariance of the sensor's noise (m, m).
        e: innovations (steps, m), NaN where nothing arrived.
        P: predicted covariances (steps, n, n).
    """
    steps, m = e.shape
    n = len(A)
    output_mean = np.full((steps, m), np.nan)
    output_covariance = np.full((steps, m, m), np.nan)
    plant_mean = np.full((steps, n), np.nan)
    plant_covariance = np.full((steps, n, n), np.nan)
    is_known = np.isfinite(P).all(axis=(1, 2))  # an unknown start has infinite variances
    first_known = int(np.argmax(is_known)) if is_known.any() else steps
    r, N = np.zeros(n), np.zeros((n, n))
    for k in reversed(range(first_known, steps)):
        arrived = np.flatnonzero(~np.isnan(e[k]))
        C_k = C[arrived]
        R_k = R[np.ix_(arrived, arrived)]
        S = C_k @ P[k] @ C_k.T + R_k
        # S^-1 e and K
        weighed = np.linalg.solve(S, e[k, arrived])
        K = np.linalg.solve(S, C_k @ P[k]).T
        output_mean[k, arrived] = R_k @ (weighed - K.T @ r)
        output_covariance[k][np.ix_(arrived, arrived)] = R_k @ (np.linalg.inv(S) + K.T @ N @ K) @ R_k
        B = np.eye(n) - K @ C_k
        r = C_k.T @ weighed + B.T @ r
        N = C_k.T @ np.linalg.solve(S, C_k) + B.T @ N @ B
        plant_mean[k], plant_covariance[k] = Q @ r, Q @ N @ Q
        r = A.T @ r
        N = A.T @ N @ A
    return (output_mean, output_covariance), (plant_mean, plant_covariance)


def _compute_deviations(mean: np.ndarray, covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return means (steps, size) and their standard deviations, both NaN where the variance is only rounding.

    A variance up to the share ROUNDING of the largest over the steps counts as
    rounding.

    Args:
        mean: means of a noise given all data (steps, size).
        covariance: how these means vary where the model is right (steps, size, size).
    """
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    largest = np.max(variance, axis=0, where=np.isfinite(variance), initial=0.0)
    is_above_rounding = variance > ROUNDING * largest
    return np.where(is_above_rounding, mean, np.nan), np.sqrt(np.where(is_above_rounding, variance, np.nan))


def _find_peaks(size: np.ndarray, is_candidate: np.ndarray) -> list[int]:
    """Return, for each run of neighbouring candidate rows, the row with the largest size.

    Args:
        size: largest residual of each row (rows,).
        is_candidate: which rows have a residual that counts as a shock (rows,).
    """
    rows = np.flatnonzero(is_candidate)
    if not len(rows):
        return []
    runs = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1)
    return [int(run[np.argmax(size[run])]) for run in runs]
