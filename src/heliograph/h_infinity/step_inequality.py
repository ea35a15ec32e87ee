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
    """Return the matrices of every step of x+ = A x + f(x) + B v, received G (C x + h(x) + D v) + N rho.

    They act on eta = (x, e, f, f~, h, h~, v, rho): the state x, the error e = x - xhat, the functions f(x) and h(x),
    their differences f~ = f(x) - f(xhat) and h~ = h(x) - h(xhat), and the disturbances. A function that is zero at all
    steps is left out of eta. f and h are known by bounds |f(x)| <= a |x| alone, each of which is a quadratic form
    eta'N_i eta >= 0 with a multiplier lambda_i >= 0 (S-procedure). With `separate`, each of f, f~, h, h~ has a
    multiplier; else (f, f~) share one, and (h, h~) too.
    """
    # The random part of (G, N) is a sum of independent matrices. All steps need the same number of these: a step with
    # fewer gets matrices of zeros.
    spreads = [link.spreads() for link in system.channel]
    count = max(len(matrices) for matrices in spreads)
    padded = []
    for matrices in spreads:
        zeros = np.zeros((count - len(matrices), *matrices.shape[1:]))
        padded.append(np.concatenate([matrices, zeros]))
    return [_make_step_matrices(system, k, padded[k], separate) for k in range(system.steps)]


def complete_multipliers(
    system: GrowthSystem, found: Float[np.ndarray, "*steps present"], separate: bool
) -> Float[np.ndarray, "*steps count"]:
    """Return the multipliers of all growth conditions, from those `found` for functions f and h that are not zero.

    f and h are known by bounds |f(x)| <= a |x|, and so are their differences f~ and h~ between the state and its
    estimate. In the step's inequality each bound is a quadratic form times a multiplier lambda >= 0 (S-procedure). A
    function that is zero at all steps has no unknown multiplier; its place is filled with 0.

    With `separate` the result is (steps, 4) for f, f~, h, h~. Otherwise (f, f~) share one, and (h, h~) too: (steps, 2).
    """
    multipliers_by_function = 2 if separate else 1
    is_present = list[bool]()
    for growth in (system.growth, system.output_growth):
        is_present += [not growth.absent] * multipliers_by_function
    multipliers = np.zeros((*found.shape[:-1], len(is_present)))
    multipliers[..., is_present] = found
    return multipliers


def _make_step_matrices(
    system: GrowthSystem, k: int, spreads: Float[np.ndarray, "spreads m _"], separate: bool
) -> StepMatrices:
    """Return the matrices of step k over eta = (x, e, f, f~, h, h~, v, rho), all that the step depends on.

    eta holds the state x, the error e = x - xhat, the nonlinear functions f(x) and h(x), their differences
    f~ = f(x) - f(xhat) and h~ = h(x) - h(xhat), and the disturbances v and rho. Functions that are zero at all steps
    are left out. An H-infinity filter bounds the energy of M e by level^2 times that of the disturbances; its condition
    at step k is a quadratic form in eta, which these matrices make:

      x+ = A x + f + B v,   e+ = A e + f~ + B v - K (what is received less its prediction),
      received = G (C x + h + D v) + N rho with random (G, N),   its prediction E[G] (C xhat + h(xhat)).

    No gain is chosen yet: the nominal gain of the result is 0 (`scale_steps` sets it).

    Args:
        system: x+ = A x + f(x) + B v, what is received G (C x + h(x) + D v) + N rho, and the target M e.
        k: the step.
        spreads: the random part of (G, N) about its mean, as a sum of independent matrices (spreads, m, y + size of
            rho).
        separate: whether each of f, f~, h, h~ has a multiplier of its own; else f and f~ share one, and h and h~.
    """
    A, B, M = system.transition[k], system.disturbance[k], system.target[k]
    C, D = system.output[k], system.feedthrough[k]
    n, y, m, link = system.states, system.output.shape[1], system.received, system.channel[k]
    # Slices of the parts in eta, which has q entries. Of an absent f or h no columns are used.
    eta = _locate_parts_of_eta(system, k)
    q = eta.rho.stop
    of_f = slice(0, eta.f.stop - eta.f.start)  # columns of a matrix that multiplies f: all n, or none
    of_h = slice(0, eta.h.stop - eta.h.start)
    # State x+ = A x + f + B v, and error e+ = A e + f~ + B v before the correction.
    state, error = np.zeros((n, q)), np.zeros((n, q))
    state[:, eta.x], state[:, eta.f], state[:, eta.v] = A, np.eye(n)[:, of_f], B
    error[:, eta.e], error[:, eta.f_error], error[:, eta.v] = A, np.eye(n)[:, of_f], B
    # Mean of what is received less its prediction: E[G] (C e + h~ + D v) + E[N] rho.
    G, N = link.mean[:, :y], link.mean[:, y:]
    mean = np.zeros((m, q))
    mean[:, eta.e], mean[:, eta.h_error], mean[:, eta.v], mean[:, eta.rho] = G @ C, G[:, of_h], G @ D, N
    # Random part of G (C x + h + D v) + N rho, for each of the spreads.
    G, N = spreads[..., :y], spreads[..., y:]
    random = np.zeros((len(spreads), m, q))
    random[..., eta.x], random[..., eta.h], random[..., eta.v] = G @ C, G[..., of_h], G @ D
    random[..., eta.rho] = N
    # |M e|^2 = e' M'M e and |v|^2 + |rho|^2 as quadratic forms in eta.
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
    """The indices of each part of eta = (x, e, f, f~, h, h~, v, rho); that of an absent function is empty."""

    x: slice
    e: slice
    f: slice
    f_error: slice
    h: slice
    h_error: slice
    v: slice
    rho: slice


def _locate_parts_of_eta(system: GrowthSystem, k: int) -> _PartsOfEta:
    """Return at which indices of eta = (x, e, f, f~, h, h~, v, rho) each of its parts stands, at step k.

    x is the state, e its error; f~ = f(x) - f(xhat) (`f_error`) and h~ = h(x) - h(xhat) (`h_error`); v and rho are the
    disturbances of plant and channel. A function that is zero at all steps has an empty slice.
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
    """Return the diagonals (multiplier, q) of the growth forms N_i of step k, with eta'N_i eta >= 0, one a multiplier.

    f and h are known by |f(x)| <= a |x| and |f(x) - f(xhat)| <= a~ |x - xhat|, likewise h. Each bound is a form
    a^2 |x|^2 - |f|^2 >= 0 of eta, the vector (of length q) of all that the step depends on. A multiplier certifies a
    form (S-procedure): with `separate` it is the form of one bound, otherwise the sum of those of f and f~, or of h and
    h~. `eta` says where each part of eta stands; f~ is `eta.f_error`, h~ is `eta.h_error`.
    """
    growth, output_growth = system.growth, system.output_growth
    pairs_of_conditions = []
    if not growth.absent:
        pairs_of_conditions.append([(eta.f, eta.x, growth.state[k]), (eta.f_error, eta.e, growth.error[k])])
    if not output_growth.absent:
        pairs_of_conditions.append(
            [(eta.h, eta.x, output_growth.state[k]), (eta.h_error, eta.e, output_growth.error[k])]
        )
    # Conditions that share a multiplier: each by itself, or a function with its difference.
    groups = [[condition] for pair in pairs_of_conditions for condition in pair] if separate else pairs_of_conditions
    q = eta.rho.stop
    return np.array([_make_growth_form(q, group) for group in groups]).reshape(-1, q)


def _make_growth_form(q: int, bounds: list[tuple[slice, slice, float]]) -> Float[np.ndarray, "{q}"]:
    """Return sum_i (a_i^2 |argument_i|^2 - |value_i|^2) as the diagonal of a quadratic form of eta.

    The form is not negative if every |value_i| <= a_i |argument_i|. Each of `bounds` holds the indices of value_i and
    of argument_i in eta, and a_i.
    """
    diagonal = np.zeros(q)
    for value, argument, constant in bounds:
        diagonal[value] -= 1.0
        diagonal[argument] += constant**2
    return diagonal


def compute_next_energy(step: StepMatrices, unknowns: Unknowns) -> Float[np.ndarray, "q q"]:
    """Return the matrix of eta's form E[x+'P1 x+ + e+'P2 e+] + sum_i lambda_i eta'N_i eta, linear in the unknowns.

    eta is the vector of all that the step depends on: x+ = X eta, e+ = (E - K U) eta - (K0 + K) W eta. K0 (`nominal`)
    is a fixed gain, K its unknown correction; W is random, E[W'Q W] = sum_j U_j'Q U_j with the matrices `spreads`. P1
    and P2 are weights, Y = P2 K and Z >= K'P2 K. N_i are the growth forms. So the matrix is, with Z for K'P2 K,

      X'P1 X + (E - K U)'P2 (E - K U) + sum_j U_j'(K0 + K)'P2 (K0 + K) U_j + sum_i lambda_i N_i.
    """
    X, E, U, K0 = step.state, step.error, step.received, step.nominal
    p1, p2, Y, Z, multipliers = unknowns
    # (E - K U)'P2 (E - K U) = E'P2 E - E'Y U - U'Y'E + U'Z U.
    cross = E.T @ Y @ U
    form = X.T @ p1 @ X + E.T @ p2 @ E - cross - cross.T + U.T @ Z @ U
    # (K0 + K)'P2 (K0 + K) = Z + K0'Y + Y'K0 + K0'P2 K0.
    cross_gain = K0.T @ Y
    whole_gain_weight = Z + cross_gain + cross_gain.T + K0.T @ p2 @ K0
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
        """Return the unknowns of a step from their vector: triangles of P1 and P2, Y, a triangle of Z, multipliers.

        The weights P1 and P2 of the next state and error, the gain K in Y = P2 K and Z >= K'P2 K, and the multipliers
        of the growth conditions must make the step's quadratic form negative. If K is given, Y = P2 K and Z = K'P2 K
        are computed from it, and are not in the vector.
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

    The entries are listed row after row, as `_lower_triangle_indices` lists them.
    """
    matrix = np.zeros((n, n))
    rows, columns = _lower_triangle_indices(n)
    matrix[rows, columns] = matrix[columns, rows] = entries
    return matrix


@cache
def _lower_triangle_indices(n: int) -> tuple[Int[np.ndarray, "triangle"], Int[np.ndarray, "triangle"]]:
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
    """Return the matrices of a step's inequality as linear maps of the vector of unknowns, each matrix row by row.

    The inequality is Phi < 0: Phi = E[x+'P1 x+ + e+'P2 e+] and growth forms (`compute_next_energy`, the map `next`),
    plus a part without unknowns. It needs P1 > 0, and [[Z, Y'], [Y, P2]] > 0, so that Z > K'P2 K (Schur complement),
    or P2 > 0 if the gain K is given. `weight` is diag(P1, P2). All are linear: column i of a map is the matrix at unit
    vector i. `layout`: where each unknown stands in the vector.
    """
    # The unknowns at each unit vector: the values of a linear map there are its columns.
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    next_form = np.array([compute_next_energy(step, unit).ravel() for unit in units]).T
    state_form = np.array([unit.state.ravel() for unit in units]).T  # P1
    if layout.gain is None:  # [[Z, Y'], [Y, P2]]
        blocks = [np.block([[unit.gain_square, unit.product.T], [unit.product, unit.error]]) for unit in units]
    else:  # P2
        blocks = [unit.error for unit in units]
    error_form = np.array([block.ravel() for block in blocks]).T
    return LinearForms(next_form, (state_form, error_form), make_weight_form(layout))


def make_weight_form(layout: UnknownsLayout) -> Float[np.ndarray, "ww size"]:
    """Return the linear map from the vector of unknowns to diag(P1, P2), written row by row.

    P1 and P2 are the weights of state and error after the step. `layout` says where they stand in the vector. A linear
    map's columns are its values at the unit vectors.
    """
    units = [layout.unpack(unit) for unit in np.eye(layout.size)]
    first_block, second_block = np.diag([1.0, 0.0]), np.diag([0.0, 1.0])
    weights = [np.kron(first_block, unit.state) + np.kron(second_block, unit.error) for unit in units]
    return np.array([weight.ravel() for weight in weights]).T


def find_independent_parts(
    step: StepMatrices, forms: LinearForms, start: Float[np.ndarray, "w w"] | None = None
) -> list[Int[np.ndarray, "_"]]:
    """Return sets of indices of eta between which all entries of Phi are zero, whatever the unknowns are.

    So Phi < 0 splits into a smaller inequality for each set, which a solver solves faster. They are the connected parts
    of the graph of Phi's entries that may not be zero. Phi (q, q) is the matrix of the step's inequality in eta, which
    begins with x and e of n components each.

    Args:
        step: matrices of the step.
        forms: Phi's part that is linear in the unknowns, `forms.next`.
        start: the weight before the step if it is not diag(P1, P2).
    """
    q = len(step.energy)
    are_coupled = np.any(forms.next != 0, axis=1).reshape(q, q) | (step.target != 0) | (step.energy != 0)
    n = step.state.shape[0]
    are_coupled[:n, :n] = are_coupled[n : 2 * n, n : 2 * n] = True  # the weight diag(P1, P2) of this step
    if start is not None:
        are_coupled[: 2 * n, : 2 * n] |= start != 0
    count, labels = connected_components(are_coupled, directed=False)
    return [np.flatnonzero(labels == i) for i in range(count)]
