"""Coordinates in which a design problem is of order one, so that a solver's accuracy and margins mean the same to all.

With x = S1 xs, e = S2 es, a received signal Q times a scaled one and levels in units of `unit`, every inequality is a
congruence of itself. The sizes are those that the system gives its own signals: standard deviations where disturbances
are white noises of variance 1, x_0 and e_0 have the covariances of the initial weight, f and h are noises as large as
their growth allows, and e is the error of the best predictor, near whose gain the design's is searched for. Where no
growth is a ratio of norms, S1 and S2 are factors of covariances; else they are numbers, powers of 4, so that nothing is
rounded and steps that differ little are the same problem, compiled once.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from heliograph.h_infinity.step import StepMatrices, Unknowns
from heliograph.h_infinity.system import GrowthSystem
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

CONVERGED = 0.1  # more of each error's variance: what the gain of the step before may cost to be searched near again
SMALLEST = 1e-6  # of what an error's size was before a measurement: as small as one measurement can make it


class Coordinates(NamedTuple):
    """Scales S = diag(S1, S2) before every step and after the last, of received signals, growth forms and levels."""

    states: Float[np.ndarray, "times w w"]
    received: Float[np.ndarray, "steps m"]
    forms: Float[np.ndarray, "steps multipliers"]
    unit: float
    plain: bool

    def ratio(self, k: int) -> tuple[float, float]:
        """Sizes of x and e, the larger one 1, where they are numbers; (1, 1) where S1 and S2 are matrices."""
        if self.plain:
            return 1.0, 1.0
        x, e = float(self.states[k, 0, 0]), float(self.states[k, -1, -1])
        return x / max(x, e), e / max(x, e)

    def weight(self, scaled: Float[np.ndarray, "w w"], k: int) -> Float[np.ndarray, "w w"]:
        """Weight P_k in the user's units."""
        half = np.linalg.solve(self.states[k].T, scaled)
        return self.unit**2 * _symmetric(np.linalg.solve(self.states[k].T, half.T))

    def scaled_weight(self, weight: Float[np.ndarray, "w w"], k: int) -> Float[np.ndarray, "w w"]:
        """Weight P_k in scaled coordinates."""
        return _symmetric(self.states[k].T @ weight @ self.states[k]) / self.unit**2

    def gain(self, scaled: Float[np.ndarray, "n m"], k: int) -> Float[np.ndarray, "n m"]:
        """Gain of step k in the user's units."""
        n = len(scaled)
        return np.asarray(self.states[k + 1, n:, n:] @ scaled / self.received[k])

    def multipliers(self, unknowns: Unknowns, k: int) -> Float[np.ndarray, "multipliers"]:
        """Multipliers of step k in the user's units."""
        return np.asarray(self.unit**2 * unknowns.multipliers / self.forms[k])


def _symmetric(a: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
    return np.asarray((a + a.T) / 2)


def scale(
    system: GrowthSystem, steps: list[StepMatrices], gains: Float[np.ndarray, "steps n m"] | None = None
) -> tuple[list[StepMatrices], Coordinates]:
    """Transform the steps to coordinates of order one, near the best predictor's gains or the given `gains`.

    Raises:
        ValueError: a target that is zero at every step.
    """
    n, plain = system.states, system.growth.absent and system.output_growth.absent
    initial = np.diag(1 / np.diagonal(system.initial_weight))
    # covariances of x_0 and e_0 from the initial weight
    x, e = initial[:n, :n], initial[n:, n:]
    sizes, received, forms, scaled, target = [_sizes(x, e, plain)], [], [], [], 0.0
    nominal = steps[0].nominal
    # covariances of (x, e) propagated with the nominal gain, and sizes from these
    for k, step in enumerate(steps):
        spread = _signals(system, k, step, x, e)
        target = max(target, float(np.trace(step.target @ spread)))
        x, e, measured, best = _moved(step, spread, None if gains is None else gains[k])
        nominal = best if gains is not None or k == 0 else _steady_gain(nominal, best, measured, e)
        sizes.append(_sizes(x, e, plain))
        received.append(_nonzero(np.sqrt(np.diagonal(measured))))
        unit = _coordinates(system, k, step, sizes[k])
        form = np.max(np.abs(step.growth) * np.diagonal(unit) ** 2, axis=1, initial=0.0)  # with growth, T is diagonal
        forms.append(np.where(form > 0, form, 1.0))
        scaled.append(_congruent(step, unit, sizes[k + 1], received[k], forms[k], nominal))
    if target == 0:
        raise fail("wanted matrix", "one that is not zero", "zero at every step")
    # levels in units of the largest E |M e|^2
    level = float(_power(np.sqrt(target)))
    scaled = [s._replace(target=s.target / level**2) for s in scaled]
    return scaled, Coordinates(np.array(sizes), np.array(received), np.array(forms), level, plain)


def _power(size: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Nearest power of 4."""
    return np.asarray(4.0 ** np.round(np.log(size) / np.log(4.0)))


def _sizes(x: np.ndarray, e: np.ndarray, plain: bool) -> Float[np.ndarray, "w w"]:
    """Scales diag(S1, S2): factors of the covariances, or where growth is a ratio of norms a number for each."""
    if plain:
        return np.asarray(block_diag(_factor(x), _factor(e)))
    return np.diag(
        np.concatenate([_nonzero(np.full(len(part), np.sqrt(np.trace(part) / len(part)))) for part in (x, e)])
    )


def _factor(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Lower factor of a covariance, of a state that is never disturbed with a little variance added."""
    unit = _nonzero(np.sqrt(np.diagonal(covariance)))
    return np.asarray(
        unit[:, None] * np.linalg.cholesky(covariance / np.outer(unit, unit) + SMALLEST**2 * np.eye(len(unit)))
    )


def _nonzero(size: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Powers of 4 near the sizes, however different; a component of size zero takes the smallest of the others."""
    positive = size[size > 0]
    return _power(np.where(size > 0, size, positive.min() if positive.size else 1.0))


def _signals(system: GrowthSystem, k: int, step: StepMatrices, x: np.ndarray, e: np.ndarray) -> np.ndarray:
    """Covariance of eta = (x, e, f, f~, h, h~, v, rho) with f and h as large as their growth allows."""
    n, y, q = system.states, system.output.shape[1], len(step.energy)
    result, at = np.zeros((q, q)), 2 * n
    result[:n, :n], result[n:at, n:at] = x, e
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if not growth.absent:
            for constant, part in ((growth.state[k], x), (growth.error[k], e)):
                result[at : at + width, at : at + width] = constant**2 * np.linalg.eigvalsh(part)[-1] * np.eye(width)
                at += width
    result[at:, at:] = np.eye(q - at)
    return result


def _moved(
    step: StepMatrices, spread: np.ndarray, given: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Covariances of x+, of e+ with the given or the best gain and of what is received, and that gain."""
    received = step.received @ spread @ step.received.T + np.einsum(
        "jai,ik,jbk->ab", step.spreads, spread, step.spreads
    )
    cross = step.error @ spread @ step.received.T
    unit = np.sqrt(np.maximum(np.diagonal(received), np.finfo(float).tiny))
    best = cross / unit @ np.linalg.pinv(received / np.outer(unit, unit), rcond=1e-12, hermitian=True) / unit
    gain = best if given is None else given
    before, left = step.error @ spread @ step.error.T, step.error - gain @ step.received
    after = left @ spread @ left.T + gain @ (received - step.received @ spread @ step.received.T) @ gain.T
    floor = SMALLEST**2 * np.diag(np.diagonal(before))
    return step.state @ spread @ step.state.T, _symmetric(after) + floor, received, gain


def _steady_gain(last: np.ndarray, best: np.ndarray, received: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Last gain where it loses little against the best, by (K - K0) R (K - K0)' with R the received covariance."""
    more = (last - best) @ received @ (last - best).T
    return last if np.all(np.diagonal(more) <= CONVERGED * np.diagonal(after)) else best


def _coordinates(system: GrowthSystem, k: int, step: StepMatrices, sizes: np.ndarray) -> Float[np.ndarray, "q q"]:
    """Scale T of eta = T times what is of order one."""
    n, y = system.states, system.output.shape[1]
    parts = [sizes]
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if not growth.absent:
            for constant, size in ((growth.state[k], sizes[0, 0]), (growth.error[k], sizes[n, n])):
                parts.append((constant * size if constant > 0 else size) * np.eye(width))
    return np.asarray(block_diag(*parts, np.eye(len(step.energy) - sum(map(len, parts)))))


def _congruent(
    step: StepMatrices,
    unit: np.ndarray,
    after: np.ndarray,
    received: np.ndarray,
    forms: np.ndarray,
    nominal: np.ndarray,
) -> StepMatrices:
    """Step in scaled coordinates, with errors about the nominal gain."""
    n = step.state.shape[0]
    return StepMatrices(
        np.linalg.solve(after[:n, :n], step.state @ unit),
        np.linalg.solve(after[n:, n:], (step.error - nominal @ step.received) @ unit),
        step.received @ unit / received[:, None],
        step.spreads @ unit / received[:, None],
        _symmetric(unit.T @ step.target @ unit),
        _symmetric(unit.T @ step.energy @ unit),
        step.growth * np.diagonal(unit) ** 2 / forms[:, None],
        np.linalg.solve(after[n:, n:], nominal * received),
    )
