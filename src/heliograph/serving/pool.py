"""Table of the rows of all plants: received measurements, the filters' states after them, and their outputs."""

import numpy as np

from heliograph.serving.lanes import Lanes

FEWEST = 1024  # rows of the table at first; it doubles when it is full


class Pool:
    """Table with one row per slot; slots are taken and given back.

    The columns are (state, outputs, inputs held, step number, received, inputs, time). `numbers` is the slice of the
    last three, as in the rows of a timeline.
    """

    def __init__(self, lanes: Lanes):
        self.lanes = lanes
        ends = np.cumsum([lanes.state.size, lanes.outputs.size, lanes.given, 1, lanes.received + lanes.given + 1])
        self.state, self.outputs, self.held, self.at, self.numbers = (
            slice(int(begin), int(end)) for begin, end in zip([0, *ends], ends, strict=False)
        )
        self.table = np.zeros((FEWEST, int(ends[-1])))
        self._free = list(range(FEWEST - 1, -1, -1))

    @property
    def used(self) -> int:
        """Return how many slots are taken."""
        return len(self.table) - len(self._free)

    def take(self) -> int:
        """Take a free slot."""
        if not self._free:
            count = len(self.table)
            self.table = np.concatenate([self.table, np.zeros_like(self.table)])
            self._free = list(range(2 * count - 1, count - 1, -1))
        return self._free.pop()

    def give(self, slots: list[int]) -> None:
        """Give slots back."""
        self._free += slots

    def start(self, slot: int, time: float) -> None:
        """Fill a slot with the prior, at `time`, before any measurement."""
        row = self.table[slot]
        row[:] = 0.0
        row[self.state], row[self.at], row[self.numbers] = self.lanes.start, -1.0, np.nan
        row[-1] = time

    def trial(self, before: np.ndarray, given: np.ndarray, last: float) -> np.ndarray:
        """Predict from the rows in these slots, with these inputs and no measurement; return the outputs.

        The prediction covers one step, or one unit of continuous time. An input that is NaN keeps its value. The step
        number is at most `last`.
        """
        lanes, table = self.lanes, self.table
        u = np.where(np.isnan(given), table[before, self.held], given)
        u = u if lanes.dt is None else np.insert(u, lanes.dt, 1.0, axis=1)
        k = np.minimum(table[before, self.at.start] + 1, last)
        nothing = np.full((len(before), lanes.received), np.nan)
        done = lanes.step(np.concatenate([table[before, self.state], nothing, u, k[:, None]], axis=1))
        return done[:, lanes.state.size :]

    def step(self, before: np.ndarray, after: np.ndarray, at: np.ndarray) -> None:
        """Step from the rows in the slots `before` into those in `after`; `at`: the step number in discrete time.

        In discrete time a row is reached by as many steps as lie between it and the row before; its measurement is
        received at the last of these.
        """
        lanes, table = self.lanes, self.table
        numbers, held = table[after, self.numbers], table[before, self.held]
        received, given = numbers[:, : lanes.received], numbers[:, lanes.received : -1]
        now_held = np.where(np.isnan(given), held, given)
        if lanes.dt is None:
            there = (at == numbers[:, -1])[:, None]
            received, u = np.where(there, received, np.nan), np.where(there, now_held, held)
            now_held, k = u, at
        else:
            u = np.insert(held, lanes.dt, numbers[:, -1] - table[before, -1], axis=1)
            k = table[before, self.at.start] + 1
        done = lanes.step(np.concatenate([table[before, self.state], received, u, k[:, None]], axis=1))
        table[after, : self.outputs.stop] = done
        table[after, self.held], table[after, self.at.start] = now_held, k
