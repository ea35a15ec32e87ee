"""Settings of a study: their numbers by dotted name, other numbers in their place, and where two settings differ."""

import hashlib
import json
import pickle
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from heliograph.numerics.check import check_count, check_seed, fail, scalar

S = TypeVar("S")
Plain = bool | int | float | str


class File(str):
    """The path of a file, empty where there is none: a setting that is shown by its name and known by what it holds."""

    __slots__ = ()


NO_FILE = File()


def check_fields(setting: Any, **limits: int | tuple[float, ...]) -> None:
    """Check a setting's `seed` and fields: whole numbers of at least so many, numbers from the first to the second.

    Raises:
        ValueError: one that is not.
    """
    for name, limit in limits.items():
        for value in np.ravel(getattr(setting, name)).tolist():
            if isinstance(limit, int):
                check_count(name, value, limit)
            else:
                scalar(name, value, *limit)
    if hasattr(setting, "seed"):
        seed, seeds = check_seed("seed", setting.seed), getattr(setting, "seeds", 1)
        check_seed(f"last of {seeds} seeds", seed + seeds - 1)


def leaves(setting: object, name: str = "") -> Iterator[tuple[str, Any]]:
    """Everything that a setting is made of, by dotted name: fields of dataclasses, and what mappings hold."""
    parts: Mapping[str, object] | None = None
    if is_dataclass(setting) and not isinstance(setting, type):
        parts = {field.name: getattr(setting, field.name) for field in fields(setting)}
    elif isinstance(setting, Mapping):
        parts = {str(key): value for key, value in setting.items()}
    if parts is None:
        yield name, setting
        return
    for part, value in parts.items():
        yield from leaves(value, f"{name}.{part}" if name else part)


def with_values(setting: S, values: Mapping[str, str]) -> S:
    """The setting with other numbers, each given as text by its dotted name, as `noise.mean`.

    Numbers in a row are separated by commas. What is no number is set in Python.

    Raises:
        ValueError: an unknown name, text that is not of the kind of the value that it replaces, a value out of range.
    """
    for name, text in values.items():
        setting = _replaced(setting, name.split("."), name, text, [name for name, _ in leaves(setting)])
    return setting


def _replaced(part: Any, path: list[str], name: str, text: str, known: list[str]) -> Any:
    if not path:
        return _read(part, name, text)
    first, rest = path[0], path[1:]
    if isinstance(part, Mapping) and first in part:
        return {**part, first: _replaced(part[first], rest, name, text, known)}
    if not is_dataclass(part) or first not in {field.name for field in fields(part)}:
        raise fail("--set", f"one of {', '.join(known)}", repr(name))
    value = _replaced(getattr(part, first), rest, name, text, known)
    try:
        return replace(part, **{first: value})  # type: ignore[type-var]
    except TypeError:  # an object of the library, which is made of other arguments than it holds
        raise fail(f"--set {name}", f"a {type(part).__name__} that is set in Python", repr(text)) from None


def _read(now: object, name: str, text: str) -> object:
    """Text as a value of the kind of the present one."""
    if isinstance(now, str):
        return type(now)(text)
    if isinstance(now, bool):
        if text not in ("true", "false"):
            raise fail(f"--set {name}", "true or false", repr(text))
        return text == "true"
    if isinstance(now, int | float):
        return _number(text, name, type(now))
    numbers = np.asarray(now) if isinstance(now, tuple | np.ndarray) else np.asarray(None)
    if numbers.dtype.kind in "if":
        return _row(numbers, name, text, isinstance(now, tuple))
    raise fail(f"--set {name}", "a number; what is none is set in Python", repr(text))


def _row(now: np.ndarray, name: str, text: str, as_tuple: bool) -> object:
    """As many numbers as there are now, in their shape."""
    try:
        numbers = np.array([_number(part, name, int if now.dtype.kind == "i" else float) for part in text.split(",")])
    except ValueError:
        numbers = np.zeros(0)
    if numbers.size != now.size:
        raise fail(f"--set {name}", f"{now.size} numbers separated by commas", repr(text))
    shaped = numbers.reshape(now.shape)
    if not as_tuple:
        return shaped
    return tuple(shaped.tolist()) if now.ndim == 1 else tuple(map(tuple, shaped.tolist()))


def _number(text: str, name: str, kind: type) -> int | float:
    try:
        return int(text) if kind is int else float(text)
    except ValueError:
        raise fail(f"--set {name}", "a whole number" if kind is int else "a number", repr(text)) from None


def differences(setting: object, published: object) -> dict[str, tuple[str, str]]:
    """Where two settings of a study differ: as published and as it is here, by dotted name."""
    before, now = dict(leaves(published)), dict(leaves(setting))
    names = [name for name in {**before, **now} if _bytes(before.get(name)) != _bytes(now.get(name))]
    return {name: (_shown(before.get(name)), _shown(now.get(name))) for name in names}


def digest(setting: object) -> str | None:
    """A word that two settings share only if they are alike; None where that cannot be said of a function in it."""
    try:
        parts = [name.encode() + b"=" + _bytes(value) for name, value in leaves(setting)]
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return hashlib.sha256(b"\0".join(parts)).hexdigest()


def content(path: Path) -> bytes:
    """What tells a file from others: a digest of what it holds, nothing where there is none."""
    return hashlib.sha256(path.read_bytes()).digest() if path.is_file() else b""


def _bytes(value: object) -> bytes:
    if isinstance(value, File):
        return repr(value).encode() + content(Path(value))
    if value is None or isinstance(value, Plain):
        return repr(value).encode()
    if isinstance(value, np.ndarray) and value.dtype != object:
        return f"{value.dtype} {value.shape} ".encode() + value.tobytes()
    return pickle.dumps(value)


def _shown(value: object) -> str:
    """A value in a table: numbers as they are, of anything else what it is."""
    if value is None:
        return "–"
    if isinstance(value, File):
        return Path(value).name or "–"
    if isinstance(value, Plain):
        return f"{value:g}" if isinstance(value, float) else str(value)
    numbers = np.asarray(value) if isinstance(value, tuple | list | np.ndarray) else None
    if numbers is not None and numbers.dtype.kind in "if" and numbers.size <= 9:
        return json.dumps(numbers.tolist())
    return type(value).__name__
