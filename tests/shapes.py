"""Shape checks of the tests: beartype, for annotations that name the shape of an array and for nothing else.

Values of a wrong kind are refused by the package, with lines that tests read. So `Float[ArrayLike, "n"]`, an input that
becomes an array, is not checked here: its shape is for the reader.
"""

import inspect
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
    return once_a_kind(thing, shaped, typechecker) if by_kind else JAXTYPED(thing, typechecker=typechecker)


def once_a_kind(function: FunctionType, shaped: dict[str, Any], typechecker: Any) -> Callable[..., Any]:
    """Check each combination of types and shapes once: of the same kinds a second check has the same outcome.

    A check takes some 50 us, and some functions are called a hundred thousand times. Of tuples of any length every
    entry is checked.
    """
    code, computed, accepted, checks = function.__code__, [], {}, {}
    names = code.co_varnames[: code.co_argcount]
    places = [i for i, name in enumerate(names) if name in shaped]
    any_length = any(map(_is_of_any_length, shaped.values()))

    def given(*args: Any, **kwargs: Any) -> Any:
        return computed.pop()

    @cache
    def whole() -> Callable[..., Any]:  # made at the first call: a file of tests calls a few of them
        return JAXTYPED(function, typechecker=typechecker)

    def check(args: Any, kwargs: Any, **returned: Any) -> None:
        """Check the annotations around what is returned already, if anything is, for tuples of these lengths."""
        values = {**dict(zip(names, args, strict=False)), **kwargs, **returned}
        hints = {name: _of_entries(hint, values.get(name)) for name, hint in shaped.items()}
        hints = hints if returned else {name: hint for name, hint in hints.items() if name != "return"}
        if (key := tuple(hints.items())) not in checks:
            again = FunctionType(given.__code__, function.__globals__, function.__name__, None, given.__closure__)
            update_wrapper(again, function).__annotations__ = hints
            signature = inspect.signature(function)
            known = [p.replace(annotation=hints.get(p.name, p.empty)) for p in signature.parameters.values()]
            returns = hints.get("return", signature.empty)
            again.__signature__ = signature.replace(parameters=known, return_annotation=returns)
            checks[key] = JAXTYPED(again, typechecker=typechecker)
        computed.append(returned.get("return"))
        checks[key](*args, **kwargs)

    def call(*args: Any, **kwargs: Any) -> Any:
        if jaxtyping.config.jaxtyping_disable:
            return function(*args, **kwargs)
        count = len(args)
        key = (*(_kind(args[i]) if i < count else names[i] for i in places),
               *((name, _kind(kwargs[name])) for name in kwargs if name in shaped))  # fmt: skip
        if key not in accepted:
            if any_length:
                check(args, kwargs)
            outcome = whole()(*args, **kwargs)
            if any_length:
                check(args, kwargs, **{"return": outcome})
            accepted[key] = {_kind(outcome)}
            return outcome
        outcome = function(*args, **kwargs)
        if "return" in shaped and (kind := _kind(outcome)) not in accepted[key]:
            check(args, kwargs, **{"return": outcome})
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
    """Whether a check reads kinds alone: of arrays, and of tuples and choices of them."""
    hint = getattr(hint, "__value__", hint)
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return "{" not in hint.dim_str
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return all(_follows_from_kinds(part) and not _is_of_any_length(part) for part in parts)
    if get_origin(hint) is tuple:
        return all(map(_follows_from_kinds, parts))
    return hint in (None, NoneType, float, int, bool, Ellipsis)


def _is_of_any_length(hint: Any) -> bool:
    parts = get_args(getattr(hint, "__value__", hint))
    return Ellipsis in parts or any(map(_is_of_any_length, parts))


def _of_entries(hint: Any, value: Any) -> Any:
    """Annotation of each entry of a tuple like this, in place of that of any number of them: beartype looks at one."""
    hint = getattr(hint, "__value__", hint)
    if get_origin(hint) is not tuple or not isinstance(value, tuple):
        return hint
    parts = get_args(hint)
    entries = [parts[0]] * len(value) if Ellipsis in parts else parts
    if len(entries) != len(value):
        return hint
    return tuple[*map(_of_entries, entries, value)] if entries else tuple[()]


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
