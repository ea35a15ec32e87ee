"""Shape checks of the tests: beartype, for annotations that name the shape of an array and for nothing else.

Values of a wrong kind are refused by the package, with lines that tests read. So `Float[ArrayLike, "n"]`, an input that
becomes an array, is not checked here: its shape is for the reader.
"""

import sys
from collections.abc import Callable
from functools import cache, partial, update_wrapper
from types import FunctionType, NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import jaxtyping
from beartype import beartype

JAXTYPED = jaxtyping.jaxtyped


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Have beartype check the annotations of a function that hold a shaped array."""
    hints = function.__annotations__
    shaped = {name: _evaluated(hint, function.__globals__) for name, hint in hints.items()}
    function.__annotations__ = {name: hint for name, hint in shaped.items() if _has_shape(hint)}
    result: Callable[..., Any] = beartype(function)
    function.__annotations__ = hints  # as `help` shows them
    return result


def where_shaped(thing: Any = None, *, typechecker: Any) -> Any:
    """Decorate as `jaxtyped` does what has a shape to check, and nothing else: three functions of four have none.

    Its wrapper binds the arguments of each call, which was a sixth of the time of tests that trace filters.
    """
    if thing is None:
        return partial(where_shaped, typechecker=typechecker)
    function = getattr(thing, "fget", None) or getattr(thing, "__func__", None) or thing
    names = getattr(function, "__globals__", None) or vars(sys.modules[function.__module__])
    hints = {name: _evaluated(hint, names) for name, hint in getattr(function, "__annotations__", {}).items()}
    shaped = {name: hint for name, hint in hints.items() if _has_shape(hint)}
    if not shaped:
        return thing
    by_kind = isinstance(thing, FunctionType) and all(map(_follows_from_kinds, shaped.values()))
    return once_a_kind(thing, set(shaped), typechecker) if by_kind else JAXTYPED(thing, typechecker=typechecker)


def once_a_kind(function: FunctionType, shaped: set[str], typechecker: Any) -> Callable[..., Any]:
    """Check each combination of types and shapes once: of the same kinds a second check has the same outcome.

    A check takes some 50 us, and some functions are called a hundred thousand times.
    """
    code, computed, accepted = function.__code__, [], {}
    names = code.co_varnames[: code.co_argcount]
    places = [i for i, name in enumerate(names) if name in shaped]

    def given(*args: Any, **kwargs: Any) -> Any:
        return computed.pop()

    @cache
    def whole() -> Callable[..., Any]:  # made at the first call: a file of tests calls a few of them
        return JAXTYPED(function, typechecker=typechecker)

    @cache
    def again() -> Callable[..., Any]:  # the same annotations around a result that is there already
        renamed = FunctionType(given.__code__, function.__globals__, function.__name__, None, given.__closure__)
        return JAXTYPED(update_wrapper(renamed, function), typechecker=typechecker)

    def call(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        count = len(args)
        key = (*(_kind(args[i]) if i < count else names[i] for i in places),
               *((name, _kind(kwargs[name])) for name in kwargs if name in shaped))  # fmt: skip
        if key not in accepted:
            outcome = whole()(*args, **kwargs)
            accepted[key] = {_kind(outcome)}
            return outcome
        outcome = function(*args, **kwargs)
        if "return" in shaped and (kind := _kind(outcome)) not in accepted[key]:
            computed.append(outcome)
            again()(*args, **kwargs)
            accepted[key].add(kind)
        return outcome

    return update_wrapper(call, function)


def _kind(value: Any) -> Any:
    """Type, and shape and type of numbers of an array: what a check of a shape reads."""
    if isinstance(value, tuple):
        return (type(value), *map(_kind, value))
    shape = getattr(value, "shape", None)
    return type(value) if shape is None else (type(value), shape, value.dtype)


def _follows_from_kinds(hint: Any) -> bool:
    """Whether a check reads kinds alone: of arrays, and of fixed tuples and choices of them."""
    hint = getattr(hint, "__value__", hint)
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return "{" not in hint.dim_str
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType) or (get_origin(hint) is tuple and Ellipsis not in parts):
        return all(map(_follows_from_kinds, parts))
    return hint in (None, NoneType, float, int, bool)


def _evaluated(hint: Any, names: dict[str, Any]) -> Any:
    """Annotation itself, where a short text or a name stands for it."""
    if isinstance(hint, str):
        try:
            return eval(hint, dict(names))
        except (NameError, TypeError):  # of a class that is defined below, or in quotes inside
            return None
    return getattr(hint, "__value__", hint)


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return hint.array_type is not Any
    return any(_has_shape(part) for part in get_args(hint))
