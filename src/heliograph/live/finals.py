"""Queue of final estimates that have not been collected yet."""

import numpy as np

from heliograph.numerics.types import Float


class Finals:
    """Rows of final outputs, of `size` numbers, in order of time; beyond `most` rows the oldest parts are dropped."""

    def __init__(self, most: int, size: int):
        self.most, self.size, self._parts = most, size, list[tuple[np.ndarray, np.ndarray]]()

    def add(self, time: np.ndarray, rows: Float[np.ndarray, "row output"]) -> None:
        """Append the outputs of some rows."""
        self._parts.append((time, rows))
        while sum(len(part) for part, _ in self._parts[1:]) >= self.most:
            del self._parts[0]

    def take(self) -> tuple[np.ndarray, Float[np.ndarray, "row output"]]:
        """Remove and return all times and rows."""
        times, rows = zip((np.zeros(0), np.zeros((0, self.size))), *self._parts, strict=True)
        self._parts = []
        return np.concatenate(times), np.concatenate(rows)
