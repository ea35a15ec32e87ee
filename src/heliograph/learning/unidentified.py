"""Directions in which the data say nothing: from the information's rank, put in words, never inverted."""

from typing import NamedTuple

import numpy as np
from scipy.sparse.csgraph import connected_components

from heliograph.learning.parameters import Parameters
from heliograph.numerics.types import Float

SPANNED = 1e-12  # share of the largest singular value above which a direction is spanned
NOTHING, WEAK = 1e-8, 1e-4  # eigenvalues of the information in units of each coordinate's own
SAME = 1e-5  # of a direction at several points
WHOLE = 1e-4  # how far an exponent may be from a whole number
LARGEST = 4  # exponent that is put in words


class Confounded(NamedTuple):
    """Free numbers of which the data identify fewer combinations than there are numbers.

    places: coordinates of the numbers. exponents: rows e of identified products prod_i v_i^e_i; weights: rows w of
    identified sums sum_i w_i v_i where no product is; what is identified besides is neither. fix: how many numbers have
    to be known from elsewhere.

    Shapes: exponents, weights (combinations, places).
    """

    places: tuple[int, ...]
    exponents: Float[np.ndarray, "combinations places"]
    weights: Float[np.ndarray, "combinations places"]
    fix: int


class InformationRank(NamedTuple):
    """Rank of the information at a point: directions of which nothing is known, and those of which something is.

    flat, rest: orthonormal directions of either kind, in columns, in units of each coordinate. unit: that unit,
    1 / sqrt(I_ii). weakest: the least eigenvalue along `rest`.
    Shapes: flat (p, k), rest (p, p - k), unit (p,).
    """

    flat: Float[np.ndarray, "p k"]
    rest: Float[np.ndarray, "p r"]
    unit: Float[np.ndarray, " p"]
    weakest: float


def rank_of_information(information: Float[np.ndarray, "p p"]) -> InformationRank:
    """Return the rank of I_ij / sqrt(I_ii I_jj); a coordinate of which nothing is known is a direction by itself."""
    diagonal = np.diag(information)
    known = diagonal > 0
    unit = np.where(known, 1 / np.sqrt(np.where(known, diagonal, 1.0)), 1.0)
    values, vectors = np.linalg.eigh(information * unit[:, None] * unit)
    is_flat = values < NOTHING
    weakest = float(values[~is_flat].min(initial=np.inf))
    return InformationRank(flat=vectors[:, is_flat], rest=vectors[:, ~is_flat], unit=unit, weakest=weakest)


def find_confounded(
    parameters: Parameters, points: list[Float[np.ndarray, " p"]], ranks: list[InformationRank]
) -> list[Confounded]:
    """Return the groups of coordinates that the data do not separate at any of the points, with what they identify.

    Only points with the fewest flat directions count. The flat directions of coordinates become those of the numbers
    v themselves, and of log |v|: sums of v, or products, are identified where they do not change along these.
    """
    count = min(rank.flat.shape[1] for rank in ranks)
    if not count:
        return []
    used = [(x, rank) for x, rank in zip(points, ranks, strict=True) if rank.flat.shape[1] == count]
    scales = [_differentiate_coordinates(parameters, x) for x, _ in used]
    logs = [
        _orthonormalise(log[:, None] * rank.unit[:, None] * rank.flat)
        for (_, rank), (_, log) in zip(used, scales, strict=True)
    ]
    plain = [
        _orthonormalise(slopes[:, None] * rank.unit[:, None] * rank.flat)
        for (_, rank), (slopes, _) in zip(used, scales, strict=True)
    ]
    return [_make_confounded(group, logs, plain) for group in _group_connected(logs)]


def _differentiate_coordinates(parameters: Parameters, x: Float[np.ndarray, " p"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the derivatives dv/dx and d log|v|/dx of each coordinate that is a number itself; 1 for the others."""
    slopes, log = np.ones(len(x)), np.ones(len(x))
    for entry, row, value in zip(parameters.entries, parameters.jacobian(x), parameters.entries_at(x), strict=True):
        if entry.coordinate is not None:
            slopes[entry.coordinate] = row[entry.coordinate]
            log[entry.coordinate] = row[entry.coordinate] / value if value else np.nan
    return slopes, np.nan_to_num(log)


def _orthonormalise(vectors: np.ndarray) -> np.ndarray:
    """Return an orthonormal basis, in columns, of what the columns of `vectors` span."""
    left, size, _ = np.linalg.svd(vectors, full_matrices=False)
    return np.asarray(left[:, size > SPANNED * max(size.max(initial=0.0), 1e-300)])


def _group_connected(bases: list[np.ndarray]) -> list[tuple[int, ...]]:
    """Return the groups of coordinates that a flat direction at any point connects; `bases`: of each point, columns."""
    joined = np.max([np.abs(b @ b.T) for b in bases], axis=0) > SAME
    count, labels = connected_components(joined, directed=False)
    groups = [tuple(np.flatnonzero(labels == i).tolist()) for i in range(count)]
    return [group for group in groups if joined[group, group].any()]


def _make_confounded(group: tuple[int, ...], logs: list[np.ndarray], plain: list[np.ndarray]) -> Confounded:
    """Return a group, with what the data do identify: products of whole powers if those fit all points, else sums.

    Args:
        group: the coordinates.
        logs: flat directions of the logarithms of numbers at each point, in columns.
        plain: flat directions of the numbers at each point, in columns.
    """
    places = list(group)
    unknown = int(max(np.linalg.matrix_rank(b[places], tol=SAME) for b in logs))
    no_rows = np.zeros((0, len(group)))
    powers = _find_known_rows([b[places] for b in logs])
    if len(powers):
        # In each row the least exponent becomes 1.
        powers = powers / np.min(np.abs(np.where(powers == 0, np.inf, powers)), axis=1, keepdims=True)
        if np.all(np.abs(powers - np.round(powers)) < WHOLE) and np.max(np.abs(powers)) <= LARGEST + WHOLE:
            return Confounded(group, exponents=np.round(powers), weights=no_rows, fix=unknown)
    return Confounded(group, no_rows, weights=_find_known_rows([b[places] for b in plain]), fix=unknown)


def _find_known_rows(bases: list[np.ndarray]) -> np.ndarray:
    """Return the combinations, in rows, that no flat direction of any point changes, in row echelon form."""
    _, size, right = np.linalg.svd(np.concatenate(bases, axis=1).T)
    rank = int(np.count_nonzero(size > SAME))
    return _reduce_to_echelon(right[rank:])


def _reduce_to_echelon(rows: np.ndarray) -> np.ndarray:
    """Return the row echelon form, leading entries 1."""
    reduced, lead, pivot = rows.copy(), 0, 0
    for row in range(len(reduced)):
        # Pivot: the largest entry of the next column that has one.
        while lead < reduced.shape[1]:
            pivot = row + int(np.argmax(np.abs(reduced[row:, lead])))
            if abs(reduced[pivot, lead]) > SAME:
                break
            lead += 1
        if lead == reduced.shape[1]:
            break
        # Swap, scale, eliminate.
        reduced[[row, pivot]] = reduced[[pivot, row]]
        reduced[row] /= reduced[row, lead]
        for other in range(len(reduced)):
            if other != row:
                reduced[other] -= reduced[other, lead] * reduced[row]
        lead += 1
    reduced[np.abs(reduced) < SAME] = 0.0
    return reduced


def product_text(names: list[str], exponents: Float[np.ndarray, " places"]) -> str:
    """Return the text of a product: a * b^2 / c."""
    above = [_format_power(n, e) for n, e in zip(names, exponents, strict=True) if e > 0]
    below = [_format_power(n, -e) for n, e in zip(names, exponents, strict=True) if e < 0]
    top = " * ".join(above) or "1"
    return " / ".join([top, *below])


def format_sum(names: list[str], weights: Float[np.ndarray, " places"]) -> str:
    """Return the text of a sum: a + 0.64 b."""
    text = ""
    for name, weight in zip(names, weights, strict=True):
        if weight:
            sign = "-" if weight < 0 else "+"
            if text:
                text += f" {sign} "
            elif weight < 0:
                text = sign
            text += name if abs(abs(weight) - 1) < SAME else f"{abs(weight):.4g} {name}"
    return text


def _format_power(name: str, exponent: float) -> str:
    """Return a factor of a product as text: a, a^2, a^0.5."""
    return name if exponent == 1 else f"{name}^{exponent:g}"
