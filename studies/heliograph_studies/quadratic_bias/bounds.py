"""Published bounds on a filter's error covariance, evaluated for one system: which hold, and which assumption fails."""

from dataclasses import dataclass
from decimal import Decimal, localcontext
from typing import NamedTuple

import numpy as np

from heliograph.factors.square_root_update import covariance_of_root, roots_of
from heliograph.linear.lmmse_recursion import find_noise_roots, step_covariance_roots
from heliograph.linear.system import LinearSystem, state_moments
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

SINGULAR = 1e-12  # smallest eigenvalue relative to the largest below which a matrix is singular up to rounding
DIGITS = 200  # the Gramian's eigenvalues span more than 64 decades, so it is inverted in decimal arithmetic


class Constants(NamedTuple):
    """Extreme eigenvalues over all steps: of A A', A' A, C' C, Cov(v) and Cov(w); 0 where singular up to rounding."""

    transition_high: float
    transition_low: float
    output_high: float
    noise_low: float
    process_low: float
    process_high: float


@dataclass(frozen=True)
class Bound:
    """One bound on the eigenvalues of P_k: its value (NaN if it does not apply), what P_k has, and why.

    `value` is compared with `actual`, the extreme eigenvalue over the steps that the bound speaks of.
    """

    name: str
    applies: bool
    value: float
    actual: float
    reason: str


@dataclass(frozen=True)
class Boundedness:
    """All bounds of one system, with the constants that decide."""

    constants: Constants
    lower: Bound
    growth: Bound
    window: Bound
    covariance: Bound


def boundedness(system: LinearSystem, window: int | None = None) -> Boundedness:
    """Evaluate the uniform bounds of Theorems 3 to 5, and the one that needs no assumption, P_k <= Cov(y_k).

    lower: P >= b I with 1/b = 1/min eig Cov(w) + max eig C'C / min eig Cov(v).
    growth: P_k <= b_k I with b_(k+1) = max eig A A' b_k + max eig Cov(w); bounded only if max eig A A' < 1.
    window: P_k <= bound I from the information of the last `window` steps, discounted by
    zeta = 1 + max eig Cov(w) / (min eig A'A b); evaluated at the last step (N / m + 3 steps unless given).
    covariance: the largest eigenvalue of Cov(y_k); finite for all time if the plant is stable.

    Raises:
        ValueError: a window that is longer than the horizon.
    Source: quadratic filtering with dynamical bias, Assumption 2 and Theorems 3 to 5.
    """
    n, m = system.steps.output.shape[-1], system.steps.output.shape[-2]
    window = min(-(-n // m) + 3, system.horizon - 1) if window is None else window
    if not 1 <= window < system.horizon:
        raise fail("window", f"from 1 to {system.horizon - 1} steps", window)
    c, before = _constants(system), state_moments(system).covariance
    # Error covariances of the best filter, and their extreme eigenvalues.
    roots, size = [roots_of(system.covariance)], system.mean**2 + np.diag(system.covariance)
    for k in range(system.horizon):
        s = system.step(k)
        roots.append(step_covariance_roots(roots[-1], s, find_noise_roots(s, size)).root)
    values = np.linalg.eigvalsh(np.array([covariance_of_root(root) for root in roots]))
    low, high = float(values[1:, 0].min()), float(values[:, -1].max())
    lower = _lower(c, low)
    return Boundedness(
        c,
        lower,
        _growth(c, float(values[0, -1]), system.horizon, float(values[-1, -1])),
        _window(system, c, lower, window, float(values[-1, -1])),
        Bound("state covariance", True, float(np.linalg.eigvalsh(before)[:, -1].max()), high, "needs no assumption"),
    )


def _constants(system: LinearSystem) -> Constants:
    s = system.steps

    def low(a: Float[np.ndarray, "time n n"]) -> float:
        values = np.linalg.eigvalsh(a)
        return float(np.where(values[:, 0] > SINGULAR * values[:, -1], values[:, 0], 0.0).min())

    def high(a: Float[np.ndarray, "time n n"]) -> float:
        return float(np.linalg.eigvalsh(a)[:, -1].max())

    square = np.swapaxes(s.transition, 1, 2) @ s.transition
    information = np.swapaxes(s.output, 1, 2) @ s.output
    return Constants(high(square), low(square), high(information), low(s.noise), low(s.process), high(s.process))


def _lower(c: Constants, actual: float) -> Bound:
    name = "Theorem 3, lower"
    missing = [f"{what} >= q I with q > 0 fails: smallest eigenvalue 0"
               for what, value in (("Cov(w)", c.process_low), ("Cov(v)", c.noise_low)) if value <= 0]  # fmt: skip
    if missing:
        return Bound(name, False, float("nan"), actual, "; ".join(missing))
    return Bound(name, True, 1 / (1 / c.process_low + c.output_high / c.noise_low), actual, "Assumption 2 holds")


def _growth(c: Constants, start: float, horizon: int, actual: float) -> Bound:
    value = start
    for _ in range(horizon):
        value = c.transition_high * value + c.process_high
    if c.transition_high < 1:
        return Bound("Theorem 4, upper", True, value, actual, "max eig A A' < 1: bounded for all time")
    reason = f"holds at each step but grows without end: max eig A A' = {c.transition_high:.5g} >= 1"
    return Bound("Theorem 4, upper", True, value, actual, reason)


def _window(system: LinearSystem, c: Constants, lower: Bound, window: int, actual: float) -> Bound:
    name = f"Theorem 5, upper, window of {window}"
    if not lower.applies:
        return Bound(name, False, float("nan"), actual, f"needs Theorem 3: {lower.reason}")
    if c.transition_low <= 0:
        return Bound(name, False, float("nan"), actual, "A' A >= q I with q > 0 fails: smallest eigenvalue 0")
    zeta = 1 + c.process_high / (c.transition_low * lower.value)
    value = _gramian_bound(system, zeta, window)
    if value is None:
        return Bound(name, False, float("nan"), actual, "the Gramian of the window is singular: a longer one may do")
    return Bound(name, True, value, actual, f"Assumption 2 holds, zeta = {zeta:.4g}")


def _gramian_bound(system: LinearSystem, zeta: float, window: int) -> float | None:
    """1 / min eig sum_i zeta^(i - t) Omega_i' C_i' Cov(v_i)^-1 C_i Omega_i, Omega_i = (A_t ... A_(i+1))^-1, i <= t."""
    n, last = len(system.mean), system.horizon - 1
    with localcontext() as context:
        context.prec = DIGITS
        omega, gramian, discount = _exact(np.eye(n)), _exact(np.zeros((n, n))), Decimal(1)
        for i in range(last, last - window - 1, -1):
            s = system.step(i)
            read = _exact(s.output) @ omega
            noise = _inverse(_exact(s.noise))
            if noise is None:
                return None
            gramian = gramian + discount * (read.T @ noise @ read)
            back = _inverse(_exact(s.transition))
            if back is None:
                return None
            omega, discount = back @ omega, discount / Decimal(zeta)
        inverse = _inverse(gramian)
        if inverse is None:
            return None
        scale = max(abs(v) for v in inverse.reshape(-1))
        return float(scale * Decimal(float(np.linalg.eigvalsh((inverse / scale).astype(np.float64))[-1])))


def _exact(a: np.ndarray) -> np.ndarray:
    """The same numbers as decimals."""
    return np.array([[Decimal(float(v)) for v in row] for row in a], dtype=object).reshape(a.shape)


def _inverse(a: np.ndarray) -> np.ndarray | None:
    """Gauss-Jordan with pivoting on decimals; None if a pivot vanishes to half the digits carried."""
    n = len(a)
    work = np.concatenate([a, _exact(np.eye(n))], axis=1)
    size = max(abs(v) for v in a.reshape(-1))
    for j in range(n):
        pivot = j + max(range(n - j), key=lambda i: abs(work[j + i, j]))
        if abs(work[pivot, j]) <= size * Decimal(10) ** (-DIGITS // 2):
            return None
        work[[j, pivot]] = work[[pivot, j]]
        work[j] = work[j] / work[j, j]
        for i in range(n):
            if i != j:
                work[i] = work[i] - work[i, j] * work[j]
    return work[:, n:]
