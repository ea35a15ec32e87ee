"""Second moments of Markov jump linear systems: the state zeta moves by zeta+ = F_j zeta + w in a step of mode j.

X_j = E[zeta zeta' 1{mode j}] follows X_j+ = F_j Y_j F_j' + S_j, Y_j = sum_i T_ij X_i, with T_ij = P(j in this step | i
in the one before). S_j is P(j) Cov w plus the covariances that random coefficients add. With one mode, X is E[zeta
zeta'].

Arrays are NumPy's or JAX's. X is (..., M, n, n). Before a step that draws its mode independently of the last one, so
that all rows of T are equal, only the sum over the modes matters, and X may be (..., 1, n, n).

Source: Costa, Fragoso and Marques, Discrete-time Markov jump linear systems (2005), chapter 3.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, Float, Int

Maps = Callable[[Any], Any]  # of several symmetric matrices at once, along a first axis


def mix_moments_of_modes(chain: Float[Array, "*time M M"], moments: Float[Array, "*axes _ n n"]) -> Any:
    """Return Y_j = sum_i T_ij X_i, for each next mode j, of moments X_i by mode i and the chain's probabilities T_ij.

    If the next mode does not depend on the present one, a single X, the sum over the modes, is enough: then only the
    first row of T is used, the probabilities of the next modes.
    """
    *axes, modes, n, _ = moments.shape
    # As one matrix product: row i holds the n^2 entries of X_i, and Y = T' X.
    used_chain = chain[..., :modes, :]
    sums = used_chain.swapaxes(-1, -2) @ moments.reshape(*axes, modes, n * n)
    return sums.reshape(*axes, -1, n, n)


def propagate_by_mode(maps: Any, moments: Float[Array, "..."], added: Array | float) -> Any:
    """Return F X F' + S: second moments X of a state, propagated over a linear step; all arrays may be stacks of them.

    For a symmetric X, F X F' = F (F X)', so that F is only ever multiplied from the left: it may be sparse, or a
    structured matrix with an `@`.

    Args:
        maps: F, a matrix (..., p, n).
        moments: X (..., n, n), symmetric.
        added: S (..., p, p), such as the covariance of the noise; 0 for none.
    """
    return maps @ (maps @ moments).swapaxes(-1, -2) + added


@readable
class JumpSystem(NamedTuple):
    """Steps of a jump system, X_j+ = F_j (sum_i T_ij X_i) F_j' + S_j with X_j = E[zeta zeta' 1{mode j}].

    Arrays are NumPy's or JAX's. X is (..., M, n, n), or its sum over the modes (..., 1, n, n), before a step whose
    chain forgets the mode before: all rows of T are alike.

    Args:
        chain: T_ij, the probability of j in this step given i in the one before (time, M, M).
        maps: F_j of each mode (time, M, n, n).
        added: S_j, P(j) times the covariance of the noise, and all that random coefficients add (time, M, n, n).

    Source: Costa, Fragoso and Marques, Discrete-time Markov jump linear systems (2005), chapter 3.
    """

    chain: Array
    maps: Array
    added: Array

    def step(self, moments: Float[Array, "*axes _ n n"]) -> Any:
        """Return X+ from X over one step, if the fields have no axis of time; with one, X+ of each step from its own X.

        X+_j = F_j (sum_i T_ij X_i) F_j' + S_j.
        """
        return propagate_by_mode(self.maps, mix_moments_of_modes(self.chain, moments), self.added)

    def after(self, moments: Float[Array, "*axes _ n n"]) -> list[Any]:
        """Return the moments X by mode after each step, propagated from those before the first one (M, n, n)."""
        steps = []
        for fields in zip(*self, strict=True):  # T, F and S of one step, without the axis of time
            moments = JumpSystem(*fields).step(moments)
            steps.append(moments)
        return steps

    @property
    def shape(self) -> tuple[int, int, int]:
        """Shape (modes, n, n) of X before the first step.

        If all rows of the first step's chain are equal, its mode does not depend on the one before. Then the sum of X
        over the modes is enough, and the shape is (1, n, n).
        """
        _, modes, n, _ = self.maps.shape
        forgets_mode = np.all(self.chain[0] == self.chain[0][:1])
        return (1 if forgets_mode else modes, n, n)

    def operator(self) -> Float[np.ndarray, "e e"]:
        """Return the matrix that takes X before the first step to X after the last, without noise.

        X_j = E[zeta zeta' 1{mode j}] is the second moment of the state in mode j. The matrix acts on the e entries of
        the upper triangles of all modes' moments.
        """
        without_noise = self._replace(added=0.0 * self.added)
        return np.asarray(make_matrix_on_triangle_entries(without_noise._propagate_one_period, self.shape))

    def radius(self) -> float:
        """Return the spectral radius of `operator`, which takes X over all steps.

        Below 1, X stays bounded if the steps repeat for ever; above 1, it grows without limit.
        """
        return spectral_radius(self.operator())

    def steady(self) -> Any:
        """Return the steady moments X (time, M, n, n) by mode after each of the steps, which repeat for ever.

        X_j = E[zeta zeta' 1{mode j}] is the second moment of the state in mode j. The spectral radius of the steps'
        `operator` has to be below 1; else there are no steady moments.
        """
        # X after a period is L(X) + C, with X the moments before it. Steady moments solve X = L(X) + C.
        without_noise = self._replace(added=0.0 * self.added)
        from_zero = self._propagate_one_period(np.zeros(self.shape))
        start = solve_fixed_point(without_noise._propagate_one_period, from_zero)
        moments = library(start).stack(self.after(start))
        return (moments + moments.swapaxes(-1, -2)) / 2

    def adjoint(self, weights: Float[np.ndarray, "time n n"], forever: bool) -> Float[np.ndarray, "time M n n"]:
        """Return the derivative L of sum_k <W_k, sum_j X_k,j> by each X_k,j, through all later steps.

        X_k,j = E[zeta zeta' 1{mode j}] after step k is moved by X+ = F_j (sum_i T_ij X_i) F_j' + S_j, and W_k are the
        weights of a cost, of which planners need the gradient. L_k,i = W_k + sum_l T_k+1,il F_k+1,l' L_k+1,l F_k+1,l,
        from the last step to the first. Behind the last step L is zero; or, if the steps repeat `forever`, it is that
        of the next period.

        Args:
            weights: W of each step.
            forever: whether the steps are a period that repeats.
        """
        # modes_before: 1 where X before a step is a sum over the modes, else M.
        modes_before, n, _n = self.shape

        def go_back(later: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
            """Return the derivative by X before the first step, and L of each step, with these weights W.

            `later` is the derivative by X after the last step, through what follows it. Each step, taken backwards,
            applies the transposes of its maps F_j and of its chain.
            """
            derivatives = []
            for chain, maps, weight in zip(self.chain[::-1], self.maps[::-1], weights[::-1], strict=True):
                derivative = weight + later  # by X after this step
                derivatives.append(derivative)
                # By X_i before it: sum_j T_ij F_j' (derivative by X_j) F_j.
                by_mode = propagate_by_mode(maps.swapaxes(-1, -2), derivative, 0.0)
                later = mix_moments_of_modes(chain.T, by_mode)
            return later[..., :modes_before, :, :], derivatives[::-1]

        later = np.zeros((modes_before, n, n))
        # The derivative after a period is that before the next one: a fixed point. Going back over a period is a linear
        # map and a constant, the part that comes from the weights of that period.
        if forever:
            from_one_period, _ = go_back(later, weights)
            later = solve_fixed_point(lambda x: go_back(x, 0.0 * weights)[0], from_one_period)
        _, derivatives = go_back(later, weights)
        by_step = np.array([np.broadcast_to(derivative, self.maps.shape[1:]) for derivative in derivatives])
        return np.asarray(by_step + by_step.swapaxes(-1, -2)) / 2  # symmetric, as rounding left it nearly

    def _propagate_one_period(self, moments: Array) -> Any:
        """Return X after the last step, from X before the first, in the form in which the next period begins with it.

        If `moments` has a single X (the first step of a period draws its mode anew), the result is summed over the
        modes to a single X too.
        """
        last = self.after(moments)[-1]
        return last if moments.shape[-3] == last.shape[-3] else last.sum(axis=-3, keepdims=True)


def make_matrix_on_triangle_entries(linear: Maps, shape: tuple[int, ...]) -> Float[Array, "e e"]:
    """Return the matrix of a linear map of symmetric matrices (..., n, n) on the e entries of their upper triangles.

    Column k is the map's result for the k-th unit matrix, which has an entry and its mirror image at 1, all others at
    0.
    """
    triangles = _place_in_upper_triangles(shape)
    results = linear(triangles.unit_matrices)  # (e, ..., n, n), one for each unit matrix
    matrix: Array = results[:, *triangles.entry_indices].T
    return matrix


def solve_fixed_point(linear: Maps, constant: Array) -> Any:
    """Solve X = L(X) + C for a linear map L of symmetric matrices (..., n, n), and a constant C of their shape.

    The entries of the upper triangles, which determine a symmetric matrix, are the unknowns of linear equations.
    """
    matrix = make_matrix_on_triangle_entries(linear, constant.shape)
    constant_entries = constant[_place_in_upper_triangles(constant.shape).entry_indices]
    entries = library(matrix, constant).linalg.solve(np.eye(len(matrix)) - matrix, constant_entries)
    return unpack_triangle_entries(entries, constant.shape)


def unpack_triangle_entries(entries: Float[Array, "e"], shape: tuple[int, ...]) -> Any:
    """Return the symmetric matrices of a shape (..., n, n) that have these entries in their upper triangles.

    `entries` are in the order of rows. It is the inverse of reading them off with `TrianglePlaces.entry_indices`.
    """
    return entries[_place_in_upper_triangles(shape).index_in_list]


class TrianglePlaces(NamedTuple):
    """How symmetric matrices of a shape (..., n, n) are built from the list of their upper triangles' e entries.

    Args:
        index_in_list: for each number of the matrices, its index in the list (..., n, n).
        entry_indices: the indices of the list's entries in the matrices, one array (e,) for each axis.
        unit_matrices: for each entry of the list, matrices that are 1 at the entry and at its mirror image, else 0
            (e, ..., n, n).
    """

    index_in_list: Int[np.ndarray, "..."]
    entry_indices: tuple[np.ndarray, ...]
    unit_matrices: np.ndarray


@lru_cache(8)
def _place_in_upper_triangles(shape: tuple[int, ...]) -> TrianglePlaces:
    """Return where the entries of the upper triangles stand in symmetric matrices of a shape (..., n, n)."""
    *leading, rows, columns = triangle_indices = np.nonzero(np.triu(np.ones(shape)))
    mirrored_indices = *leading, columns, rows
    count = len(rows)
    index_in_list = np.empty(shape, dtype=int)
    index_in_list[triangle_indices] = index_in_list[mirrored_indices] = np.arange(count)
    unit_matrices = np.eye(count)[:, index_in_list]
    return TrianglePlaces(index_in_list, triangle_indices, unit_matrices)
