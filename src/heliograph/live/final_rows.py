"""Outputs of rows that are final, held until they are read."""

from collections import deque

import numpy as np

from heliograph.numerics.types import Float


class FinalRows:
    """Outputs of final rows, `size` numbers each, in order of time; beyond `most` rows the oldest parts are dropped."""

    def __init__(self, most: int, size: int):
        self.most, self.size, self._parts = most, size, deque[tuple[np.ndarray, np.ndarray]]()
        self._count = 0  # rows of all parts

    def add(self, time: np.ndarray, rows: Float[np.ndarray, "row output"]) -> None:
        """Append the outputs of some rows."""
        self._parts.append((time, rows))
        self._count += len(time)
        while self._count - len(self._parts[0][0]) >= self.most:
            self._count -= len(self._parts.popleft()[0])

    def take(self) -> tuple[np.ndarray, Float[np.ndarray, "row output"]]:
        """Remove and return all times and rows."""
        times, rows = zip((np.zeros(0), np.zeros((0, self.size))), *self._parts, strict=True)
        self._parts.clear()
        self._count = 0
        return np.concatenate(times), np.concatenate(rows)
