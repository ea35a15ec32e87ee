"""Methods that cost no more than a call."""

from typing import TypeVar

T = TypeVar("T", bound=type)


def plain_methods(kind: T) -> T:
    """Let a class of modules, and those made from it, bind methods as Python does.

    Equinox makes a module of each bound method, so that transformations take one as an argument, and walks through all
    that the object holds to do so: 25 microseconds for a law, milliseconds for a large network. That is more than most
    of their methods take, which are called by the thousand and never passed to a transformation.
    """
    setattr(kind, "__getattribute__", object.__getattribute__)  # noqa: B010
    return kind
