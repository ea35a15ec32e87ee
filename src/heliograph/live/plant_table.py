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

    The columns are (state, outputs, inputs held, step number, received, inputs, time); `state`, `outputs`,
    `held_inputs` and `step_number` are the slices of the first four, `numbers` that of the last three, which a
    `HeldRow` has as well.
    `alone`: single rows are stepped, not many at once.
    """

    def __init__(self, program: NetworkProgram, alone: bool = False):
        """Make a table with FEWEST free slots for rows of a network's program.

        These slices of a row's columns follow one another: `state` (of the filters), `outputs` (their estimates),
        `held_inputs` (inputs that hold after the row), `step_number`, and `numbers` (what came: measurements, inputs,
        and time as the last).

        Args:
            program: the network's step on rows.
            alone: rows are stepped one by one, not those of many plants at once.
        """
        self.program, self.step_rows, self._alone = program, program.step_rows, alone
        sizes = [
            self.step_rows.state.size,
            self.step_rows.outputs.size,
            program.given,
            1,
            program.received + program.given + 1,
        ]
        ends = np.cumsum(sizes)
        self.state, self.outputs, self.held_inputs, self.step_number, self.numbers = (
            slice(int(end) - size, int(end)) for size, end in zip(sizes, ends, strict=True)
        )
        self.table = np.zeros((FEWEST, int(ends[-1])))
        self._free = list(range(FEWEST - 1, -1, -1))  # slots; the last is taken first

    @cached_property
    def _step_single_row(self) -> Callable[..., np.ndarray]:
        """Return a function that steps one row at a time; its result lies in memory that the next call overwrites."""
        return self.step_rows.for_one()

    @property
    def used(self) -> int:
        """Return how many slots (lines of the table) are taken."""
        return len(self.table) - len(self._free)

    def take_slot(self) -> int:
        """Take a free slot (line of the table), and return its number."""
        if not self._free:
            # Double the table; the new slots are free, and the lowest is taken first.
            count = len(self.table)
            self.table = np.concatenate([self.table, np.zeros_like(self.table)])
            self._free = list(range(2 * count - 1, count - 1, -1))
        return self._free.pop()

    def free_slots(self, slots: list[int]) -> None:
        """Give slots back, to be taken again."""
        self._free += slots

    def write_prior(self, slot: int, time: float) -> None:
        """Fill a slot with the filters' initial law, at `time`, before any measurement.

        The outputs and inputs are 0, the step number is -1, and the numbers received are NaN, for none; the last of
        these is the row's time.
        """
        row = self.table[slot]
        row[:] = 0.0
        step_before_all = -1.0
        row[self.state], row[self.step_number], row[self.numbers] = self.step_rows.start, step_before_all, np.nan
        row[-1] = time

    def predict_outputs(self, before: np.ndarray, given: np.ndarray, last: float) -> np.ndarray:
        """Return the outputs (row, outputs) predicted from rows, without measurements.

        The prediction covers one step, or one unit of continuous time.

        Args:
            before: slots of the rows.
            given: inputs over that time, (row, inputs); one that is NaN keeps its value.
            last: the last step for which the network is defined: the step number is at most this.
        """
        dt, table = self.program.dt, self.table
        u = np.where(np.isnan(given), table[before, self.held_inputs], given)
        if dt is not None:
            u = _insert_time_step(u, dt, np.ones(len(u)))
        k = np.minimum(table[before, self.step_number.start] + 1, last)
        nothing = np.full((len(before), self.program.received), np.nan)
        state_and_outputs = self._step_parts(table[before, self.state], nothing, u, k[:, None])
        return state_and_outputs[:, self.step_rows.state.size :].copy()

    def step_slots_in_place(self, before: np.ndarray, after: np.ndarray, at: np.ndarray) -> None:
        """Step from the rows in the slots `before` into those in `after`: a slot of each for every step.

        If time counts steps, a row is reached by as many steps as lie between it and the row before; its measurement is
        received at the last of these. `at` are the numbers of these steps; in continuous time they are not used.
        """
        dt, table = self.program.dt, self.table
        numbers, held = table[after, self.numbers], table[before, self.held_inputs]
        # The numbers of a row are [measurements, inputs, time]. An input that did not come keeps its value.
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
            k = table[before, self.step_number.start] + 1
        state_and_outputs = self._step_parts(table[before, self.state], received, u, k[:, None])
        table[after, : self.outputs.stop] = state_and_outputs
        table[after, self.held_inputs], table[after, self.step_number.start] = now_held, k

    def _step_parts(self, *parts: np.ndarray) -> np.ndarray:
        """Step rows, and return their new states and outputs in one array (row, state + outputs).

        `parts` are arrays (row, columns) which side by side hold, for each row: state, measurements z, inputs u, and
        step number k. A single row may be stepped by code of its own: then the next call overwrites the result.
        """
        if len(parts[0]) == 1 and (self._alone or self.step_rows.is_native):
            return self._step_single_row(*parts)
        return self.step_rows(np.concatenate(parts, axis=1))

    def inputs_between(self, before: int, after: int) -> tuple[Float[np.ndarray, " inputs"], int]:
        """Return the inputs u that led from the row in slot `before` to that in slot `after`, and the latter's step.

        If time counts steps, inputs are given for the step that leads to their row: those of `after` led to it. In
        continuous time inputs hold from their row on: those of `before` led to `after`, with the input dt, the time
        between both rows.
        """
        dt, table = self.program.dt, self.table
        step_number = int(table[after, self.step_number.start])
        if dt is None:
            return table[after, self.held_inputs], step_number
        time_column = self.numbers.stop - 1
        time_between = table[[after], time_column] - table[[before], time_column]
        u_without_dt = table[before, self.held_inputs]
        return _insert_time_step(u_without_dt[None], dt, time_between)[0], step_number

    def pass_long_gap(self, slot: int, to: int) -> None:
        """Predict the row in a slot, in place, to step number `to` without measurements, with its latest inputs.

        The work is bounded, however long the gap (`heliograph.live.long_gap`).
        """
        row = self.table[slot]
        step_before, inputs = int(row[self.step_number.start]), row[self.held_inputs]
        nothing = np.full(self.program.received, np.nan)

        def step(states: Float[np.ndarray, "row state"], k: int) -> Float[np.ndarray, "row state"]:
            """Return the states (row, state) after step number k, without measurements and with the same `inputs`."""
            same_for_all = np.concatenate([nothing, inputs, [k]])
            rows = np.broadcast_to(same_for_all, (len(states), len(same_for_all)))
            return self._step_parts(states, rows)[:, : self.step_rows.state.size].copy()

        state = self.step_rows.state
        # Where the state's array has factors of covariances: a step is affine in a covariance, not in its factors.
        column_numbers = np.arange(float(state.size))
        factors = find_factor_indices(state.tree(column_numbers))
        state_before = row[self.state].copy()
        state_after = pass_long_gap(
            step, self.step_rows.start, state_before, at=step_before, count=to - step_before, factors=factors
        )
        self.table[slot, self.state], self.table[slot, self.step_number.start] = state_after, to

    def gather_history(self, slots: Sequence[int]) -> PyTree:
        """Return the rows in these slots (lines of the table), in order, as a smoother takes them.

        Copies of the last row are appended until the number of rows is a power of two and at least SHORTEST (64). The
        smoother is then compiled for few lengths only.
        """
        length = max(SHORTEST, 1 << (len(slots) - 1).bit_length())  # the next power of two
        rows = self.table[[*slots, *[slots[-1]] * (length - len(slots))]]
        return self.step_rows.history(
            rows[:, self.numbers],
            rows[:, self.state],
            rows[:, self.held_inputs],
            rows[:, self.step_number.start],
            rows[:, self.outputs],
        )


def _insert_time_step(u: Float[np.ndarray, "row given"], dt: int, steps: Float[np.ndarray, " row"]) -> np.ndarray:
    """Return inputs (row, inputs + 1) with the time steps (row,) inserted as the input of index `dt`."""
    return np.concatenate([u[:, :dt], steps[:, None], u[:, dt:]], axis=1)


Single: TypeAlias = tuple[int, int, float]  # a step: slot to step from, slot to step into, step number


class ChainLeg(NamedTuple):
    """Steps of a chain one by one, and the step number to which the last row is then taken at once; 0 if to none."""

    steps: list[Single]
    jump: int = 0


def cut_chain_into_legs(chain: list[HeldRow], by_steps: bool, endless: bool) -> list[ChainLeg]:
    """Return the steps along a chain of rows, cut into legs where a gap is too long to step through one by one.

    A step is (slot of the row before, slot of the row, step number). In a gap of over LONG (10,000) steps the first
    step makes the new row. This ends a leg: the row's state is then predicted over the gap at once, to step number
    `jump`, TAIL (4) steps before its time. These last steps, one by one, begin the next leg.

    Args:
        chain: rows, of which each is stepped into from the one before it.
        by_steps: whether time counts steps.
        endless: whether the network is defined for all steps, so that silent steps are alike.
    """
    legs = [ChainLeg([])]
    for row, next_row in pairwise(chain):
        (time, *_), (last, *_) = row.key, next_row.key  # a key begins with the row's time
        begin, before = int(time) + 1, row.slot
        numbers: Sequence[float] = range(begin, int(last) + 1) if by_steps else (last,)
        if len(numbers) > LONG and endless:
            legs[-1] = ChainLeg([*legs[-1].steps, (before, next_row.slot, begin)], jump=int(last) - TAIL)
            legs.append(ChainLeg([]))
            before, numbers = next_row.slot, range(int(last) - TAIL + 1, int(last) + 1)
        for at in numbers:
            legs[-1].steps.append((before, next_row.slot, at))
            before = next_row.slot  # further steps into the same row go on from itself
    return legs


def group_by_turn(walks: Iterable[list[Single]]) -> list[list[Single]]:
    """Return groups of steps that can be computed at once, since they belong to different chains.

    The first group has the first step of each walk (list of steps, one after another), the second the second step of
    each walk that has one, and so on.
    """
    turns: list[list[Single]] = []
    for steps in walks:
        for turn, step in enumerate(steps):
            if turn == len(turns):
                turns.append([])
            turns[turn].append(step)
    return turns
