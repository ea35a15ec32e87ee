"""Filters on events in any order: each event gets a verdict and its place in time."""

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from heliograph.live.event import INPUTS, VERDICTS, CheckedEvent, Verdict, check_63_bits, check_moment, check_numbers
from heliograph.live.final_rows import FinalRows, GateCounts
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.forecast_start_of_row import estimates_by_name, judged_estimates_by_name, make_forecast_origin
from heliograph.live.health.fleet_warnings import FleetRepeatWatch, RemarkWatch
from heliograph.live.health.implausible_events import AngleWatch, CandidateEvent, JudgementReader
from heliograph.live.health.link_counts import LinkCounts
from heliograph.live.health.sender_status import SenderStatus
from heliograph.live.network_step_program import shared_program
from heliograph.live.sorted_rows import BEFORE, HeldRow
from heliograph.live.stored.migration import describe_network
from heliograph.live.stored.network_changes import DESCRIPTION, SAME
from heliograph.live.stored.plant_codec import pack_plant, unpack_plant
from heliograph.live.stored.snapshot import check_same_network, pack_snapshot, unpack_snapshot
from heliograph.live.stored.timeline_migration import carry_over_timeline
from heliograph.model.checks.refusal_reasons import SCREENED, Reason
from heliograph.model.estimate import Estimate
from heliograph.model.forecast_origin import Origin
from heliograph.numerics.check import check_count, fail, instance, scalar, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record


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
    row. `counts` has the number of each verdict; `refused` that of single values which count as not arrived, by node
    and reason, and `gated` of those that a filter alone left out; `timeouts` that of silences longer than a node's
    timeout, which `senders` names while they last; `held` that of runs of equal readings that a node without `stuck=`
    does not refuse; `reasons` says in words, by node, why the last implausible event was one; `forced` is the number of
    rows that became final early.

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
        """Begin with the initial laws of a network's filters, and no event.

        Args:
            network: the network whose filters run.
            window: how late an event may be, in steps or in the unit of dt.
            start: start of continuous time.
            ahead: how much later than its arrival an event may be dated.
            capacity: greatest number of rows held that are not final yet.
        """
        self.network = instance("network", network, Network, "a Network")
        self.window, self.ahead = float(scalar("window", window, 0)), float(scalar("ahead", ahead, 0))
        start, self.capacity = float(scalar("start", start)), check_count("capacity", capacity)
        if INPUTS in network.nodes:
            names = list(network.nodes)
            raise fail("node names", f"none called {INPUTS!r}, which stands for the plant's inputs", names)
        self._program = shared_program(network)
        if self._program.dt is None and start != 0:
            raise fail("start", "0 where time counts steps", start)
        # Such a plant is integrated by steps that depend on where a prediction in between stops.
        if what := self._program.uneven:
            warnings.warn(f"timeline: predictions depend on when others are asked for: {what}", stacklevel=2)
        self._start_fleet_and_watches(start)

    def _start_fleet_and_watches(self, start: float) -> None:
        """Make the fleet of one plant that steps the filters, and what judges and counts on top of it.

        `start`: time of the plant's initial law, where time is continuous.
        """
        # The rows of events, and the filters' states after each, in a table of which a slot is a line. `_spare` is a
        # slot of no row, to predict into.
        self._fleet = Fleet(self._program, Options(self.window, self.ahead, capacity=self.capacity), alone=True)
        self._plant = self._fleet.begin_plant("", start, origin=None)
        self._spare = self._fleet.state_table.take_slot()
        # Reads whether filters found an event implausible; why the last one of each node was.
        self._judges = JudgementReader(self._fleet)
        self.reasons: dict[str, str] = {}
        # Find what to warn of: angles known too badly, remarks of filters on their states, readings that repeat.
        self._angles = AngleWatch(self._fleet)
        self._remarks = RemarkWatch(self._fleet)
        self._held = FleetRepeatWatch(self._fleet)
        # Of rows that are final: counts of values that filters left out, and outputs that `final` has not returned yet.
        self._gates = GateCounts(self._program.filter_columns)
        self._finals = FinalRows(2 * self.capacity, self._program.step_rows.outputs.size)

    def __getstate__(self) -> dict[str, object]:
        """Return the whole state, in double precision; compiled programs are left out."""
        head, arrays = self._pack_state()
        return {"network": self.network, "saved": pack_snapshot(head, arrays)}

    def __setstate__(self, stored: dict[str, Any]) -> None:
        """Restore what `__getstate__` returned, with programs compiled anew."""
        vars(self).update(vars(self._resume_from(stored["network"], *unpack_snapshot(stored["saved"]))))

    @property
    def engine(self) -> str:
        """Return which engine steps the filters, "native: ..." or "xla: ...", and why."""
        return self._program.step_rows.engine

    @property
    def now(self) -> float:
        """Return the latest arrival."""
        return self._plant.now

    @property
    def forced(self) -> int:
        """Return how many rows became final early, since more than `capacity` would have been held."""
        return self._plant.forced

    @property
    def counts(self) -> dict[str, dict[Verdict, int]]:
        """Return for each node, and for "inputs", how many events had each verdict."""
        links = self._plant.links
        return {
            name: {verdict: getattr(links.get(name, LinkCounts()), verdict) for verdict in VERDICTS}
            for name in self._fleet.layout.sizes
        }

    @property
    def refused(self) -> dict[str, dict[Reason, int]]:
        """Return for each node how many single values it refused for each reason: "limits", "code" or "stuck"."""
        links = self._plant.links
        refused = {name: links.get(name, LinkCounts()).refused for name in self.network.names}
        return {name: {reason: counts.get(reason, 0) for reason in SCREENED} for name, counts in refused.items()}

    @property
    def gated(self) -> dict[tuple[str, str], int]:
        """Return {(node, filter): number of values in final rows with weight 0}, for filters that weigh values."""
        return dict(self._gates.counts)

    @property
    def timeouts(self) -> dict[str, int]:
        """Return by node how many silences longer than its timeout have ended; `senders` shows one that goes on."""
        return self._counts_of("timeouts")

    @property
    def held(self) -> dict[str, int]:
        """Return by node how many runs of equal readings were longer than noise allows; 0 if limits refuse these."""
        return self._counts_of("held")

    def _counts_of(self, what: str) -> dict[str, int]:
        """Return {node: the count of its link called `what`}, an attribute of `LinkCounts`; 0 before a message."""
        return {name: getattr(self._plant.links.get(name, LinkCounts()), what) for name in self.network.names}

    def push(self, node: str, sequence: int, time: float, values: ArrayLike, arrival: float | None = None) -> Verdict:
        """Take what a node measured at `time`, which arrived at `arrival` (None: at once); return the verdict on it.

        A row is all events of one time; an event costs one step of all filters for its row and for each later one.

        Args:
            node: name of the node, or "inputs" of the plant's inputs.
            sequence: the node's running count, from 0.
            time: moment of the measurement, in steps or in the unit of dt.
            values: what was measured, NaN where a component did not arrive; shape (received,) of the node.
            arrival: moment of arrival.

        Raises:
            ValueError: an unknown node, values that are not the node's, a time that is no number or no step; nothing
                is counted, and everything stays as it was.
        """
        plant, clock_before = self._plant, self._plant.clock
        screened = self._fleet.screen_event(node, self._convert_event(node, sequence, time, values, arrival), plant)
        event = screened.event
        verdict, lines = self._fleet.take_event(plant, event, arrival is not None), list[str]()
        if verdict == "used":
            row, _ = plant.changes[-1]  # the newest change: the row that holds the event now, and what it held before
            why = screened.why if screened.is_empty else self._explain_implausible(event, row)
            if why is not None:
                # The event is implausible: undo it, as if it had never arrived.
                verdict, self.reasons[node] = "implausible", why
                self._fleet.undo_events(plant, clock_before)
                self._fleet.step([plant])
            else:
                lines += [line for _, line in (*self._angles.find_new([plant]), *self._remarks.find_new([plant]))]
                self._finalise()
        self._fleet.count_event(plant, node, screened, verdict)
        lines += [line for _, line in self._held.find_new([plant])]
        # Last, when all is done: where warnings are errors, the event counts too.
        for line in lines:
            warnings.warn(f"timeline, {line}", stacklevel=2)
        return verdict

    def _explain_implausible(self, event: CheckedEvent, row: HeldRow) -> str | None:
        """Step the rows that an event changed; return why the event is implausible, or None if it is not.

        In continuous time inputs hold from their row on, so that they are judged by a prediction over one unit of time
        after it.
        """
        fleet, plant = self._fleet, self._plant
        fleet.step([plant])
        why = self._judges.find_implausible([CandidateEvent(0, plant, event, row)]).get(0)
        if why is None and event.is_inputs and self._program.dt is not None:
            inputs_stay = np.full((1, self._program.given), np.nan)
            outputs_after = fleet.state_table.predict_outputs(np.array([row.slot]), inputs_stay, last=np.inf)
            why = self._judges.explain_inputs(outputs_after[0])
        return why

    def advance(self, now: float) -> None:
        """Advance the time: what is older than the window becomes final."""
        self._fleet.advance_time(self._plant, check_moment("now", now))
        self._finalise()

    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return estimates at `now` by node and filter; those of several nodes are under "fused".

        Each says what its filter made of what arrived at `now`: `nis`, `received` and `refused` of `JudgedEstimate`.
        """
        slot, _time = self._slot_now()
        return judged_estimates_by_name(self._program, self._outputs_after(slot))

    @property
    def origin(self) -> Origin:
        """Return the filters' states at `now`, from which `hg.forecast` predicts.

        They are a copy: the timeline itself does not change, and can still take late events.
        """
        slot, time = self._slot_now()
        return make_forecast_origin(self._fleet, slot, time)

    def _slot_now(self) -> tuple[int, float]:
        """Return the slot (line of the table of states) that holds the state at `now`, and its time.

        It is the newest row's if nothing has to be predicted, else `_spare`, into which it is predicted here.
        """
        newest, by_steps = self._plant.rows.held[-1], self._program.dt is None
        newest_time, newest_node, _ = newest.key  # the node is BEFORE in the row before all events
        now = np.floor(min(self.now, self._fleet.end_step)) if by_steps else self.now
        if newest_node != BEFORE and now <= newest_time:
            return newest.slot, float(newest_time)
        self._fleet.predict_into(newest, now, self._spare)
        return self._spare, float(now)

    def senders(self) -> dict[str, SenderStatus]:
        """Return by node what silence means by now, for senders that decide when to send or have a timeout.

        Raises:
            ValueError: there is no such node.
        """
        if not self._fleet.watched:
            raise fail("senders", "a node with a trigger or a timeout", list(self.network.names))
        return self._fleet.find_sender_status(self._plant)

    def _outputs_after(self, slots: int | list[int]) -> np.ndarray:
        """Return the outputs of the row in a slot of the fleet's table, or of several: estimates after its events."""
        state_table = self._fleet.state_table
        return state_table.table[slots, state_table.outputs].copy()

    def lagged(self, lag: float) -> dict[str, dict[str, Estimate]]:
        """Return smoothed estimates at `now` - `lag` given all events held, by node and filter."""
        if not 0 <= check_moment("lag", lag) <= self.window:
            raise fail("lag", f"a number from 0 to the window, {self.window:g}", lag)
        by_steps, rows = self._program.dt is None, self._plant.rows
        time = np.ceil(min(self.now, self._fleet.end_step) - lag) if by_steps else self.now - lag
        base_time, *_ = rows.keys[0]  # of the newest row that is final
        if time <= base_time if by_steps else time < base_time:
            raise fail("lag", "one to a moment after what is final", f"{lag:g}, to {time:.12g}")
        # Slots of the row before that moment, of the moment itself (index 1), and of all later rows. If there is no row
        # at that moment, a prediction to it in the spare slot takes its place.
        after = rows.first_after(time)
        has_row = by_steps and rows.keys[after - 1][0] >= time
        slots = [row.slot for row in rows.held[after - (2 if has_row else 1) :]]
        if not has_row:
            self._fleet.predict_into(rows.held[after - 1], time, self._spare)
            slots.insert(1, self._spare)
        return self._program.smoother.estimates(self._fleet.state_table.gather_history(slots), 1, len(slots))

    def final(self) -> Record:
        """Return the estimates that became final since the last call, one for each row with a measurement.

        They are filtered estimates after each row, in order of time. Without calls only the last 2 * `capacity` stay.
        """
        time, outputs = self._finals.take_all()
        estimates = estimates_by_name(self._program, outputs)
        return Record(time, self.network.states, truth=None, measurements={}, estimates=estimates)

    def save(self) -> bytes:
        """Serialise the whole state for `restore`: after it, the same pushes give the same bits."""
        head, arrays = self._pack_state()
        return pack_snapshot(head | {"of": self._program.identity, DESCRIPTION: describe_network(self._fleet)}, arrays)

    def _pack_state(self) -> tuple[dict[str, object], dict[str, np.ndarray]]:
        """Return the whole state as a head and arrays: options, the plant, and the final rows."""
        time, outputs = self._finals.take_all()
        self._finals.add(time, outputs)
        plant = np.frombuffer(pack_plant(self._plant, self._fleet), np.uint8)
        arrays = {"plant": plant, "final.time": time, "final": outputs}
        options = [self.window, self.ahead, self.capacity]
        return {"options": options, "gated": self._gates.pack(), "reasons": self.reasons}, arrays

    @classmethod
    def restore(cls, network: Network, data: bytes, accept_changes: bool = False) -> "Timeline":
        """Restore a saved timeline of the same network.

        Args:
            network: the network of the timeline.
            data: what `save` returned.
            accept_changes: go on with the timeline of a network that has changed in numbers, nodes or filters, or that
                another version saved, and warn of each change. A filter goes on if its state has the same parts; a
                covariance of a version before 0.3.0 becomes its factors. Others begin with the initial law, and final
                rows of estimates go on if their filters are the same.

        Raises:
            ValueError: no snapshot, or one of another network or version.
        """
        head, arrays = unpack_snapshot(data)
        mine, other = shared_program(network).identity, head.get("of", {})
        if accept_changes and mine != other:
            return cls._resume_from(network, head, carry_over_timeline(network, head, arrays))
        check_same_network("snapshot", mine, other, SAME)
        return cls._resume_from(network, head, arrays)

    @classmethod
    def _resume_from(cls, network: Network, head: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Timeline":
        """Return a timeline of the network that goes on from a saved state, given as a snapshot's head and arrays."""
        window, ahead, capacity = head["options"]
        with warnings.catch_warnings():  # the warning was given when the timeline was made
            warnings.simplefilter("ignore")
            new = cls(network, window, ahead=ahead, capacity=capacity)
        new._fleet.end_plant(new._plant)
        new._plant = unpack_plant("", arrays["plant"].tobytes(), new._fleet)
        new._remarks.note_said(new._plant)
        new._gates.unpack(head.get("gated", []))  # absent until version 0.4.0
        new.reasons = dict(head.get("reasons", {}))  # absent until version 0.5.0
        new._finals.add(arrays["final.time"], arrays["final"])
        return new

    def _convert_event(
        self, node: str, sequence: int, time: float, values: ArrayLike, arrival: float | None
    ) -> CheckedEvent:
        """Return a pushed event as checked numbers; without `arrival` it arrived when measured, or now if later."""
        sizes, name = self._fleet.layout.sizes, f"event of {node!r}"
        if not isinstance(node, str) or node not in sizes:
            raise fail("node of an event", f"one of {', '.join(sizes)}", show_value(node))
        index, size = sizes[node]
        moment = check_moment(f"{name}, time", time)
        self._fleet.check_step(f"{name}, time", moment)
        arrived = max(self._plant.confirmed, moment) if arrival is None else check_moment(f"{name}, arrival", arrival)
        numbers = check_numbers(name, values, size, self._fleet.layout.count_values_alone(node)).tolist()
        numbers = self._fleet.layout.append_losses(node, numbers)
        return CheckedEvent(index, check_63_bits(f"{name}, sequence", sequence), moment, numbers, arrived)

    def _finalise(self) -> None:
        """Make rows that are older than the window final, and keep the outputs of those that have data."""
        results = self._fleet.finalise_plants([self._plant])
        with_data = [row for row in results[0].final if row.has_data()]
        if with_data:
            outputs = self._outputs_after([row.slot for row in with_data])
            self._finals.add(np.array([row.key[0] for row in with_data]), outputs)
            self._gates.count_weights_of_zero(outputs)
        self._fleet.free_slots(results)
