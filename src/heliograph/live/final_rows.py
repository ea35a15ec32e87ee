"""Outputs of rows that are final, held until they are read, and counts of what filters left out in them."""

from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from heliograph.numerics.types import Float
from heliograph.simulation.rows.output_columns import FilterColumns


class FinalRows:
    """Outputs of final rows, `size` numbers each, in order of time; beyond `most` rows the oldest parts are dropped."""

    def __init__(self, most: int, size: int):
        """Begin without rows.

        Args:
            most: so many of the newest rows are kept at least.
            size: how many numbers a row has.
        """
        self.most, self.size = most, size
        self._parts = deque[tuple[np.ndarray, np.ndarray]]()  # times and outputs of each call of `add`
        self._count = 0  # rows of all parts

    def add(self, time: np.ndarray, rows: Float[np.ndarray, "row output"]) -> None:
        """Append rows: their times (row,) and outputs (row, output).

        The rows of the oldest calls are dropped while those of the other calls are at least `most`.
        """
        self._parts.append((time, rows))
        self._count += len(time)
        oldest_times, _ = self._parts[0]
        while self._count - len(oldest_times) >= self.most:
            self._parts.popleft()
            self._count -= len(oldest_times)
            oldest_times, _ = self._parts[0]

    def take_all(self) -> tuple[np.ndarray, Float[np.ndarray, "row output"]]:
        """Remove all rows; return their times (row,) and outputs (row, output), the oldest first."""
        no_rows = np.zeros(0), np.zeros((0, self.size))  # np.concatenate needs at least one array
        times, rows = zip(no_rows, *self._parts, strict=True)
        self._parts.clear()
        self._count = 0
        return np.concatenate(times), np.concatenate(rows)


class GateCounts:
    """Counts of the values that filters left out of rows, by node and filter that weighs what arrives."""

    def __init__(self, filters: Iterable[FilterColumns]):
        """Begin with counts of 0 for each filter that weighs values; note the columns of its weights in a row.

        A weight of 0 means that the filter left the value out, as too far from what it expected (a gate).
        """
        self._columns = {(f.node, f.filter): list(f.weighed.weight) for f in filters if f.weighed is not None}
        self.counts = dict.fromkeys(self._columns, 0)

    def count_weights_of_zero(self, rows: Float[np.ndarray, "row output"]) -> None:
        """Add the weights of 0 in some rows' outputs to the counts; a value that did not arrive has weight NaN."""
        for name, columns in self._columns.items():
            self.counts[name] += int(np.count_nonzero(rows[:, columns] == 0))

    def pack(self) -> list[tuple[str, str, int]]:
        """Return the counts as (node, filter, number), as they are saved."""
        return [(*name, count) for name, count in self.counts.items()]

    def unpack(self, stored: Sequence[tuple[str, str, int]]) -> None:
        """Restore counts that `pack` returned; those of filters that are not here any more are left out."""
        self.counts |= {(node, name): count for node, name, count in stored if (node, name) in self.counts}
