"""Filters of messages that tell numbers of their link, as rooms of design see them."""

from typing import Protocol, runtime_checkable

import jax

from heliograph.filters.base import AbstractFilter


@runtime_checkable
class TellsNumbers(Protocol):
    """A filter of messages that tell numbers of their link's law, such as `linear_filter` behind `hop(known=True)`.

    Args:
        numbers: their rows in what is received.
    """

    numbers: tuple[int, ...]

    def draw_numbers(self, key: jax.Array, k: jax.Array | int = 0) -> jax.Array:
        """Draw what a message tells at step k."""

    def with_numbers(self, z: jax.Array, numbers: jax.Array) -> jax.Array:
        """Return a message with these numbers in the place of its own."""


def find_told_filter(filter: AbstractFilter) -> TellsNumbers | None:
    """Return the filter that reads told numbers, which is `filter` or a filter inside it, or None.

    An outer filter, such as one with limits of states, leaves messages as they are.
    """
    while not isinstance(filter, TellsNumbers) and isinstance(within := getattr(filter, "base", None), AbstractFilter):
        filter = within
    return filter if isinstance(filter, TellsNumbers) else None
