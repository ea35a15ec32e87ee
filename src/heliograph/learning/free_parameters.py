"""Free numbers as unconstrained coordinates, in which a fit searches, and as entries of the table of estimates."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from heliograph.learning.likelihood.parameter_transforms import (
    count_coordinates,
    map_from_unconstrained,
    map_to_unconstrained,
    slope_from_unconstrained,
    slope_to_unconstrained,
)
from heliograph.numerics.domains import POSITIVE, PROBABILITY, REAL, Domain
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, Float


@readable
@dataclass(frozen=True)
class Parameter:
    """A free number of a network, which a fit estimates; it may be an array.

    A fit searches by its unconstrained coordinates: numbers without bounds, such as the logarithm of a variance. Its
    entries are the single numbers in it that the table of estimates shows, a row for each.

    Args:
        name: its name.
        start: the value, with the number's shape, from which the search begins.
        domain: which values it may have: an interval, probabilities that sum to 1 ("simplex") or a covariance.
    """

    name: str
    start: Float[np.ndarray, "..."]
    domain: Domain

    @property
    def size(self) -> int:
        """Return how many unconstrained coordinates it has."""
        return count_coordinates(self.domain, self.start.shape)

    @property
    def entry_names(self) -> tuple[str, ...]:
        """Return the names of the number's entries in the table of estimates, such as ("Q[0,0]", "Q[1,0]", "Q[1,1]").

        A covariance, which is symmetric, has only the entries on and below the diagonal.
        """
        if self.start.ndim == 0:
            return (self.name,)
        indices = np.ndindex(self.start.shape)
        is_covariance = self.domain.kind == "covariance"
        shown = [index for index in indices if not is_covariance or index[0] >= index[1]]
        return tuple(f"{self.name}[{','.join(map(str, index))}]" for index in shown)

    def list_entries(self, value: Array) -> Array:
        """Return a value of the free number as a vector of its entries in the table (entries,), row after row."""
        return value[np.tril_indices(len(value))] if self.domain.kind == "covariance" else value.reshape(-1)

    def entries_at(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, " entries"]:
        """Return the number's entries (entries,), as the table of estimates shows them, from its coordinates x (size,).

        A variance, for instance, has the coordinate x = log(variance) and the entry exp(x).
        """
        with jax.enable_x64(True):
            return np.asarray(self._compute_entries(np.asarray(x)))

    def differentiate_entries(self, x: Float[np.ndarray, " size"]) -> Float[np.ndarray, "entries size"]:
        """Return the derivatives (entries, size) of the number's entries by its coordinates, at x (size,).

        Each entry of an interval has its own coordinate, so the derivatives are diagonal. JAX differentiates those of
        a simplex or a covariance.
        """
        if self.domain.kind == "interval":
            return np.diag(slope_from_unconstrained(self.domain, x))
        with jax.enable_x64(True):
            return np.asarray(jax.jacfwd(self._compute_entries)(jnp.asarray(x)))

    def _compute_entries(self, x: Array) -> Array:
        """Return the entries (entries,) at coordinates x (size,), by operations that JAX can differentiate."""
        return self.list_entries(map_from_unconstrained(self.domain, self.start.shape, x))

    @property
    def entry_domains(self) -> tuple[Domain, ...]:
        """Return the domain of each of the number's entries in the table.

        Entries of a simplex are probabilities. Entries of a covariance are positive on the diagonal and real elsewhere.
        """
        if self.domain.kind == "simplex":
            return (PROBABILITY,) * self.start.size
        if self.domain.kind == "covariance":
            return tuple(POSITIVE if i == j else REAL for i, j in zip(*np.tril_indices(len(self.start)), strict=True))
        return (self.domain,) * self.start.size


class TableEntry(NamedTuple):
    """A number that the table of estimates shows.

    Args:
        name: its name.
        domain: which values it may have.
        coordinate: index of its own coordinate among all unconstrained coordinates x (p,). None for an entry of a
            simplex or a covariance, which depends on several.
    """

    name: str
    domain: Domain
    coordinate: int | None


@readable
@dataclass(frozen=True)
class Parameters:
    """All free numbers of a network, in the order in which the function that builds it asks for them.

    A point of the search is the vector x (p,) of the unconstrained coordinates of all numbers, one after the other.

    Args:
        every: the numbers.
    """

    every: tuple[Parameter, ...]

    @property
    def size(self) -> int:
        """Return p, how many unconstrained coordinates all numbers have together."""
        return sum(parameter.size for parameter in self.every)

    @property
    def start(self) -> Float[np.ndarray, " p"]:
        """Return the point x (p,) from which a search begins: the coordinates of all numbers' starts."""
        return np.concatenate(
            [map_to_unconstrained(parameter.name, parameter.domain, parameter.start) for parameter in self.every]
        )

    @property
    def entries(self) -> tuple[TableEntry, ...]:
        """Return the numbers that the table of estimates shows, in its order.

        An entry has its name, its domain, and the index of its coordinate among all p coordinates; None for entries of
        a simplex or a covariance, which have none of their own.
        """
        results, begin = [], 0
        for parameter in self.every:
            has_own_coordinates = parameter.domain.kind == "interval"  # one coordinate for each entry
            for i, (name, domain) in enumerate(zip(parameter.entry_names, parameter.entry_domains, strict=True)):
                results.append(TableEntry(name, domain, begin + i if has_own_coordinates else None))
            begin += parameter.size
        return tuple(results)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Return the names of all p unconstrained coordinates, for messages.

        Each entry of a number on an interval has its own coordinate, which gets the entry's name. The coordinates of a
        simplex or a covariance are no single entry's, and are numbered: NAME(0), NAME(1), ...
        """
        return tuple(
            parameter.entry_names[i] if parameter.domain.kind == "interval" else f"{parameter.name}({i})"
            for parameter in self.every
            for i in range(parameter.size)
        )

    def values(self, x: Array) -> dict[str, Array]:
        """Return the free numbers {name: number} at unconstrained coordinates x (p,), in operations that JAX traces.

        The coordinates of all numbers stand one after another in x.
        """
        ends = np.cumsum([0, *(parameter.size for parameter in self.every)])
        return {
            parameter.name: map_from_unconstrained(parameter.domain, parameter.start.shape, x[begin:end])
            for parameter, begin, end in zip(self.every, ends[:-1], ends[1:], strict=True)
        }

    def known(self, x: Float[np.ndarray, " p"]) -> dict[str, Any]:
        """Return the free numbers at unconstrained coordinates x (p,), {name: number}, as plain floats and arrays."""
        with jax.enable_x64(True):
            return {name: to_plain_number(value) for name, value in self.values(np.asarray(x)).items()}

    def entries_at(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, " entries"]:
        """Return all numbers of the table of estimates (entries,) at unconstrained coordinates x (p,)."""
        return np.concatenate([parameter.entries_at(single) for parameter, single in self._split_point(x)])

    def jacobian(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "entries p"]:
        """Return the derivatives (entries, p) of all numbers of the table by the coordinates, at x (p,)."""
        blocks = [parameter.differentiate_entries(own) for parameter, own in self._split_point(x)]
        return np.asarray(block_diag(*blocks))  # an entry depends on the coordinates of its own number alone

    def _split_point(self, x: np.ndarray) -> list[tuple[Parameter, np.ndarray]]:
        """Return each free number with its own coordinates (size,) at a point x (p,)."""
        ends = np.cumsum([parameter.size for parameter in self.every])
        return list(zip(self.every, np.split(x, ends[:-1]), strict=True))

    def slopes(self, x: Float[np.ndarray, " p"]) -> Float[np.ndarray, "entries p"]:
        """Return d t(v) / dx (entries, p) for each number v of the table, with t(v) its logarithm or logit.

        Intervals of estimates are symmetric in t(v); without ends of the domain it is v itself. By the chain rule it is
        t'(v) dv/dx. It may be infinite at an end of the domain, which gives no warning.
        """
        entries = zip(self.entries, self.entries_at(x), self.jacobian(x), strict=True)
        with np.errstate(all="ignore"):
            return np.stack([slope_to_unconstrained(entry.domain, value) * dv_dx for entry, value, dv_dx in entries])


def to_plain_number(value: Array) -> float | np.ndarray:
    """Return a single number as a float, several as an array."""
    return float(value) if np.ndim(value) == 0 else np.asarray(value)
