"""Shape checks of the tests: beartype, for annotations that name the shape of an array and for nothing else.

Values of a wrong kind are refused by the package, with lines that tests read. So `Float[ArrayLike, "n"]`, an input that
becomes an array, is not checked here: its shape is for the reader.
"""

from collections.abc import Callable
from typing import Any, get_args

import jaxtyping
from beartype import beartype


def checked(function: Callable[..., Any]) -> Callable[..., Any]:
    """Have beartype check the annotations of a function that hold a shaped array."""
    hints = function.__annotations__
    function.__annotations__ = {name: hint for name, hint in hints.items() if _has_shape(hint)}
    return beartype(function)


def _has_shape(hint: Any) -> bool:
    if isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray):
        return hint.array_type is not Any
    return any(_has_shape(part) for part in get_args(hint))
