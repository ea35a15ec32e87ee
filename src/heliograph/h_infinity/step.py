"""Matrix inequality of one step of an H-infinity design, linear in its unknowns.

With eta = (x, e, f, f~, h, h~, v, rho) the next stacked state is x+ = X eta, e+ = (E - K U) eta - K W eta, where the
random W has E[W'QW] = sum_j U_j'Q U_j. The level holds if, at every step,
Phi = X'P1 X + (E - K U)'P2 (E - K U) + sum_j U_j'K'P2 K U_j + S - diag(P_s, 0) + sum_i lambda_i N_i < 0,
S = diag(0, M'M, 0, ..., -level^2 I), eta'N_i eta >= 0 the growth conditions. With Y = P2 K and any Z >= K'P2 K it is
linear: (E - K U)'P2 (E - K U) becomes E'P2 E - E'Y U - U'Y'E + U'Z U, and [[Z, Y'], [Y, P2]] >= 0. With K0 + K in
place of K, and E - K0 U in place of E, no large numbers cancel where a measurement is precise. This is the Schur
complement of the published inequality, after a congruence, at 14 + 4 rows in place of 34 in the published example.
"""

from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from heliograph.h_infinity.system import GrowthSystem
from heliograph.numerics.types import Float, Int


class StepMatrices(NamedTuple):
    """Matrices X, E - K0 U, U, U_j, M'M, I of S, diagonals of N_i, and a gain K0 near which K is searched for."""

    state: Float[np.ndarray, "n q"]
    error: Float[np.ndarray, "n q"]
    received: Float[np.ndarray, "m q"]
    spreads: Float[np.ndarray, "spreads m q"]
    target: Float[np.ndarray, "q q"]
    energy: Float[np.ndarray, "q q"]
    growth: Float[np.ndarray, "multipliers q"]
    nominal: Float[np.ndarray, "n m"]


class Unknowns(NamedTuple):
    """Unknowns P1, P2, Y = P2 (K - K0), Z >= (K - K0)'P2 (K - K0) and lambda of a step."""

    state: Float[np.ndarray, "n n"]
    error: Float[np.ndarray, "n n"]
    product: Float[np.ndarray, "n m"]
    spread: Float[np.ndarray, "m m"]
    multipliers: Float[np.ndarray, "multipliers"]


def step_matrices(system: GrowthSystem, separate: bool) -> list[StepMatrices]:
    """Matrices of every step; a function that is zero throughout, as an h that is all linear, is left out of eta.

    `separate`: one multiplier for each of f, f~, h, h~ in place of one for (f, f~) and one for (h, h~).
    """
    spreads = [link.spreads() for link in system.channel]
    count = max(len(s) for s in spreads)
    padded = [np.concatenate([s, np.zeros((count - len(s), *s.shape[1:]))]) for s in spreads]
    return [_at(system, k, padded[k], separate) for k in range(system.steps)]


def all_multipliers(
    system: GrowthSystem, given: Float[np.ndarray, "*steps present"], separate: bool
) -> Float[np.ndarray, "*steps count"]:
    """Multipliers with zeros for functions that were left out, in the order f, f~, h, h~ or f, h."""
    items = 2 if separate else 1
    present = [not growth.absent for growth in (system.growth, system.output_growth) for _ in range(items)]
    result = np.zeros((*given.shape[:-1], len(present)))
    result[..., present] = given
    return result


def _at(system: GrowthSystem, k: int, spreads: Float[np.ndarray, "spreads m _"], separate: bool) -> StepMatrices:
    """Matrices of step k."""
    A, B, C, D, M = (getattr(system, name)[k] for name in GrowthSystem._fields[:5])
    link, n, y = system.channel[k], system.states, system.output.shape[1]
    w, h = 0 if system.growth.absent else n, 0 if system.output_growth.absent else y
    # eta = (x, e, f, f~, h, h~, v, rho) without absent functions
    widths = [n, n, w, w, h, h, B.shape[1], link.disturbances]
    x, e, f, df, g, dg, v, rho = (slice(b - a, b) for a, b in zip(widths, np.cumsum(widths), strict=True))
    q, eye = sum(widths), np.eye(n)[:, :w]
    # x+ = A x + f + B v and e+ = A e + f~ + B v before the correction
    state, error = np.zeros((n, q)), np.zeros((n, q))
    state[:, x], state[:, f], state[:, v] = A, eye, B
    error[:, e], error[:, df], error[:, v] = A, eye, B
    # received: mean and spread of G (C . + h + D v) + N rho
    gain, noise = link.mean[:, :y], link.mean[:, y:]
    received = np.zeros((system.received, q))
    received[:, e], received[:, dg], received[:, v], received[:, rho] = gain @ C, gain[:, :h], gain @ D, noise
    varied = np.zeros((len(spreads), system.received, q))
    gain, noise = spreads[..., :y], spreads[..., y:]
    varied[..., x], varied[..., g], varied[..., v], varied[..., rho] = gain @ C, gain[..., :h], gain @ D, noise
    # M'M, the disturbances' energy and the growth conditions as quadratic forms
    target, energy = np.zeros((q, q)), np.zeros((q, q))
    target[e, e] = M.T @ M
    energy[v, v], energy[rho, rho] = np.eye(v.stop - v.start), np.eye(rho.stop - rho.start)
    parts = [[(f, x, system.growth.state[k]), (df, e, system.growth.error[k])]] if w else []
    parts += [[(g, x, system.output_growth.state[k]), (dg, e, system.output_growth.error[k])]] if h else []
    groups = [[part] for pair in parts for part in pair] if separate else parts
    growth = np.array([_growth(q, group) for group in groups]).reshape(-1, q)
    return StepMatrices(state, error, received, varied, target, energy, growth, np.zeros((n, system.received)))


def _growth(q: int, parts: list[tuple[slice, slice, float]]) -> Float[np.ndarray, "{q}"]:
    """sum_i (a_i^2 |argument_i|^2 - |value_i|^2) as the diagonal of a quadratic form of eta."""
    diagonal = np.zeros(q)
    for value, argument, constant in parts:
        diagonal[value] -= 1.0
        diagonal[argument] += constant**2
    return diagonal


def next_energy(step: StepMatrices, unknowns: Unknowns) -> Float[np.ndarray, "q q"]:
    """Quadratic form E[V_next] + sum_i lambda_i N_i of eta, linear in the unknowns."""
    X, E, U = step.state, step.error, step.received
    p1, p2, Y, Z, multipliers = unknowns
    cross = E.T @ Y @ U
    result = X.T @ p1 @ X + E.T @ p2 @ E - cross - cross.T + U.T @ Z @ U
    shifted = step.nominal.T @ Y
    whole = Z + shifted + shifted.T + step.nominal.T @ p2 @ step.nominal  # K'P2 K, as Z is that of K - K0
    result += np.einsum("jai,ab,jbk->ik", step.spreads, whole, step.spreads)
    return np.asarray(result + np.diag(multipliers @ step.growth))


class Layout(NamedTuple):
    """Layout of one step's unknowns in a vector: lower triangles of P1, P2 and Z, then Y and the multipliers.

    With `gain` given, Y = P2 K and Z = K'P2 K are no unknowns.
    """

    states: int
    received: int
    multipliers: int
    gain: Float[np.ndarray, "n m"] | None = None

    @property
    def size(self) -> int:
        """Length of the vector."""
        n, m = self.states, self.received
        free = n * m + m * (m + 1) // 2 if self.gain is None else 0
        return n * (n + 1) + free + self.multipliers

    def unpack(self, vector: Float[np.ndarray, "size"]) -> Unknowns:
        """Unpack the vector into matrices."""
        n, m = self.states, self.received
        triangle = n * (n + 1) // 2
        p1, p2 = _symmetric(vector[:triangle], n), _symmetric(vector[triangle : 2 * triangle], n)
        if self.gain is not None:
            product = p2 @ self.gain
            return Unknowns(p1, p2, product, self.gain.T @ product, vector[2 * triangle :])
        rest = vector[2 * triangle :]
        product, spread = rest[: n * m].reshape(n, m), rest[n * m : n * m + m * (m + 1) // 2]
        return Unknowns(p1, p2, product, _symmetric(spread, m), vector[self.size - self.multipliers :])


def _symmetric(entries: Float[np.ndarray, "triangle"], n: int) -> Float[np.ndarray, "{n} {n}"]:
    result = np.zeros((n, n))
    rows, columns = _triangle(n)
    result[rows, columns] = result[columns, rows] = entries
    return result


@cache
def _triangle(n: int) -> tuple[Int[np.ndarray, "triangle"], Int[np.ndarray, "triangle"]]:
    return np.tril_indices(n)


class LinearForms(NamedTuple):
    """Inequalities of a step as linear maps of the vector of unknowns, each to a matrix written row by row.

    next: Phi's part that is linear in the unknowns. positive: matrices that must be positive. weight: diag(P1, P2).
    """

    next: Float[np.ndarray, "qq size"]
    positive: tuple[Float[np.ndarray, "_ size"], ...]
    weight: Float[np.ndarray, "ww size"]


def linear_forms(step: StepMatrices, layout: Layout) -> LinearForms:
    """Evaluate every form at the unit vectors."""
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    forward = np.array([next_energy(step, u).ravel() for u in units]).T
    positive = [np.array([u.state.ravel() for u in units]).T]
    if layout.gain is None:
        positive.append(np.array([np.block([[u.spread, u.product.T], [u.product, u.error]]).ravel() for u in units]).T)
    else:
        positive.append(np.array([u.error.ravel() for u in units]).T)
    return LinearForms(forward, tuple(positive), weight_form(layout))


def weight_form(layout: Layout) -> Float[np.ndarray, "ww size"]:
    """Linear map from the vector of unknowns to diag(P1, P2), written row by row."""
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    upper, lower = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    return np.array([(np.kron(upper, u.state) + np.kron(lower, u.error)).ravel() for u in units]).T


def independent_parts(
    step: StepMatrices, forms: LinearForms, start: Float[np.ndarray, "w w"] | None = None
) -> list[Int[np.ndarray, "_"]]:
    """Index sets of eta that Phi never couples: a smaller inequality for each says the same.

    `start`: the weight before the step, where it is not diag(P1, P2).
    """
    q = len(step.energy)
    coupled = np.any(forms.next != 0, axis=1).reshape(q, q) | (step.target != 0) | (step.energy != 0)
    n = step.state.shape[0]
    coupled[:n, :n] = coupled[n : 2 * n, n : 2 * n] = True  # the weight diag(P1, P2) of this step
    if start is not None:
        coupled[: 2 * n, : 2 * n] |= start != 0
    count, labels = connected_components(coupled, directed=False)
    return [np.flatnonzero(labels == i) for i in range(count)]
