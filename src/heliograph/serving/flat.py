"""Trees of arrays as rows of doubles: what many plants know is one table, and what a plant knows a few of its rows."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import PyTree


class Flat(NamedTuple):
    """The leaves of a tree side by side in a row; whole numbers keep their value up to 2^53."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]

    @property
    def size(self) -> int:
        """Length of a row."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def tree(self, row: jax.Array | np.ndarray) -> PyTree:
        """The tree of a row."""
        parts, begin = [], 0
        for shape, kind in zip(self.shapes, self.kinds, strict=True):
            end = begin + int(np.prod(shape))
            parts.append(row[begin:end].reshape(shape).astype(kind))
            begin = end
        return self.structure.unflatten(parts)


def flat_like(tree: PyTree) -> Flat:
    """The layout of a tree of arrays."""
    leaves, structure = jax.tree.flatten(tree)
    return Flat(structure, tuple(leaf.shape for leaf in leaves), tuple(str(leaf.dtype) for leaf in leaves))


def row_of(tree: PyTree) -> jax.Array:
    """A tree of arrays as a row."""
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(leaf).astype(np.float64) for leaf in jax.tree.leaves(tree))])
