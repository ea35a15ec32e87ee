"""Scaled coordinates in which the matrix inequalities of H-infinity designs are of order one, and the way back."""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from heliograph.h_infinity.error_system import GrowthSystem
from heliograph.h_infinity.step_inequality import StepMatrices, Unknowns
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

CONVERGED = 0.1  # more of each error's variance: what the gain of the step before may cost to be searched near again
RANK = 1e-12  # share of the largest correlation of received numbers below which a combination is taken for none
SMALLEST = 1e-6  # of what an error's size was before a measurement: as small as one measurement can make it


class ScaledCoordinates(NamedTuple):
    """Scaled coordinates in which a design is computed, and the way back to the user's units.

    Args:
        states: diag(S1, S2) of (x, e) = diag(S1, S2) (scaled x, scaled e), before every step and after the last.
        received: size of each received number at each step.
        forms: size of each growth form, a quadratic form that bounds an unknown function, at each step.
        unit: in which the level is measured.
        nothing_grows: whether the unknown functions f and h are both zero.
    """

    states: Float[np.ndarray, "times w w"]
    received: Float[np.ndarray, "steps m"]
    forms: Float[np.ndarray, "steps multipliers"]
    unit: float
    nothing_grows: bool

    def relative_scales(self, k: int) -> tuple[float, float]:
        """Return the scales of the state x and the error e before step k, each divided by the larger of both.

        Objectives of the design are of weights of x and e, and by these scales they keep the user's units. Scaled
        coordinates are defined by (x, e) = diag(S1, S2) (scaled x, scaled e); `self.states` holds diag(S1, S2). If the
        plant or the sensor has a nonlinear function f, known by |f(x)| <= a |x|, S1 and S2 are numbers times I.
        Otherwise (`self.nothing_grows`) they are full matrices, which have no one scale, and (1, 1) is returned.
        """
        if self.nothing_grows:
            return 1.0, 1.0
        scale_of_x, scale_of_e = float(self.states[k, 0, 0]), float(self.states[k, -1, -1])
        larger = max(scale_of_x, scale_of_e)
        return scale_of_x / larger, scale_of_e / larger

    def unscale_weight(self, scaled: Float[np.ndarray, "w w"], k: int) -> Float[np.ndarray, "w w"]:
        """Return the weight P_k in the user's units, unit^2 S'^-1 P S^-1 from P in scaled coordinates.

        S = `self.states`[k] takes scaled (x, e) to those in the user's units. Scaled weights are in units of the level
        squared, whose unit is `self.unit`^2.
        """
        half = np.linalg.solve(self.states[k].T, scaled)  # S'^-1 P
        return self.unit**2 * _symmetrise(np.linalg.solve(self.states[k].T, half.T))

    def scale_initial_weight(self, weight: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
        """Return the weight P_0 of the first (x, e) in scaled coordinates, S'P_0 S / unit^2 with S = diag(S1, S2)."""
        return _symmetrise(self.states[0].T @ weight @ self.states[0]) / self.unit**2

    def unscale_gain(self, scaled: Float[np.ndarray, "n m"], k: int) -> Float[np.ndarray, "n m"]:
        """Return the gain of step k in the user's units, S2 K r^-1.

        It takes what is received, of sizes r, to a correction of e, of scale S2 after the step.
        """
        n = len(scaled)
        return np.asarray(self.states[k + 1, n:, n:] @ scaled / self.received[k])

    def unscale_multipliers(self, unknowns: Unknowns, k: int) -> Float[np.ndarray, "multipliers"]:
        """Return the multipliers of the growth forms of step k in the user's units, from those that were found.

        A form was divided by its size and the inequality by unit^2, so a multiplier is multiplied by their ratio.
        """
        return np.asarray(self.unit**2 * unknowns.multipliers / self.forms[k])


def _symmetrise(a: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
    """Return (A + A') / 2."""
    return np.asarray((a + a.T) / 2)


def scale_steps(
    system: GrowthSystem, steps: list[StepMatrices], gains: Float[np.ndarray, "steps n m"] | None = None
) -> tuple[list[StepMatrices], ScaledCoordinates]:
    """Return the steps in coordinates in which all numbers are of order one, and the way back to the user's units.

    A solver of matrix inequalities needs numbers of like size. Scales are the deviations of the state x, the error e
    and what is received, if disturbances were independent noises of unit variance and the filter had these `gains`;
    None stands for gains near the best predictor's. These are the nominal gains of the scaled steps, whose unknown is a
    correction of them. `steps` has each step's matrices over eta, the vector of x, e, nonlinear parts and disturbances.
    """
    n, nothing_grows = system.states, system.growth.absent and system.output_growth.absent
    # Covariances of x_0 and e_0 from the initial weight.
    initial = np.diag(1 / np.diagonal(system.initial_weight))
    x, e = initial[:n, :n], initial[n:, n:]
    state_scales, received_scales, form_scales = [_choose_state_scales(x, e, nothing_grows)], [], []
    scaled, largest_target, nominal = list[StepMatrices](), 0.0, steps[0].nominal
    for k, step in enumerate(steps):
        # Covariances of (x, e) after the step with the nominal gain, and scales from these.
        eta = _compute_eta_covariance(system, k, step, x, e)
        largest_target = max(largest_target, float(np.trace(step.target @ eta)))
        after = _propagate_covariances(step, eta, None if gains is None else gains[k])
        x, e = after.state, after.error
        is_taken_as_it_is = gains is not None or k == 0  # else the gain of the step before may serve
        nominal = after.gain if is_taken_as_it_is else _keep_gain(nominal, after.gain, after.innovation, e)
        state_scales.append(_choose_state_scales(x, e, nothing_grows))
        received_scales.append(_powers_of_four_near(np.sqrt(np.diagonal(after.innovation))))
        eta_scales = _choose_eta_scales(system, k, step, state_scales[k])
        # Scales that make the largest entry of each growth form 1. Forms are diagonal, and so, with growth, are the
        # scales of eta.
        size = np.max(np.abs(step.growth) * np.diagonal(eta_scales) ** 2, axis=1, initial=0.0)
        form_scales.append(np.where(size > 0, size, 1.0))
        scaled.append(_rescale_step(step, eta_scales, state_scales[k + 1], received_scales[k], form_scales[k], nominal))
    if largest_target == 0:
        raise fail("wanted matrix", "one that is not zero", "zero at every step")
    # Levels in units of the largest root of E |M e|^2.
    unit = float(_nearest_power_of_four(np.sqrt(largest_target)))
    coordinates = ScaledCoordinates(
        states=np.array(state_scales),
        received=np.array(received_scales),
        forms=np.array(form_scales),
        unit=unit,
        nothing_grows=nothing_grows,
    )
    return [s._replace(target=s.target / unit**2) for s in scaled], coordinates


def _nearest_power_of_four(size: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return the power of 4 nearest to a size, by which numbers are scaled without rounding."""
    return np.asarray(4.0 ** np.round(np.log(size) / np.log(4.0)))


def _choose_state_scales(x: np.ndarray, e: np.ndarray, nothing_grows: bool) -> Float[np.ndarray, "w w"]:
    """Return scales diag(S1, S2) of x and e from their covariances.

    x is the state and e the error. `nothing_grows` says that plant and sensor have no unknown functions. Then S1 and S2
    are factors of the covariances. Else they are multiples of I, since a growth bound such as |f(x)| <= a |x| keeps its
    meaning under these alone.
    """
    if nothing_grows:
        return np.asarray(block_diag(_factor_with_floor(x), _factor_with_floor(e)))
    deviations = [np.full(len(covariance), np.sqrt(np.trace(covariance) / len(covariance))) for covariance in (x, e)]
    return np.diag(np.concatenate([_powers_of_four_near(deviation) for deviation in deviations]))


def _factor_with_floor(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Return the lower factor L, L L' = P + a little variance, of a covariance P.

    A state that is never disturbed has no variance of its own. So SMALLEST, 1e-6, of each unit is added. Units are
    powers of four, since scaling by them does not round.
    """
    unit = _powers_of_four_near(np.sqrt(np.diagonal(covariance)))
    scaled = covariance / np.outer(unit, unit) + SMALLEST**2 * np.eye(len(unit))
    return np.asarray(unit[:, None] * np.linalg.cholesky(scaled))


def _powers_of_four_near(size: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the powers of 4 near the sizes; a component of size zero takes the smallest of the others."""
    positive = size[size > 0]
    return _nearest_power_of_four(np.where(size > 0, size, positive.min() if positive.size else 1.0))


def _compute_eta_covariance(
    system: GrowthSystem, k: int, step: StepMatrices, x: np.ndarray, e: np.ndarray
) -> np.ndarray:
    """Return a covariance of eta = (x, e, f, f~, h, h~, v, rho) by which its coordinates are scaled.

    An H-infinity bound is a matrix inequality in eta, which a solver solves more exactly if all coordinates are of one
    size. x is the state, e the estimate's error, v and rho are disturbances of unknown course. The functions f(x) and
    h(x), and their differences f~ = f(x) - f(xhat) and h~ between the state and its estimate, are known by growth
    constants alone, |f(x)| <= a |x|: each gets the largest variance that its constant allows. v and rho get the
    variance 1. A function that is zero at all steps is not in eta.

    Args:
        system: x+ = A x + f(x) + B v, y = C x + h(x) + D v, with the growth constants of f and h at each step.
        k: the step.
        step: its matrices; their width is the size q of eta.
        x: covariance of the state before the step.
        e: covariance of the error before the step.
    """
    # The blocks of x and e; `begin` is where the next block begins.
    n, y, q = system.states, system.output.shape[1], len(step.energy)
    covariance, begin = np.zeros((q, q)), 2 * n
    covariance[:n, :n], covariance[n:begin, n:begin] = x, e
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if growth.absent:
            continue
        # Of f or h, then of f~ or h~: a^2 times the largest variance of the argument in any direction.
        for constant, argument_covariance in ((growth.state[k], x), (growth.error[k], e)):
            indices = slice(begin, begin + width)
            covariance[indices, indices] = constant**2 * np.linalg.eigvalsh(argument_covariance)[-1] * np.eye(width)
            begin += width
    covariance[begin:, begin:] = np.eye(q - begin)  # v and rho
    return covariance


class _CovariancesAfterStep(NamedTuple):
    """Covariances of the next state x+ and error e+, of the innovation, and the gain K that the error had."""

    state: Float[np.ndarray, "n n"]
    error: Float[np.ndarray, "n n"]
    innovation: Float[np.ndarray, "m m"]
    gain: Float[np.ndarray, "n m"]


def _propagate_covariances(step: StepMatrices, eta: np.ndarray, given: np.ndarray | None) -> _CovariancesAfterStep:
    """Return the covariances of x+, of e+ and of the innovation, and the gain K: the `given` one, or the best.

    With the covariance Cov eta = `eta` of all that the step depends on: x+ = X eta, the innovation is (U + W) eta with
    a random W of mean zero, E[W Q W'] = sum_j U_j Q U_j', and e+ = E eta - K (U + W) eta.
    """
    E, U = step.error, step.received
    # R = Cov (U + W) eta = U Cov eta U' + sum_j U_j Cov eta U_j'.
    by_mean = U @ eta @ U.T
    R = by_mean + np.einsum("jai,ik,jbk->ab", step.spreads, eta, step.spreads)
    # The best gain E Cov eta U' R^-1, computed in units of the innovation's deviations.
    cross = E @ eta @ U.T
    unit = np.sqrt(np.maximum(np.diagonal(R), np.finfo(float).tiny))
    best = cross / unit @ np.linalg.pinv(R / np.outer(unit, unit), rcond=RANK, hermitian=True) / unit
    gain = best if given is None else given
    # (E - K U) Cov eta (E - K U)' + K (R - U Cov eta U') K', and of each variance at least SMALLEST^2 of the predicted.
    predicted, corrected_map = E @ eta @ E.T, E - gain @ U
    corrected = corrected_map @ eta @ corrected_map.T + gain @ (R - by_mean) @ gain.T
    floor = SMALLEST**2 * np.diag(np.diagonal(predicted))
    return _CovariancesAfterStep(
        state=step.state @ eta @ step.state.T, error=_symmetrise(corrected) + floor, innovation=R, gain=gain
    )


def _keep_gain(last: np.ndarray, best: np.ndarray, innovation: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the last step's gain K0 if it is nearly as good as the best gain K, else K.

    Steps with the same gain are compiled once. K0 adds (K - K0) R (K - K0)' to the covariance of the `error` after the
    correction, with R the covariance of the `innovation`. It may add the share CONVERGED, 0.1, of each variance.
    """
    added = (last - best) @ innovation @ (last - best).T
    return last if np.all(np.diagonal(added) <= CONVERGED * np.diagonal(error)) else best


def _choose_eta_scales(system: GrowthSystem, k: int, step: StepMatrices, sizes: np.ndarray) -> Float[np.ndarray, "q q"]:
    """Return the scales T of eta, so that T^-1 eta is of order one, from the scales `sizes` of (x, e) before the step.

    eta = (x, e, f, f~, h, h~, disturbances). f is as large as its growth constant times x, and f~ as large as its
    constant times e. Disturbances are of order one. A function that is zero at all steps is not in eta.

    Args:
        system: the system with the growth constants of f and h.
        k: the step.
        step: its matrices, for the length q of eta.
        sizes: diag(S1, S2) of (x, e); with growing functions, S1 and S2 are numbers times I.
    """
    n, y = system.states, system.output.shape[1]
    blocks = [sizes]
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if growth.absent:
            continue
        # The scale of a function, and that of its difference.
        size_of_x, size_of_e = sizes[0, 0], sizes[n, n]
        for constant, size in ((growth.state[k], size_of_x), (growth.error[k], size_of_e)):
            scale = constant * size if constant > 0 else size
            blocks.append(scale * np.eye(width))
    disturbances = len(step.energy) - sum(map(len, blocks))
    return np.asarray(block_diag(*blocks, np.eye(disturbances)))


def _rescale_step(
    step: StepMatrices,
    eta_scales: np.ndarray,
    state_scales: np.ndarray,
    received_scales: np.ndarray,
    form_scales: np.ndarray,
    nominal: np.ndarray,
) -> StepMatrices:
    """Return the step in scaled coordinates, with errors about the nominal gain.

    An H-infinity bound is a matrix inequality in the vector eta of state, error, unknown functions and disturbances;
    its solver needs numbers of order one. With eta = T (scaled eta), x+ = S1 (scaled x+), e+ = S2 (scaled e+) and sizes
    r of what is received,
      x+ = X eta                         becomes  S1^-1 X T     (`state`),
      e+ = E eta - K (received)          becomes  S2^-1 (E - K0 U) T, less a scaled correction of K0   (`error`),
      received = U eta, deviations U_j   become   r^-1 U T and r^-1 U_j T   (`received`, `spreads`),
      a quadratic form eta'F eta         becomes  T'F T   (`target` |M e|^2, `energy` |(v, rho)|^2, `growth`).

    Args:
        step: matrices of the step in the user's units.
        eta_scales: T of eta = T times scaled eta.
        state_scales: diag(S1, S2), the scales of (x, e) after the step: x = S1 times scaled x, e = S2 times scaled e.
        received_scales: r, the size of each received number.
        form_scales: a scale for each growth form, a diagonal quadratic form that bounds an unknown function.
        nominal: the gain K0: the error's matrix becomes E - K0 U, where U maps eta to the received numbers.
    """
    n = step.state.shape[0]
    s1, s2, per_received = state_scales[:n, :n], state_scales[n:, n:], received_scales[:, None]
    return StepMatrices(
        state=np.linalg.solve(s1, step.state @ eta_scales),
        error=np.linalg.solve(s2, (step.error - nominal @ step.received) @ eta_scales),
        received=step.received @ eta_scales / per_received,
        spreads=step.spreads @ eta_scales / per_received,
        target=_symmetrise(eta_scales.T @ step.target @ eta_scales),
        energy=_symmetrise(eta_scales.T @ step.energy @ eta_scales),
        growth=step.growth * np.diagonal(eta_scales) ** 2 / form_scales[:, None],
        nominal=np.linalg.solve(s2, nominal * received_scales),
    )
