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
from scipy.linalg import block_diag
from scipy.sparse.csgraph import connected_components

from heliograph.h_infinity.system import GrowthSystem
from heliograph.numerics.check import fail
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
    return [_make_step_matrices(system, k, padded[k], separate) for k in range(system.steps)]


def all_multipliers(
    system: GrowthSystem, given: Float[np.ndarray, "*steps present"], separate: bool
) -> Float[np.ndarray, "*steps count"]:
    """Return the multipliers with zeros for functions that were left out, in the order f, f~, h, h~ or f, h."""
    items = 2 if separate else 1
    present = [not growth.absent for growth in (system.growth, system.output_growth) for _ in range(items)]
    full = np.zeros((*given.shape[:-1], len(present)))
    full[..., present] = given
    return full


def _make_step_matrices(
    system: GrowthSystem, k: int, spreads: Float[np.ndarray, "spreads m _"], separate: bool
) -> StepMatrices:
    """Return the matrices of step k."""
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
    # Received: mean and spread of G (C . + h + D v) + N rho.
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
    groups = [[term] for pair in parts for term in pair] if separate else parts
    growth = np.array([_make_growth_form(q, group) for group in groups]).reshape(-1, q)
    return StepMatrices(state, error, received, varied, target, energy, growth, np.zeros((n, system.received)))


def _make_growth_form(q: int, parts: list[tuple[slice, slice, float]]) -> Float[np.ndarray, "{q}"]:
    """Return sum_i (a_i^2 |argument_i|^2 - |value_i|^2) as the diagonal of a quadratic form of eta."""
    diagonal = np.zeros(q)
    for value, argument, constant in parts:
        diagonal[value] -= 1.0
        diagonal[argument] += constant**2
    return diagonal


def next_energy(step: StepMatrices, unknowns: Unknowns) -> Float[np.ndarray, "q q"]:
    """Return the quadratic form E[V_next] + sum_i lambda_i N_i of eta, linear in the unknowns."""
    X, E, U = step.state, step.error, step.received
    p1, p2, Y, Z, multipliers = unknowns
    cross = E.T @ Y @ U
    form = X.T @ p1 @ X + E.T @ p2 @ E - cross - cross.T + U.T @ Z @ U
    shifted = step.nominal.T @ Y
    whole = Z + shifted + shifted.T + step.nominal.T @ p2 @ step.nominal  # K'P2 K, as Z is that of K - K0
    form += np.einsum("jai,ab,jbk->ik", step.spreads, whole, step.spreads)
    return np.asarray(form + np.diag(multipliers @ step.growth))


class UnknownsLayout(NamedTuple):
    """Layout of one step's unknowns in a vector: lower triangles of P1, P2 and Z, then Y and the multipliers.

    With `gain` given, Y = P2 K and Z = K'P2 K are no unknowns.
    """

    states: int
    received: int
    multipliers: int
    gain: Float[np.ndarray, "n m"] | None = None

    @property
    def size(self) -> int:
        """Length of the vector of all unknowns."""
        n, m = self.states, self.received
        free = n * m + m * (m + 1) // 2 if self.gain is None else 0
        return n * (n + 1) + free + self.multipliers

    def unpack(self, vector: Float[np.ndarray, "size"]) -> Unknowns:
        """Unpack triangles of P1 and P2, then Y and a triangle of Z unless the gain is given, then the multipliers."""
        n, m = self.states, self.received
        triangle = n * (n + 1) // 2
        p1, p2 = (
            _mirror_lower_triangle(vector[:triangle], n),
            _mirror_lower_triangle(vector[triangle : 2 * triangle], n),
        )
        if self.gain is not None:
            Y = p2 @ self.gain
            return Unknowns(p1, p2, Y, self.gain.T @ Y, vector[2 * triangle :])
        rest = vector[2 * triangle :]
        Y, triangle_of_z = rest[: n * m].reshape(n, m), rest[n * m : n * m + m * (m + 1) // 2]
        return Unknowns(p1, p2, Y, _mirror_lower_triangle(triangle_of_z, m), vector[self.size - self.multipliers :])


def _mirror_lower_triangle(entries: Float[np.ndarray, "triangle"], n: int) -> Float[np.ndarray, "{n} {n}"]:
    """Return the symmetric matrix (n, n) of the entries of its lower triangle."""
    matrix = np.zeros((n, n))
    rows, columns = _triangle_places(n)
    matrix[rows, columns] = matrix[columns, rows] = entries
    return matrix


@cache
def _triangle_places(n: int) -> tuple[Int[np.ndarray, "triangle"], Int[np.ndarray, "triangle"]]:
    """For each entry of an (n, n) matrix its place among those of the lower triangle."""
    return np.tril_indices(n)


class LinearForms(NamedTuple):
    """Inequalities of a step as linear maps of the vector of unknowns, each to a matrix written row by row.

    next: Phi's part that is linear in the unknowns. positive: matrices that must be positive. weight: diag(P1, P2).
    """

    next: Float[np.ndarray, "qq size"]
    positive: tuple[Float[np.ndarray, "_ size"], ...]
    weight: Float[np.ndarray, "ww size"]


def linear_forms(step: StepMatrices, layout: UnknownsLayout) -> LinearForms:
    """Evaluate every form at the unit vectors."""
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    forward = np.array([next_energy(step, u).ravel() for u in units]).T
    positive = [np.array([u.state.ravel() for u in units]).T]
    if layout.gain is None:
        positive.append(np.array([np.block([[u.spread, u.product.T], [u.product, u.error]]).ravel() for u in units]).T)
    else:
        positive.append(np.array([u.error.ravel() for u in units]).T)
    return LinearForms(forward, tuple(positive), weight_form(layout))


def weight_form(layout: UnknownsLayout) -> Float[np.ndarray, "ww size"]:
    """Return the linear map from the vector of unknowns to diag(P1, P2), written row by row."""
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    upper, lower = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    return np.array([(np.kron(upper, u.state) + np.kron(lower, u.error)).ravel() for u in units]).T


def independent_parts(
    step: StepMatrices, forms: LinearForms, start: Float[np.ndarray, "w w"] | None = None
) -> list[Int[np.ndarray, "_"]]:
    """Return the index sets of eta that Phi never couples: a smaller inequality for each says the same.

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


CONVERGED = 0.1  # more of each error's variance: what the gain of the step before may cost to be searched near again
SMALLEST = 1e-6  # of what an error's size was before a measurement: as small as one measurement can make it


class Coordinates(NamedTuple):
    """Scales S = diag(S1, S2) before every step and after the last, of received signals, growth forms and levels."""

    states: Float[np.ndarray, "times w w"]
    received: Float[np.ndarray, "steps m"]
    forms: Float[np.ndarray, "steps multipliers"]
    unit: float
    nothing_grows: bool

    def sizes(self, k: int) -> tuple[float, float]:
        """Return by what state x and error e are scaled before step k, the larger one 1.

        (1, 1) where nothing grows: S1 and S2 are matrices then, and the inequality has no norms of x and e to weigh.
        """
        if self.nothing_grows:
            return 1.0, 1.0
        x, e = float(self.states[k, 0, 0]), float(self.states[k, -1, -1])
        return x / max(x, e), e / max(x, e)

    def weight(self, scaled: Float[np.ndarray, "w w"], k: int) -> Float[np.ndarray, "w w"]:
        """Weight P_k in the user's units."""
        half = np.linalg.solve(self.states[k].T, scaled)
        return self.unit**2 * _symmetrise(np.linalg.solve(self.states[k].T, half.T))

    def initial_weight(self, weight: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
        """Weight P_0 in scaled coordinates."""
        return _symmetrise(self.states[0].T @ weight @ self.states[0]) / self.unit**2

    def gain(self, scaled: Float[np.ndarray, "n m"], k: int) -> Float[np.ndarray, "n m"]:
        """Return the gain of step k in the user's units."""
        n = len(scaled)
        return np.asarray(self.states[k + 1, n:, n:] @ scaled / self.received[k])

    def multipliers(self, unknowns: Unknowns, k: int) -> Float[np.ndarray, "multipliers"]:
        """Return the multipliers of step k in the user's units."""
        return np.asarray(self.unit**2 * unknowns.multipliers / self.forms[k])


def _symmetrise(a: Float[np.ndarray, "w w"]) -> Float[np.ndarray, "w w"]:
    """Return (A + A') / 2."""
    return np.asarray((a + a.T) / 2)


def scale_steps(
    system: GrowthSystem, steps: list[StepMatrices], gains: Float[np.ndarray, "steps n m"] | None = None
) -> tuple[list[StepMatrices], Coordinates]:
    """Transform the steps to coordinates of order one, near the best predictor's gains or the given `gains`."""
    n, nothing_grows = system.states, system.growth.absent and system.output_growth.absent
    initial = np.diag(1 / np.diagonal(system.initial_weight))
    # Covariances of x_0 and e_0 from the initial weight.
    x, e = initial[:n, :n], initial[n:, n:]
    sizes, received, forms, scaled, target = [_choose_error_scales(x, e, nothing_grows)], [], [], [], 0.0
    nominal = steps[0].nominal
    # Covariances of (x, e) propagated with the nominal gain, and sizes from these.
    for k, step in enumerate(steps):
        spread = _compute_signal_covariance(system, k, step, x, e)
        target = max(target, float(np.trace(step.target @ spread)))
        x, e, measured, best = _propagate(step, spread, None if gains is None else gains[k])
        nominal = best if gains is not None or k == 0 else _steady_gain(nominal, best, measured, e)
        sizes.append(_choose_error_scales(x, e, nothing_grows))
        received.append(_powers_of_four_near(np.sqrt(np.diagonal(measured))))
        unit = _choose_eta_scales(system, k, step, sizes[k])
        form = np.max(np.abs(step.growth) * np.diagonal(unit) ** 2, axis=1, initial=0.0)  # with growth, T is diagonal
        forms.append(np.where(form > 0, form, 1.0))
        scaled.append(_rescale_step(step, unit, sizes[k + 1], received[k], forms[k], nominal))
    if target == 0:
        raise fail("wanted matrix", "one that is not zero", "zero at every step")
    # Levels in units of the largest E |M e|^2.
    level = float(_nearest_power_of_four(np.sqrt(target)))
    scaled = [s._replace(target=s.target / level**2) for s in scaled]
    return scaled, Coordinates(np.array(sizes), np.array(received), np.array(forms), level, nothing_grows)


def _nearest_power_of_four(size: Float[np.ndarray, "*n"] | float) -> Float[np.ndarray, "*n"]:
    """Return the power of 4 nearest to a size, by which numbers are scaled without rounding."""
    return np.asarray(4.0 ** np.round(np.log(size) / np.log(4.0)))


def _choose_error_scales(x: np.ndarray, e: np.ndarray, nothing_grows: bool) -> Float[np.ndarray, "w w"]:
    """Return scales diag(S1, S2): factors of the covariances, or where growth is a ratio of norms a number for each."""
    if nothing_grows:
        return np.asarray(block_diag(_factor_with_floor(x), _factor_with_floor(e)))
    return np.diag(
        np.concatenate([_powers_of_four_near(np.full(len(s), np.sqrt(np.trace(s) / len(s)))) for s in (x, e)])
    )


def _factor_with_floor(covariance: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Lower factor of a covariance, of a state that is never disturbed with a little variance added."""
    unit = _powers_of_four_near(np.sqrt(np.diagonal(covariance)))
    return np.asarray(
        unit[:, None] * np.linalg.cholesky(covariance / np.outer(unit, unit) + SMALLEST**2 * np.eye(len(unit)))
    )


def _powers_of_four_near(size: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Return the powers of 4 near the sizes; a component of size zero takes the smallest of the others."""
    positive = size[size > 0]
    return _nearest_power_of_four(np.where(size > 0, size, positive.min() if positive.size else 1.0))


def _compute_signal_covariance(
    system: GrowthSystem, k: int, step: StepMatrices, x: np.ndarray, e: np.ndarray
) -> np.ndarray:
    """Return the covariance of eta = (x, e, f, f~, h, h~, v, rho) with f and h as large as their growth allows."""
    n, y, q = system.states, system.output.shape[1], len(step.energy)
    total, at = np.zeros((q, q)), 2 * n
    total[:n, :n], total[n:at, n:at] = x, e
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if not growth.absent:
            for constant, p in ((growth.state[k], x), (growth.error[k], e)):
                total[at : at + width, at : at + width] = constant**2 * np.linalg.eigvalsh(p)[-1] * np.eye(width)
                at += width
    total[at:, at:] = np.eye(q - at)
    return total


def _propagate(
    step: StepMatrices, spread: np.ndarray, given: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the covariances of x+, of e+ with the given or the best gain and of what is received, and that gain."""
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
    return step.state @ spread @ step.state.T, _symmetrise(after) + floor, received, gain


def _steady_gain(last: np.ndarray, best: np.ndarray, received: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Last gain where it loses little against the best, by (K - K0) R (K - K0)' with R the received covariance."""
    more = (last - best) @ received @ (last - best).T
    return last if np.all(np.diagonal(more) <= CONVERGED * np.diagonal(after)) else best


def _choose_eta_scales(system: GrowthSystem, k: int, step: StepMatrices, sizes: np.ndarray) -> Float[np.ndarray, "q q"]:
    """Scale T of eta = T times what is of order one."""
    n, y = system.states, system.output.shape[1]
    parts = [sizes]
    for growth, width in ((system.growth, n), (system.output_growth, y)):
        if not growth.absent:
            for constant, size in ((growth.state[k], sizes[0, 0]), (growth.error[k], sizes[n, n])):
                parts.append((constant * size if constant > 0 else size) * np.eye(width))
    return np.asarray(block_diag(*parts, np.eye(len(step.energy) - sum(map(len, parts)))))


def _rescale_step(
    step: StepMatrices,
    unit: np.ndarray,
    after: np.ndarray,
    received: np.ndarray,
    forms: np.ndarray,
    nominal: np.ndarray,
) -> StepMatrices:
    """Return the step in scaled coordinates, with errors about the nominal gain."""
    n = step.state.shape[0]
    return StepMatrices(
        np.linalg.solve(after[:n, :n], step.state @ unit),
        np.linalg.solve(after[n:, n:], (step.error - nominal @ step.received) @ unit),
        step.received @ unit / received[:, None],
        step.spreads @ unit / received[:, None],
        _symmetrise(unit.T @ step.target @ unit),
        _symmetrise(unit.T @ step.energy @ unit),
        step.growth * np.diagonal(unit) ** 2 / forms[:, None],
        np.linalg.solve(after[n:, n:], nominal * received),
    )
