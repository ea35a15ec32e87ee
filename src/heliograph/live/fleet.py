"""Plants of one network and the table of their rows: due rows are stepped for all plants at once."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from itertools import pairwise
from math import nan
from typing import NamedTuple

import numpy as np

from heliograph.live.event import INPUTS, OF_STEPS, Known, Verdict
from heliograph.live.lanes import Lanes
from heliograph.live.later import History
from heliograph.live.plant import Plant
from heliograph.live.rows import BEFORE, HeldRow, Rows
from heliograph.live.senders import LossChain, SenderStatus, sender_status
from heliograph.model.over_time import steps_covered
from heliograph.numerics.check import TINY, check_count, fail, instance, scalar
from heliograph.numerics.types import Float
from heliograph.simulation.node import Node

FAR = 10_000  # steps that an event may be after the newest one: each of them has to be computed, while others wait
FEWEST = 1024  # rows of the table at first; it doubles when it is full
SHORTEST = 64  # rows of a history


class Pool:
    """Table with one row per slot; slots are taken and given back.

    The columns are (state, outputs, inputs held, step number, received, inputs, time). `numbers` is the slice of the
    last three, as in the rows of a timeline. `alone`: single rows are stepped, not many at once.
    """

    def __init__(self, lanes: Lanes, alone: bool = False):
        self.lanes, self.step_rows, self._alone = lanes, lanes.step_rows, alone
        sizes = self.step_rows.state.size, self.step_rows.outputs.size
        ends = np.cumsum([*sizes, lanes.given, 1, lanes.received + lanes.given + 1])
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
        row[self.state], row[self.at], row[self.numbers] = self.step_rows.start, -1.0, np.nan
        row[-1] = time

    def trial(self, before: np.ndarray, given: np.ndarray, last: float) -> np.ndarray:
        """Predict from the rows in these slots, with these inputs and no measurement; return the outputs.

        The prediction covers one step, or one unit of continuous time. An input that is NaN keeps its value. The step
        number is at most `last`.
        """
        dt, table = self.lanes.dt, self.table
        u = np.where(np.isnan(given), table[before, self.held], given)
        u = u if dt is None else _with_time_step(u, dt, np.ones(len(u)))
        k = np.minimum(table[before, self.at.start] + 1, last)
        nothing = np.full((len(before), self.lanes.received), np.nan)
        done = self.step_rows(np.concatenate([table[before, self.state], nothing, u, k[:, None]], axis=1), self._alone)
        return done[:, self.step_rows.state.size :]

    def step(self, before: np.ndarray, after: np.ndarray, at: np.ndarray) -> None:
        """Step from the rows in the slots `before` into those in `after`; `at`: the step number in discrete time.

        In discrete time a row is reached by as many steps as lie between it and the row before; its measurement is
        received at the last of these.
        """
        dt, table = self.lanes.dt, self.table
        numbers, held = table[after, self.numbers], table[before, self.held]
        received, given = numbers[:, : self.lanes.received], numbers[:, self.lanes.received : -1]
        now_held = np.where(np.isnan(given), held, given)
        if dt is None:
            there = (at == numbers[:, -1])[:, None]
            received, u = np.where(there, received, np.nan), np.where(there, now_held, held)
            now_held, k = u, at
        else:
            u = _with_time_step(held, dt, numbers[:, -1] - table[before, -1])
            k = table[before, self.at.start] + 1
        done = self.step_rows(np.concatenate([table[before, self.state], received, u, k[:, None]], axis=1), self._alone)
        table[after, : self.outputs.stop] = done
        table[after, self.held], table[after, self.at.start] = now_held, k

    def history(self, slots: Sequence[int]) -> History:
        """Return the rows in these slots, in order, and behind them copies of the last up to a power of two."""
        length = max(SHORTEST, 1 << (len(slots) - 1).bit_length())
        rows, steps = self.table[[*slots, *[slots[-1]] * (length - len(slots))]], self.step_rows
        state, outputs = steps.state.tree(rows[:, self.state]), steps.outputs.tree(rows[:, self.outputs])
        return History(rows[:, self.numbers], state, rows[:, self.held], rows[:, self.at.start].astype(int), outputs)


def _with_time_step(u: Float[np.ndarray, "row given"], dt: int, steps: Float[np.ndarray, " row"]) -> np.ndarray:
    """Insert the time steps among the inputs, as number `dt`."""
    return np.concatenate([u[:, :dt], steps[:, None], u[:, dt:]], axis=1)


class Options(NamedTuple):
    """Limits of a fleet: which events it accepts, and how many rows it holds.

    Args:
        window: how late an event may be, in the unit of time of the network (default 10).
        ahead: how much later than its arrival the time of an event may be (default 0).
        leap: how much later than the newest arrival so far the time of an event may be (default unlimited).
        capacity: greatest number of rows held for each plant (default 1000).
        step: seconds of a step, where time counts steps and messages carry dates; None where they carry steps.
    """

    window: float = 10.0
    ahead: float = 0.0
    leap: float = np.inf
    capacity: int = 1000
    step: float | None = None


class Finalised(NamedTuple):
    """Rows of a plant that are final now, and its newest row; `left`: slots to free once these have been read."""

    plant: Plant
    final: list[HeldRow]
    newest: HeldRow
    left: list[int]


class Fleet:
    """Plants of one network: events are taken one after another, and `step` computes the rows that they made due.

    Estimates and verdicts are those of a `Timeline` for each plant; final rows come in order of time within each plant.
    Which plants share a fleet, and how events are cut into batches, changes no bit of an estimate.

    Args:
        lanes: the compiled step of the network.
        options: the limits of events and of memory.
        alone: single rows are stepped, not those of many plants at once.
    """

    def __init__(self, lanes: Lanes, options: Options, alone: bool = False):
        instance("lanes", lanes, Lanes, "Lanes")
        instance("options", options, Options, "Options")
        network = self.network = lanes.network
        self.options, self.lanes = _checked(options), lanes
        self.pool = Pool(lanes, alone)
        # Index and size of each node's measurement, and of the inputs; their columns in a row, in this order.
        self.sizes = {name: (i, network.nodes[name].received) for i, name in enumerate(network.names)}
        self.sizes[INPUTS] = -1, self.lanes.given
        sizes = [size for _, size in self.sizes.values()]
        self._places = [slice(int(end) - size, int(end)) for end, size in zip(np.cumsum(sizes), sizes, strict=True)]
        self.width = self._places[-1].stop
        # Last step for which the network is defined; limits of the jumps in time.
        covered = steps_covered(network)
        self.end_step = np.inf if covered is None else covered - 1
        self._leap = options.leap if alone or self.lanes.dt is not None else min(options.leap, FAR)
        self._joint = self.lanes.dt is None or network.common is not None
        self._limits = {name: node.limits for name, node in network.nodes.items() if node.limits is not None}
        # Nodes whose sender decides when to send.
        nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
        deciding = {name: (node.trigger, node) for name, node in nodes.items() if node.trigger is not None}
        self.deciding = {name: (trigger, LossChain.of_node(node)) for name, (trigger, node) in deciding.items()}
        # A slot with the prior, for plants that have not begun.
        self._blank = self.pool.take()
        self.pool.start(self._blank, -1.0)

    @property
    def rows_are_joint(self) -> bool:
        """Return whether all events of one time form one row."""
        return self._joint

    def begin(self, name: str, time: float, origin: datetime | None) -> Plant:
        """Add a plant, whose continuous time starts at `time`."""
        begun = -1.0 if self.lanes.dt is None else time
        slot = self.pool.take()
        self.pool.start(slot, begun)
        base = HeldRow((begun, BEFORE, 0), slot, self.width)
        base.numbers[-1] = begun
        return Plant(name, self.rows(base), time if self.lanes.dt is not None else 0.0, origin)

    def end(self, plant: Plant) -> None:
        """Remove a plant and free its slots."""
        self.pool.give([row.slot for row in plant.rows.held])

    def size(self, node: int) -> int:
        """Return how many numbers an event of the node with this index has."""
        columns = self._places[node]
        return columns.stop - columns.start

    def rows(self, base: HeldRow) -> Rows:
        """Return a chain of rows that begins with this one."""
        return Rows(base, self._joint, self._places, self.options.capacity)

    def known(self, node: str, sequence: int, time: float, values: list[float | None], arrival: float) -> Known:
        """Convert an event to numbers."""
        index, size = self.sizes.get(node, (0, -1))
        if size < 0:
            raise fail("message, node", f"one of {', '.join(self.sizes)}", repr(node)[:60])
        if len(values) != size:
            raise fail(f"message of {node!r}, values", f"{size} numbers", len(values))
        self.check_step("message, time", time)
        numbers = [nan if value is None else value for value in values]
        return Known(index, sequence, time, numbers, arrival)

    def check_step(self, name: str, time: float) -> None:
        """Refuse a time that is no step of the network, where time counts steps."""
        if self.lanes.dt is None and not (0 <= time <= self.end_step and time == int(time)):
            end = "" if self.end_step == np.inf else f" to {self.end_step:g}"
            raise fail(name, f"a step, a whole number from 0{end}", f"{time} ({OF_STEPS})")

    def within(self, node: str, event: Known) -> tuple[Known, int, str]:
        """Remove an event's values beyond the limits of its node; return how many these are, and which, in words."""
        if node not in self._limits:
            return event, 0, ""
        limits, values = self._limits[node], np.array(event.values)
        if not (outside := limits.outside(values)).any():
            return event, 0, ""
        said = limits.why(values, self.network.nodes[node].received_names)
        return event._replace(values=np.where(outside, nan, values).tolist()), int(outside.sum()), said

    def take(self, plant: Plant, event: Known) -> Verdict:
        """Judge an event and hold it if it is used."""
        if event.time > plant.now + self._leap:
            return "future"
        rows, now = plant.rows, max(plant.now, event.arrival)
        key = rows.key(event)
        verdict = rows.verdict(event, key, now - self.options.window, self.options.ahead)
        if verdict != "used":
            return verdict
        plant.take(event, key, self.pool.take, self.width)
        plant.now = now
        return verdict

    def undo(self, plant: Plant, now: float) -> None:
        """Restore a plant to its state before the events taken since the last call of `finalise`."""
        self.pool.give(plant.undo())
        plant.now = now

    def finalise(self, touched: Iterable[Plant], all_: bool = False) -> list[Finalised]:
        """Step what is due, and let what is older than the window, or all, become final."""
        plants = list(touched)
        self.step(plants)
        back = -np.inf if all_ else self.options.window
        ends = [(plant, *plant.finalise(plant.now - back)) for plant in plants]
        return [Finalised(plant, final, plant.rows.held[-1], left) for plant, final, left in ends]

    def step(self, plants: Iterable[Plant]) -> None:
        """Step what is due, for all plants at once."""
        chains = [chain for plant in plants if (chain := plant.chain())]
        if rows := [row for chain in chains for row in chain]:
            numbers = np.array([number for row in rows for number in row.numbers]).reshape(len(rows), -1)
            self.pool.table[[row.slot for row in rows], self.pool.numbers] = numbers
        self._run(chains)

    def _run(self, chains: Sequence[list[HeldRow]]) -> None:
        """Step along chains of rows, whose numbers stand in the table, from the first of each."""
        for before, after, at in _rounds(chains, self.lanes.dt is None):
            self.pool.step(np.array(before), np.array(after), np.array(at))

    def look(self, row: HeldRow, time: float, slot: int) -> None:
        """Predict from a row to a later time, into a slot that no row has."""
        there = HeldRow((float(time), 0, 0), slot, self.width)
        self.pool.table[slot, self.pool.numbers] = there.numbers
        self._run([[row, there]])

    def trial(
        self, plants: Sequence[Plant | None], given: Float[np.ndarray, "plant given"]
    ) -> Float[np.ndarray, "plant outputs"]:
        """Estimates of each plant (None: one that has not begun) with these inputs, NaN: as they were.

        The prediction covers one step from the newest row, or one unit of continuous time. A plant that is None has not
        begun yet. An input that is NaN keeps its value.
        """
        slots = [self._blank if plant is None else plant.rows.held[-1].slot for plant in plants]
        return self.pool.trial(np.array(slots), given, self.end_step)

    def outputs(self, slots: list[int]) -> Float[np.ndarray, "row outputs"]:
        """Return the outputs of the filters after the rows in these slots."""
        return self.pool.table[np.array(slots, dtype=int), self.pool.outputs]

    def senders(self, plant: Plant) -> dict[str, SenderStatus]:
        """Return the status of each sender of a plant that decides when to send: what its silence means by now."""
        final, now = int(np.ceil(plant.now - self.options.window)) - 1, int(np.floor(min(plant.now, self.end_step)))
        links = {name: plant.links.get(name) for name in self.deciding}
        last = {
            name: int(link.latest) if link is not None and link.latest >= 0 else None for name, link in links.items()
        }
        return {name: sender_status(*items, last[name], final, now) for name, items in self.deciding.items()}

    def forget(self, finalised: Iterable[Finalised]) -> None:
        """Free the slots of these rows, once their outputs have been read."""
        for row in finalised:
            self.pool.give(row.left)


def _checked(options: Options) -> Options:
    step = None if options.step is None else float(scalar("step", options.step, TINY))
    leap = options.leap if options.leap == np.inf else scalar("leap", options.leap, 0)
    window, ahead = (float(scalar(name, getattr(options, name), 0)) for name in ("window", "ahead"))
    return Options(window, ahead, float(leap), check_count("capacity", options.capacity), step)


Round = tuple[list[int], list[int], list[float]]  # slots to step from, slots to step into, and the number of the step


def _rounds(chains: Iterable[list[HeldRow]], by_steps: bool) -> list[Round]:
    """Group the steps of all chains by turn, so that each group has at most one step of each chain."""
    rounds: list[Round] = []
    for chain in chains:
        turn = 0
        for row, next_row in pairwise(chain):
            before, last = row.slot, next_row.key[0]
            for at in range(int(row.key[0]) + 1, int(last) + 1) if by_steps else (last,):
                if turn == len(rounds):
                    rounds.append(([], [], []))
                rounds[turn][0].append(before)
                rounds[turn][1].append(next_row.slot)
                rounds[turn][2].append(at)
                before, turn = next_row.slot, turn + 1
    return rounds
