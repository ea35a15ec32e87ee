"""What objects that differ in numbers alone share: so they share compiled programs, called with arrays only."""

from collections.abc import Hashable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np

from heliograph.numerics.types import PyTree


class Static(NamedTuple):
    """The structure of an object, and its leaves: None stands for an array. Hashable, so a program may depend on it.

    A program is called with arrays only, since telling apart what is none costs more than all the rest of a step.
    """

    tree: PyTree
    parts: tuple[Hashable, ...]

    def filled(self, numbers: Sequence[jax.Array]) -> PyTree:
        """The object with these arrays."""
        rest = iter(numbers)
        return self.tree.unflatten([next(rest) if part is None else part for part in self.parts])


def cast(item: object) -> tuple[list[jax.Array], Static]:
    """An object's arrays, where a program finds them, and the rest of it. Call it in the float64 scope."""
    leaves, tree = jax.tree.flatten(jax.tree.map(_as_array, item))
    numbers = [jax.device_put(leaf) for leaf in leaves if eqx.is_array(leaf)]  # no program for each shape
    return numbers, Static(tree, tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves))


def _as_array(leaf: object) -> object:
    return np.asarray(leaf) if isinstance(leaf, int | float) else leaf
