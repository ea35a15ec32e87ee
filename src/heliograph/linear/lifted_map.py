"""Linear map of monomials of the state: its mean matrix, and the covariance that it adds."""

import numpy as np

from heliograph.numerics.types import Array, Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.monomials import (
    count_monomials,
    degrees,
    list_exponents,
)
from heliograph.random_affine.moments.pushed_moments import products_of_monomials, push_moments

EPS = float(np.finfo(np.float64).eps)
STORED_ENTRIES = 100_000  # of a matrix that is kept for the whole horizon


class LiftedMap:
    """A map z = G y + n on monomials: E[Z | y] = K Y, and how moments of y of twice the degree become those of z.

    `matrix` is K, (monomials of z, monomials of y) up to `degree`. `moment_matrix` maps moments of y of twice the
    degree to those of z; it is None if it would be large, or if the map varies over time, so that it would be used
    once. `moment_degrees` has the degree of each of these monomials of y, and `highest_degree`[i, j] the highest degree
    of moments of y that Cov(Z_i, Z_j | y) needs.
    """

    def __init__(self, route: AbstractRandomAffine, degree: int, varies: bool):
        """Lift the map z = G y + n (`route`) to monomials up to `degree`; `varies`: it is another one at each step.

        Z_i - E[Z_i | y] is a polynomial of y whose degree is deg Z_i, or deg Z_i - 1 if all gains in Z_i are known,
        since then each of its terms has a factor n. Cov(Z_i, Z_j | y) has the sum of the degrees of both.
        """
        self.route, self.degree = route, degree
        self.matrix = np.asarray(route.moments(degree).matrix)
        rows, columns = (count_monomials(size + 1, 2 * degree) for size in (route.outputs, route.inputs))
        is_stored = not varies and rows * columns <= STORED_ENTRIES
        self.moment_matrix = np.asarray(route.moments(2 * degree).matrix) if is_stored else None
        self.moment_degrees = degrees(route.inputs, 2 * degree)
        # Exponents of each output in each monomial of z; the last column, of the constant 1, is left out. A monomial
        # has known gains if no output with a random gain is a factor of it.
        exponents = np.array(list_exponents(route.outputs + 1, degree))[:, :-1]
        has_known_gains = ~np.any(exponents[:, ~route.known_gains], axis=1)
        deviation_degrees = degrees(route.outputs, degree) - has_known_gains
        self.highest_degree = deviation_degrees[:, None] + deviation_degrees
        # Where both have a random gain, all moments are used.
        self.highest_degree[~has_known_gains[:, None] & ~has_known_gains] = 2 * degree

    def push_moments(self, moments: Float[Array, "M"]) -> Float[np.ndarray, "L"]:
        """Return E[monomials of z] from `moments`, E[monomials of y], both up to twice the degree of the lift."""
        with np.errstate(over="ignore", invalid="ignore"):  # the caller refuses what overflows
            if self.moment_matrix is not None:
                return np.asarray(self.moment_matrix @ np.asarray(moments))
            return np.asarray(push_moments(self.route, 2 * self.degree, moments))

    def mean_conditional_covariance(
        self, moments: Float[Array, "M"]
    ) -> tuple[Float[np.ndarray, "m m"], Float[np.ndarray, "m"]]:
        """Return E[Cov(Z | y)] = E[Z Z'] - K E[Y Y'] K', and the rounding of its diagonal.

        `moments` are those of y up to twice the degree. Entry (i, j) needs those up to `highest_degree`[i, j]: higher
        ones cancel in the difference, and would cost digits, so they are set to 0.
        """
        n, m = self.route.inputs + 1, self.route.outputs + 1  # with the constant 1
        K = self.matrix
        covariance, rounding = np.zeros(self.highest_degree.shape), np.zeros(len(self.highest_degree))
        for highest in range(int(self.highest_degree.max()) + 1):
            entries = self.highest_degree == highest  # entries that need moments of y up to this degree
            if not entries[:-1, :-1].any():  # the last row and column are of the constant 1
                continue
            needed = np.where(self.moment_degrees <= highest, np.asarray(moments), 0.0)
            second_of_y = np.asarray(products_of_monomials(needed, n, self.degree))
            second_of_z = np.asarray(products_of_monomials(self.push_moments(needed), m, self.degree))
            covariance = np.where(entries, second_of_z - K @ second_of_y @ K.T, covariance)
            rounding = np.where(np.diagonal(entries), EPS * np.abs(np.diagonal(second_of_z)), rounding)
        return covariance[:-1, :-1], rounding[:-1]


def mean_and_covariance(
    second: Float[Array, "N N"],
) -> tuple[Float[np.ndarray, "N-1"], Float[np.ndarray, "N-1 N-1"]]:
    """Return the mean and covariance of y, given the second moments of (y, 1).

    The variances are raised by (n + 2) EPS of the second moments, so that rounding makes none of them negative.
    """
    second = np.asarray(second)
    mean = second[:-1, -1]
    rounding = (len(mean) + 2) * EPS * np.diag(np.diag(second)[:-1])
    return mean, second[:-1, :-1] + rounding - np.outer(mean, mean)


def split_homogeneous(
    homogeneous: Float[np.ndarray, "m n"],
) -> tuple[Float[np.ndarray, "m-1 n-1"], Float[np.ndarray, "m-1"]]:
    """Return the matrix A and the offset a of a homogeneous matrix [[A, a], [0, 1]], of y -> A y + a."""
    return homogeneous[:-1, :-1], homogeneous[:-1, -1]


def make_linear_rows(variables: int, degree: int, expected: int | None = None) -> Float[np.ndarray, "wanted monomials"]:
    """Return the matrix that reads variables off the vector of all their monomials of degree 1 to `degree`.

    It has one row for each of the first `expected` variables (all, if None), with a single 1 in the column of the
    monomial that is the variable itself.
    """
    # Monomials are products of `degree` factors of (variables, 1). Variable i itself is x_i times 1^(degree - 1). The
    # last monomial, 1^degree, is the constant, which is not among the columns.
    column_of_monomial = {powers: i for i, powers in enumerate(list_exponents(variables + 1, degree))}
    rows = np.zeros((variables if expected is None else expected, len(column_of_monomial) - 1))
    for i, row in enumerate(rows):
        powers_of_variable = (*(int(i == j) for j in range(variables)), degree - 1)
        row[column_of_monomial[powers_of_variable]] = 1.0
    return rows
