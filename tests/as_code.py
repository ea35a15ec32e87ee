"""A network that a property test drew, as Python that makes it again: what a failing one prints."""

import inspect
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

import jax
import numpy as np

import heliograph as hg
from tests.map import BORDERS

HELD = {  # arguments that an object holds otherwise than under their names
    "limits": lambda node: None if node.limits is None else np.stack([node.limits.low, node.limits.high], -1),
    "invalid": lambda node: None if node.limits is None else node.limits.invalid,
    "stuck": lambda node: None if node.limits is None else node.limits.stuck,
    "chain": lambda modes: modes.memory,
    "drift": lambda faded: faded.memory,
    "weights": lambda mixture: mixture.choice.probabilities,
    "radius": lambda mixture: mixture.choice.radius,
    "resolution": lambda sensor: None,  # part of the noise
}


def as_code(**parts: Any) -> str:
    """Statements that assign each part to its name, after the imports that they need."""
    modules: set[str] = set()
    lines = [f"{name} = {expression(value, modules)}" for name, value in parts.items()]
    imports = ["import numpy as np", "import heliograph as hg", *(f"import {module}" for module in sorted(modules))]
    return "\n".join([*imports, *lines])


@contextmanager
def printing(**parts: Any) -> Iterator[None]:
    """Add these parts as code to what is said when the test inside fails."""
    try:
        yield
    except Exception as error:
        error.add_note(f"What was drawn:\n{as_code(**parts)}")
        raise


def expression(value: Any, modules: set[str]) -> str:
    """An expression equal to a value to the last digit; adds to `modules` what it has to import."""
    inside = lambda part: expression(part, modules)  # noqa: E731
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        array = np.asarray(value)
        text = str(array.tolist()).replace("nan", "np.nan").replace("inf", "np.inf")
        return f"np.array({text})" if array.size else f"np.zeros({array.shape})"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{inside(key)}: {inside(part)}' for key, part in value.items())}}}"
    if type(value) in (list, tuple):
        marks = "[]" if isinstance(value, list) else ("(", ",)" if len(value) == 1 else ")")
        return f"{marks[0]}{', '.join(map(inside, value))}{marks[1]}"
    if value is None or isinstance(value, bool | int | float | str):
        return repr(value).replace("nan", "np.nan") if isinstance(value, float) else repr(value)
    return f"{_name(type(value), modules)}({', '.join(_arguments(value, modules))})"


def _arguments(value: Any, modules: set[str]) -> list[str]:
    """Of a call of the class that makes the object: what it holds under the names of the arguments."""
    arguments = []
    for name, parameter in inspect.signature(type(value)).parameters.items():
        take = HELD.get(name, attrgetter(name.removesuffix("_")))
        argument = getattr(value, name) if hasattr(value, name) else take(value)
        if argument is not None and argument is not parameter.default:
            arguments.append(f"{name}={expression(argument, modules)}")
    return arguments


def _name(kind: type, modules: set[str]) -> str:
    """The public name of a class, or where it is."""
    if kind in _public():
        return _public()[kind]
    modules.add(kind.__module__)
    return f"{kind.__module__}.{kind.__qualname__}"


@cache
def _public() -> dict[Any, str]:
    stubs = Path(hg.__file__).parent.glob("*/__init__.pyi")
    rooms = [stub.parent.name for stub in stubs if stub.parent.name not in BORDERS]
    places = {"hg": hg} | {f"hg.{room}": import_module(f"heliograph.{room}") for room in rooms}
    return {getattr(place, name): f"{prefix}.{name}" for prefix, place in reversed(places.items())
            for name in place.__all__ if inspect.isclass(getattr(place, name))}  # fmt: skip
