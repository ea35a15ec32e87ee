"""The states of all plants in one table, and the steps between rows: due rows are stepped for all plants at once."""

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple, TypeAlias

import numpy as np

from heliograph.live.long_gap import LONG, TAIL, find_factor_indices, pass_long_gap
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.sorted_rows import HeldRow
from heliograph.numerics.types import Float, PyTree

FEWEST = 1024  # rows of the table at first; it doubles when it is full
SHORTEST = 64  # rows of a history


class StateTable:
    """Table of states: a slot is a row of it, which is taken and given back.

    The columns are (state, outputs, inputs held, step number, received, inputs, time); `state`, `outputs`, `held` and
    `at` are the slices of the first four, `numbers` that of the last three, which a `HeldRow` has as well.
    `alone`: single rows are stepped, not many at once.
    """

    def __init__(self, program: NetworkProgram, alone: bool = False):
        """Make a table with FEWEST free slots for rows of a network's program.

        `alone`: rows are stepped one by one, not those of many plants at once. These slices of a row's columns follow
        one another: `state` (of the filters), `outputs`, `held` (inputs that hold after the row), `at` (step number),
        and `numbers` (what came: measurements, inputs, and time as the last).
        """
        self.program, self.step_rows, self._alone = program, program.step_rows, alone
        sizes = self.step_rows.state.size, self.step_rows.outputs.size
        ends = np.cumsum([*sizes, program.given, 1, program.received + program.given + 1])
        self.state, self.outputs, self.held, self.at, self.numbers = (
            slice(int(begin), int(end)) for begin, end in zip([0, *ends], ends, strict=False)
        )
        self.table = np.zeros((FEWEST, int(ends[-1])))
        self._free = list(range(FEWEST - 1, -1, -1))

    @cached_property
    def _step_single_row(self) -> Callable[..., np.ndarray]:
        """Return the step of one row at a time, with memory of this table's own."""
        return self.step_rows.for_one()

    @property
    def used(self) -> int:
        """Return how many slots are taken."""
        return len(self.table) - len(self._free)

    def take_slot(self) -> int:
        """Return a free slot (row number of the table), which is then taken."""
        if not self._free:
            # Double the table; the new slots are free, and the lowest is taken first.
            count = len(self.table)
            self.table = np.concatenate([self.table, np.zeros_like(self.table)])
            self._free = list(range(2 * count - 1, count - 1, -1))
        return self._free.pop()

    def free_slots(self, slots: list[int]) -> None:
        """Give slots back."""
        self._free += slots

    def write_prior(self, slot: int, time: float) -> None:
        """Fill a slot with the prior, at `time`, before any measurement.

        A row has columns of the state (here the initial law), the outputs (0), the step number `at` (-1, before the
        first step) and the `numbers` received (NaN for none), of which the last is the row's time.
        """
        row = self.table[slot]
        row[:] = 0.0
        step_before_all = -1.0
        row[self.state], row[self.at], row[self.numbers] = self.step_rows.start, step_before_all, np.nan
        row[-1] = time

    def predict_outputs(self, before: np.ndarray, given: np.ndarray, last: float) -> np.ndarray:
        """Return the outputs (row, outputs) predicted from the rows in the slots `before`, without measurements.

        The prediction covers one step, or one unit of continuous time. An input that is NaN keeps its value. The step
        number is at most `last`, the last step for which the network is defined.
        """
        dt, table = self.program.dt, self.table
        u = np.where(np.isnan(given), table[before, self.held], given)  # held: the inputs that hold after a row
        if dt is not None:
            u = _insert_time_step(u, dt, np.ones(len(u)))
        k = np.minimum(table[before, self.at.start] + 1, last)
        nothing = np.full((len(before), self.program.received), np.nan)
        state_and_outputs = self._step_parts(table[before, self.state], nothing, u, k[:, None])
        return state_and_outputs[:, self.step_rows.state.size :].copy()

    def step_slots_in_place(self, before: np.ndarray, after: np.ndarray, at: np.ndarray) -> None:
        """Step from the rows in the slots `before` into those in `after`; `at`: the step number in discrete time.

        In discrete time a row is reached by as many steps as lie between it and the row before; its measurement is
        received at the last of these.
        """
        dt, table = self.program.dt, self.table
        numbers, held = table[after, self.numbers], table[before, self.held]
        received, given = numbers[:, : self.program.received], numbers[:, self.program.received : -1]
        now_held = np.where(np.isnan(given), held, given)
        if dt is None:
            # On the way to a row nothing is received, and the inputs are those of before.
            arrives = (at == numbers[:, -1])[:, None]  # the row's own step, not one on the way
            received, u = np.where(arrives, received, np.nan), np.where(arrives, now_held, held)
            now_held, k = u, at
        else:
            # Inputs given with a row hold from there on: those of before led to it.
            u = _insert_time_step(held, dt, numbers[:, -1] - table[before, -1])
            k = table[before, self.at.start] + 1
        state_and_outputs = self._step_parts(table[before, self.state], received, u, k[:, None])
        table[after, : self.outputs.stop] = state_and_outputs
        table[after, self.held], table[after, self.at.start] = now_held, k

    def _step_parts(self, *parts: np.ndarray) -> np.ndarray:
        """Step rows, and return their new states and outputs in one array (row, state + outputs).

        `parts` are the arrays (row, ...) of the rows' states, measurements, inputs and step numbers. A single row may
        be stepped by code of its own: then the next call overwrites the result.
        """
        if len(parts[0]) == 1 and (self._alone or self.step_rows.is_native):
            return self._step_single_row(*parts)
        return self.step_rows(np.concatenate(parts, axis=1))

    def inputs_between(self, before: int, after: int) -> tuple[Float[np.ndarray, " inputs"], int]:
        """Return the inputs that led from the row in slot `before` to that in `after`, and the step number of `after`.

        If time counts steps, they are the inputs in the columns `held` of `after`. In continuous time they are those of
        `before`, since inputs hold from their row on, with dt inserted, the time between both rows. `at` is the column
        of the step number, and the last of the columns `numbers` holds the time.
        """
        dt, table = self.program.dt, self.table
        step_number = int(table[after, self.at.start])
        if dt is None:
            return table[after, self.held], step_number
        time_column = self.numbers.stop - 1
        time_between = table[[after], time_column] - table[[before], time_column]
        u_without_dt = table[before, self.held]
        return _insert_time_step(u_without_dt[None], dt, time_between)[0], step_number

    def pass_long_gap(self, slot: int, to: int) -> None:
        """Predict the row in a slot, in place, to step number `to` without measurements, in bounded work.

        Its latest inputs go on. `self.at`, `self.held`, `self.state`: a row's columns of step number, inputs and state.
        """
        row = self.table[slot]
        at, inputs = int(row[self.at.start]), row[self.held]
        nothing = np.full(self.program.received, np.nan)

        def step(states: Float[np.ndarray, "row state"], k: int) -> Float[np.ndarray, "row state"]:
            """Return the states (row, state) after step number k, without measurements and with the same `inputs`."""
            same_for_all = np.concatenate([nothing, inputs, [k]])
            rows = np.broadcast_to(same_for_all, (len(states), len(same_for_all)))
            return self._step_parts(states, rows)[:, : self.step_rows.state.size].copy()

        state = self.step_rows.state
        column_numbers = np.arange(float(state.size))
        factors = find_factor_indices(state.tree(column_numbers))  # of factors of covariances, which are not affine
        state_before = row[self.state].copy()
        state_after = pass_long_gap(step, self.step_rows.start, state_before, at, count=to - at, factors=factors)
        self.table[slot, self.state], self.table[slot, self.at.start] = state_after, to

    def gather_history(self, slots: Sequence[int]) -> PyTree:
        """Return the rows in these slots (row numbers of the table), in order, as a smoother takes them.

        Copies of the last row are appended until the number is a power of two and at least SHORTEST. The smoother is
        then compiled for few lengths only.
        """
        length = max(SHORTEST, 1 << (len(slots) - 1).bit_length())  # the next power of two
        rows = self.table[[*slots, *[slots[-1]] * (length - len(slots))]]
        state, outputs = rows[:, self.state], rows[:, self.outputs]
        return self.step_rows.history(rows[:, self.numbers], state, rows[:, self.held], rows[:, self.at.start], outputs)


def _insert_time_step(u: Float[np.ndarray, "row given"], dt: int, steps: Float[np.ndarray, " row"]) -> np.ndarray:
    """Insert the time steps among the inputs, as number `dt`."""
    return np.concatenate([u[:, :dt], steps[:, None], u[:, dt:]], axis=1)


Single: TypeAlias = tuple[int, int, float]  # a step: slot to step from, slot to step into, number


class ChainLeg(NamedTuple):
    """Steps of a chain one by one, and the step number to which the last row is then taken at once; 0 if to none."""

    steps: list[Single]
    jump: int = 0


def cut_chain_into_legs(chain: list[HeldRow], by_steps: bool, endless: bool) -> list[ChainLeg]:
    """Return the steps along a chain of rows, cut into legs where a gap is too long to step through one by one.

    A step is (slot of the row before, slot of the row, step number). In a gap of over LONG steps the first step
    makes the new row; its state is then predicted over the gap at once, to step number `jump`, TAIL steps before its
    time. These last steps, one by one, begin the next leg.

    Args:
        chain: rows, of which each is stepped into from the one before it.
        by_steps: whether time counts steps.
        endless: whether the network is defined for all steps, so that silent steps are alike.
    """
    legs = [ChainLeg([])]
    for row, next_row in pairwise(chain):
        begin, last, before = int(row.key[0]) + 1, next_row.key[0], row.slot
        numbers: Sequence[float] = range(begin, int(last) + 1) if by_steps else (last,)
        if len(numbers) > LONG and endless:
            legs[-1] = ChainLeg([*legs[-1].steps, (before, next_row.slot, begin)], jump=int(last) - TAIL)
            legs.append(ChainLeg([]))
            before, numbers = next_row.slot, range(int(last) - TAIL + 1, int(last) + 1)
        for at in numbers:
            legs[-1].steps.append((before, next_row.slot, at))
            before = next_row.slot
    return legs


def group_by_turn(walks: Iterable[list[Single]]) -> list[list[Single]]:
    """Return groups: the first steps of all walks, then the second steps of walks with at least two, and so on."""
    turns: list[list[Single]] = []
    for steps in walks:
        for turn, step in enumerate(steps):
            if turn == len(turns):
                turns.append([])
            turns[turn].append(step)
    return turns
