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

from heliograph.h_infinity.error_system import GrowthSystem
from heliograph.numerics.types import Float, Int


class StepMatrices(NamedTuple):
    """Matrices of one step over the q entries of eta, as in the module docstring.

    state: X; error: E - K0 U; received: U; spreads: U_j; target: M'M in its place; energy: the identity in the place of
    (v, rho), so that S = target - level^2 energy; growth: diagonals of the N_i; nominal: K0, near which the gain is
    searched for.
    """

    state: Float[np.ndarray, "n q"]
    error: Float[np.ndarray, "n q"]
    received: Float[np.ndarray, "m q"]
    spreads: Float[np.ndarray, "spreads m q"]
    target: Float[np.ndarray, "q q"]
    energy: Float[np.ndarray, "q q"]
    growth: Float[np.ndarray, "multipliers q"]
    nominal: Float[np.ndarray, "n m"]


class Unknowns(NamedTuple):
    """Unknowns of a step, K being short for the gain less K0.

    state: P1; error: P2, of the next weight diag(P1, P2). product: Y = P2 K. gain_square: Z >= K'P2 K. multipliers:
    lambda, one for each growth form.
    """

    state: Float[np.ndarray, "n n"]
    error: Float[np.ndarray, "n n"]
    product: Float[np.ndarray, "n m"]
    gain_square: Float[np.ndarray, "m m"]
    multipliers: Float[np.ndarray, "multipliers"]


def list_step_matrices(system: GrowthSystem, separate: bool) -> list[StepMatrices]:
    """Return the matrices of every step.

    They act on eta, the vector of all that a step depends on. A function that is zero at all steps, such as the h of a
    linear sensor, is left out of eta. With `separate`, each of f, f~, h, h~ has a multiplier; else (f, f~) share one,
    and (h, h~) too. U_j are the matrices of the random part of what is received.
    """
    # All steps need the same number of matrices U_j: a step with fewer gets matrices of zeros.
    spreads = [link.spreads() for link in system.channel]
    count = max(len(of_step) for of_step in spreads)
    padded = []
    for of_step in spreads:
        zeros = np.zeros((count - len(of_step), *of_step.shape[1:]))
        padded.append(np.concatenate([of_step, zeros]))
    return [_make_step_matrices(system, k, padded[k], separate) for k in range(system.steps)]


def complete_multipliers(
    system: GrowthSystem, given: Float[np.ndarray, "*steps present"], separate: bool
) -> Float[np.ndarray, "*steps count"]:
    """Return all multipliers, zeros for functions that were left out: (steps, 4) for f, f~, h, h~, or (steps, 2).

    f~ and h~ are the differences of f and h between the state and its estimate. A function is absent if it is zero at
    all steps. With `separate` each of the four has a multiplier; else (f, f~) share one, and (h, h~) too.
    """
    multipliers_by_function = 2 if separate else 1
    is_present = [
        not growth.absent for growth in (system.growth, system.output_growth) for _ in range(multipliers_by_function)
    ]
    multipliers = np.zeros((*given.shape[:-1], len(is_present)))
    multipliers[..., is_present] = given
    return multipliers


def _make_step_matrices(
    system: GrowthSystem, k: int, spreads: Float[np.ndarray, "spreads m _"], separate: bool
) -> StepMatrices:
    """Return the matrices of step k over eta = (x, e, f, f~, h, h~, v, rho), without functions that are absent.

    Args:
        system: x+ = A x + f(x) + B v, what is received G (C x + h(x) + D v) + N rho, and the target M e.
        k: the step.
        spreads: the random part of (G, N) as a sum of independent matrices, (matrix, m, y + size of rho).
        separate: whether each of f, f~, h, h~ has a multiplier of its own; else f and f~ share one, and h and h~.
    """
    A, B, M = system.transition[k], system.disturbance[k], system.target[k]
    C, D = system.output[k], system.feedthrough[k]
    n, y, m, link = system.states, system.output.shape[1], system.received, system.channel[k]
    eta = _locate_parts_of_eta(system, k)
    q, of_f, of_h = eta.rho.stop, slice(0, eta.f.stop - eta.f.start), slice(0, eta.h.stop - eta.h.start)
    # x+ = A x + f + B v, and e+ = A e + f~ + B v before the correction.
    state, error = np.zeros((n, q)), np.zeros((n, q))
    state[:, eta.x], state[:, eta.f], state[:, eta.v] = A, np.eye(n)[:, of_f], B
    error[:, eta.e], error[:, eta.f_error], error[:, eta.v] = A, np.eye(n)[:, of_f], B
    # Received less its prediction: E[G] (C e + h~ + D v) + E[N] rho, and the random part of G (C x + h + D v) + N rho.
    G, N = link.mean[:, :y], link.mean[:, y:]
    mean = np.zeros((m, q))
    mean[:, eta.e], mean[:, eta.h_error], mean[:, eta.v], mean[:, eta.rho] = G @ C, G[:, of_h], G @ D, N
    G, N = spreads[..., :y], spreads[..., y:]
    random = np.zeros((len(spreads), m, q))
    random[..., eta.x], random[..., eta.h], random[..., eta.v] = G @ C, G[..., of_h], G @ D
    random[..., eta.rho] = N
    # M'M and the disturbances' energy as quadratic forms.
    target, energy = np.zeros((q, q)), np.zeros((q, q))
    target[eta.e, eta.e] = M.T @ M
    energy[eta.v, eta.v], energy[eta.rho, eta.rho] = np.eye(B.shape[1]), np.eye(link.disturbances)
    return StepMatrices(
        state=state,
        error=error,
        received=mean,
        spreads=random,
        target=target,
        energy=energy,
        growth=_list_growth_forms(system, k, eta, separate),
        nominal=np.zeros((n, m)),
    )


class _PartsOfEta(NamedTuple):
    """The place of each part of eta = (x, e, f, f~, h, h~, v, rho); that of an absent function is empty."""

    x: slice
    e: slice
    f: slice
    f_error: slice
    h: slice
    h_error: slice
    v: slice
    rho: slice


def _locate_parts_of_eta(system: GrowthSystem, k: int) -> _PartsOfEta:
    """Return the place of each part of eta at step k.

    The parts are x, e, f, f~, h, h~, the plant's disturbance and the channel's. A function that is zero at all steps
    has a place of length 0.
    """
    n, y = system.states, system.output.shape[1]
    size_of_f = 0 if system.growth.absent else n
    size_of_h = 0 if system.output_growth.absent else y
    disturbances = system.disturbance.shape[2], system.channel[k].disturbances
    sizes = [n, n, size_of_f, size_of_f, size_of_h, size_of_h, *disturbances]
    ends = np.cumsum(sizes).tolist()
    return _PartsOfEta(*(slice(end - size, end) for size, end in zip(sizes, ends, strict=True)))


def _list_growth_forms(
    system: GrowthSystem, k: int, eta: _PartsOfEta, separate: bool
) -> Float[np.ndarray, "multipliers q"]:
    """Return the diagonals of the growth forms of step k, one for each multiplier.

    Conditions |value| <= constant |argument| on f and f~, on h and h~; `separate`: each has a multiplier of its own.

    q: length of eta; f~, h~ (`f_error`, `h_error`): differences of f and h.
    """
    growth, output_growth = system.growth, system.output_growth
    pairs_of_conditions = []
    if not growth.absent:
        pairs_of_conditions.append([(eta.f, eta.x, growth.state[k]), (eta.f_error, eta.e, growth.error[k])])
    if not output_growth.absent:
        pairs_of_conditions.append(
            [(eta.h, eta.x, output_growth.state[k]), (eta.h_error, eta.e, output_growth.error[k])]
        )
    groups = [[condition] for pair in pairs_of_conditions for condition in pair] if separate else pairs_of_conditions
    q = eta.rho.stop
    return np.array([_make_growth_form(q, group) for group in groups]).reshape(-1, q)


def _make_growth_form(q: int, parts: list[tuple[slice, slice, float]]) -> Float[np.ndarray, "{q}"]:
    """Return sum_i (a_i^2 |argument_i|^2 - |value_i|^2) as the diagonal of a quadratic form of eta.

    The form is not negative if every |value_i| <= a_i |argument_i|. Each of `parts` holds the places of value_i and
    argument_i in eta, and a_i.
    """
    diagonal = np.zeros(q)
    for value, argument, constant in parts:
        diagonal[value] -= 1.0
        diagonal[argument] += constant**2
    return diagonal


def compute_next_energy(step: StepMatrices, unknowns: Unknowns) -> Float[np.ndarray, "q q"]:
    """Return the quadratic form E[next weight of (x+, e+)] + sum_i lambda_i N_i of eta, linear in the unknowns.

    X, E and U are the maps from eta to x+, e+ and what is received. P1 and P2 are the next weights, Y = P2 K and
    Z >= K'P2 K. N_i are the growth forms, with multipliers lambda_i. The form is, over the random matrices U_j,
    X'P1 X + E'P2 E - E'Y U - U'Y'E + U'Z U + sum_j U_j'(K0 + K)'P2 (K0 + K) U_j + sum_i lambda_i N_i.
    """
    X, E, U = step.state, step.error, step.received
    p1, p2, Y, Z, multipliers = unknowns
    cross = E.T @ Y @ U
    form = X.T @ p1 @ X + E.T @ p2 @ E - cross - cross.T + U.T @ Z @ U
    # The random part is corrected by the whole gain K0 + K: (K0 + K)'P2 (K0 + K), with Z in place of K'P2 K.
    cross_gain = step.nominal.T @ Y
    whole_gain_weight = Z + cross_gain + cross_gain.T + step.nominal.T @ p2 @ step.nominal
    form += np.einsum("jai,ab,jbk->ik", step.spreads, whole_gain_weight, step.spreads)
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
        """Length of the vector of all unknowns.

        It holds the triangles of two weights (n, n), the multipliers, and Y and Z for the gain unless that is given.
        """
        n, m = self.states, self.received
        unknowns_of_gain = n * m + m * (m + 1) // 2 if self.gain is None else 0
        return n * (n + 1) + unknowns_of_gain + self.multipliers

    def unpack(self, vector: Float[np.ndarray, "size"]) -> Unknowns:
        """Return the unknowns: triangles of P1 and P2, then Y and a triangle of Z, then the multipliers.

        P1 and P2 are the next weights of state and error, and K is the gain. If the gain is given, Y = P2 K and
        Z = K'P2 K are computed from it, and are not in the vector.
        """
        n, m = self.states, self.received
        triangle = n * (n + 1) // 2
        p1 = _mirror_lower_triangle(vector[:triangle], n)
        p2 = _mirror_lower_triangle(vector[triangle : 2 * triangle], n)
        multipliers = vector[self.size - self.multipliers :]
        if self.gain is not None:
            Y = p2 @ self.gain
            return Unknowns(p1, p2, Y, self.gain.T @ Y, multipliers)
        after_weights = vector[2 * triangle :]
        Y = after_weights[: n * m].reshape(n, m)
        triangle_of_z = after_weights[n * m : n * m + m * (m + 1) // 2]
        return Unknowns(p1, p2, Y, _mirror_lower_triangle(triangle_of_z, m), multipliers)


def _mirror_lower_triangle(entries: Float[np.ndarray, "triangle"], n: int) -> Float[np.ndarray, "{n} {n}"]:
    """Return the symmetric matrix (n, n) that has these entries in its lower triangle.

    The entries are listed row after row, as `_triangle_places` lists them.
    """
    matrix = np.zeros((n, n))
    rows, columns = _triangle_places(n)
    matrix[rows, columns] = matrix[columns, rows] = entries
    return matrix


@cache
def _triangle_places(n: int) -> tuple[Int[np.ndarray, "triangle"], Int[np.ndarray, "triangle"]]:
    """Return the rows and columns of the entries of an (n, n) matrix's lower triangle, row by row."""
    return np.tril_indices(n)


class LinearForms(NamedTuple):
    """Inequalities of a step as linear maps of the vector of unknowns, each to a matrix written row by row.

    next: Phi's part that is linear in the unknowns. positive: matrices that must be positive. weight: diag(P1, P2).
    """

    next: Float[np.ndarray, "qq size"]
    positive: tuple[Float[np.ndarray, "_ size"], ...]
    weight: Float[np.ndarray, "ww size"]


def make_linear_forms(step: StepMatrices, layout: UnknownsLayout) -> LinearForms:
    """Return the linear forms of a step, whose columns are their values at the unit vectors of the unknowns.

    There are forms for Phi's part with unknowns, for the matrices that must be positive, and for the next weight. Each
    gives its matrix row by row. `layout.gain` is the given gain, or None if the gain is unknown.
    """
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    forward = np.array([compute_next_energy(step, unit).ravel() for unit in units]).T
    state_form = np.array([unit.state.ravel() for unit in units]).T
    if layout.gain is None:
        blocks = [np.block([[unit.gain_square, unit.product.T], [unit.product, unit.error]]) for unit in units]
    else:
        blocks = [unit.error for unit in units]
    error_form = np.array([block.ravel() for block in blocks]).T
    return LinearForms(forward, (state_form, error_form), make_weight_form(layout))


def make_weight_form(layout: UnknownsLayout) -> Float[np.ndarray, "ww size"]:
    """Return the linear map from the vector of unknowns to diag(P1, P2), written row by row.

    P1, P2: weights of state and error after the step.
    """
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    first_block, second_block = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    weights = [np.kron(first_block, unit.state) + np.kron(second_block, unit.error) for unit in units]
    return np.array([weight.ravel() for weight in weights]).T


def find_independent_parts(
    step: StepMatrices, forms: LinearForms, start: Float[np.ndarray, "w w"] | None = None
) -> list[Int[np.ndarray, "_"]]:
    """Return sets of indices of eta between which all entries of Phi are zero, whatever the unknowns are.

    So Phi < 0 splits into a smaller inequality for each set. Phi (q, q) is the matrix of the step's inequality in eta,
    which begins with x and e of n components each. `start` is the weight before the step if it is not diag(P1, P2).
    """
    q = len(step.energy)
    are_coupled = np.any(forms.next != 0, axis=1).reshape(q, q) | (step.target != 0) | (step.energy != 0)
    n = step.state.shape[0]
    are_coupled[:n, :n] = are_coupled[n : 2 * n, n : 2 * n] = True  # the weight diag(P1, P2) of this step
    if start is not None:
        are_coupled[: 2 * n, : 2 * n] |= start != 0
    count, labels = connected_components(are_coupled, directed=False)
    return [np.flatnonzero(labels == i) for i in range(count)]
