"""Public names of a package, loaded when first used; where there is none of a name, the ones most like it."""

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from importlib import import_module
from importlib.util import find_spec
from typing import NoReturn

import lazy_loader

from heliograph.numerics.process.garbage_collector import pause_collector

MOST = 3  # names that are offered
ALIKE = 0.7  # as difflib measures it, so that neess offers nees and foo nothing
MEANT = {  # what others call it, in plain letters
    "kf": "kalmanfilter", "ekf": "extendedfilter", "ckf": "cubaturefilter", "ukf": "unscentedfilter",
    "filter": "kalmanfilter", "batch": "run", "batchfilter": "run", "update": "push", "x": "means", "p": "covariances",
    "f": "matrix", "h": "matrix", "q": "noise", "r": "noise",
    "dare": "steadystate", "dlqe": "steadystate", "readcsv": "readrecording", "smooth": "rtssmoother",
}  # fmt: skip


def lazy_names(package: str, file: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package whose stub (.pyi) lists its public names.

    A name's module is imported when the name is first asked for.
    """
    load, list_names, names = lazy_loader.attach_stub(package, file)

    def load_attribute(name: str) -> object:
        """Return the object of a public name, importing it; raise AttributeError, with similar names, for others."""
        if name in names or name.startswith("_"):
            with pause_collector():
                return load(name)
        raise AttributeError(f"{package} has no attribute {name!r}{suggest_names(name, _list_public(package, names))}")

    return load_attribute, list_names, names


def refuse_attribute(owner: object, name: str, remedies: Mapping[str, str] | None = None) -> NoReturn:
    """Raise AttributeError for a name that an object does not have, with what to write instead.

    That is the entry of `remedies` for the name, or else the most similar attributes, or else the function of
    heliograph of this name.
    """
    kind = type(owner)
    if name.startswith("_") or hasattr(kind, name):  # a private name, or a property that raised an AttributeError
        object.__getattribute__(owner, name)
    public = {other: other for other in object.__dir__(owner) if not other.startswith("_")}
    remedy = suggest_names(name, public)
    if not remedy and name in import_module("heliograph").__all__:
        remedy = f"; write hg.{name}(...)"
    if remedies and name in remedies:
        remedy = f"; write {remedies[name]}"
    raise AttributeError(f"{kind.__name__} has no attribute {name!r}{remedy}")


def suggest_names(name: str, known: Mapping[str, str]) -> str:
    """Return the end of a message that offers the known names most like one that does not exist."""
    near = list_closest_names(name, known)
    return f"; closest: {', '.join(near)}" if near else ""


def list_closest_names(name: str, known: Mapping[str, str]) -> list[str]:
    """Return the values of the `known` names most similar to a name, at most MOST; capitals and _ do not count.

    First comes the name that others use for it (MEANT), then names with similar letters (of a likeness of difflib of at
    least ALIKE), and then names that contain it.
    """
    by_stripped_name: dict[str, str] = {}
    for public_name, shown_name in known.items():
        by_stripped_name.setdefault(_strip_name(public_name), shown_name)
    stripped = _strip_name(name)
    synonyms = [candidate for candidate in by_stripped_name if candidate == MEANT.get(stripped)]
    alike = get_close_matches(stripped, by_stripped_name, n=MOST, cutoff=ALIKE)
    containing = []  # as kalman_filter contains kalman
    if len(name) > 2:  # one or two letters are in many names
        containing = [candidate for candidate in by_stripped_name if stripped in candidate]
    each_once = dict.fromkeys([*synonyms, *alike, *containing])
    return [by_stripped_name[candidate] for candidate in each_once][:MOST]


def _strip_name(name: str) -> str:
    """Return a name in small letters without underscores."""
    return name.lower().replace("_", "")


def _list_public(package: str, names: list[str]) -> dict[str, str]:
    """Return public names that a user may have meant, each with how it is written: the package's own `names` first.

    For heliograph itself (without a dot), the names of its rooms (subpackages) follow as room.name. For a room, those
    of heliograph follow.
    """
    known = {name: name for name in names}
    if "." in package:
        known |= {name: f"heliograph.{name}" for name in import_module("heliograph").__all__ if name not in known}
    else:
        for room in names:
            public = getattr(import_module(f"{package}.{room}"), "__all__", []) if _is_room(package, room) else []
            known |= {name: f"{room}.{name}" for name in public if name not in known}
    return known


def _is_room(package: str, name: str) -> bool:
    """Return whether a public name is that of a folder or file of the package."""
    return find_spec(f"{package}.{name}") is not None
