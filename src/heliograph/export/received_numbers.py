"""The measurement z of an exported step: names of its numbers, and which values of them count as not arrived."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax


def keep_all(z: jax.Array) -> jax.Array:
    """Return a measurement as it is: no value of it is refused."""
    return z


class Received(NamedTuple):
    """What arrives at a filter, and what of it is refused.

    Args:
        names: of its numbers.
        refused: in words the values of each number that count as not arrived; () where all count.
        leave_out: returns the measurement with NaN in place of these.
        looks_for_stuck: whether readings that repeat for too long are refused too, elsewhere: a step holds no earlier
            ones, and uses them.
    """

    names: Sequence[str]
    refused: Sequence[str] = ()
    leave_out: Callable[[jax.Array], jax.Array] = keep_all
    looks_for_stuck: bool = False

    def explain(self, notes: Sequence[str]) -> list[str]:
        """Return a line for each number, with a note of another kind: "z[0]: level (not arrived: -999, below 0)"."""
        if not self.names:
            return ["z: not used"]
        refused = [f" (not arrived: {values})" if values else "" for values in self.refused or [""] * len(self.names)]
        numbered = enumerate(zip(self.names, notes, refused, strict=True))
        lines = [f"z[{i}]: {name}{note}{not_arrived}" for i, (name, note, not_arrived) in numbered]
        stuck = "Readings that repeat for too long (stuck) are used: a step holds no earlier ones."
        return [*lines, stuck] if self.looks_for_stuck else lines
