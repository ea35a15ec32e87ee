"""Laws as mixtures: atoms of a map and of a noise, and the Gaussian branches of each component of a noise."""

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.numerics.check import fail
from heliograph.numerics.numpy_or_jax import block_diagonal, library
from heliograph.numerics.types import Array, Float

COMPONENT_LIMIT = 4096  # combinations of atoms held for one step
Number: TypeAlias = float | jax.Array
Atom = TypeVar("Atom", bound=tuple[object, ...])


class AffineComponent(NamedTuple):
    """One combination of atoms of a map: with probability `weight`, z = gain x + offset + N(0, noise).

    Shapes: gain (m, n), offset (m,), noise (m, m).
    """

    weight: Number
    gain: Array
    offset: Array
    noise: Array

    def then(self, other: "AffineComponent") -> "AffineComponent":
        """Return this map x followed by a map y, which takes s to G_y (G_x s + c_x + n_x) + c_y + n_y.

        c are offsets, and n noises with given covariances. The weight is the product of both weights.
        """
        weight, gain, offset, noise = other
        covariance = gain @ self.noise @ gain.T + noise
        return AffineComponent(self.weight * weight, gain @ self.gain, gain @ self.offset + offset, covariance)

    def above(self, other: "AffineComponent") -> "AffineComponent":
        """Return this map stacked above an independent one of the same input; their probabilities are multiplied."""
        gain = _concatenate_first_axis(self.gain, other.gain)
        offset = _concatenate_first_axis(self.offset, other.offset)
        noise = block_diagonal([self.noise, other.noise])
        return AffineComponent(self.weight * other.weight, gain, offset, noise)


class NoiseAtom(NamedTuple):
    """One atom of a noise: with probability `weight`, n = value + N(0, covariance).

    Shapes: value (n,), covariance (n, n).
    """

    weight: Number
    value: Array
    covariance: Array

    def above(self, other: "NoiseAtom") -> "NoiseAtom":
        """Return this atom of a noise above the `other` one, of an independent noise; probabilities are multiplied."""
        value = _concatenate_first_axis(self.value, other.value)
        return NoiseAtom(self.weight * other.weight, value, block_diagonal([self.covariance, other.covariance]))


def combine_atoms(atoms_by_part: Sequence[list[Atom]], join: Callable[[Atom, Atom], Atom]) -> list[Atom]:
    """Return all combinations of one atom of each independent part, joined; an atom is a value and its probability.

    Raises:
        ValueError: more combinations than COMPONENT_LIMIT.
    """

    def pairs(a: list[Atom], b: list[Atom]) -> list[Atom]:
        """Return every atom of a joined with every atom of b; raise ValueError if there are too many."""
        if len(a) * len(b) > COMPONENT_LIMIT:
            raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", f"{len(a) * len(b):,}")
        return [join(x, y) for x in a for y in b]

    return reduce(pairs, atoms_by_part)


def _concatenate_first_axis(a: Array, b: Array) -> Array:
    """Return the arrays a and b, of NumPy or JAX, joined along the first axis."""
    joined: Array = library(a, b).concatenate([a, b])
    return joined


class GaussianBranches(NamedTuple):
    """Each component of a noise as a mixture of Gaussian branches about the mean of the noise.

    Shapes: log_share, mean, variance (n, branches); a branch that a component does not have has log_share -inf.
    """

    log_share: Float[Array, "n branches"]
    mean: Float[Array, "n branches"]
    variance: Float[Array, "n branches"]


class SignalNoise(NamedTuple):
    """A noise beside a signal y: factors of what it adds to the error of y, and what to E y y' (n, n)."""

    columns: WeightedColumns
    covariance: Float[Array, "n n"]


def stack_branches(parts: Sequence[GaussianBranches]) -> GaussianBranches:
    """Return the components of several noises one above the other, all with the largest number of branches.

    A component is a mixture of Gaussian branches. Branches that are added have the probability 0.
    """
    xp = library(parts)
    largest_count = max(law.mean.shape[1] for law in parts)
    padding_values = (-np.inf, 0.0, 1.0)  # log of the probability 0, mean 0 and variance 1

    def padded(law: GaussianBranches) -> list[Array]:
        """Return the arrays of a law, with branches of probability 0 appended up to the largest number."""
        more = ((0, 0), (0, largest_count - law.mean.shape[1]))
        return [xp.pad(value, more, constant_values=fill) for value, fill in zip(law, padding_values, strict=True)]

    return GaussianBranches(*(xp.concatenate(rows) for rows in zip(*map(padded, parts), strict=True)))


class NoiseWithoutOutliers(NamedTuple):
    """The noise without its outliers: mean (n,), relative to that of the whole, and covariance (n, n)."""

    mean: Float[Array, " n"]
    covariance: Float[Array, "n n"]
