"""Trees of arrays as rows of doubles, and back."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.types import PyTree


class FlatLayout(NamedTuple):
    """Layout of a tree whose leaves are concatenated in a row of doubles; integers are exact up to 2^53."""

    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]
    kinds: tuple[str, ...]

    @property
    def size(self) -> int:
        """Length of a row: how many numbers the tree holds."""
        return sum(int(np.prod(shape)) for shape in self.shapes)

    def tree(self, rows: jax.Array | np.ndarray) -> PyTree:
        """Return the tree whose leaves lie one after another in a row, with their shapes and dtypes.

        From rows (..., size), its leaves have the leading axes too.
        """
        leaves, begin = [], 0
        leading_axes = rows.shape[:-1]
        for shape, kind in zip(self.shapes, self.kinds, strict=True):
            end = begin + int(np.prod(shape))
            leaves.append(rows[..., begin:end].reshape((*leading_axes, *shape)).astype(kind))
            begin = end
        return self.structure.unflatten(leaves)


def make_flat_layout(tree: PyTree) -> FlatLayout:
    """Return the layout of a tree of arrays (structure, shapes and types), by which a row becomes a tree again."""
    leaves, structure = jax.tree.flatten(tree)
    shapes, kinds = tuple(leaf.shape for leaf in leaves), tuple(str(leaf.dtype) for leaf in leaves)
    return FlatLayout(structure=structure, shapes=shapes, kinds=kinds)


def flatten_to_row(tree: PyTree) -> jax.Array:
    """Concatenate the leaves of a tree of arrays in a row of doubles."""
    return jnp.concatenate([jnp.zeros(0), *(jnp.ravel(leaf).astype(np.float64) for leaf in jax.tree.leaves(tree))])
