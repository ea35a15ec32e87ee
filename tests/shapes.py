"""Shape checks of the tests: beartype, for annotations that name the shape of an array and for nothing else.

Values of a wrong kind are refused by the package, with lines that tests read. So `Float[ArrayLike, "n"]`, an input that
becomes an array, is not checked here: its shape is for the reader.
"""

import sys
from collections.abc import Callable
from functools import partial
from typing import Any, get_args

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
    hints = getattr(function, "__annotations__", {}).values()
    if any(_has_shape(_evaluated(hint, names)) for hint in hints):
        return JAXTYPED(thing, typechecker=typechecker)
    return thing


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
