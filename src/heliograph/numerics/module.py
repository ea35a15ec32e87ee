"""Base class of all models, filters and rules; text and equality of the package's objects, one way for all of them."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import partial
from html import escape
from itertools import islice
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.check import InputError, fail
from heliograph.numerics.float64 import let_compute_in_float64
from heliograph.numerics.lazy_exports import refuse_attribute


def are_same(x: Any, y: Any) -> bool:
    """Return whether two objects that may hold arrays are of the same class, and the same in each part.

    Python's == does not serve, as it compares arrays by element and NaN as different. Here arrays are the same if
    their shape, kind of number and numbers are; NaN is the same as NaN. An array that JAX traces has no known numbers,
    and is the same as itself alone.
    """
    if x is y:
        return True
    if isinstance(x, jax.core.Tracer) or isinstance(y, jax.core.Tracer):
        return False
    if isinstance(x, np.ndarray | np.generic | jax.Array) and isinstance(y, np.ndarray | np.generic | jax.Array):
        return _same_array(x, y)
    if type(x) is not type(y):
        return False
    # Containers and dataclasses, part by part.
    if isinstance(x, Mapping):
        return x.keys() == y.keys() and all(are_same(x[key], y[key]) for key in x) and _same_attributes(x, y)
    if isinstance(x, tuple | list):
        return len(x) == len(y) and all(map(are_same, x, y))
    if isinstance(x, partial):
        return are_same((x.func, x.args, x.keywords), (y.func, y.args, y.keywords))
    if is_dataclass(x):
        return all(are_same(getattr(x, f.name, None), getattr(y, f.name, None)) for f in fields(x) if f.compare)
    # Objects whose class defines no equality are compared by their attributes, but for functions.
    kind: Any = type(x)
    has_no_equality = kind.__eq__ is object.__eq__
    if has_no_equality and not callable(x) and getattr(x, "__dict__", None):
        return are_same(vars(x), vars(y))
    are_both_nan = isinstance(x, float) and x != x and y != y
    return bool(x == y) or are_both_nan


def _same_attributes(x: object, y: object) -> bool:
    """Return whether two mappings have the same attributes, which a subclass of dict may have beside its entries."""
    return are_same(getattr(x, "__dict__", None), getattr(y, "__dict__", None))


def _same_array(value: Any, other: Any) -> bool:
    """Return whether arrays have the same shape, type and entries; NaN equals NaN, random keys go by their data."""
    if value.shape != other.shape or value.dtype != other.dtype:
        return False
    if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
        value, other = jax.random.key_data(value), jax.random.key_data(other)
    a, b = np.asarray(value), np.asarray(other)
    return bool(np.array_equal(a, b, equal_nan=a.dtype.kind in "fcmM"))  # kinds that have a NaN or NaT


class Module(eqx.Module):
    """A dataclass that is a tree of arrays to JAX, and binds its methods as Python does.

    Equinox makes a module of each bound method, so that transformations take one as an argument, and walks through all
    that the object holds to do so: 25 microseconds for a law, a fifth of a second for a network of a thousand nodes.
    Our methods are called by the thousand while a program is traced, and are never passed to a transformation.

    `formulas` names the methods of a model that return numbers known from its own: a class of a user's own may write
    them in jax.numpy, and they are computed in float64.
    """

    formulas: ClassVar[tuple[str, ...]] = ()

    def __init_subclass__(cls, **options: object) -> None:
        """Wrap the methods named in `formulas` of a new subclass, so that they compute in double precision."""
        super().__init_subclass__(**options)
        let_compute_in_float64(cls, cls.formulas)

    __getattribute__ = object.__getattribute__


def unwritten(owner: object, method: str) -> InputError:
    """Build the error of a class that lacks a method which its base class leaves to it."""
    return fail(type(owner).__name__, f"a method {method} of its own, as its base class says", "none")


T = TypeVar("T", bound=type)
E = TypeVar("E")

WIDTH, LINES, DEPTH = 110, 10, 3  # characters, lines and levels of what is shown
FEW, SOME, LARGE = 4, 8, 20  # numbers of an array, items on a line, rows of a table


def readable(kind: T) -> T:
    """Give a class and its subclasses the short `repr`, the table for notebooks, and an `==` with one answer.

    A class with its own `_repr_html_` keeps it. An unknown attribute is refused with the most similar names.
    """
    if not hasattr(kind, "__getattr__"):
        kind.__getattr__ = refuse_attribute  # type: ignore[attr-defined]
    for name, method in (("__repr__", _write_repr), ("_repr_html_", _html), ("__eq__", _are_equal)):
        if name != "_repr_html_" or name not in vars(kind):
            setattr(kind, name, method)
    return kind


def _write_repr(self: object) -> str:
    """Return the object as text: one line of up to WIDTH characters, or at most LINES lines with one for each part.

    A part is an entry or a field. DEPTH: how deep parts of parts are shown.
    """
    one_line = format_on_one_line(self, DEPTH)
    if len(one_line) <= WIDTH:
        return one_line
    parts = list(_list_parts(self))
    lines = [f"  {name}={format_on_one_line(value, DEPTH - 1)}" for name, value in parts[: LINES - 2]]
    if len(parts) > len(lines):
        lines.append(f"  … {len(parts) - len(lines)} more")
    return "\n".join([f"{type(self).__name__}(", *map(cut, lines), ")"])


def _html(self: object) -> str:
    """Return an HTML table of the object's parts; a part that has parts itself can be opened in its cell."""
    return _format_table(self, DEPTH)


def _are_equal(self: object, other: object) -> bool:
    """Return whether both are of the same class and equal in every part; arrays count as a whole, NaN equals NaN.

    `are_same` goes through containers, dataclasses and arrays itself. Of any other object it would ask ==, which is
    this function: so their attributes are compared, also those in slots, as `__getstate__` lists them for a copy.
    """
    is_container = is_dataclass(self) or isinstance(self, Mapping | tuple)
    if type(self) is type(other) and not is_container:
        return are_same(self.__getstate__(), other.__getstate__())
    return are_same(self, other)


def format_on_one_line(value: object, depth: int) -> str:
    """Return any value on one line: arrays by their type and shape, containers down to `depth` levels."""
    if isinstance(value, np.ndarray | np.generic | jax.Array):
        return _format_array(value)

    def format_part(part: object) -> str:
        """Return a part of the value (an entry or a field) on one line, one level deeper."""
        return format_on_one_line(part, depth - 1)

    def format_pair(pair: tuple[object, object]) -> str:
        """Return "key: part" of a mapping."""
        key, part = pair
        return f"{key!r}: {format_part(part)}"

    def format_field(field: tuple[str, object]) -> str:
        """Return "name=part" of an object."""
        name, part = field
        return f"{name}={format_part(part)}"

    # Containers, item by item.
    if isinstance(value, Mapping) and not _is_ours(value):
        return _join_first_items("{", value.items(), len(value), depth, format_pair, "}")
    if isinstance(value, list) and not _is_ours(value):
        return _join_first_items("[", value, len(value), depth, format_part, "]")
    if isinstance(value, tuple) and not _is_ours(value):
        return _join_first_items("(", value, len(value), depth, format_part, ",)" if len(value) == 1 else ")")
    # Objects with fields.
    if _is_ours(value) or is_dataclass(value):
        parts = list(islice(_list_parts(value), LARGE))
        return _join_first_items(f"{type(value).__name__}(", parts, len(parts), depth, format_field, ")")
    if isinstance(value, partial):
        return format_on_one_line(value.func, depth)
    if callable(value):
        return str(getattr(value, "__name__", type(value).__name__))
    return " ".join(repr(value).split())


def _is_ours(value: object) -> bool:
    """Return whether an object's text is written by `_write_repr`: its class was given to `readable`."""
    return getattr(type(value), "__repr__", None) is _write_repr


def _list_parts(value: object) -> Iterable[tuple[str, object]]:
    """Return the names and values of an object's public parts: entries, fields or attributes."""
    if isinstance(value, Mapping):
        return ((repr(key), entry) for key, entry in value.items())
    if is_dataclass(value):
        attributes = ((field.name, getattr(value, field.name, None)) for field in fields(value) if field.repr)
    else:
        names = getattr(value, "_fields", getattr(value, "__dict__", {}))  # of a named tuple, or of any object
        attributes = ((name, getattr(value, name)) for name in names)
    return ((name, entry) for name, entry in attributes if not name.startswith("_"))


def _format_array(value: np.ndarray | np.generic | jax.Array) -> str:
    """Return up to FEW numbers as text; for more, traced or other ones the type and shape, such as float64[3,2]."""
    if isinstance(value, jax.core.Tracer) or value.size > FEW or value.dtype.kind not in "fiub":
        return f"{value.dtype}[{','.join(map(str, value.shape))}]"
    numbers = np.asarray(value).tolist()
    return repr(numbers) if value.dtype.kind != "f" else _round_numbers(numbers)


def _round_numbers(numbers: object) -> str:
    """Return a number, or lists of them within lists, as text with four digits each."""
    if isinstance(numbers, list):
        return f"[{', '.join(map(_round_numbers, numbers))}]"
    return f"{numbers:.4g}"


def _join_first_items(start: str, items: Iterable[E], count: int, depth: int, of: Callable[[E], str], end: str) -> str:
    """Return the first SOME items as text between `start` and `end`, and how many more of `count` there are.

    `of`: returns an item's text. At depth 0 "…" stands for all of them.
    """
    if count and depth <= 0:
        return f"{start}…{end}"
    more = [f"… {count - SOME} more"] if count > SOME else []
    return f"{start}{', '.join([*map(of, islice(items, SOME)), *more])}{end}"


def cut(text: str) -> str:
    """Return a text cut to WIDTH characters, with … at the end where it is longer."""
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 1]}…"


def _format_table(value: object, depth: int) -> str:
    """Return an object as an HTML table with a row for each part (entry or field); tables nest `depth` deep."""
    rows = [
        f"<tr><th>{escape(name)}</th><td>{_format_cell(entry, depth - 1)}</td></tr>"
        for name, entry in _list_entries(value)
    ]
    return f"<table><caption>{escape(type(value).__name__)}</caption>{''.join(rows)}</table>"


def _list_entries(value: object) -> Iterable[tuple[str, object]]:
    """Yield the first LARGE parts (entries or fields) of an object by name, and then how many more there are."""
    entries = iter(_list_parts(value))
    yield from islice(entries, LARGE)
    remaining_count = sum(1 for _ in entries)
    if remaining_count:
        yield "…", f"{remaining_count} more"


def _format_cell(value: object, depth: int) -> str:
    """Return a value as an HTML cell: a line of text, which opens to a table of its parts if it has some.

    A mapping, or an object of this library, has parts. At depth 0 the cell is text alone.
    """
    text = escape(cut(format_on_one_line(value, depth)))
    has_parts = _is_ours(value) or (isinstance(value, Mapping) and value)
    if not has_parts or depth <= 0:
        return text
    return f"<details><summary>{text}</summary>{_format_table(value, depth)}</details>"
