"""Filters of messages that report numbers of their link, such as its gain, as learning and design see them."""

from typing import Protocol, runtime_checkable

import jax

from heliograph.filters.base import AbstractFilter


@runtime_checkable
class TellsNumbers(Protocol):
    """A filter of messages that report their link's gain or noise variance, as behind `hop(known=True)`.

    Args:
        numbers: rows of the reported numbers in a message (received,).
    """

    numbers: tuple[int, ...]

    def draw_numbers(self, key: jax.Array, k: jax.Array | int = 0) -> jax.Array:
        """Draw the numbers that a message reports at step k from their law."""

    def with_numbers(self, z: jax.Array, numbers: jax.Array) -> jax.Array:
        """Return the message z (received,) with these numbers in place of its own reported ones."""


def find_told_filter(filter: AbstractFilter) -> TellsNumbers | None:
    """Return the filter that reads gains or noise variances reported with messages: `filter`, one inside it, or None.

    An outer filter, such as one with limits of states, leaves messages as they are.
    """
    while not isinstance(filter, TellsNumbers) and isinstance(within := getattr(filter, "base", None), AbstractFilter):
        filter = within
    return filter if isinstance(filter, TellsNumbers) else None
