"""Check that gains, from anywhere, guarantee an H-infinity level, by code that shares nothing with the designs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.h_infinity.error_system import LARGEST, Growth, GrowthSystem, smallest_eigenvalue, symmetric_weight
from heliograph.h_infinity.lipschitz_check import TOLERANCE, GrowthFinding
from heliograph.numerics.check import TINY, array, fail, instance, items, scalar
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

FINDINGS = "findings of check_growth"
ROUNDING = 1e-12  # an eigenvalue this close to zero has no sign, in a matrix whose diagonal is -1


@readable
class HInfinityCertificate(NamedTuple):
    """Certificate of an H-infinity level, with every number that it rests on.

    Args:
        certified: true if every condition of Theorem 1 holds and no growth constant is refuted.
        level: the level gamma, a ratio of norms.
        largest_eigenvalues: of Theorem 1's matrix at each step (steps,); all must be negative.
        steps_certified: number of steps, from the first on, at which they are.
        initial: smallest eigenvalue of level^2 W - P_0, which must be positive.
        margin: smallest distance of all of these from failing, with every matrix scaled to a diagonal of -1 or 1.
        growth: what is known about the growth constants.
        reasons: every condition that fails, in words.
        assumed: growth constants that no finding proves.
    """

    certified: bool
    level: float
    largest_eigenvalues: Float[np.ndarray, "steps"]
    steps_certified: int
    initial: float
    margin: float
    growth: tuple[GrowthFinding, ...]
    reasons: tuple[str, ...]
    assumed: tuple[str, ...]

    @property
    def text(self) -> str:
        """One line that says whether the level gamma, the error's norm over the disturbances', is certified.

        If not, it says why not; if so, which growth constants it rests on are not proved but assumed.
        """
        if not self.certified:
            return f"level {self.level:g} is not certified: {'; '.join(self.reasons)}"
        all_proved = "growth constants proved in their boxes, or zero"
        basis = f"assumed: {'; '.join(self.assumed)}" if self.assumed else all_proved
        return f"level {self.level:g} is certified; {basis}"


def certify_level(
    system: "GrowthSystem",
    gains: "Float[ArrayLike, 'steps n m']",
    weights: "Float[ArrayLike, 'steps+1 n+n n+n']",
    multipliers: "Float[ArrayLike, 'steps count']",
    level: float,
    growth: "Sequence[GrowthFinding]" = (),
    output_growth: "Sequence[GrowthFinding]" = (),
) -> "HInfinityCertificate":
    """Return whether gains K guarantee an H-infinity level, given weights P and multipliers that are meant to prove it.

    With Phi_k the matrix of step k (`make_theorem_matrix`), e the error, v and rho the disturbances of plant and
    channel and W the initial weight: Phi_k < 0 at every step, P_k > 0, level^2 W - P_0 > 0 and multipliers >= 0
    together prove sum |M e|^2 < level^2 (sum |v|^2 + |rho|^2 + xi_0' W xi_0). A level that rests on a refuted growth
    constant, or on a finding about a constant above the system's, is not certified.

    Args:
        system: the system with its growth constants, from `growth_system`.
        gains: K (steps, n, m).
        weights: P_0 ... P_steps (steps + 1, 2n, 2n), of the stacked (x, e).
        multipliers: (steps, 2) for (f, f~) and (h, h~) together, or (steps, 4) for f, f~, h, h~.
        level: gamma, a positive ratio of norms.
        growth: results of `check_growth` about f; constants that none of them proves are listed as assumed (default
            none).
        output_growth: the same about h (default none).

    Raises:
        ValueError: arrays of the wrong shape, weights that are not symmetric, or a level that is not positive.
    Source: H-infinity fusion over amplify-and-forward relays, Theorem 1 (inequalities (18) and (19)).
    """
    instance("system", system, GrowthSystem, "a GrowthSystem, as growth_system makes it")
    level = float(scalar("level", level, low=TINY, high=LARGEST))
    findings_of_f = _list_findings("growth", growth)
    findings_of_h = _list_findings("output growth", output_growth)
    n, m, T = system.states, system.received, system.steps
    K = array("gains", gains, (T, n, m))
    if np.max(np.abs(K), initial=0.0) > LARGEST:
        raise fail("gains", f"entries of at most {LARGEST:g}", f"{np.max(np.abs(K)):g}")
    P = symmetric_weight("weights", array("weights", weights, (T + 1, 2 * n, 2 * n)))
    lam = _complete_multipliers(array("multipliers", multipliers, (T, None)))  # of f, f~, h, h~ at each step
    # Phi_k < 0 of every step.
    matrices = [make_theorem_matrix(system, k, K[k], P[k], P[k + 1], lam[k], level) for k in range(T)]
    largest = np.array([_largest_eigenvalue(phi) for phi in matrices])
    negative = np.array([is_negative_definite(phi) for phi in matrices])
    # Initial condition level^2 W - P_0 > 0, and how far all these are from failing, in units of the diagonals.
    allowed = level**2 * system.initial_weight
    initial = float(np.linalg.eigvalsh(allowed - P[0])[0])
    initial_margin = smallest_eigenvalue(allowed - P[0], np.sqrt(np.diagonal(allowed)))
    margin = min(initial_margin, *(-_find_scaled_largest(phi) for phi in matrices))
    # Every condition that fails, in words.
    reasons = [f"step {k}: the largest eigenvalue is {largest[k]:.3g}, not negative" for k in np.flatnonzero(~negative)]
    if not initial_margin > ROUNDING:
        reasons.append(f"initial condition: the smallest eigenvalue of level^2 W - P_0 is {initial:.3g}, not positive")
    reasons += _list_wrong_signs(P, lam)
    reasons += _list_objections(system.growth, findings_of_f)
    reasons += _list_objections(system.output_growth, findings_of_h)
    assumed = _list_assumed_constants("f", system.growth, findings_of_f)
    assumed += _list_assumed_constants("h", system.output_growth, findings_of_h)
    return HInfinityCertificate(
        certified=not reasons,
        level=level,
        largest_eigenvalues=largest,
        steps_certified=T if negative.all() else int(np.argmin(negative)),
        initial=initial,
        margin=margin,
        growth=tuple(findings_of_f + findings_of_h),
        reasons=tuple(reasons),
        assumed=tuple(assumed),
    )


def _list_findings(name: str, given: Sequence[GrowthFinding]) -> list[GrowthFinding]:
    """Return the results of `check_growth` that a user gave, as a list; raise ValueError for anything else among them.

    `name` is what they are called in errors.
    """
    return [instance(name, finding, GrowthFinding, FINDINGS) for finding in items(name, given, FINDINGS)]


def _list_objections(growth: Growth, findings: Sequence[GrowthFinding]) -> list[str]:
    """Return reasons against a certificate: refuted constants, and findings about constants above the system's.

    `growth` holds the constants a of |f(x)| <= a |x| and of |f(x) - f(y)| <= a |x - y|. `findings` are the results of
    checks of such constants.
    """
    reasons, constants = [], _list_positive(growth.state) + _list_positive(growth.error)
    for finding in findings:
        if finding.refuted:
            reasons.append(finding.text)
        elif not any(_finding_covers(finding, value) for value in constants):
            names = ", ".join(sorted({f"{value:g}" for value in constants})) or "none"
            text = f"a finding about the constant {finding.constant:g}, the system has {names}"
            reasons.append(f"{finding.name}: {text}")
    return reasons


def _finding_covers(finding: GrowthFinding, constant: float) -> bool:
    """Decide whether a finding about its own constant covers this one: it is no larger, but for rounding."""
    return finding.constant <= constant * (1 + TOLERANCE)


def _list_positive(constants: Float[np.ndarray, "steps"]) -> list[float]:
    """List the constants that are not zero, without repetition, in their order."""
    return list(dict.fromkeys(float(value) for value in constants if value > 0))


def _list_assumed_constants(letter: str, growth: Growth, findings: Sequence[GrowthFinding]) -> list[str]:
    """Return in words the growth constants of a function, called by a `letter`, that no finding proves.

    A finding is the result of `check_growth`. It bounds the slopes in a box, and so the differences of the function in
    it. If 0 is in the box (`finding.around_zero`) and f(0) = 0, it bounds the function itself too. `growth.state` and
    `growth.error` hold the constants of f itself and of its differences.
    """
    around_zero = [finding for finding in findings if finding.around_zero]
    of_function, of_differences = f"|{letter}(x)| <= a |x|", f"|{letter}(x) - {letter}(y)| <= a |x - y|"
    assumed = []
    for constants, condition, relevant in (
        (growth.state, of_function, around_zero),
        (growth.error, of_differences, findings),
    ):
        for value in _list_positive(constants):
            findings_of_constant = [finding for finding in relevant if _finding_covers(finding, value)]
            if not findings_of_constant or not all(finding.proved for finding in findings_of_constant):
                assumed.append(f"{condition} with a = {value:g}")
    return assumed


def _list_wrong_signs(
    weights: Float[np.ndarray, "times w w"], multipliers: Float[np.ndarray, "steps count"]
) -> list[str]:
    """Return in words which weights P_k are not positive definite, and which steps have a negative multiplier.

    An eigenvalue up to ROUNDING, 1e-12, counts as zero.
    """
    smallest = np.array([smallest_eigenvalue(p) for p in weights])
    indefinite = np.flatnonzero(~(smallest > ROUNDING))
    reasons = [f"P_{k} is not positive definite ({smallest[k]:.3g})" for k in indefinite]
    negative_steps = np.flatnonzero((multipliers < 0).any(axis=1))
    return reasons + [f"step {k}: a multiplier is negative" for k in negative_steps]


def make_theorem_matrix(
    system: GrowthSystem,
    k: int,
    gain: Float[np.ndarray, "n m"],
    weight: Float[np.ndarray, "n+n n+n"],
    following: Float[np.ndarray, "n+n n+n"],
    multipliers: Float[np.ndarray, "4"],
    level: float,
) -> Float[np.ndarray, "q q"]:
    """Return Phi of step k over eta = (x, e, f, f~, h, h~, v, rho): where negative definite, the step keeps the level.

    x+ = A x + f(x) + B v and z = G (C x + h(x) + D v) + N rho, with H = [G, N] random; e = x - xhat,
    f~ = f(x) - f(xhat), h~ = h(x) - h(xhat). The next (x, e) is R eta - [0; K] H V eta, V eta = (C x + h + D v, rho),
    where R eta holds what the filter expects, G-bar (C xhat + h(xhat)), so that Phi needs E[H] and E[H_ab H_ij] and
    nothing else of the channel. Functions that are zero throughout are left out of eta.

    Args:
        system: the system.
        k: the step.
        gain: K.
        weight: P_k.
        following: P_k+1.
        multipliers: of f, f~, h, h~.
        level: gamma.

    Source: H-infinity fusion over amplify-and-forward relays, equations (8) and (18).
    """
    A, B, M = system.transition[k], system.disturbance[k], system.target[k]
    C, D = system.output[k], system.feedthrough[k]
    link, n, y, v = system.channel[k], system.states, system.output.shape[1], system.disturbance.shape[2]
    r, eye = link.disturbances, np.eye
    # Where each part of eta begins, by a letter: g for f~, d for h~, r for rho.
    at = dict(zip("xefghdvr", np.cumsum([0, n, n, n, n, y, y, v]), strict=True))
    q = 4 * n + 2 * y + v + r

    def rows(height: int, **blocks: np.ndarray) -> Float[np.ndarray, "{height} q"]:
        """Return a matrix of `height` rows over eta that has these blocks, each in the columns of a part of eta.

        eta, of length q, is the vector of all that a step depends on. `at` gives the first index of each part by its
        letter, the name of the block. Parts without a block get zeros: rows(n, x=A) @ eta is A x.
        """
        matrix = np.zeros((height, q))
        for name, block in blocks.items():
            matrix[:, at[name] : at[name] + block.shape[1]] = block
        return matrix

    # The matrices V = [C x + h + D v; rho], E[G] (C xhat + h(xhat)) with xhat = x - e and h(xhat) = h - h~, and
    # R = [A x + f + B v; A e + f~ + B v + K E[G] (C xhat + h(xhat))], each over eta.
    v_eta = np.concatenate([rows(y, x=C, h=eye(y), v=D), rows(r, r=eye(r))])
    expected = link.mean[:, :y] @ rows(y, x=C, e=-C, h=eye(y), d=-eye(y))
    r_eta = np.concatenate([rows(n, x=A, f=eye(n), v=B), rows(n, e=A, g=eye(n), v=B) + gain @ expected])
    # E |R eta - [0; K] H V eta|^2 in the norm of P_k+1.
    correction = np.concatenate([np.zeros_like(gain), gain])
    inner = correction.T @ following @ correction
    cross = r_eta.T @ following @ correction @ link.mean @ v_eta
    square = v_eta.T @ np.einsum("ai,abij->bj", inner, link.second) @ v_eta
    phi = r_eta.T @ following @ r_eta - cross - cross.T + square
    # - P_k + M'M - level^2 |(v, rho)|^2, and the growth conditions.
    phi[: 2 * n, : 2 * n] -= weight
    phi[n : 2 * n, n : 2 * n] += M.T @ M
    disturbances = slice(4 * n + 2 * y, q)
    phi[disturbances, disturbances] -= level**2 * np.eye(v + r)
    _add_growth(phi, at, y, system, k, multipliers)
    return _drop_absent_functions(phi, at, y, system)


def _add_growth(
    phi: Float[np.ndarray, "q q"],
    at: dict[str, int],
    y: int,
    system: GrowthSystem,
    k: int,
    multipliers: Float[np.ndarray, "4"],
) -> None:
    """Add to Phi the growth conditions of step k: sum_i lambda_i (a_i^2 |argument_i|^2 - |value_i|^2).

    An H-infinity level holds if the quadratic form Phi in eta (state x, error e, unknown functions, disturbances) is
    negative definite. The functions f(x), h(x), and their differences f~(e), h~(e) between state and estimate, are
    known by |value_i| <= a_i |argument_i| alone; with lambda_i >= 0 these conditions may be added to Phi.

    Args:
        phi: Phi (q, q), which is changed.
        at: where each part of eta begins, by its letter (g for f~, d for h~).
        y: number of outputs.
        system: the system, with the constants a_i of each step.
        k: the step.
        multipliers: lambda of f, f~, h, h~.
    """
    n, f, h = system.states, system.growth, system.output_growth
    # Letter of the value, its size, letter of the argument (of n numbers), and the constant.
    conditions = [
        ("f", n, "x", f.state[k]),
        ("g", n, "e", f.error[k]),
        ("h", y, "x", h.state[k]),
        ("d", y, "e", h.error[k]),
    ]
    for (value_name, size, argument_name, constant), multiplier in zip(conditions, multipliers, strict=True):
        # - lambda I in the block of the value, + lambda a^2 I in the block of the argument.
        value = slice(at[value_name], at[value_name] + size)
        argument = slice(at[argument_name], at[argument_name] + n)
        phi[value, value] -= multiplier * np.eye(size)
        phi[argument, argument] += multiplier * constant**2 * np.eye(n)


def _drop_absent_functions(
    phi: Float[np.ndarray, "q q"], at: dict[str, int], y: int, system: GrowthSystem
) -> Float[np.ndarray, "kept kept"]:
    """Return Phi without the rows and columns of f and f~, or of h and h~, where the function is zero throughout.

    Phi is the quadratic form of a step in eta = (x, e, f, f~, h, h~, v, rho). f is the plant's nonlinear part, and f~
    its difference between the state and the estimate. h and h~ are those of the sensor, with `y` numbers each. `at`
    gives the first row of each part of eta by its letter.
    """
    kept_rows = list(range(len(phi)))
    for growth, name, width in ((system.growth, "f", 2 * system.states), (system.output_growth, "h", 2 * y)):
        if growth.absent:
            kept_rows = [i for i in kept_rows if not at[name] <= i < at[name] + width]
    return np.asarray(phi[np.ix_(kept_rows, kept_rows)])


def _complete_multipliers(multipliers: Float[np.ndarray, "steps count"]) -> Float[np.ndarray, "steps 4"]:
    """Return the multipliers of f, f~, h, h~ from 2 or 4 for each step.

    Where there are 2, the first counts for f and f~, and the second for h and h~.
    """
    if multipliers.shape[1] not in (2, 4):
        raise fail("multipliers", "2 or 4 for each step", multipliers.shape[1])
    return multipliers if multipliers.shape[1] == 4 else np.repeat(multipliers, 2, axis=1)


def _largest_eigenvalue(phi: Float[np.ndarray, "q q"]) -> float:
    """Return the largest eigenvalue of a symmetric matrix."""
    return float(np.linalg.eigvalsh((phi + phi.T) / 2)[-1])


def is_negative_definite(phi: Float[np.ndarray, "q q"]) -> bool:
    """Return whether a symmetric matrix Phi is negative definite beyond rounding, after scaling its diagonal to -1.

    Scaling preserves definiteness and lets weights of very different sizes stand in one matrix.
    """
    return _find_scaled_largest(phi) < -ROUNDING


def _find_scaled_largest(phi: Float[np.ndarray, "q q"]) -> float:
    """Return the largest eigenvalue of a symmetric Phi after scaling its diagonal to -1, by s_i s_j on entry ij.

    It is infinite if the diagonal is not negative, since Phi is then not negative definite. It has the same sign as the
    largest eigenvalue of Phi itself, and does not depend on units.
    """
    diagonal = np.diagonal(phi)
    if not np.all(diagonal < 0):
        return np.inf
    scale = 1 / np.sqrt(-diagonal)
    return _largest_eigenvalue(phi * np.outer(scale, scale))
