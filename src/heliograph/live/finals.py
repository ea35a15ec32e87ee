"""What became final and was not asked for yet."""

from collections.abc import Sequence

import jax
import numpy as np


class Finals:
    """Parts of what was told, one entry a row, in the order of time; beyond `most` rows the oldest parts go."""

    def __init__(self, most: int):
        self.most, self._parts = most, list[tuple[np.ndarray, list[np.ndarray]]]()

    def add(self, time: np.ndarray, outputs: list[np.ndarray]) -> None:
        """One part more."""
        self._parts.append((time, outputs))
        while sum(len(part) for part, _ in self._parts[1:]) >= self.most:
            del self._parts[0]

    def take(self, like: Sequence[jax.Array]) -> tuple[np.ndarray, list[np.ndarray]]:
        """All times and leaves (time, ...), which are forgotten; of the shapes that the tape has."""
        parts = [(np.zeros(0), [np.zeros((0, *leaf.shape[1:])) for leaf in like]), *self._parts]
        self._parts = []
        times, outputs = zip(*parts, strict=True)
        return np.concatenate(times), [np.concatenate(leaves) for leaves in zip(*outputs, strict=True)]
