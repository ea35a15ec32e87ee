"""Filters on events in any order: each event gets a verdict and its place in time."""

import warnings
from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import numpy as np

from heliograph.live.event import INPUTS, OF_STEPS, VERDICTS, Known, Verdict, moment, numbers, whole
from heliograph.live.player import player
from heliograph.live.pool import Pool
from heliograph.live.rows import BEFORE, HeldRow, Rows
from heliograph.live.senders import LossChain, SenderStatus, sender_status
from heliograph.live.snapshot import check_same, packed, row_arrays, rows_from, unpacked
from heliograph.model.estimate import Estimate, with_sound_claim
from heliograph.model.over_time import steps_covered
from heliograph.numerics.check import check_count, fail, instance, scalar, shown
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.by_name import by_name
from heliograph.simulation.results.record import Record


class Finals:
    """Rows of final outputs, of `size` numbers, in order of time; beyond `most` rows the oldest parts are dropped."""

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


@readable
class Timeline:
    """A network's filters on events that arrive late, out of order and twice.

    Pushed in whatever order, the accepted events give the estimates of filters that had received them in order of time.
    What is older than now - `window` is final, now being the latest arrival; the newest final event is the base, from
    which later ones are replayed. Each push gets one verdict, the first that holds:

    - "future": its time is later than its arrival by more than `ahead`;
    - "late": it is before the base, in the order (time, node, sequence);
    - "duplicate": the same node, sequence and time are held with the same values; "conflict": with others, and the
      first stay;
    - "implausible": no filter at the node could use it without losing its state or its digits, judged on what is held
      by `heliograph.filters.plausibility`; or all its values are beyond the node's limits;
    - "used".

    An event that is refused changes nothing. A plant with an input "dt" has continuous time, which starts at `start`;
    its other inputs are held from their event to the next, 0 before the first. Any other plant's time counts steps,
    from 0, and inputs lead to the step of their time. Where time counts steps, and where nodes share a channel, all
    events of a time form one row, and a second measurement of a node at that time is a conflict; else every event is a
    row.

    `counts` has the number of each verdict by node, and under "inputs"; `dropped` the number of single values beyond a
    node's limits, which counted as not arrived; `forced` the number of rows that became final early.

    Args:
        network: the network whose filters run.
        window: how late an event may be, in steps or seconds, at least 0.
        start: start of continuous time (default 0); must be 0 where time counts steps.
        ahead: how much later than its arrival the time of an event may be (default 0).
        capacity: greatest number of rows held (default 1000); beyond it the oldest become final.

    A node with a trigger goes by steps, and that nothing came is silence: final once the step is, and before that
    provisional, so that a late value has all steps from its own on made anew. `senders` says which is which.

    Raises:
        ValueError: no network, a negative window, a node called "inputs", continuous time where parts go by steps.
    """

    def __init__(self, network: Network, window: float, start: float = 0.0, ahead: float = 0.0, capacity: int = 1000):
        self.network = instance("network", network, Network, "a Network")
        self.window, self.ahead = float(scalar("window", window, 0)), float(scalar("ahead", ahead, 0))
        self.now, self.capacity = float(scalar("start", start)), check_count("capacity", capacity)
        if INPUTS in network.nodes:
            names = list(network.nodes)
            raise fail("node names", f"none called {INPUTS!r}, which stands for the plant's inputs", names)
        self._player, self._horizon = player(network), steps_covered(network)
        self._dt = self._player.dt
        if self._dt is None and start != 0:
            raise fail("start", "0 where time counts steps", start)
        if what := self._player.uneven:
            warnings.warn(f"timeline: predictions depend on when others are asked for: {what}", stacklevel=2)
        # Index and size of each node's measurement, and of the inputs; counts by node.
        self._sizes = {name: (i, network.nodes[name].received) for i, name in enumerate(network.names)}
        self._sizes[INPUTS] = -1, self._player.given
        self.counts = {name: dict.fromkeys(VERDICTS, 0) for name in self._sizes}
        self.dropped = dict.fromkeys(network.names, 0)
        self.forced = 0
        # Columns of each node in a row.
        ends = np.cumsum([size for _, size in self._sizes.values()])
        places = [slice(end - size, end) for end, (_, size) in zip(ends, self._sizes.values(), strict=True)]
        self._size = int(ends[-1])
        # The prior as the base, and a slot to look ahead in.
        self._pool = Pool(self._player, alone=True)
        begun = self.now if self._dt is not None else -1.0
        base, self._spare = HeldRow((begun, BEFORE, 0), self._pool.take(), self._size), self._pool.take()
        self._pool.start(base.slot, base.key[0])
        joint = self._dt is None or network.common is not None
        self._rows = Rows(base, joint, places, self.capacity)
        self._finals = Finals(2 * self.capacity, self._player.step_rows.outputs.size)
        self._latest: np.ndarray | None = None  # outputs after the newest row
        self._last = np.full(len(network.names), np.nan)  # time of each node's newest final value

    def __getstate__(self) -> dict[str, object]:
        """Return the whole state, in double precision; compiled programs are left out."""
        head, arrays = self._state()
        return {"network": self.network, "saved": packed(head, arrays)}

    def __setstate__(self, stored: dict[str, Any]) -> None:
        vars(self).update(vars(self._resumed(stored["network"], *unpacked(stored["saved"]))))

    @property
    def engine(self) -> str:
        """Return which engine steps the filters, "native: ..." or "xla: ...", and why."""
        return self._player.step_rows.engine

    def push(self, node: str, sequence: int, time: float, values: ArrayLike, arrival: float | None = None) -> Verdict:
        """Take what a node measured at `time`, which arrived at `arrival` (None: at once), and judge it.

        It costs a step from the event's row on into each later one.

        Raises:
            ValueError: an unknown node, values that are not the node's, a time that is no number or no step; nothing
                is counted, and everything stays as it was.
        """
        event, dropped = self._within(self._known(node, sequence, time, values, arrival), node)
        now = max(self.now, event.arrival)
        verdict = self._rows.verdict(event, now - self.window, self.ahead)
        nothing = dropped and np.isnan(event.values).all()
        if verdict == "used" and (nothing or not self._used(event)):
            verdict = "implausible"
        if verdict == "used":
            self.now = now
            self._finalise()
        if verdict in ("used", "implausible") and dropped:
            self.dropped[node] += dropped
        self.counts[node][verdict] += 1
        return verdict

    def _within(self, event: Known, node: str) -> tuple[Known, int]:
        """Remove an event's values beyond its node's limits; return the event and how many these were."""
        limits = None if node == INPUTS else self.network.nodes[node].limits
        outside = None if limits is None else limits.outside(event.values)
        if outside is None or not outside.any():
            return event, 0
        return event._replace(values=np.where(outside, np.nan, event.values)), int(outside.sum())

    def advance(self, now: float) -> None:
        """Advance the time: what is older than the window becomes final."""
        self.now = max(self.now, moment("now", now))
        self._finalise()

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return estimates at `now` by node and filter; those of several nodes are under "fused"."""
        newest, now = self._rows.keys[-1][0], self.now
        if self._dt is None:
            now = np.floor(min(now, self._end()))
        if self._latest is not None and now <= newest:
            return self._named(self._latest)
        return self._named(self._look(now, len(self._rows.held)))

    def senders(self) -> dict[str, SenderStatus]:
        """Return the status of each node's sender that decides when to send: what its silence means by now.

        Raises:
            ValueError: no such node.
        """
        nodes = {name: node for name, node in self.network.nodes.items() if isinstance(node, Node)}
        deciding = {name: (node.trigger, node) for name, node in nodes.items() if node.trigger is not None}
        if not deciding:
            raise fail("senders", "a node with a trigger", list(self.network.names))
        final, now = int(np.ceil(self.now - self.window)) - 1, int(np.floor(min(self.now, self._end())))
        results = {}
        for name, (trigger, node) in deciding.items():
            place = self._sizes[name][0]
            times = [row.key[0] for row in self._rows.held if any(at == place for at, _, _ in row.events)]
            last = max([*times, self._last[place]], default=np.nan)
            results[name] = sender_status(
                trigger, LossChain.of_node(node), None if np.isnan(last) else int(last), final, now
            )
        return results

    def _end(self) -> float:
        """Return the last step that the network covers."""
        return np.inf if self._horizon is None else self._horizon - 1

    def _look(self, time: float, place: int) -> np.ndarray:
        """Predict to a time after the row before `place`, in a slot that no row has; return the outputs."""
        self._pool.table[self._spare, self._pool.numbers] = HeldRow(
            (float(time), 0, 0), self._spare, self._size
        ).numbers
        self._pool.reach(self._rows.held[place - 1].slot, self._spare)
        return self._outputs(self._spare)

    def _outputs(self, slots: int | list[int]) -> np.ndarray:
        """Return the outputs after the row in a slot, or after several."""
        return self._pool.table[slots, self._pool.outputs].copy()

    def lagged(self, lag: float) -> dict[str, dict[str, Estimate]]:
        """Return smoothed estimates at `now` - `lag` given all events held, by node and filter."""
        if not 0 <= moment("lag", lag) <= self.window:
            raise fail("lag", f"a number from 0 to the window, {self.window:g}", lag)
        time = self.now - lag if self._dt is not None else np.ceil(min(self.now, self._end()) - lag)
        if time <= self._rows.keys[0][0] if self._dt is None else time < self._rows.keys[0][0]:
            raise fail("lag", "one to a moment after what is final", f"{lag:g}, to {time:g}")
        place, slots = self._rows.after(time), [row.slot for row in self._rows.held]
        if self._dt is not None or self._rows.keys[place - 1][0] < time:
            self._look(time, place)
            slots.insert(place, self._spare)
        else:
            place -= 1
        return self._player.sweeper.estimates(self._pool.history(slots), place, len(slots))

    def final(self) -> Record:
        """Return the estimates that became final since the last call, one for each row with a measurement.

        They are the filtered estimates after the row, in order of time. Without calls, the last 2 `capacity` of them
        are kept.
        """
        time, outputs = self._finals.take()
        return Record(time, self.network.states, None, {}, self._named(outputs))

    def save(self) -> bytes:
        """Serialise the whole state for `restore`: after it, the same pushes give the same bits."""
        head, arrays = self._state()
        return packed(head | {"of": self._player.identity}, arrays)

    def _state(self) -> tuple[dict[str, object], dict[str, np.ndarray]]:
        """Return the whole state: numbers and counts, and arrays."""
        time, outputs = self._finals.take()
        self._finals.add(time, outputs)
        head = {"now": self.now, "forced": self.forced, "counts": self.counts, "dropped": self.dropped}
        table = self._pool.table[[row.slot for row in self._rows.held]]
        arrays = {"table": table, "senders.last": self._last, "final.time": time, "final": outputs}
        options = {"options": [self.window, self.ahead, self.capacity]}
        return head | options, row_arrays(self._rows.held) | arrays

    @classmethod
    def restore(cls, network: Network, data: bytes) -> "Timeline":
        """Restore a saved timeline of the same network."""
        head, arrays = unpacked(data)
        check_same("snapshot", player(network).identity, head.get("of", {}))
        return cls._resumed(network, head, arrays)

    @classmethod
    def _resumed(cls, network: Network, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Timeline":
        """Make a timeline from a saved state."""
        window, ahead, capacity = head["options"]
        with warnings.catch_warnings():  # the warning was given when the timeline was made
            warnings.simplefilter("ignore")
            new = cls(network, window, ahead=ahead, capacity=capacity)
        new.now, new.forced, new.counts, new.dropped = (head[name] for name in ("now", "forced", "counts", "dropped"))
        new._last = np.array(arrays["senders.last"])
        # The rows take the first slots of a new table.
        new._pool, saved = Pool(new._player, alone=True), arrays["table"]
        slots = [new._pool.take() for _ in range(len(saved))]
        new._spare = new._pool.take()
        new._pool.table[slots] = saved
        new._rows.hold(rows_from(arrays, saved[:, new._pool.numbers], dict(new._sizes.values())))
        new._finals.add(arrays["final.time"], arrays["final"])
        if new._rows.keys[-1][1] != BEFORE:
            new._latest = new._outputs(slots[-1])
        return new

    def _known(self, node: str, sequence: int, time: float, values: ArrayLike, arrival: float | None) -> Known:
        """Convert an event to numbers."""
        if not isinstance(node, str) or node not in self._sizes:
            raise fail("node of an event", f"one of {', '.join(self._sizes)}", shown(node))
        place, size = self._sizes[node]
        name = f"event of {node!r}"
        at = moment(f"{name}, time", time)
        if self._dt is None and (at < 0 or at != int(at) or (self._horizon is not None and at >= self._horizon)):
            end = "" if self._horizon is None else f" to {self._horizon - 1}"
            raise fail(f"{name}, time", f"a step, a whole number from 0{end}", f"{time} ({OF_STEPS})")
        came = max(self.now, at) if arrival is None else moment(f"{name}, arrival", arrival)
        return Known(place, whole(f"{name}, sequence", sequence), at, numbers(name, values, size), came)

    def _used(self, event: Known) -> bool:
        """Insert the event and replay from its row; if it is implausible, restore everything and return False."""
        place, row = self._rows.find(event)
        before = None if row is None else (row.numbers.copy(), dict(row.events))
        if row is None:
            row = HeldRow(self._rows.key(event), self._pool.take(), self._size)
            self._rows.insert(place, row)
        self._rows.fill(row, event)
        # Replay from the row on, and judge the event by the outputs.
        latest = self._replayed(row, place, len(self._rows.held))
        if not self._refuses(event, row, place):
            self._latest = latest
            return True
        # Refused: restore the row or remove it, and replay what follows.
        if before is None:
            self._rows.remove(place)
            self._pool.give([row.slot])
        else:
            row.numbers[:], row.events = before
        if place < len(self._rows.held):
            self._replayed(self._rows.held[place], place, len(self._rows.held))
        return False

    def _refuses(self, event: Known, row: HeldRow, place: int) -> bool:
        """Return whether a replayed event is implausible; inputs are also judged over one unit of time after them."""
        name = INPUTS if event.place < 0 else self.network.names[event.place]
        why = self._player.why(self._outputs(row.slot), name)
        if why is None and name == INPUTS and self._dt is not None:
            why = self._player.why(self._look(row.key[0] + 1.0, place + 1), name)
        return why is not None

    def _replayed(self, row: HeldRow, start: int, stop: int) -> np.ndarray:
        """Write a row's numbers and step into the rows from `start` to `stop`; return the outputs after the last."""
        held, pool = self._rows.held, self._pool
        pool.table[row.slot, pool.numbers] = row.numbers
        for before, after in pairwise(held[start - 1 : stop]):
            pool.reach(before.slot, after.slot)
        return self._outputs(held[stop - 1].slot)

    def _finalise(self) -> None:
        """Move the base up to the watermark, and read the outputs of the rows that are final by it."""
        base, forced = self._rows.finalise(self.now - self.window)
        if not base:
            return
        self.forced += forced
        final, left = self._rows.drop(base)
        for row in final:
            for place, _, time in row.events:
                if place >= 0:
                    self._last[place] = time
        read = [row for row in final if row.has_data()]
        self._finals.add(np.array([row.key[0] for row in read]), self._outputs([row.slot for row in read]))
        self._pool.give([row.slot for row in left])

    def _named(self, outputs: np.ndarray) -> dict[str, dict[str, Estimate]]:
        """Arrange outputs by node and filter."""
        result = self._player.step_rows.outputs.tree(outputs)
        mean = by_name(self.network, result, lambda part: np.asarray(part.mean), -3)
        covariance = by_name(self.network, result, lambda part: np.asarray(part.covariance), -4)
        return {
            node: {
                name: with_sound_claim(Estimate(mean[node][name], covariance[node][name], claim))
                for name, claim in claims.items()
            }
            for node, claims in self._player.claims.items()
        }
