"""Structure of an object apart from its arrays, so that objects with equal structure share compiled programs."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from heliograph.numerics.types import PyTree


class Static(NamedTuple):
    """Structure of an object and its leaves, with None in place of arrays. Hashable, as a static argument must be.

    Programs take arrays only: filtering out other leaves at each call would cost more than the step itself.
    """

    tree: PyTree
    parts: tuple[Hashable, ...]

    def with_arrays(self, numbers: Sequence[jax.Array]) -> PyTree:
        """Return the object with these arrays in the places of its own, in the order of its leaves."""
        rest = iter(numbers)
        return self.tree.unflatten([next(rest) if leaf is None else leaf for leaf in self.parts])


def split_structure(whole: object) -> tuple[list[jax.Array], Static]:
    """Return an object's arrays, on the device, and its structure with None in their places; call it in float64."""
    leaves, tree = jax.tree.flatten(jax.tree.map(_convert_leaf, whole))
    numbers = [jax.device_put(leaf) for leaf in leaves if eqx.is_array(leaf)]  # no program for each shape
    return numbers, Static(tree, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves))


def _convert_leaf(leaf: object) -> object:
    """Return a number of Python as an array, anything else as it is."""
    return np.asarray(leaf) if isinstance(leaf, int | float) else leaf
