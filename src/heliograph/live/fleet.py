"""Plants of one network: events are taken one after another, and due rows are stepped for all plants at once."""

from collections.abc import Iterable, Sequence
from datetime import datetime
from math import ceil, floor, inf, nan

import numpy as np

from heliograph.live.clock_leap import ARRIVAL, ClockLeap, find_contradicted_leap
from heliograph.live.event import INPUTS, OF_STEPS, CheckedEvent, Verdict
from heliograph.live.fleet_options import Options, check_options
from heliograph.live.health.link_counts import ScreenedEvent
from heliograph.live.health.sender_status import SenderStatus, count_values_before_losses, find_silence_rules
from heliograph.live.health.stuck_sensor_watch import RepeatWatch
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.plant_state import FinalisedPlant, PlantState
from heliograph.live.plant_table import StateTable, cut_chain_into_legs, group_by_turn
from heliograph.live.sorted_rows import BEFORE, HeldRow, SortedRows, list_columns_of_blocks
from heliograph.model.checks.refusal_reasons import count_by_reason
from heliograph.model.over_time import steps_covered
from heliograph.model.readings.reading_limits import ReadingLimits
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
        """Take the compiled step of a network and the limits of events, and note what each node's events need.

        `alone`: single rows are stepped, not those of many plants at once. There is no plant yet.
        """
        instance("program", program, NetworkProgram, "NetworkProgram")
        instance("options", options, Options, "Options")
        network = self.network = program.network
        self.options, self.program = check_options(options), program
        self.state_table = StateTable(program, alone)
        # By name of a node, then of the inputs: its index, -1 for the inputs, and how many numbers its events have.
        self.sizes = {name: (i, network.nodes[name].received) for i, name in enumerate(network.names)}
        self.sizes[INPUTS] = -1, self.program.given
        # Columns of these numbers in a row, by that index; how many numbers a row has before its time.
        self._columns = list_columns_of_blocks([size for _, size in self.sizes.values()])
        self.width = self._columns[-1].stop
        covered = steps_covered(network)
        self.end_step = np.inf if covered is None else covered - 1  # the last step for which the network is defined
        self._names = [*network.names, INPUTS]
        self._joint = self.program.dt is None or network.common is not None  # see `rows_are_joint`
        # What a node refuses of its readings; what it watches for where it refuses none that repeat.
        self._limits = {name: node.limits for name, node in network.nodes.items() if node.limits is not None}
        self.held_watches = {n: watch for n, node in network.nodes.items() if (watch := RepeatWatch.for_node(node))}
        self.periods = dict[str, int]()  # after how many messages a node's count begins at 0 again, where it does
        # Nodes whose silence says something; of these the ones whose sender decides when to send, by its trigger.
        self.watched = find_silence_rules(network)
        self.deciding = {name: rule.trigger for name, rule in self.watched.items() if rule.trigger is not None}
        self._values_before_losses = count_values_before_losses(network, self.deciding)
        # A slot with the prior, at step -1, for plants that have not begun.
        self._blank = self.state_table.take_slot()
        self.state_table.write_prior(self._blank, -1.0)

    @property
    def shortest_timeout(self) -> float:
        """Return the shortest timeout of a node, in steps or in the unit of continuous time; infinite where none is."""
        return min((s.timeout for s in self.watched.values() if s.timeout is not None), default=inf)

    @property
    def rows_are_joint(self) -> bool:
        """Return whether all events of one time form one row."""
        return self._joint

    def begin_plant(self, name: str, time: float, origin: datetime | None) -> PlantState:
        """Return a new plant whose only row, in a slot (row number) of the table, holds the prior.

        In continuous time the prior is at `time`. If time counts steps, they start at 0, and the prior is at step -1.
        `origin`: the date from which times are counted, None if they are numbers.
        """
        by_steps = self.program.dt is None
        prior_time = -1.0 if by_steps else time
        slot = self.state_table.take_slot()
        self.state_table.write_prior(slot, prior_time)
        base = HeldRow((prior_time, BEFORE, 0), slot, self.width)
        base.numbers[-1] = prior_time
        return PlantState(name, self.make_rows(base), now=0.0 if by_steps else time, origin=origin, begun=time)

    def end_plant(self, plant: PlantState) -> None:
        """Remove a plant and free its slots."""
        self.end_silence(plant)
        self.state_table.free_slots(plant.slots)

    def pass_silence(self, plants: Iterable[tuple[PlantState, float]]) -> None:
        """Predict each plant to the step paired with it, without measurements; this row becomes the plant's `silence`.

        The row does not belong to the plant's history and is dropped at the next event. A later prediction continues
        from an earlier one, so that no step is computed twice.
        """
        chains = []
        for plant, step in plants:
            before = plant.silence or plant.rows.held[-1]
            if step <= before.key[0]:  # the plant was already predicted so far
                continue
            slot = plant.silence.slot if plant.silence is not None else self.state_table.take_slot()
            plant.silence = HeldRow((step, 0, 0), slot, self.width)  # nothing came: all its numbers are NaN
            self.state_table.table[slot, self.state_table.numbers] = plant.silence.numbers
            chains.append([before, plant.silence])
        self._step_chains(chains)

    def end_silence(self, plant: PlantState) -> None:
        """Forget the row of a plant that was predicted without measurements, and free its slot in the table."""
        if plant.silence is not None:
            self.state_table.free_slots([plant.silence.slot])
            plant.silence = None

    def count_values(self, node: int) -> int:
        """Return how many numbers an event has of the node with this index, -1 for the inputs."""
        columns = self._columns[node]
        return int(columns.stop - columns.start)

    def make_rows(self, base: HeldRow) -> SortedRows:
        """Return the rows of a plant, of which so far there is only the one before all events, `base`."""
        return SortedRows(base, self._joint, self._columns, self.options.capacity)

    def convert_message(
        self, node: str, sequence: int, time: float, values: list[float | None], arrival: float
    ) -> CheckedEvent:
        """Return a message as an event; raise ValueError if its node, number of values or time is impossible.

        None stands for a value that did not arrive. `time` and `arrival` are in steps, or in the unit of dt.
        """
        index, size = self.sizes.get(node, (0, -1))
        if size < 0:  # no such node
            raise fail("message, node", f"one of {', '.join(self.sizes)}", repr(node)[:60])
        numbers = self.append_losses(node, [nan if value is None else value for value in values])
        if len(numbers) != size:
            raise fail(f"message of {node!r}, values", f"{size} numbers", len(values))
        self.check_step("message, time", time)
        return CheckedEvent(index, sequence, time, numbers, arrival)

    def append_losses(self, node: str, values: list[float]) -> list[float]:
        """Return a message's values, followed by NaN for each number of lost messages if it does not state these.

        Only filters of senders that decide when to send need them. The count of messages later replaces the NaN.

        Raises:
            ValueError: values of a sender of single components, whose losses a count of messages does not say.
        """
        (_, size), outputs = self.sizes[node], self.count_values_alone(node)
        if outputs is None:
            return values
        if len(values) == outputs:
            values = values + [nan] * (size - outputs)
        # A sender of single components: behind each value that arrived (is not NaN) has to stand a number.
        is_by_component = self.deciding[node].region == "each" and len(values) == size
        lacks_number = is_by_component and any(
            value == value and lost != lost for value, lost in zip(values[:outputs], values[outputs:], strict=True)
        )
        if lacks_number:
            expected = "behind each value how many of its component were lost since the last"
            raise fail(
                f"message of {node!r}, values", expected, "none, and its count is of messages, not of components"
            )
        return values

    def count_values_alone(self, node: str) -> int | None:
        """Return how many values a node's event has without numbers of lost messages; None if it has none of these."""
        return self._values_before_losses.get(self.sizes[node][0])

    def _find_lost_column(self, node: int) -> tuple[str, int] | None:
        """Return the node's name and the column of its number of lost messages, or None if it has no such number."""
        outputs = self._values_before_losses.get(node)
        if outputs is None or self.count_values(node) != outputs + 1:
            return None
        return self._names[node], self._columns[node].start + outputs

    def check_step(self, name: str, time: float) -> None:
        """Raise ValueError, which calls the time `name`, if the network counts steps and the time is none of them."""
        if self.program.dt is None and not (0 <= time <= self.end_step and time == int(time)):
            end = "" if self.end_step == np.inf else f" to {self.end_step:g}"
            raise fail(name, f"a step, a whole number from 0{end}", f"{time} ({OF_STEPS})")

    def screen_event(self, node: str, event: CheckedEvent, plant: PlantState | None) -> ScreenedEvent:
        """Return an event without the values that its node refuses: beyond its limits, or repeated for too long.

        The runs of equal readings that end with this event, in order of arrival, are returned too. The plant (None if
        it has not begun) is not changed.
        """
        limits, watch = self._limits.get(node), self.held_watches.get(node)
        if limits is None and watch is None:
            return ScreenedEvent(event)
        link = None if plant is None else plant.links.get(node)
        screened = ScreenedEvent(event, repeats=Repeats() if link is None else link.repeats)
        if limits is not None:
            screened = self._screen_by_limits(limits, node, screened)
        if watch is not None:
            screened = screened._replace(repeats=watch.extend_runs(screened.event.values, screened.repeats))
        return screened

    def _screen_by_limits(self, limits: ReadingLimits, node: str, unscreened: ScreenedEvent) -> ScreenedEvent:
        """Return an event without the values that a node's limits refuse. `repeats`: its runs of equal readings."""
        event, values = unscreened.event, np.array(unscreened.event.values)
        screened = limits.screen(values[None], unscreened.repeats)
        if not screened.refused.any():
            return ScreenedEvent(event, repeats=screened.repeats)
        why = limits.describe_missing(values, screened.refused[0], self.network.nodes[node].received_names)
        left, trigger = screened.values[0], self.deciding.get(node)
        if trigger is not None:
            left = trigger.leave_out_refused(values, screened.refused[0] > 0, len(self.network.nodes[node].outputs))
        counts = {reason: int(count.sum()) for reason, count in count_by_reason(screened.refused).items()}
        return ScreenedEvent(event._replace(values=left.tolist()), counts, why, screened.repeats)

    def take_event(
        self, plant: PlantState, event: CheckedEvent, arrival_known: bool = False, wall: float | None = None,
        clock: str | None = None,
    ) -> Verdict:  # fmt: skip
        """Return the verdict on an event of a plant, and hold the event in its row if that is "used".

        An event dated more than `options.leap` after all before it is used, but that clock may be wrong: no row becomes
        final by it until another clock says the same, and events dated before the gap take it back (`ClockLeap`).

        Args:
            plant: rows and newest time of the plant.
            event: a message of a node: its time, arrival, running count and values.
            arrival_known: whether its arrival was given, by another clock than the sender's.
            wall: time by the receiver's own clock, if it is known.
            clock: name of the node by whose clock it is dated (None: its own).
        """
        if self.program.dt is None and event.time > LAST_STEP:  # beyond it one step cannot be told from the next
            return "future"
        # The clock that says how late it is: that of arrivals where one was given, else the sender's.
        longest_gap = self.options.leap
        clock_time = event.arrival if arrival_known else event.time
        clock_name = ARRIVAL if arrival_known else clock or self._names[event.node_index]
        # A second clock may agree: the one on the wall, or the sender's with that of arrivals.
        wall_agrees = wall is not None and abs(clock_time - wall) <= longest_gap
        sender_agrees = arrival_known and abs(clock_time - event.time) <= longest_gap
        agreed = wall_agrees or sender_agrees
        # An event from the future will be refused, and takes back no leap.
        if plant.leap is not None and event.time <= event.arrival + self.options.ahead:
            plant.undo_contradicted_leap(clock_name, clock_time, longest_gap, agreed, self._names)
            if not arrival_known:  # it arrives now, which may be earlier by now
                event = event._replace(arrival=max(plant.confirmed, event.time))
        now = max(plant.confirmed, event.arrival)
        key = plant.rows.make_key(event)
        verdict = plant.rows.judge_event(event, key, now - self.options.window, self.options.ahead)
        if verdict == "used":
            self.end_silence(plant)
            plant.add_event(
                event, key, self.state_table.take_slot, self.width, self._find_lost_column(event.node_index)
            )
            plant.pass_time(clock_name, clock_time, now, longest_gap, agreed)
        return verdict

    def advance_time(self, plant: PlantState, now: float) -> None:
        """Advance a plant's time to `now`, known to be right; undo a leap (jump of one clock) that went far beyond."""
        leap, longest_gap = plant.leap, self.options.leap
        if leap is not None:
            found = find_contradicted_leap(leap, plant.now, now, longest_gap)
            if found is not None and found[0].now > -inf:  # not the leap with which the plant began (nothing before)
                plant.undo_leap(found[0], longest_gap, self._names)
            elif now >= leap.time - longest_gap:  # the right time has come as far, and confirms the leap
                plant.leap = None
        plant.now = max(plant.now, now)

    def undo_events(self, plant: PlantState, clock: tuple[float, ClockLeap | None]) -> None:
        """Undo a plant's events since its rows were last made final. `clock`: its time and newest leap in time then."""
        self.state_table.free_slots(plant.undo_changes())
        plant.clock = clock

    def finalise_plants(self, touched: Iterable[PlantState], all_: bool = False) -> list[FinalisedPlant]:
        """Step the plants, and return for each the rows that became final: those before the watermark, or `all_`.

        `touched` holds plants that took events or whose time went on. The watermark is their time minus the window.
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
        """Step the changed rows of all plants, and all rows after them, at once; write them into the table."""
        chains = list(filter(None, [plant.take_changed_rows() for plant in plants]))
        rows = [row for chain in chains for row in chain]
        if rows:
            numbers = np.array([number for row in rows for number in row.numbers]).reshape(len(rows), -1)
            self.state_table.table[[row.slot for row in rows], self.state_table.numbers] = numbers
        self._step_chains(chains)

    def _step_chains(self, chains: Sequence[list[HeldRow]]) -> None:
        """Compute the state of each row of a chain from the row before it; a row's measurements are in the table."""
        by_steps, endless = self.program.dt is None, self.end_step == np.inf
        # Long gaps cut a chain into legs. Step the first legs of all chains at once, pass their gaps, and so on.
        legs_of_chains = [cut_chain_into_legs(chain, by_steps, endless) for chain in chains]
        while legs_of_chains:
            for steps in group_by_turn(legs[0].steps for legs in legs_of_chains):
                self.state_table.step_slots_in_place(*map(np.array, zip(*steps, strict=True)))
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
        """Predict from a row to a later time, into a slot that no row has."""
        self.step_row(row, HeldRow((float(time), 0, 0), slot, self.width))

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
        """Return the outputs of all filters (row, output) after the rows in these slots of the table."""
        return self.state_table.table[np.array(slots, dtype=int), self.state_table.outputs]

    def find_sender_status(self, plant: PlantState, now: float = -inf) -> dict[str, SenderStatus]:
        """Return {node whose silence says something: the status of its sender by now}.

        `now`: time by a clock; if the newest arrival, or the newest step without a message, is later, that counts.
        """
        now = max(now, plant.now, -inf if plant.silence is None else plant.silence.key[0])
        # What is before the watermark is final: no value may come for it any more. `final`: the newest such moment.
        by_steps, watermark = self.program.dt is None, plant.confirmed - self.options.window
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
            status = rule.find_status(last, plant.begun if rule.trigger is None else -1, final, now)
            statuses[name] = status._replace(refused={} if link is None else link.refused, unit=unit)
        return statuses

    def count_event(self, plant: PlantState, node: str, screened: ScreenedEvent, verdict: Verdict) -> None:
        """Count an event of a node by its verdict; count its screened values and the silence before it."""
        link, event, rule = plant.link_counts(node), screened.event, self.watched.get(node)
        if rule is not None and rule.timeout is not None and verdict == "used":
            link.count_timeout(event.time, plant.begun, rule.timeout)
        link.count(verdict, event.sequence, event.time, self.periods.get(node, 0))
        link.count_screened(screened, verdict)

    def free_slots(self, finalised: Iterable[FinalisedPlant]) -> None:
        """Free the slots that are not needed any more, once the outputs of the final rows have been read."""
        for of_plant in finalised:
            self.state_table.free_slots(of_plant.left)
