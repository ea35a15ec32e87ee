"""Examples: each module or folder here is one; the first line of its text says what it shows, `example` writes it."""

import ast
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

Example = Callable[
    ..., None
]  # folder and seed, and a file: it writes report, figures and summary to a folder of its own


def examples() -> dict[str, str]:
    """What each example shows, by the name that it is run by; none of them is imported."""
    return {name: _first_line(module) for name, module in _modules().items()}


def load_example(name: str) -> Example:
    """The function that runs an example.

    Raises:
        ValueError: an unknown name.
    """
    from heliograph.numerics.check import fail

    modules = _modules()
    if name not in modules:
        raise fail("example", f"one of {', '.join(modules)}", repr(name))
    run: Example = import_module(f"{__name__}.{modules[name]}").example
    return run


def _modules() -> dict[str, str]:
    return {found.name.replace("_", "-"): found.name for found in iter_modules(__path__)}


def _first_line(module: str) -> str:
    place = Path(__path__[0]) / module
    file = place / "__init__.py" if place.is_dir() else place.with_suffix(".py")
    text = ast.get_docstring(ast.parse(file.read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]
