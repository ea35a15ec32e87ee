"""Results computed from an immutable object, cached as long as the object lives."""

from collections.abc import Callable, Hashable
from functools import cache, wraps
from inspect import signature
from typing import Any, Concatenate, ParamSpec, TypeVar, cast
from weakref import WeakValueDictionary, ref

import jax
import numpy as np

from heliograph.numerics.numpy_or_jax import is_traced

S = TypeVar("S")
P = ParamSpec("P")
T = TypeVar("T")


def cache_by_object(function: Callable[Concatenate[S, P], T]) -> Callable[Concatenate[S, P], T]:
    """Decorate a function: its results are cached for each object that is its first argument, while the object lives.

    An object is identified by `id`, so that nothing is compared: it must not change. The other arguments must have
    hashes. Cached arrays are made read-only, since all callers share them; results that JAX traces are never cached.
    """
    # By identity of the object: a weak reference to it, and the results by the other arguments.
    cache: dict[int, tuple[ref[S], dict[Hashable, T]]] = {}
    first_parameter = next(iter(signature(function).parameters))  # the object may also be given by this name

    @wraps(function)
    def look_up(*positional: Any, **named: Any) -> T:
        """Return the result for this object and these arguments, computed only once while the object lives."""
        if not positional and first_parameter not in named:
            return function(*positional, **named)  # which raises an error that says what is missing
        owner, *others = positional or (named.pop(first_parameter),)
        identity = id(owner)
        key = (tuple(others), tuple(named.items()))  # of the other arguments
        _reference, results = cache.get(identity, (None, {}))
        if key in results:
            return results[key]
        result = function(owner, *others, **named)
        # A traced result belongs to one trace only.
        if is_traced(result):
            return result
        for leaf in jax.tree.leaves(result):
            _make_read_only(leaf)
        # The weak reference removes the object's entry when it is collected, before another has the same `id`.
        results[key] = result
        cache.setdefault(identity, (ref(owner, lambda _: cache.pop(identity, None)), results))
        return result

    return cast(Callable[Concatenate[S, P], T], look_up)


def share_by_object(make: Callable[[S], T]) -> Callable[[S], T]:
    """Return the function with its result for an object shared by all callers, as long as one of them holds it.

    The result must hold the object. Its identity is the key, which is then not given to another object meanwhile.
    """
    in_use: WeakValueDictionary[int, T] = WeakValueDictionary()

    @wraps(make, updated=())
    def share_or_make(source: S) -> T:
        """Return the result for this object if somebody still holds it, else make it."""
        result = in_use.get(id(source))
        if result is None:
            result = in_use[id(source)] = make(source)
        return result

    return share_or_make


def cache_arrays(function: Callable[P, T]) -> Callable[P, T]:
    """Return a function of hashable arguments whose results, NumPy arrays, are cached and copied at each call.

    The copy is needed because JAX converts an array that a trace closes over once for all traces, to the precision of
    the first. After a trace in single precision, the same array would be single in a double one, or an index of the
    wrong type.
    """
    cached = cast(Callable[P, T], cache(function))

    @wraps(function)
    def copy_cached(*args: P.args, **kwargs: P.kwargs) -> T:
        """Return a copy of the result for these arguments, which is computed once."""
        arrays: T = jax.tree.map(np.copy, cached(*args, **kwargs))
        return arrays

    return copy_cached


def _make_read_only(leaf: Any) -> None:
    """Make a leaf of a cached result read-only if it is a NumPy array, since all callers share it."""
    if isinstance(leaf, np.ndarray):
        leaf.setflags(write=False)
