"""Equality of two objects in everything they hold, as one bool where arrays would give many."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def same(item: Any, other: Any) -> bool:
    """Return one bool for objects that hold arrays: of the same class, and the same in each part.

    Arrays are the same if their shape, kind of number and numbers are; NaN is the same as NaN. A traced array is the
    same as itself alone.
    """
    if item is other:
        return True
    if isinstance(item, jax.core.Tracer) or isinstance(other, jax.core.Tracer):
        return False
    if isinstance(item, np.ndarray | np.generic | jax.Array) and isinstance(other, np.ndarray | np.generic | jax.Array):
        return _same_array(item, other)
    if type(item) is not type(other):
        return False
    # Containers and dataclasses, part by part.
    if isinstance(item, Mapping):
        return item.keys() == other.keys() and all(same(item[key], other[key]) for key in item) and _rest(item, other)
    if isinstance(item, tuple | list):
        return len(item) == len(other) and all(map(same, item, other))
    if isinstance(item, partial):
        return same((item.func, item.args, item.keywords), (other.func, other.args, other.keywords))
    if is_dataclass(item):
        return all(same(getattr(item, f.name, None), getattr(other, f.name, None)) for f in fields(item) if f.compare)
    # Objects without an equality of their class are compared by their attributes.
    kind: Any = type(item)
    if kind.__eq__ is object.__eq__ and not callable(item) and getattr(item, "__dict__", None):
        return same(vars(item), vars(other))  # nobody has said when two of these are equal
    return bool(item == other) or (isinstance(item, float) and item != item and other != other)


def _rest(item: object, other: object) -> bool:
    """Compare the attributes that a subclass of dict has in addition to its entries."""
    return same(getattr(item, "__dict__", None), getattr(other, "__dict__", None))


def _same_array(item: Any, other: Any) -> bool:
    if item.shape != other.shape or item.dtype != other.dtype:
        return False
    if jnp.issubdtype(item.dtype, jax.dtypes.prng_key):
        item, other = jax.random.key_data(item), jax.random.key_data(other)
    a, b = np.asarray(item), np.asarray(other)
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fcmM"))
