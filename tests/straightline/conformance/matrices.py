"""Cases of decompositions and special functions: singular, indefinite and zero matrices, NaN among the entries."""

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from tests.straightline.conformance.case import Case, of_each_type

RANDOM = np.random.default_rng(3)
SQUARE = RANDOM.normal(size=(3, 3))
DEFINITE = SQUARE @ SQUARE.T + np.eye(3)
MISSING = DEFINITE.copy()
MISSING[1, 1] = np.nan
MATRICES = np.stack(
    [
        DEFINITE,
        -DEFINITE,
        np.zeros((3, 3)),
        np.eye(3),
        np.ones((3, 3)),
        np.diag([1.0, 0.0, 2.0]),
        np.diag([1.0, -1.0, 2.0]),
        np.diag([1.0, 2.0, -1e-20]),
        np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        np.array([[1.0, 2, 0], [2, 4, 0], [0, 0, 1]]),
        1e200 * DEFINITE,
        1e-200 * DEFINITE,
        MISSING,
    ]
)
KNOWN = MATRICES[:-1]  # LAPACK passes over NaN when it seeks a pivot
GENERAL = np.concatenate([KNOWN, RANDOM.normal(size=(3, 3, 3)), np.array([[[0.0, 2, 1], [0, 1, 1], [0, 3, 2]]])])
VECTORS = RANDOM.normal(size=(len(GENERAL), 3))
PIVOTS = np.array([(i, j, k) for i in range(4) for j in range(1, 4) for k in range(2, 4)], np.int32)
SEPARATE = [0, 1, 5, 6, 7, 9, 10, 11]  # of the known ones: no two eigenvalues are equal
ROUNDED = 1000.0  # units: of matrices whose condition is some hundred


def _eigenvalues_beside_the_largest(a: jax.Array) -> jax.Array:
    """An eigenvalue is known to the rounding of the matrix, also one that is zero."""
    return jnp.linalg.eigvalsh(a) + 3 * jnp.sum(jnp.abs(a))


def _composed(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """V diag(w) V' beside the largest, and V'V beside 3; any sign, and any basis of equal eigenvalues', will do."""
    w, v = jnp.linalg.eigh(a)
    return (v * w) @ v.T + 3 * jnp.sum(jnp.abs(a)), v.T @ v + 3


def _projectors(a: jax.Array) -> jax.Array:
    """v v' of each eigenvector, whatever its sign, beside 3."""
    _, v = jnp.linalg.eigh(a)
    return v[:, None, :] * v[None, :, :] + 3


def _of_one(matrices: np.ndarray) -> np.ndarray:
    return matrices[:, :1, :1]


def _triangular() -> list[Case]:
    cases = []
    for lower in (True, False):
        for transposed in (0, 1):
            for unit in (False, True):

                def solve(
                    a: jax.Array, b: jax.Array, how: tuple[bool, int, bool] = (lower, transposed, unit)
                ) -> jax.Array:
                    return jax.scipy.linalg.solve_triangular(a, b, lower=how[0], trans=how[1], unit_diagonal=how[2])

                cases.append(Case(solve, (GENERAL, VECTORS), ROUNDED, f"{lower} {transposed} {unit}"))

    def right(a, b):
        return lax.linalg.triangular_solve(a, jnp.stack([b, 2 * b]), left_side=False, lower=True)

    return [*cases, Case(right, (GENERAL, VECTORS), ROUNDED, "right")]


def _masses() -> tuple[np.ndarray, np.ndarray]:
    """Shapes and arguments; of shapes beyond these XLA's loop does not end (`rules/test_special.py` has them)."""
    shapes = [0.0, -1.0, 0.5, 1.0, 3.0, 30.0, 1e3, 9e3, 2e4]
    factors = [0.0, -1.0, 0.3, 0.99, 1.0, 1.01, 3.0, np.inf, np.nan]
    pairs = np.array([(a, a * f if np.isfinite(f) and f > 0 else f) for a in shapes for f in factors])
    return pairs[:, 0], pairs[:, 1]


def _two(*arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Two matrices, or two right sides, in each run: (runs, 2, ...)."""
    return tuple(np.stack([a, a[::-1]], axis=1) for a in arrays)


def _by_factors(a: jax.Array, b: jax.Array) -> jax.Array:
    return jax.scipy.linalg.lu_solve(jax.scipy.linalg.lu_factor(a), b)


CASES: dict[str, list[Case]] = {
    "cholesky": [
        *(Case(jnp.linalg.cholesky, (m,), ROUNDED) for m in (MATRICES, _of_one(MATRICES), *_two(MATRICES))),
        Case(lambda a: jnp.linalg.cholesky(a[:0]), _two(MATRICES), ROUNDED, "none"),
    ],
    "triangular_solve": _triangular(),
    "lu": [
        Case(lambda a: lax.linalg.lu(a), (GENERAL,), ROUNDED),
        Case(lambda a: lax.linalg.lu(a), (_of_one(GENERAL),)),
        Case(lambda a: jnp.linalg.det(a), (GENERAL[:-1],), ROUNDED),
        Case(lambda a: lax.linalg.lu(a), _two(GENERAL), ROUNDED, "two"),
    ],
    "lu_pivots_to_permutation": [
        Case(_by_factors, (GENERAL, VECTORS), ROUNDED),
        Case(lambda p: lax.linalg.lu_pivots_to_permutation(p, 4), (PIVOTS,)),
        Case(lambda p: lax.linalg.lu_pivots_to_permutation(p, 5), _two(PIVOTS)),
    ],
    "custom_linear_solve": [
        Case(jnp.linalg.solve, (GENERAL, VECTORS), ROUNDED),
        Case(jnp.linalg.inv, (GENERAL,), ROUNDED),
        Case(jax.vmap(jnp.linalg.solve), _two(GENERAL, VECTORS), ROUNDED, "two"),
        Case(lambda a, b: jax.vmap(lambda c: jnp.linalg.solve(a, c))(b), (GENERAL, *_two(VECTORS)), ROUNDED, "sides"),
    ],
    "eigh": [
        Case(_eigenvalues_beside_the_largest, (KNOWN,), ROUNDED),
        Case(jnp.linalg.eigvalsh, (_of_one(MATRICES),), ROUNDED),
        Case(jnp.linalg.eigh, (MATRICES[-1:],)),
        Case(_composed, (KNOWN,), ROUNDED, "composed"),
        Case(_projectors, (KNOWN[SEPARATE],), ROUNDED, "projectors"),
        Case(jax.vmap(_composed), _two(KNOWN), ROUNDED, "two"),
    ],
    "igamma": [Case(jax.scipy.special.gammainc, _masses(), 1e6)],
    "igammac": [Case(jax.scipy.special.gammaincc, _masses(), 1e6)],
    "digamma": of_each_type(jax.scipy.special.digamma, 1, 1e4, dtypes=(np.float64,)),
    "bessel_i0e": of_each_type(jax.scipy.special.i0e, 1, 20.0, dtypes=(np.float64,)),
    "bessel_i1e": of_each_type(jax.scipy.special.i1e, 1, 20.0, dtypes=(np.float64,)),
}
