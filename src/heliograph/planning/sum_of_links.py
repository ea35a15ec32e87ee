"""Links of a sum z = sum_i a_i g_i y_i + noise: their information at amplitudes a, and the best a for one signal.

With b_i = E[g_i] c_i (rows of B), D_ij = E[g_i] E[g_j] R_ij + (i = j) Var(g_i) t_i, t_i = E[y_i^2] and N the noise of
links and receiver, a step tells J = B' a a' B / (a' D a + N) of the state. Of one scalar signal x that is
j = (b' a)^2 / (a' D a + N), a generalised Rayleigh quotient:

- total power sum_i a_i^2 t_i = P: a ~ (D + N T / P)^-1 b, j = b' (D + N T / P)^-1 b, T = diag(t);
- each a_i at most cap_i, D diagonal: a_i = min(theta b_i / D_i, cap_i), theta = (a' D a + N) / b' a;
- both: D + nu T and N - nu P in place of D and N, with nu >= 0 at which the power is P.

Of several states no information is above B' (D + N T / P)^-1 B (Cauchy and Schwarz).
"""

from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.types import Float

Vector = Float[np.ndarray, "links"]
RELATIVE_ROUNDING = 1e-12  # relative: rows of one signal, noises that are independent
BISECTIONS = 200  # of an interval that holds a multiplier or a power


class SummedLinks(NamedTuple):
    """Links of a sum z = sum_i a_i g_i y_i + noise, with amplitudes a_i, random gains g_i and sensor outputs y_i.

    Args:
        rows: B, with the row E[g_i] c_i for link i: what it carries of the state (links, n).
        noise: D, covariance of what the links add to the sum before the receiver, at amplitudes 1 (links, links).
        unit: t, the power E y_i^2 that each link sends at amplitude 1 (links,).
        floor: N, variance of the noise of receiver and links that does not depend on the amplitudes.
        present: amplitudes at present (links,).
    """

    rows: Float[np.ndarray, "links n"]
    noise: Float[np.ndarray, "links links"]
    unit: Vector
    floor: float
    present: Vector

    def information(self, amplitudes: Vector) -> Float[np.ndarray, "n n"]:
        """Return the information J = B' a a' B / (a' D a + N) about the state that one step gives.

        a are the amplitudes. Row i of B (`self.rows`) is what link i carries of the state. D (`self.noise`) is the
        covariance of what the links add before the sum, and N (`self.floor`) the variance of the receiver's noise.
        """
        signal = amplitudes @ self.rows
        noise = float(amplitudes @ self.noise @ amplitudes) + self.floor
        return np.outer(signal, signal) / noise if noise > 0 else np.zeros((len(signal),) * 2)

    def best_information(self, total: float) -> Float[np.ndarray, "n n"]:
        """Return B' (D + N T / P)^-1 B, which no amplitudes of this total power P exceed.

        B (`self.rows`) is what each link carries of the state. D (`self.noise`) is the covariance of the links' noise,
        and N (`self.floor`) the variance of the receiver's. T = diag(`self.unit`) is the power of each link at
        amplitude 1. With a' T a = P, the information is B' a a' B / (a' (D + N T / P) a), which by Cauchy and Schwarz
        is at most the bound.
        """
        noise = self.noise + np.diag(self.floor * self.unit / total)
        bound: np.ndarray = self.rows.T @ np.linalg.solve(noise, self.rows)
        return bound


def find_amplitudes_by_formula(links: SummedLinks, total: float, caps: Vector) -> Vector | None:
    """Return the best amplitudes (links,) of one scalar signal by formulas; None where no formula is known.

    The sum of links with amplitudes a carries the information j = (b' a)^2 / (a' D a + N). Here b are the gains, D is
    the noise of the links, and N (`floor`) that of the receiver. The links send the power a' T a, T = diag(unit).
    There are formulas where only the total power binds, and under limits of each amplitude where the noises of links
    are independent.

    Args:
        links: the gains as rows B (with one signal all rows are multiples b_i of one direction), D (links, links), the
            diagonal of T (power of a link with amplitude 1), and N.
        total: largest power that all may send together.
        caps: largest size of each amplitude.
    """
    # Formulas are known for one signal: then B has rank 1, and its rows are multiples b_i of one direction.
    _, singular_values, right = np.linalg.svd(links.rows)
    if len(singular_values) > 1 and singular_values[1] > RELATIVE_ROUNDING * singular_values[0]:
        return None
    b = links.rows @ right[0]
    # Where only the total P binds: a ~ (D + N T / P)^-1 b, scaled to send P.
    if np.isfinite(total):
        uncapped = np.linalg.solve(links.noise + np.diag(links.floor * links.unit / total), b)
        uncapped = uncapped * np.sqrt(total / (uncapped**2 @ links.unit))
        if np.all(np.abs(uncapped) <= caps):
            return np.asarray(uncapped)
    # Under limits of each amplitude there is a formula only if the links' noises are independent, D diagonal.
    variances = np.diagonal(links.noise)
    if np.any(np.abs(links.noise - np.diag(variances)) > RELATIVE_ROUNDING * np.sqrt(np.outer(variances, variances))):
        return None
    # Where only the limits of each bind.
    capped: np.ndarray = np.sign(b) * _cap_amplitudes(np.abs(b), variances, links.floor, caps)
    if capped**2 @ links.unit <= total:
        return capped
    return _cap_and_share_total(links, b, variances, total, caps)


def _cap_and_share_total(links: SummedLinks, b: Vector, variances: Vector, total: float, caps: Vector) -> Vector:
    """Return the best amplitudes a (links,) where the total power P binds as well as the limits of some amplitudes.

    The best a maximise (b' a)^2 / (a' D a + N) with sum_i T_i a_i^2 <= P. With a multiplier nu of the total, they are
    those under the single limits alone for D + nu T and N - nu P in place of D and N. nu lies between 0 and N / P, and
    is found by bisection, as the power sum_i T_i a_i^2 falls with nu.

    Args:
        links: D (`noise`), covariance of what links add before the sum, diagonal here; T (`unit`), the power at
            amplitude 1; N (`floor`), variance of the receiver's noise.
        b: gain of each link (links,).
        variances: the diagonal of D.
        total: P.
        caps: largest size of each amplitude.
    """

    def amplitudes_at(nu: float) -> Vector:
        """Return the best amplitudes under the limits of each link, for the noises D + nu T and N - nu P.

        `variances` is the diagonal of D. `links.unit` is T, `links.floor` N, `total` P, and `caps` the limits. Sizes
        are computed first, since the best amplitude has the sign of its link's gain b.
        """
        sizes = _cap_amplitudes(np.abs(b), variances + nu * links.unit, links.floor - nu * total, caps)
        return np.asarray(np.sign(b) * sizes)

    # At `low` the links send more than P, at `high` at most P.
    low, high = 0.0, links.floor / total
    for _ in range(BISECTIONS):
        nu = (low + high) / 2
        low, high = (nu, high) if amplitudes_at(nu) ** 2 @ links.unit > total else (low, nu)
    return amplitudes_at(high)


def _cap_amplitudes(b: Vector, noise: Vector, floor: float, caps: Vector) -> Vector:
    """Return the amplitudes a_i = min(theta b_i / D_i, cap_i) (links,) that maximise (b' a)^2 / (a' D a + N).

    That ratio is the information in z = b' a x + noise, the sum of links that send one signal x with amplitudes a_i.
    Without caps a is in proportion to b_i / D_i. theta is where theta b' a = a' D a + N, found by bisection.

    Args:
        b: gains of the links, not negative.
        noise: the diagonal of D, the variances of the links' noises.
        floor: N, the variance of the receiver's noise.
        caps: largest amplitudes.
    """
    # b_i / D_i; infinite for a link without noise, whose amplitude is then its cap.
    ratio = np.divide(b, noise, out=np.full_like(b, np.inf), where=noise > 0)

    def amplitudes_at(theta: float) -> Vector:
        """Return the amplitudes min(theta b_i / D_i, cap_i); 0 of a link without gain."""
        return np.asarray(np.where(b > 0, np.minimum(theta * ratio, caps), 0.0))

    def excess(theta: float) -> float:
        """Return theta b' a - (a' D a + N), which rises with theta.

        a are the best amplitudes for this theta, `noise` is the diagonal of D, and `floor` is N.
        """
        a = amplitudes_at(theta)
        return theta * float(b @ a) - float(noise @ a**2) - floor

    # A bracket of theta, its upper end doubled; that has no end where no cap holds the amplitudes.
    low, high = 0.0, 1.0
    while excess(high) < 0:
        high *= 2
        if high > 1 / RELATIVE_ROUNDING**2:
            raise fail("budget", "one that limits every transmitter that helps", "no limit")
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return amplitudes_at(high)
