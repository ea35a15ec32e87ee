"""Plants of one network: events are taken one after another, and due rows are stepped for all plants at once."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from math import ceil, floor, inf, nan

import numpy as np

from heliograph.live.clock_leap import ARRIVAL, ClockLeap, find_contradicted_leap
from heliograph.live.event import OF_STEPS, CheckedEvent, Verdict
from heliograph.live.event_screening import EventScreening
from heliograph.live.fleet_options import Options, check_options
from heliograph.live.health.link_counts import ScreenedEvent
from heliograph.live.health.sender_status import SenderStatus, find_silence_rules
from heliograph.live.health.stuck_sensor_watch import RepeatWatch
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.plant_state import FinalisedPlant, PlantState
from heliograph.live.plant_table import StateTable, cut_chain_into_legs, group_by_turn
from heliograph.live.row_layout import RowLayout
from heliograph.live.sorted_rows import BEFORE, HeldRow, SortedRows
from heliograph.model.over_time import steps_covered
from heliograph.model.readings.repeated_readings import Repeats
from heliograph.model.readings.timeouts import name_timeout_unit
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Float

LAST_STEP = 2.0**53  # up to which numbers count steps one by one


class Fleet:
    """Plants of one network: events are taken one after another, and `step` computes the rows that they made due.

    Estimates and verdicts are those of a `Timeline` for each plant; final rows come in order of time within each plant.
    Which plants share a fleet, and how events are cut into batches, changes no bit of an estimate.

    Args:
        program: the compiled step of the network.
        options: the limits of events and of memory.
        alone: single rows are stepped, not those of many plants at once.
    """

    def __init__(self, program: NetworkProgram, options: Options, alone: bool = False):
        """Start without plants: collect what the network says about its events, and make the table of states.

        Args:
            program: the compiled step of the network.
            options: the limits of events and of memory.
            alone: single rows are stepped, not those of many plants at once.
        """
        instance("program", program, NetworkProgram, "NetworkProgram")
        instance("options", options, Options, "Options")
        network = self.network = program.network
        self.options, self.program = check_options(options), program
        # The filters' states after each row of each plant; a slot is the number of a line of this table.
        self.state_table = StateTable(program, alone)
        # Time: the last step for which the network is defined; whether all events of one time share a row.
        covered = steps_covered(network)
        self.end_step = np.inf if covered is None else covered - 1
        self._joint = self.program.dt is None or network.common is not None
        # A watch for stuck readings at nodes that do not refuse these.
        self.held_watches = {n: watch for n, node in network.nodes.items() if (watch := RepeatWatch.for_node(node))}
        # Counts: after how many messages a node's running count begins at 0 again, for nodes where it does.
        self.periods = dict[str, int]()
        # Silence: rules of nodes with a timeout or a trigger; the triggers, by which senders decide when to send.
        self.watched = find_silence_rules(network)
        self.deciding = {name: rule.trigger for name, rule in self.watched.items() if rule.trigger is not None}
        # Where the numbers of events stand in a row; what a node refuses of an event.
        self.layout = RowLayout(network, program.given, self.deciding)
        self._screening = EventScreening(network, self.deciding, self.held_watches)
        # The slot of plants that have not begun: the initial law, at step -1.
        self._blank = self.state_table.take_slot()
        self.state_table.write_prior(self._blank, -1.0)

    @property
    def shortest_timeout(self) -> float:
        """Return the shortest timeout of a node, in steps or in the unit of continuous time; infinite where none is."""
        return min((s.timeout for s in self.watched.values() if s.timeout is not None), default=inf)

    @property
    def rows_are_joint(self) -> bool:
        """Return whether all events of one time form one row: where time counts steps, or nodes share a channel.

        Else each event has a row of its own.
        """
        return self._joint

    def begin_plant(self, name: str, time: float, origin: datetime | None) -> PlantState:
        """Return a new plant whose only row holds the initial law of the filters' states.

        Args:
            name: name of the plant.
            time: time of its first message. In continuous time the initial law holds at that time; if time counts
                steps, these start at 0, and the initial law holds at step -1.
            origin: the date from which times are counted, None if they are numbers.
        """
        by_steps = self.program.dt is None
        prior_time = -1.0 if by_steps else time
        slot = self.state_table.take_slot()
        self.state_table.write_prior(slot, prior_time)
        base = HeldRow((prior_time, BEFORE, 0), slot, self.layout.width)
        base.numbers[-1] = prior_time  # the last number of a row is its time
        return PlantState(name, self.make_rows(base), now=0.0 if by_steps else time, origin=origin, begun=time)

    def end_plant(self, plant: PlantState) -> None:
        """Free the slots of a plant, its lines in the table; it must not be used any more."""
        self.end_silence(plant)
        self.state_table.free_slots(plant.slots)

    def pass_silence(self, plants: Iterable[tuple[PlantState, float]]) -> None:
        """Predict each plant to the step paired with it, as if nothing more had been measured until then.

        The predicted row is kept as `plant.silence`. It does not belong to the plant's history and is dropped at the
        next event. A later prediction continues from an earlier one, so that no step is computed twice.
        """
        chains = []
        for plant, step in plants:
            before = plant.silence or plant.rows.held[-1]
            if step <= before.key[0]:  # the plant was already predicted so far
                continue
            slot = plant.silence.slot if plant.silence is not None else self.state_table.take_slot()
            plant.silence = HeldRow((step, 0, 0), slot, self.layout.width)  # nothing came: all its numbers are NaN
            self.state_table.table[slot, self.state_table.numbers] = plant.silence.numbers
            chains.append([before, plant.silence])
        self._step_chains(chains)

    def end_silence(self, plant: PlantState) -> None:
        """Forget the row of a plant that was predicted without measurements, and free its slot in the table."""
        if plant.silence is not None:
            self.state_table.free_slots([plant.silence.slot])
            plant.silence = None

    def make_rows(self, base: HeldRow) -> SortedRows:
        """Return the history of a plant before its first event: only the row `base`, with the initial law."""
        return SortedRows(base, self._joint, self.layout.columns, self.options.capacity)

    def convert_message(
        self, node: str, sequence: int, time: float, values: list[float | None], arrival: float
    ) -> CheckedEvent:
        """Return a message as an event; raise ValueError if its node, number of values or time is impossible.

        None stands for a value that did not arrive. `time` and `arrival` are in steps, or in the unit of dt.
        """
        index, size = self.layout.sizes.get(node, (0, -1))
        if size < 0:  # no such node
            raise fail("message, node", f"one of {', '.join(self.layout.sizes)}", repr(node)[:60])
        numbers = self.layout.append_losses(node, [nan if value is None else value for value in values])
        if len(numbers) != size:
            raise fail(f"message of {node!r}, values", f"{size} numbers", len(values))
        self.check_step("message, time", time)
        return CheckedEvent(index, sequence, time, numbers, arrival)

    def check_step(self, name: str, time: float) -> None:
        """Raise ValueError if the network counts steps and `time` is none of them; the error calls it `name`."""
        if self.program.dt is None and not (0 <= time <= self.end_step and time == int(time)):
            end = "" if self.end_step == np.inf else f" to {self.end_step:g}"
            raise fail(name, f"a step, a whole number from 0{end}", f"{time} ({OF_STEPS})")

    def screen_event(self, node: str, event: CheckedEvent, plant: PlantState | None) -> ScreenedEvent:
        """Return an event without the values that its node refuses: beyond its limits, or repeated for too long.

        Args:
            node: name of the event's node.
            event: the event as it came.
            plant: the plant, which is not changed; None if it has not begun.
        """
        link = None if plant is None else plant.links.get(node)
        return self._screening.screen(node, event, runs=Repeats() if link is None else link.repeats)

    def take_event(
        self, plant: PlantState, event: CheckedEvent, arrival_known: bool = False, wall: float | None = None,
        clock: str | None = None,
    ) -> Verdict:  # fmt: skip
        """Return the verdict on an event of a plant, and add the event to its row if that is "used".

        A leap is a jump of more than `options.leap` in the dates of events, which the error of one clock may cause: no
        row becomes final by it until another clock says the same, and events dated before the jump undo it.

        Args:
            plant: rows and newest time of the plant.
            event: a message of a node: its time, arrival, running count and values.
            arrival_known: whether its arrival was given, by another clock than the sender's.
            wall: time by the receiver's own clock, if it is known.
            clock: name of the node by whose clock it is dated (None: its own).
        """
        if self.program.dt is None and event.time > LAST_STEP:  # beyond it one step cannot be told from the next
            return "future"
        # The clock by which it is now: that of arrivals where one was given, else the sender's.
        longest_gap = self.options.leap
        clock_time = event.arrival if arrival_known else event.time
        clock_name = ARRIVAL if arrival_known else clock or self.layout.names[event.node_index]
        # A second clock may agree: the receiver's own, or the sender's with that of arrivals.
        wall_agrees = wall is not None and abs(clock_time - wall) <= longest_gap
        sender_agrees = arrival_known and abs(clock_time - event.time) <= longest_gap
        agreed = wall_agrees or sender_agrees
        # The event may show that an earlier leap never happened, unless it will be refused as dated in the future.
        if plant.leap is not None and event.time <= event.arrival + self.options.ahead:
            plant.undo_contradicted_leap(clock_name, clock_time, longest_gap, agreed, self.layout.names)
            if not arrival_known:  # it arrives now, and undoing the leap may have set that time back
                event = event._replace(arrival=max(plant.confirmed, event.time))
        now = max(plant.confirmed, event.arrival)
        key = plant.rows.make_key(event)
        verdict = plant.rows.judge_event(event, key, now - self.options.window, self.options.ahead)
        if verdict == "used":
            self.end_silence(plant)
            lost_column = self.layout.find_lost_column(event.node_index)
            plant.add_event(event, key, self.state_table.take_slot, self.layout.width, lost_column)
            plant.pass_time(clock_name, clock_time, now, longest_gap, agreed)
        return verdict

    def advance_time(self, plant: PlantState, now: float) -> None:
        """Advance a plant's time to `now`, known to be right.

        This time may settle a leap, a jump in time that only one clock showed: `now` before the jump's end undoes it,
        and `now` beyond the end confirms it.
        """
        leap, longest_gap = plant.leap, self.options.leap
        if leap is not None:
            found = find_contradicted_leap(leap, plant.now, now, longest_gap)
            contradicted = None if found is None else found[0]  # a leap; found[1] is the newest arrival after it
            if contradicted is not None and contradicted.now > -inf:  # -inf: the plant began with it, nothing is before
                plant.undo_leap(contradicted, longest_gap, self.layout.names)
            elif now >= leap.time - longest_gap:  # the right time has come as far, and confirms the leap
                plant.leap = None
        plant.now = max(plant.now, now)

    def undo_events(self, plant: PlantState, clock: tuple[float, ClockLeap | None]) -> None:
        """Undo the events that a plant took since its rows were last made final, as if they had never come.

        `clock`: the value of `plant.clock` from before these events.
        """
        self.state_table.free_slots(plant.undo_changes())
        plant.clock = clock

    def finalise_plants(self, touched: Iterable[PlantState], all_: bool = False) -> list[FinalisedPlant]:
        """Step the plants, and return for each the rows that became final.

        These are rows older than the watermark, the plant's time minus the window: later events may not change them.

        Args:
            touched: the plants that took events or whose time went on.
            all_: make all rows final, whatever their time.
        """
        plants, results = list(touched), []
        self.step(plants)
        for plant in plants:
            withdrawn, slots_of_withdrawn = plant.take_withdrawn()
            watermark = np.inf if all_ else plant.confirmed - self.options.window
            final_rows, slots_of_dropped = plant.finalise_rows(watermark, self.options.leap)
            newest, slots = plant.rows.held[-1], slots_of_dropped + slots_of_withdrawn
            results.append(FinalisedPlant(plant, final_rows, newest, left=slots, withdrawn=withdrawn))
        return results

    def step(self, plants: Iterable[PlantState]) -> None:
        """Step the changed rows of all plants, and all rows after them, at once; write the states into the table.

        A chain is a list of rows of one plant, each to be stepped into from the one before it.
        """
        chains = list(filter(None, [plant.take_changed_rows() for plant in plants]))
        rows = [row for chain in chains for row in chain]
        if rows:
            numbers = np.array([number for row in rows for number in row.numbers]).reshape(len(rows), -1)
            self.state_table.table[[row.slot for row in rows], self.state_table.numbers] = numbers
        self._step_chains(chains)

    def _step_chains(self, chains: Sequence[list[HeldRow]]) -> None:
        """Compute the state of each row of a chain from the row before it; a row's measurements are in the table.

        A gap of many steps without measurements is passed at once. Such gaps cut a chain into legs. The first legs of
        all chains are stepped together, then the gaps after them are passed, and so on.
        """
        by_steps, endless = self.program.dt is None, self.end_step == np.inf
        legs_of_chains = [cut_chain_into_legs(chain, by_steps, endless) for chain in chains]
        while legs_of_chains:
            for steps in group_by_turn(legs[0].steps for legs in legs_of_chains):
                slots_before, slots_after, step_numbers = map(np.array, zip(*steps, strict=True))
                self.state_table.step_slots_in_place(slots_before, slots_after, step_numbers)
            legs_of_chains = [legs for legs in legs_of_chains if len(legs) > 1]  # those with a gap after the first leg
            for legs in legs_of_chains:
                _, slot_before_gap, _ = legs[0].steps[-1]
                self.state_table.pass_long_gap(slot_before_gap, to=legs[0].jump)
            legs_of_chains = [legs[1:] for legs in legs_of_chains]

    def step_row(self, before: HeldRow, row: HeldRow) -> None:
        """Compute the state of `row`, which no plant holds, from that of the row `before`; write it into the table."""
        self.state_table.table[row.slot, self.state_table.numbers] = row.numbers
        self._step_chains([[before, row]])

    def predict_into(self, row: HeldRow, time: float, slot: int) -> None:
        """Write the prediction from a row to a later time, without measurements, into a slot that no row has."""
        self.step_row(row, HeldRow((float(time), 0, 0), slot, self.layout.width))

    def predict_outputs(
        self, plants: Sequence[PlantState | None], given: Float[np.ndarray, "plant given"]
    ) -> Float[np.ndarray, "plant outputs"]:
        """Return the outputs of each plant's filters, predicted with these inputs and without measurements.

        The prediction covers one step from the newest row, or one unit of continuous time. A plant that is None has not
        begun yet. An input that is NaN keeps its value.
        """
        slots = [self._blank if plant is None else plant.rows.held[-1].slot for plant in plants]
        return self.state_table.predict_outputs(np.array(slots), given, self.end_step)

    def outputs(self, slots: list[int]) -> Float[np.ndarray, "row outputs"]:
        """Return the outputs of all filters, their estimates and judgements, after rows; (row, output).

        `slots`: the lines of the rows in the table.
        """
        return self.state_table.table[np.array(slots, dtype=int), self.state_table.outputs]

    def find_sender_status(self, plant: PlantState, now: float = -inf) -> dict[str, SenderStatus]:
        """Return {node whose silence says something: the status of its sender by now}.

        `now`: time by a clock; if the newest arrival, or the newest step without a message, is later, that counts.
        """
        by_steps = self.program.dt is None
        newest_silent_step = -inf if plant.silence is None else plant.silence.key[0]
        now = max(now, plant.now, newest_silent_step)
        # What is before the watermark is final: no value may come for it any more. `final`: the newest such moment.
        watermark = plant.confirmed - self.options.window
        final = ceil(max(watermark, -1.0)) - 1 if by_steps else max(watermark, plant.begun)
        now = floor(min(now, self.end_step)) if by_steps else now
        unit = name_timeout_unit(self.network.inputs) or ("" if plant.origin is None else "s")  # s between dates
        statuses = {}
        for name, rule in self.watched.items():
            # When the newest value was measured that was used; no step is below 0.
            link = plant.links.get(name)
            last = None if link is None or not link.used else link.latest
            if by_steps and last is not None:
                last = int(last) if last >= 0 else None
            begun = plant.begun if rule.trigger is None else -1  # from when on it may be silent; triggers go by steps
            status = rule.find_status(last, begun, final, now)
            statuses[name] = status._replace(refused={} if link is None else link.refused, unit=unit)
        return statuses

    def count_event(self, plant: PlantState, node: str, screened: ScreenedEvent, verdict: Verdict) -> None:
        """Count an event of a node by its verdict, its refused values, and a silence before it beyond the timeout."""
        link, event, rule = plant.link_counts(node), screened.event, self.watched.get(node)
        if rule is not None and rule.timeout is not None and verdict == "used":
            link.count_timeout(event.time, plant.begun, rule.timeout)
        link.count(verdict, event.sequence, event.time, self.periods.get(node, 0))
        link.count_screened(screened, verdict)

    def free_slots(self, finalised: Iterable[FinalisedPlant]) -> None:
        """Free the slots that are not needed any more, once the outputs of the final rows have been read."""
        for of_plant in finalised:
            self.state_table.free_slots(of_plant.left)
