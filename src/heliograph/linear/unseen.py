"""Lower bounds of any filter's error: plant modes that grow, while links do not show them, faster than failures end."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.linear.known_losses import spectral_radius
from heliograph.numerics.types import Float

UNSEEN = 1e-9  # of its size: what of an eigenvector an output or a noise may show that is taken for nothing
SAME = 1e-7  # relative: eigenvalues closer than this are one
SETS_LIMIT = 256  # sets of modes that are tried for one eigenvalue


class Unseen(NamedTuple):
    """Growth of an eigenvalue while the links stay in modes that do not show it: |a|^2 rho(chain among these).

    From 1 on, the mean error of every filter grows without end, if noise reaches the eigenvector.
    """

    growth: float
    eigenvalue: complex
    modes: tuple[int, ...]
    vectors: Float[np.ndarray, "n d"]


def eigenspaces(matrix: Float[np.ndarray, "n n"]) -> list[tuple[complex, np.ndarray]]:
    """Return each distinct eigenvalue, conjugates once, with an orthonormal basis of its eigenvectors (n, d)."""
    results: list[tuple[complex, np.ndarray]] = []
    size = max(float(np.linalg.norm(matrix, 2)), 1e-300)
    for value in np.linalg.eigvals(matrix):
        if value.imag >= 0 and all(abs(value - other) > SAME * size for other, _ in results):
            _, singular, right = np.linalg.svd(matrix - value * np.eye(len(matrix)))
            count = max(int(np.sum(singular <= SAME * size)), 1)
            results.append((complex(value), right.conj().T[:, -count:]))
    return results


def fastest_unseen(
    matrix: Float[np.ndarray, "n n"], chain: Float[np.ndarray, "modes modes"], outputs: Sequence[np.ndarray]
) -> Unseen:
    """Return the largest growth over eigenvalues and sets of modes; `outputs` are the rows C_i (m, n) of each mode.

    E P >= eps P(the links stay in the set for l steps) |a|^(2 l) v v' for an eigenvector v that the set does not show.
    """
    results = [
        Unseen(abs(value) ** 2 * spectral_radius(chain[np.ix_(modes, modes)]), value, modes, vectors)
        for value, space in eigenspaces(matrix)
        for modes, vectors in _blind(space, outputs)
    ]
    nothing = Unseen(0.0, 0j, (), np.zeros((len(matrix), 0)))
    return max(results, key=lambda items: items.growth, default=nothing)


def _blind(space: np.ndarray, outputs: Sequence[np.ndarray]) -> list[tuple[tuple[int, ...], np.ndarray]]:
    """Sets of modes that all miss some common eigenvector, largest for each subspace, with a basis of these."""
    subspaces = {frozenset(_missing(space, outputs)): space}
    for output in outputs:
        for known in list(subspaces.values()):
            smaller = _kernel(output, known)
            if smaller.shape[1] and len(subspaces) < SETS_LIMIT:
                subspaces.setdefault(frozenset(_missing(smaller, outputs)), smaller)
    return [(tuple(sorted(modes)), basis) for modes, basis in subspaces.items() if modes]


def _missing(space: np.ndarray, outputs: Sequence[np.ndarray]) -> Iterable[int]:
    return (i for i, c in enumerate(outputs) if _kernel(c, space).shape[1] == space.shape[1])


def _kernel(output: np.ndarray, space: np.ndarray) -> np.ndarray:
    """The part of a subspace that the rows of an output do not show, each row taken at its own size."""
    sizes = np.linalg.norm(output, axis=1)
    rows = output[sizes > 0] / sizes[sizes > 0][:, None]
    if not len(rows):
        return space
    _, singular, right = np.linalg.svd(rows @ space)
    rank = int(np.sum(singular > UNSEEN))
    return np.asarray(space @ right.conj().T[:, rank:])


def reached(vectors: np.ndarray, matrix: Float[np.ndarray, "n n"], noise: Float[np.ndarray, "n n"]) -> bool:
    """Return whether a noise reaches every one of these directions within n steps (the controllable subspace)."""
    basis, columns = np.zeros((len(matrix), 0)), noise
    for _ in range(len(matrix)):
        size = np.linalg.norm(columns, 2) if columns.size else 0.0
        if size == 0:
            break
        left, singular, _ = np.linalg.svd(np.concatenate([basis, columns / size], axis=1), full_matrices=False)
        basis = left[:, singular > UNSEEN * max(singular[0], 1e-300)]
        columns = matrix @ basis
    rest = vectors - basis @ (basis.T @ vectors)
    return bool(np.max(np.abs(rest), initial=0.0) <= UNSEEN)
