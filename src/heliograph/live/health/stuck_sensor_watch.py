"""Watch for stuck sensors: readings that repeat for longer than their noise allows, where no rule says so."""

from collections.abc import Sequence
from math import ceil, inf, log

import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import unstack
from heliograph.model.readings.repeated_readings import (
    LEAST,
    SELDOM,
    Repeats,
    bound_probability_of_equal_readings,
    delivers_as_sent,
)
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.simulation.node import Node

FIRST = Repeats()  # before the first reading
KEPT_BOUNDS = 10_000  # of outputs and resolutions; then all are forgotten, and computed anew
SURE = 1e-12  # of a probability below one: a run is as long as one likes


class RepeatWatch:
    """Watch for runs of equal readings that noise makes less than once in 10^9 readings, one sensor's, one by one.

    A reading of resolution q equals the one before with probability at most p(q), whatever the sensor measures
    (`bound_probability_of_equal_readings`), and p grows with q. Where no resolution is declared, the least difference
    of two successive readings so far is a multiple of q, so that its p is a bound too; where all were equal that is 1,
    and nothing is found. A law may be stated too large, or repeat values by itself: p is at least (e + 1) / (o + 2),
    where e of the o pairs of successive readings outside of the run were equal. A run of n readings begins at a
    reading with probability at most p^(n - 1), and is found where that is at most SELDOM: one by chance is at most so
    rare.

    Args:
        noises: laws of the sensor's noise, one for each that it has over time.
    """

    def __init__(self, noises: Sequence[AbstractNoise]):
        """Hold the sensor's noise laws, one for each that it has over time; no bound p(q) is computed yet."""
        self.noises = noises
        self._bounds = dict[tuple[int, float], float]()  # by output and resolution

    @staticmethod
    def for_sensor(sensor: AnySensor | None, channel: Channel | None, received: int) -> "RepeatWatch | None":
        """Return the watch for what arrives of a sensor; None if equal readings say nothing there.

        That is so if no bound is known of how often its noise repeats a reading, or if the channel changes readings.

        Args:
            sensor: the sensor, with noise that may vary over time; None if it is not known.
            channel: what its readings pass through; None if it is not known.
            received: how many numbers arrive.
        """
        steps = [] if sensor is None else unstack(sensor)
        if channel is None or not steps or not all(isinstance(step, AbstractSensor) for step in steps):
            return None
        if any(len(list_mode_models(step)) > 1 for step in steps):  # of modes, of which one may be that it is stuck
            return None
        # All outputs have to arrive as they were measured.
        outputs = tuple(range(received))
        if len(steps[0].outputs) != received or not all(delivers_as_sent(link, outputs) for link in unstack(channel)):
            return None
        noises = list({id(step.noise): step.noise for step in steps}.values())
        try:  # whether there is a bound, at any resolution
            for noise in noises:
                bound_probability_of_equal_readings(noise, np.full(received, inf))
        except ValueError:  # a law of which no bound is known
            return None
        return RepeatWatch(noises)

    @staticmethod
    def for_node(node: object) -> "RepeatWatch | None":
        """Return the watch for runs of equal readings of a node; None where it has nothing to say.

        That is if the node already refuses stuck values by its limits, or if a trigger or an encoder decides what is
        sent, so that equal readings are normal.
        """
        if not isinstance(node, Node) or node.trigger is not None or node.encoder is not None:
            return None
        refuses = node.limits is not None and node.limits.stuck is not None
        return None if refuses else RepeatWatch.for_sensor(node.sensor, node.channel, node.received)

    def extend_runs(self, values: Sequence[float], before: Repeats | None = None) -> Repeats:
        """Return the runs of equal readings that end with these `values`, NaN where none arrived.

        A sensor that repeats a value for longer than its noise allows is stuck. `before` has the runs up to the
        reading before; None at the first one. In the result `found` is one more where a run has become too long with
        this reading.
        """
        m, before = len(values), before or FIRST
        # By component; the fields of `before` are empty before the first reading.
        newest = list(before.newest or [np.nan] * m)  # the last value
        lengths = list(before.lengths or [0] * m)  # how often it came in a row
        least_steps = list(before.steps or [inf] * m)  # least difference of two successive readings that differ
        readings = list(before.readings or [0] * m)  # how many came
        equal = list(before.equal or [0] * m)  # how many equalled the one before
        found = list(before.found or [0] * m)  # runs that became too long
        # For each component: the reading continues its run or begins a new one; then whether the run is now too long.
        for i, value in enumerate(values):
            if value != value:  # NaN: nothing arrived, and the run goes on
                continue
            if value == newest[i]:
                lengths[i] += 1
                equal[i] += 1
            else:  # a new run; the least difference of two successive readings bounds the resolution
                if readings[i]:
                    least_steps[i] = min(least_steps[i], abs(value - newest[i]))
                newest[i], lengths[i] = value, 1
            readings[i] += 1
            # A run is counted once, when its length reaches the least that is too long, which is LEAST or more.
            if lengths[i] >= LEAST:
                too_long = self._find_least_count_too_long(i, lengths[i], least_steps[i], readings[i], equal[i])
                found[i] += lengths[i] == too_long
        return Repeats(
            newest=tuple(newest),
            lengths=tuple(lengths),
            steps=tuple(least_steps),
            readings=tuple(readings),
            equal=tuple(equal),
            found=tuple(found),
        )

    def describe_stuck_output(self, output: int, name: str, repeats: Repeats) -> str:
        """Return a sentence that says which output is stuck, how rare that is, and which option refuses it.

        `output` is the output's index, `name` its name, and `repeats` the runs of equal readings so far.
        """
        length, value = repeats.lengths[output], repeats.newest[output]
        count = self._find_least_count_too_long(
            output, length, step=repeats.steps[output], readings=repeats.readings[output], equal=repeats.equal[output]
        )
        return (
            f"{name} is stuck, or has no noise: {length} equal readings in a row ({value:g}), of which its noise makes "
            f"{count:g} less than once in {1 / SELDOM:,.0f} readings; stuck={count:g} refuses such"
        )

    def _bound_repeat_probability(self, output: int, step: float) -> float:
        """Return a bound of the probability that an output of resolution `step` repeats its reading.

        It is the largest probability over `noises`, the distributions that the noise may have. `_bounds` keeps about
        KEPT_BOUNDS results, by output and resolution.
        """
        key = output, step
        if key not in self._bounds:
            if len(self._bounds) > KEPT_BOUNDS:
                self._bounds.clear()
            bounds = [
                bound_probability_of_equal_readings(noise, np.full(noise.dimension, step))[output]
                for noise in self.noises
            ]
            self._bounds[key] = float(max(bounds))
        return self._bounds[key]

    def _find_least_count_too_long(self, output: int, length: int, step: float, readings: int, equal: int) -> float:
        """Return the least count of equal readings in a row that is too long for an output; infinite if there is none.

        Args:
            output: index of the output.
            length: length of the present run of equal readings.
            step: least difference of two successive readings so far.
            readings: how many readings there were, including the run.
            equal: how many readings were equal to the previous one, including the run.
        """
        # Outside the run, e = equal - (length - 1) of o = readings - length pairs are equal: take (e + 1) / (o + 2).
        by_count = (equal - (length - 1) + 1) / (readings - length + 2)
        p = max(self._bound_repeat_probability(output, step), by_count)
        # The least count c with p^(c - 1) < SELDOM, but at least LEAST. There is none if p is 1 up to SURE.
        return inf if p >= 1 - SURE else max(LEAST, 1 + ceil(log(SELDOM) / log(p)))
