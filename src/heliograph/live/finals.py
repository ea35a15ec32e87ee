"""Queue of final estimates that have not been collected yet."""

from collections.abc import Sequence

import jax
import numpy as np


class Finals:
    """Final outputs, one entry a row, in order of time; beyond `most` rows the oldest parts are dropped."""

    def __init__(self, most: int):
        self.most, self._parts = most, list[tuple[np.ndarray, list[np.ndarray]]]()

    def add(self, time: np.ndarray, outputs: list[np.ndarray]) -> None:
        """Append the outputs of some rows."""
        self._parts.append((time, outputs))
        while sum(len(part) for part, _ in self._parts[1:]) >= self.most:
            del self._parts[0]

    def take(self, like: Sequence[jax.Array]) -> tuple[np.ndarray, list[np.ndarray]]:
        """Remove and return all times and leaves (time, ...), of the shapes that the history has."""
        parts = [(np.zeros(0), [np.zeros((0, *leaf.shape[1:])) for leaf in like]), *self._parts]
        self._parts = []
        times, outputs = zip(*parts, strict=True)
        return np.concatenate(times), [np.concatenate(leaves) for leaves in zip(*outputs, strict=True)]
