"""Filters of messages that tell numbers of their link, as rooms of design see them."""

from typing import Protocol, runtime_checkable

import jax


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
