"""Linear plants behind links whose losses the receiver knows: gains, certificates of a bounded mean error, its limits.

P is the error covariance before a measurement is used. U_i = E[P 1{the next mode of the links is i}], and
V_i = E[P+ 1{mode i}] after a step of mode i, so that U_j = sum_i T_ij V_i with the chain's probabilities T_ij. Modes of
one "kind" cannot be told apart by the receiver, and share a gain.
"""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.factors.square_root_update import observe_root, roots_of
from heliograph.linear.jump_system import JumpSystem, mix_moments_of_modes, propagate_by_mode, unpack_triangle_entries
from heliograph.numerics.check import fail
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.types import Float, Int

BELOW_ONE = 1 - 1e-9  # below this a spectral radius is below 1, whatever rounding did to it
CONVERGED = 1e-13  # relative change of the gains from step to step
ITERATIONS, POLISHING = 100, 50  # of the covariance recursion in search of gains, and of the policy iteration after it
NEGLIGIBLE = 1e12  # ratio of covariances to the noises' from which on the noises hardly matter
WEIGHT = 1e-9  # probability of a mode below which it counts as 0
SEEN = 1e-6  # probability that a mode gets in the search for gains if the chain leaves it for good
SIZE_LIMIT = 1024  # rows of the operator that acts on all entries of all covariances

KindGains = tuple[Float[np.ndarray, "n _"], ...]
ModeCovariances = Float[np.ndarray, "modes n n"]


class KnownLossSystem(NamedTuple):
    """Linear plant x+ = A x + w, Cov(w) = Q, behind links with modes i; the receiver knows their kind s = known[i].

    It receives C_s x + v, Cov(v) = R_i. The receiver cannot distinguish modes of one kind, so a gain belongs to a kind.
    A kind whose C_s has no rows is a loss.

    Args:
        transition: A (n, n).
        process: Q (n, n).
        chain: `chain[i, j]` = P(next mode j | now i).
        law: probability of each mode in the long run.
        known: the kind of each mode.
        outputs: C_s of each kind.
        noises: R_i of each mode, of the size of its kind's output.
    """

    transition: Float[np.ndarray, "n n"]
    process: Float[np.ndarray, "n n"]
    chain: Float[np.ndarray, "modes modes"]
    law: Float[np.ndarray, "modes"]
    known: Int[np.ndarray, "modes"]
    outputs: tuple[Float[np.ndarray, "_ n"], ...]
    noises: tuple[Float[np.ndarray, "_ _"], ...]

    def close_loop(self, gains: KindGains, noise: float = 1.0) -> JumpSystem:
        """Return the recursion V_j+ = F_j U_j F_j' + law_j (K R_j K' + Q), F_j = A - K C, which holds for any gains.

        V_j is E[error covariance x 1{mode j}], U_j = sum_i chain_ij V_i, and law_j = P(mode j). Mode j has the output
        matrix C and the gain K of its kind `known[j]`, the modes that the receiver cannot distinguish; `gains` has one
        K (n, m) for each kind. Q and R are scaled by `noise`. If each step draws its mode anew, one V is enough.

        Raises:
            ValueError: more than SIZE_LIMIT entries in all V_j.
        """
        n, modes = len(self.transition), len(self.chain)
        size = n * n * (1 if np.all(self.chain == self.chain[0]) else modes)
        if size > SIZE_LIMIT:
            raise fail("chain of losses", f"at most {SIZE_LIMIT} entries of covariances over all modes", size)
        loops = [self.transition - gains[s] @ self.outputs[s] for s in self.known]
        added = [gains[s] @ r @ gains[s].T + self.process for s, r in zip(self.known, self.noises, strict=True)]
        return JumpSystem(self.chain[None], np.array([loops]), noise * self.law[:, None, None] * np.array([added]))

    def solve_steady_covariances(self, gains: KindGains) -> ModeCovariances:
        """Return the steady U_j = E[P 1{next mode j}] (modes, n, n) under these gains, P the error covariance.

        The spectral radius of the closed loop must be below 1, else there is no steady covariance.
        """
        (V,) = self.close_loop(gains).steady()  # of the only step of the period
        U: ModeCovariances = mix_moments_of_modes(self.chain, V)
        return U


def certify_radius(system: KnownLossSystem, gains: KindGains) -> float:
    """Return the spectral radius of the step from error covariances V to V+ under any gains, wherever they come from.

    If it is below 1, the mean error covariance E P stays bounded under these gains, and so under the best ones. A
    computed radius below 1 is checked by a Lyapunov inequality: covariances V > 0 that a step without noise makes
    smaller, V - V+ > 0, exist if and only if the radius is below 1. The steady V under unit noises is tried as this
    proof; if rounding makes it none, infinity is returned.

    Source: Sinopoli et al., Kalman filtering with intermittent observations (2004), Theorem 5, with any gain.
    """
    jumps = system.close_loop(gains)
    radius = jumps.radius()
    if radius >= BELOW_ONE:
        return radius
    unit_noises = np.broadcast_to(np.eye(len(system.transition)), jumps.maps.shape)
    (V,) = jumps._replace(added=unit_noises).steady()
    # V_j+ = F_j (sum_i T_ij V_i) F_j' without noise; `jumps` has a single step.
    V_next = propagate_by_mode(jumps.maps[0], mix_moments_of_modes(system.chain, V), 0.0)
    decrease: ModeCovariances = V - V_next
    is_proved = min(np.linalg.eigvalsh(decrease).min(), np.linalg.eigvalsh(V).min()) > 0
    return radius if is_proved else float("inf")


def find_gains(system: KnownLossSystem) -> KindGains:
    """Return a gain for each kind of mode s, so that the mean error covariance E P stays bounded and small.

    The links to the receiver are in a mode, such as arrived or lost, which moves as a Markov chain; the receiver knows
    its kind and uses the kind's constant gain. K_s = A U C_s' (C_s U C_s' + R)^-1, with U and R summed over the modes
    of the kind. First the best filter's covariance recursion, with mean covariances, runs until its gains converge or
    keep E P bounded. Then policy iteration, which converges faster, improves the gains. If E P is still not bounded,
    the gains A C^+ (pseudo-inverse) are tried too: if C shows all of x, A - K C is 0 and no old error remains.

    Source: Sinopoli et al. (2004), Theorem 3 (the modified algebraic Riccati equation); by mode for chains.
    """
    # A mode that the chain leaves for good has probability 0 in the end, but needs a gain too: it gets a small share.
    system = system._replace(law=np.where(system.law > WEIGHT, system.law, SEEN))
    gains = _iterate_covariances(system)
    gains = _iterate_policy(system, gains)
    if system.close_loop(gains).radius() < BELOW_ONE:
        return gains
    forgetting_gains = tuple(system.transition @ np.linalg.pinv(c) for c in system.outputs)  # A C^+ of each kind
    return min(gains, forgetting_gains, key=lambda candidate: system.close_loop(candidate).radius())


def _iterate_covariances(system: KnownLossSystem) -> KindGains:
    """Return the gains with which the covariance recursion ends: it converges, bounds E P, or does ITERATIONS steps.

    Each step propagates V_j = E[error covariance x 1{mode j}] (modes, n, n) with the present gains, and takes the gains
    that are best for the result. Gains depend only on the ratio of V to the noises, so if V grows without limit, V and
    the noises are divided by its growth.
    """
    size = float(np.trace(system.process)) or 1.0  # without process noise any size serves
    V: ModeCovariances = system.law[:, None, None] * (system.process + size * np.eye(len(system.transition)))
    noise = 1.0  # factor of the covariances of all noises
    gains = _improve_gains(system, V, noise)
    for step in range(1, ITERATIONS + 1):
        (V,) = system.close_loop(gains, noise).after(V)
        growth = np.trace(V.sum(axis=0)) / size
        if growth > NEGLIGIBLE:
            V, noise = V / growth, noise / growth
        last_gains, gains = gains, _improve_gains(system, V, noise)
        if _relative_change(last_gains, gains) < CONVERGED:
            break
        # Tested after 1, 2, 4, ... steps, since it costs more than a step: do the gains keep E P bounded already?
        is_power_of_two = step.bit_count() == 1
        if is_power_of_two and system.close_loop(gains).radius() < BELOW_ONE:
            break
    return gains


def _iterate_policy(system: KnownLossSystem, gains: KindGains) -> KindGains:
    """Return better gains by policy iteration, in at most POLISHING rounds.

    Each round finds the error covariances V under the present gains, and the gains that are best for V. V is the steady
    covariance, if there is one. Else V is the direction in which covariances grow fastest, and the noises, which such a
    growth makes negligible, are scaled by 1 / NEGLIGIBLE. The iteration ends if the gains get worse, or stay.
    """
    # The step V -> V+ under these gains, with its eigenvalues and spectral radius.
    jumps = system.close_loop(gains)
    values, vectors = np.linalg.eig(jumps.operator())
    radius = float(np.max(np.abs(values)))
    for _ in range(POLISHING):
        is_bounded = radius < BELOW_ONE
        V = jumps.steady()[0] if is_bounded else _fastest_growing_covariances(jumps.shape, values, vectors)
        next_gains = _improve_gains(system, V, noise=1.0 if is_bounded else 1 / NEGLIGIBLE)
        jumps = system.close_loop(next_gains)
        values, vectors = np.linalg.eig(jumps.operator())
        next_radius = float(np.max(np.abs(values)))
        # If the new gains are worse, or differ only by rounding, the last ones are returned.
        if next_radius >= max(radius, BELOW_ONE) or _relative_change(gains, next_gains) < CONVERGED:
            break
        gains, radius = next_gains, next_radius
    return gains


def _fastest_growing_covariances(shape: tuple[int, ...], values: np.ndarray, vectors: np.ndarray) -> ModeCovariances:
    """Return the covariances V (modes, n, n) that a step without noise multiplies by its spectral radius, of trace 1.

    `values` and `vectors` are the eigenvalues and eigenvectors of the step V -> V+, which acts on the entries of upper
    triangles; `shape` is that of V. It maps covariances to covariances, so (Perron and Frobenius) its largest
    eigenvalue is real, with covariances as eigenvector. A small multiple of I makes them invertible.
    """
    V = unpack_triangle_entries(np.real(vectors[:, np.argmax(values.real)]), shape)
    return np.asarray(V / np.trace(V.sum(axis=0)) + np.eye(shape[-1]) / NEGLIGIBLE)


def _improve_gains(system: KnownLossSystem, V: ModeCovariances, noise: float) -> KindGains:
    """Return the best gain of each kind of mode s for these covariances V by mode, with R scaled by `noise`.

    K_s = A U C_s' (C_s U C_s' + R)^-1: U (V mixed by the chain) and R (noises, weighted by the modes' law) are summed
    over the modes that the receiver cannot distinguish from each other, those with `known` = s.
    """
    gains: list[np.ndarray] = []
    U_by_mode: ModeCovariances = mix_moments_of_modes(system.chain, V)
    for s, C in enumerate(system.outputs):
        modes = np.flatnonzero(system.known == s)
        U = U_by_mode[modes].sum(axis=0)
        R = sum((noise * system.law[i] * system.noises[i] for i in modes), np.zeros((len(C), len(C))))
        gains.append(system.transition @ observe_root(roots_of(U), C, roots_of(R)).gain)
    return tuple(gains)


def _relative_change(before: KindGains, after: KindGains) -> float:
    """Return the largest change of an entry of any gain, divided by the largest entry of the gains `after`.

    It is 0 if all gains `after` are zero.
    """
    largest_entry = max((np.max(np.abs(gain), initial=0.0) for gain in after), default=0.0)
    changes = [new - old for old, new in zip(before, after, strict=True)]
    largest_change = max((np.max(np.abs(change), initial=0.0) for change in changes), default=0.0)
    return float(largest_change / largest_entry) if largest_entry > 0 else 0.0


UNSEEN = 1e-9  # relative: an output or a noise that shows less than this of a unit eigenvector shows nothing of it
SAME = 1e-7  # relative: eigenvalues closer than this are one
SETS_LIMIT = 256  # sets of modes that are tried for one eigenvalue


class UnobservedGrowth(NamedTuple):
    """Growth of E P a step along eigenvectors of the plant while the links stay in modes that do not observe them.

    `growth` is |a|^2 times the spectral radius of the chain within these `modes`, with the `eigenvalue` a; `vectors`
    (n, d) is a basis of the eigenvectors. If it is 1 or more, and noise excites an eigenvector, the mean squared error
    of every filter grows without limit.
    """

    growth: float
    eigenvalue: complex
    modes: tuple[int, ...]
    vectors: Float[np.ndarray, "n d"]


def list_eigenspaces(matrix: Float[np.ndarray, "n n"]) -> list[tuple[complex, np.ndarray]]:
    """Return each distinct eigenvalue, conjugates once, with an orthonormal basis of its eigenvectors (n, d).

    Eigenvalues that differ by at most SAME times the matrix's norm count as equal. Singular values up to it are zero.
    """
    results: list[tuple[complex, np.ndarray]] = []
    tolerance = SAME * max(float(np.linalg.norm(matrix, 2)), 1e-300)  # 1e-300: above 0 for a matrix of zeros
    for value in np.linalg.eigvals(matrix):
        is_new = all(abs(value - other) > tolerance for other, _ in results)
        if value.imag >= 0 and is_new:
            # Eigenvectors span the null space of A - a I: right singular vectors of (nearly) zero singular values.
            _, singular_values, right = np.linalg.svd(matrix - value * np.eye(len(matrix)))
            dimension = max(int(np.sum(singular_values <= tolerance)), 1)
            results.append((complex(value), right.conj().T[:, -dimension:]))
    return results


def find_fastest_unobserved_mode(
    matrix: Float[np.ndarray, "n n"], chain: Float[np.ndarray, "modes modes"], outputs: Sequence[np.ndarray]
) -> UnobservedGrowth:
    """Find the largest growth of the error covariance E P a step, over eigenvectors that some modes do not observe.

    A is the plant's `matrix`, `chain` the links' transition probabilities, and `outputs` their output matrix C in each
    mode. Let A v = a v, and C v = 0 in a set of modes. While the links stay in the set, no data show v, so
    E P >= eps P(the links stay in the set for l steps) |a|^(2 l) v v'. This grows by |a|^2 times the spectral radius of
    the chain within the set. If every mode observes every eigenvector, the growth is 0.
    """
    results = list[UnobservedGrowth]()
    for eigenvalue, space in list_eigenspaces(matrix):
        for modes, vectors in _find_unobserving_modes(space, outputs):
            chain_within = chain[np.ix_(modes, modes)]
            growth = abs(eigenvalue) ** 2 * spectral_radius(chain_within)
            results.append(UnobservedGrowth(growth, eigenvalue, modes, vectors))
    no_growth = UnobservedGrowth(0.0, 0j, (), np.zeros((len(matrix), 0)))
    return max(results, key=lambda found: found.growth, default=no_growth)


def _find_unobserving_modes(
    space: np.ndarray, outputs: Sequence[np.ndarray]
) -> list[tuple[tuple[int, ...], np.ndarray]]:
    """List sets of the links' modes in which C v = 0 for a common eigenvector v, with a basis of these v (n, d).

    Args:
        space: a basis of all eigenvectors of the plant for one eigenvalue (n, d).
        outputs: the output matrix C of each mode of the links.
    """
    # From the set of modes that do not observe a subspace to the subspace: the whole space, and intersections of it
    # with the null spaces of outputs.
    subspaces = {frozenset(_list_modes_not_observing(space, outputs)): space}
    for output in outputs:
        for subspace in list(subspaces.values()):
            smaller = _find_unobservable_part(output, subspace)
            if smaller.shape[1] and len(subspaces) < SETS_LIMIT:
                subspaces.setdefault(frozenset(_list_modes_not_observing(smaller, outputs)), smaller)
    return [(tuple(sorted(modes)), basis) for modes, basis in subspaces.items() if modes]


def _list_modes_not_observing(space: np.ndarray, outputs: Sequence[np.ndarray]) -> Iterable[int]:
    """Return the modes whose output matrix C_i maps the whole subspace to zero."""
    return (i for i, c in enumerate(outputs) if _find_unobservable_part(c, space).shape[1] == space.shape[1])


def _find_unobservable_part(output: np.ndarray, space: np.ndarray) -> np.ndarray:
    """Return a basis of the part of a subspace that the rows of an output do not observe; `space` is a basis (n, d).

    It is the null space of C on the subspace. Rows of C = `output` are divided by their lengths, so that units do not
    matter. A direction is not observed if its singular value in these rows is at most UNSEEN.
    """
    lengths = np.linalg.norm(output, axis=1)
    is_used = lengths > 0
    rows = output[is_used] / lengths[is_used][:, None]
    if not len(rows):
        return space
    _, singular_values, right = np.linalg.svd(rows @ space)
    rank = int(np.sum(singular_values > UNSEEN))
    return np.asarray(space @ right.conj().T[:, rank:])


def is_excited_by_noise(vectors: np.ndarray, matrix: Float[np.ndarray, "n n"], noise: Float[np.ndarray, "n n"]) -> bool:
    """Return whether the noise excites each of the directions `vectors` (n, d) within n steps, n the number of states.

    It does if they lie in the controllable subspace, which is spanned by W, A W, A^2 W, ... with A the `matrix` and W
    the covariance of the noise.
    """
    basis = np.zeros((len(matrix), 0))  # orthonormal, of the subspace so far
    columns = noise
    for _ in range(len(matrix)):
        # The basis with the next columns, which are scaled to the size 1 of the basis vectors.
        size = np.linalg.norm(columns, 2) if columns.size else 0.0
        if size == 0:
            break
        left, singular_values, _ = np.linalg.svd(np.concatenate([basis, columns / size], axis=1), full_matrices=False)
        basis = left[:, singular_values > UNSEEN * max(singular_values[0], 1e-300)]
        columns = matrix @ basis
    outside_subspace = vectors - basis @ (basis.T @ vectors)
    return bool(np.max(np.abs(outside_subspace), initial=0.0) <= UNSEEN)
