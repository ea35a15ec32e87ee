"""Directions in which data do not identify the free numbers: by the rank of the information, put in words."""

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from heliograph.learning.free_parameters import Parameters
from heliograph.numerics.types import Float

LEAST_SINGULAR_VALUE = 1e-12  # share of the largest singular value above which a direction is spanned
NO_INFORMATION, WEAK_INFORMATION = 1e-8, 1e-4  # eigenvalues of the information in units of each coordinate's own
ROUNDING_OF_DIRECTIONS = 1e-5  # of a direction at several points
ROUNDING_OF_EXPONENTS = 1e-4  # how far an exponent may be from a whole number
LARGEST_EXPONENT = 4  # exponent that is put in words


class ConfoundedNumbers(NamedTuple):
    """Free numbers v_i of which the data identify fewer combinations than there are numbers.

    For instance the data may tell the product a b of two gains, but neither of them: exponents [[1, 1]], fix 1.

    Args:
        coordinates: indices of the numbers' coordinates.
        exponents: rows e of identified products prod_i v_i^e_i (combinations, numbers).
        weights: rows w of identified sums sum_i w_i v_i, where no product is (combinations, numbers). What is
            identified besides is neither product nor sum.
        fix: how many of the numbers have to be known from elsewhere.
    """

    coordinates: tuple[int, ...]
    exponents: Float[np.ndarray, "combinations numbers"]
    weights: Float[np.ndarray, "combinations numbers"]
    fix: int


class InformationRank(NamedTuple):
    """Information I (p, p) at a point, split in directions along which it is 0, and those in which something is known.

    Args:
        flat: orthonormal directions without information, in columns (p, k), in units of each coordinate.
        rest: those with information, likewise (p, p - k).
        unit: unit of each coordinate, 1 / sqrt(I_ii), its standard error if all others were known (p,).
        weakest: least eigenvalue of I along `rest`, in these units.
    """

    flat: Float[np.ndarray, "p k"]
    rest: Float[np.ndarray, "p r"]
    unit: Float[np.ndarray, " p"]
    weakest: float


def find_information_rank(information: Float[np.ndarray, "p p"]) -> InformationRank:
    """Return the flat and the other directions of information I (p, p), in units 1 / sqrt(I_ii) of each coordinate.

    A direction is flat if its eigenvalue of I_ij / sqrt(I_ii I_jj) is below NO_INFORMATION. A coordinate without
    information is a flat direction by itself. `weakest`: the smallest eigenvalue of the other directions.
    """
    diagonal = np.diag(information)
    known = diagonal > 0
    unit = np.where(known, 1 / np.sqrt(np.where(known, diagonal, 1.0)), 1.0)
    eigenvalues, vectors = np.linalg.eigh(information * unit[:, None] * unit)
    is_flat = eigenvalues < NO_INFORMATION
    weakest = float(eigenvalues[~is_flat].min(initial=np.inf))
    return InformationRank(flat=vectors[:, is_flat], rest=vectors[:, ~is_flat], unit=unit, weakest=weakest)


def find_confounded(
    parameters: Parameters, points: list[Float[np.ndarray, " p"]], ranks: list[InformationRank]
) -> list[ConfoundedNumbers]:
    """Return the groups of coordinates that the data do not separate at any of the points, with what they identify.

    The data may tell a product or a sum of two numbers, but neither of the two. Flat directions are those along which
    the likelihood does not change; only points with the fewest of them count. Directions of the coordinates x become
    those of the numbers v by dv/dx, and of log |v| by d log |v| / dx. A sum of v is identified if it does not change
    along the flat directions of v, and a product if its logarithm does not change along those of log |v|.

    Args:
        parameters: the free numbers.
        points: points in unconstrained coordinates x (p,): logarithms or logits of numbers whose domain has ends.
        ranks: flat directions at each point, `flat` (p, directions), in units of 1 / sqrt(information) of each
            coordinate, `unit` (p,).
    """
    fewest = min(rank.flat.shape[1] for rank in ranks)
    if not fewest:
        return []
    of_logs = []
    of_numbers = []  # flat directions at each point, in columns
    for x, rank in zip(points, ranks, strict=True):
        if rank.flat.shape[1] == fewest:
            # dv/dx and d log |v| / dx (p,) scale the rows of the flat directions, which `unit` takes to coordinates x.
            slopes, log_slopes = _differentiate_coordinates(parameters, x)
            flat = rank.unit[:, None] * rank.flat
            of_logs.append(_orthonormalise(log_slopes[:, None] * flat))
            of_numbers.append(_orthonormalise(slopes[:, None] * flat))
    return [_make_confounded_numbers(group, of_logs, of_numbers) for group in _group_connected_coordinates(of_logs)]


def _differentiate_coordinates(parameters: Parameters, x: Float[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray]:
    """Return dv/dx and d log|v|/dx (p,) at x (p,), for each coordinate that belongs to one number v of the table.

    For other coordinates both are 1.

    Args:
        parameters: the free numbers.
        x: the point in unconstrained coordinates (p,).
    """
    slopes = np.ones(len(x))
    log_slopes = np.ones(len(x))
    for entry, dv_dx, v in zip(parameters.entries, parameters.jacobian(x), parameters.entries_at(x), strict=True):
        i = entry.coordinate
        if i is not None:
            slopes[i] = dv_dx[i]
            log_slopes[i] = dv_dx[i] / v if v else np.nan
    # A number that is 0 has no logarithm, so its derivative is set to 0.
    return slopes, np.nan_to_num(log_slopes)


def _orthonormalise(vectors: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis, in columns, of what the columns of `vectors` span."""
    left, singular_values, _ = np.linalg.svd(vectors, full_matrices=False)
    least = LEAST_SINGULAR_VALUE * max(singular_values.max(initial=0.0), 1e-300)  # smaller ones are rounding
    return np.asarray(left[:, singular_values > least])


def _group_connected_coordinates(bases: list[np.ndarray]) -> list[tuple[int, ...]]:
    """Return the groups of coordinates that flat directions connect, at any point.

    `bases`: orthonormal flat directions at each point, in columns. A group of one is a coordinate that no data tell.
    Entries up to ROUNDING_OF_DIRECTIONS (1e-5) count as 0.
    """
    # An entry of the projector B B' is nonzero if some flat direction moves both coordinates.
    are_connected = np.max([np.abs(B @ B.T) for B in bases], axis=0) > ROUNDING_OF_DIRECTIONS
    count, labels = connected_components(are_connected, directed=False)
    groups = [tuple(np.flatnonzero(labels == i).tolist()) for i in range(count)]
    return [group for group in groups if are_connected[group, group].any()]


def _make_confounded_numbers(
    group: tuple[int, ...], of_logs: list[np.ndarray], of_numbers: list[np.ndarray]
) -> ConfoundedNumbers:
    """Return a group of numbers v_i that the data do not separate, with the combinations that they do identify.

    A combination is identified if it does not change along the flat directions, in which the likelihood has no
    information. These are products prod_i v_i^e_i with whole exponents e, if the same ones are identified at all points
    at which the information was computed; else sums sum_i w_i v_i. `fix` in the result: how many of the numbers must be
    known so that the others become so. Whole are exponents within ROUNDING_OF_EXPONENTS, small those up to
    LARGEST_EXPONENT (4).

    Args:
        group: numbers of the coordinates that flat directions move together.
        of_logs: for each point the flat directions of the numbers' logarithms, (numbers, directions), orthonormal.
        of_numbers: the same of the numbers themselves.
    """
    # As many numbers have to be known as there are flat directions within the group.
    coordinates = list(group)
    unknown = int(max(np.linalg.matrix_rank(basis[coordinates], tol=ROUNDING_OF_DIRECTIONS) for basis in of_logs))
    no_rows = np.zeros((0, len(group)))
    # Products: a sum of logarithms e' log v that no flat direction changes; used if its exponents are small and whole.
    powers = _find_identified_combinations([basis[coordinates] for basis in of_logs])
    if len(powers):
        # In each row the least exponent becomes 1.
        powers = powers / np.min(np.abs(np.where(powers == 0, np.inf, powers)), axis=1, keepdims=True)
        are_whole = np.all(np.abs(powers - np.round(powers)) < ROUNDING_OF_EXPONENTS)
        if are_whole and np.max(np.abs(powers)) <= LARGEST_EXPONENT + ROUNDING_OF_EXPONENTS:
            return ConfoundedNumbers(group, exponents=np.round(powers), weights=no_rows, fix=unknown)
    # Otherwise sums w' v.
    sums = _find_identified_combinations([basis[coordinates] for basis in of_numbers])
    return ConfoundedNumbers(group, exponents=no_rows, weights=sums, fix=unknown)


def _find_identified_combinations(bases: list[np.ndarray]) -> np.ndarray:
    """Return the combinations sum_i c_i v_i that no flat direction of any point changes, as rows c.

    The rows are in reduced row echelon form, so that each combination has few numbers. Along flat directions the
    likelihood does not change.

    Args:
        bases: flat directions of the numbers v at each point, in columns (numbers, directions). The combinations are
            orthogonal to all of these; a singular value up to ROUNDING_OF_DIRECTIONS counts as 0.
    """
    _, singular_values, right_vectors = np.linalg.svd(np.concatenate(bases, axis=1).T)
    rank = int(np.count_nonzero(singular_values > ROUNDING_OF_DIRECTIONS))
    # Right singular vectors beyond the rank are orthogonal to all flat directions.
    return _reduce_to_echelon(right_vectors[rank:])


def _reduce_to_echelon(rows: np.ndarray) -> np.ndarray:
    """Return the reduced row echelon form of a matrix of independent rows, by Gauss-Jordan elimination.

    The leading entry of each row is 1, and the only one of its column; entries below ROUNDING_OF_DIRECTIONS become 0.
    """
    reduced, column = rows.copy(), 0
    for row in range(len(reduced)):
        # The pivot is the largest entry from this row on, in the next column that has one above zero.
        while column < reduced.shape[1]:
            pivot = row + int(np.argmax(np.abs(reduced[row:, column])))
            if abs(reduced[pivot, column]) > ROUNDING_OF_DIRECTIONS:
                break
            column += 1
        else:  # no column is left: the rows from here on are 0
            break
        # Bring it to this row, make it 1, and eliminate its column from all other rows.
        reduced[[row, pivot]] = reduced[[pivot, row]]
        reduced[row] /= reduced[row, column]
        for other in range(len(reduced)):
            if other != row:
                reduced[other] -= reduced[other, column] * reduced[row]
        column += 1
    reduced[np.abs(reduced) < ROUNDING_OF_DIRECTIONS] = 0.0
    return reduced


def format_product(names: list[str], exponents: Float[np.ndarray, " numbers"]) -> str:
    """Return the text of a product of powers, such as "a * b^2 / c".

    Args:
        names: names of the numbers.
        exponents: exponent of each (numbers,).
    """
    powers = list(zip(names, exponents, strict=True))
    factors = [_format_power(name, exponent) for name, exponent in powers if exponent > 0]
    divisors = [_format_power(name, -exponent) for name, exponent in powers if exponent < 0]
    return " / ".join([" * ".join(factors) or "1", *divisors])


def format_sum(names: list[str], weights: Float[np.ndarray, " numbers"]) -> str:
    """Return the text of a weighted sum, such as "a + 0.64 b".

    A weight within ROUNDING_OF_DIRECTIONS of 1 or -1 is not written, and a term of weight 0 is left out.

    Args:
        names: names of the numbers.
        weights: weight of each (numbers,).
    """
    text = ""
    for name, weight in zip(names, weights, strict=True):
        if weight:
            sign = "-" if weight < 0 else "+"
            if text:
                text += f" {sign} "
            elif weight < 0:
                text = sign
            text += name if abs(abs(weight) - 1) < ROUNDING_OF_DIRECTIONS else f"{abs(weight):.4g} {name}"
    return text


def _format_power(name: str, exponent: float) -> str:
    """Return the text of a power, such as "a", "a^2", "a^0.5"."""
    return name if exponent == 1 else f"{name}^{exponent:g}"


def find_rank_of_late_rows(late: Float[np.ndarray, "p p"], ridges: int) -> InformationRank:
    """Return the flat and other directions of the information `late` (p, p), with as many flat ones as `ridges`.

    `late` is the information of the second half of the rows. The law of the initial state, which the first half has,
    informs weakly also on ridges, along which no data do. `ridges` was found at points where rounding matters less.
    """
    rank = find_information_rank(late)
    if rank.flat.shape[1] == ridges:
        return rank
    # Take the directions of the least eigenvalues as flat, in units of each coordinate's standard error.
    diagonal = np.diag(late)
    unit = np.where(diagonal > 0, 1 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0)), 1.0)
    _, vectors = np.linalg.eigh(late * unit[:, None] * unit)
    return rank._replace(flat=vectors[:, :ridges], rest=vectors[:, ridges:], unit=unit)
