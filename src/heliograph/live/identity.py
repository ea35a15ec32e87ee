"""What something is to whoever kept its state: a state goes on only where everything computes as it did."""

from collections.abc import Mapping
from hashlib import sha256

import jax
import numpy as np

import heliograph
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree

Identity = dict[str, str]
DIGITS = 16


def versions() -> Identity:
    """Of what computes."""
    return {"heliograph": heliograph.__version__, "jax": jax.__version__}


def check_same(what: str, mine: Mapping[str, str], other: Mapping[str, str]) -> None:
    """Refuse what was kept of something else, and say in what it differs.

    Raises:
        ValueError: anything that differs.
    """
    names = [name for name in {**mine, **other} if mine.get(name) != other.get(name)]
    if names:
        here = "; ".join(f"{name}: {mine.get(name, 'none')}" for name in names)
        there = "; ".join(f"{name}: {other.get(name, 'none')}" for name in names)
        raise fail(what, f"the state of what is here ({here})", f"one that differs ({there})")


def short_name(part: PyTree) -> str:
    """A short name of all numbers in a part, or of a text."""
    if isinstance(part, str):
        return sha256(part.encode()).hexdigest()[:DIGITS]
    found = sha256()
    for leaf in jax.tree.leaves(part):
        if isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
            array = np.asarray(leaf)
            found.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
    return found.hexdigest()[:DIGITS]
