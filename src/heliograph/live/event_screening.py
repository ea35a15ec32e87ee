"""What a node refuses of an event before any filter sees it: values beyond limits, and values that repeat."""

from collections.abc import Mapping

import numpy as np

from heliograph.live.event import CheckedEvent
from heliograph.live.health.link_counts import ScreenedEvent
from heliograph.live.health.stuck_sensor_watch import RepeatWatch
from heliograph.model.checks.refusal_reasons import count_by_reason
from heliograph.model.readings.reading_limits import ReadingLimits
from heliograph.model.readings.repeated_readings import Repeats
from heliograph.model.trigger import AbstractTrigger
from heliograph.simulation.network import Network


class EventScreening:
    """Takes the values out of events that their nodes refuse, and follows runs of equal readings."""

    def __init__(self, network: Network, triggers: Mapping[str, AbstractTrigger], watches: Mapping[str, RepeatWatch]):
        """Note the limits of the network's nodes.

        Args:
            network: the network.
            triggers: {node whose sender decides when to send: its trigger}.
            watches: {node that does not refuse stuck readings: what follows its runs of equal ones}.
        """
        self._nodes, self._triggers, self._watches = network.nodes, triggers, watches
        self._limits = {name: node.limits for name, node in network.nodes.items() if node.limits is not None}

    def screen(self, node: str, event: CheckedEvent, runs: Repeats) -> ScreenedEvent:
        """Return an event of a node without the values that the node refuses.

        The result also has the runs up to this event, in order of arrival: how often each component came with the same
        value in a row. `runs` are those before the event.
        """
        limits, watch = self._limits.get(node), self._watches.get(node)
        if limits is None and watch is None:
            return ScreenedEvent(event)
        screened = ScreenedEvent(event, repeats=runs)
        if limits is not None:
            screened = self._screen_by_limits(limits, node, screened)
        if watch is not None:
            screened = screened._replace(repeats=watch.extend_runs(screened.event.values, screened.repeats))
        return screened

    def _screen_by_limits(self, limits: ReadingLimits, node: str, unscreened: ScreenedEvent) -> ScreenedEvent:
        """Return an event without the values that a node's limits refuse, with counts of them and words on why."""
        event, values = unscreened.event, np.array(unscreened.event.values)
        screened = limits.screen(values[None], unscreened.repeats)  # of several readings, of which this is the only one
        if not screened.refused.any():
            return ScreenedEvent(event, repeats=screened.repeats)
        refused = screened.refused[0]  # (received,): 0 where a value is not refused, else the number of the reason
        why = limits.describe_missing(values, refused, self._nodes[node].received_names)
        left, trigger = screened.values[0], self._triggers.get(node)
        if trigger is not None:  # a refused value was sent all the same, so that its absence is no silence
            left = trigger.leave_out_refused(values, refused > 0, len(self._nodes[node].outputs))
        counts = {reason: int(count.sum()) for reason, count in count_by_reason(screened.refused).items()}
        return ScreenedEvent(event._replace(values=left.tolist()), counts, why, screened.repeats)
