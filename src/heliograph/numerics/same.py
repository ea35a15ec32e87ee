"""Whether two things are the same in everything they hold: one answer, where arrays would give many."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def same(one: Any, other: Any) -> bool:
    """One bool for objects that hold arrays: of the same class, and the same in each part.

    Arrays are the same if shape, kind of number and every number are; NaN is the same as NaN. What JAX traces is the
    same as itself alone.
    """
    if one is other:
        return True
    if isinstance(one, jax.core.Tracer) or isinstance(other, jax.core.Tracer):
        return False
    if isinstance(one, np.ndarray | np.generic | jax.Array) and isinstance(other, np.ndarray | np.generic | jax.Array):
        return _same_array(one, other)
    if type(one) is not type(other):
        return False
    if isinstance(one, Mapping):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one) and _rest(one, other)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, partial):
        return same((one.func, one.args, one.keywords), (other.func, other.args, other.keywords))
    if is_dataclass(one):
        return all(same(getattr(one, f.name, None), getattr(other, f.name, None)) for f in fields(one) if f.compare)
    kind: Any = type(one)
    if kind.__eq__ is object.__eq__ and not callable(one) and getattr(one, "__dict__", None):
        return same(vars(one), vars(other))  # nobody has said when two of these are equal
    return bool(one == other) or (isinstance(one, float) and one != one and other != other)


def _rest(one: object, other: object) -> bool:
    """What a dictionary of a class of its own holds beside its entries."""
    return same(getattr(one, "__dict__", None), getattr(other, "__dict__", None))


def _same_array(one: Any, other: Any) -> bool:
    if one.shape != other.shape or one.dtype != other.dtype:
        return False
    if jnp.issubdtype(one.dtype, jax.dtypes.prng_key):
        one, other = jax.random.key_data(one), jax.random.key_data(other)
    a, b = np.asarray(one), np.asarray(other)
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fcmM"))
