"""Metrics of a service in the format of Prometheus."""

from collections.abc import Iterable

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from heliograph.live.event import VERDICTS
from heliograph.serving.watch import Watch


class Tallies(Collector):
    """Collector of the numbers of a watch, by node and filter; not by plant, of which there may be many."""

    def __init__(self, watch: Watch):
        self.watch = watch
        watch.registry.register(self)

    def collect(self) -> Iterable[Metric]:
        """Yield the current metrics."""
        yield from _links(self.watch)
        yield from _nis(self.watch)
        yield _dead(self.watch)
        yield GaugeMetricFamily("heliograph_plants", "Plants known.", sum(1 for _ in self.watch.plants()))
        malformed = sum(service.malformed for service in self.watch.services)
        yield CounterMetricFamily("heliograph_malformed", "Messages that could not be read.", malformed)

    def text(self) -> bytes:
        """Return all metrics as text."""
        with self.watch.lock:
            return generate_latest(self.watch.registry)


def _links(watch: Watch) -> Iterable[Metric]:
    messages = CounterMetricFamily("heliograph_messages", "Messages by node and verdict.", labels=["node", "verdict"])
    lost = GaugeMetricFamily("heliograph_lost", "Gaps in a node's sequence numbers, now.", labels=["node"])
    what = "Values beyond a node's limits, or codes, which count as not arrived."
    dropped = CounterMetricFamily("heliograph_dropped", what, labels=["node"])
    for node, tally in watch.links().items():
        for verdict in VERDICTS:
            messages.add_metric([node, verdict], tally[verdict])
        lost.add_metric([node], tally["lost"])
        dropped.add_metric([node], tally["dropped"])
    return messages, lost, dropped


def _dead(watch: Watch) -> Metric:
    what = "Plants in memory whose sender at a node misses its heartbeats, and not by chance."
    dead = GaugeMetricFamily("heliograph_dead_senders", what, labels=["node"])
    for node, count in watch.dead_senders().items():
        dead.add_metric([node], count)
    return dead


def _nis(watch: Watch) -> Iterable[Metric]:
    labels = ["node", "filter"]
    ratio = GaugeMetricFamily(
        "heliograph_nis", "Normalised innovation squared over its expectation, of the last rows; 1.", labels=labels
    )
    low = GaugeMetricFamily("heliograph_nis_low", "Least that is expected of an honest filter.", labels=labels)
    high = GaugeMetricFamily("heliograph_nis_high", "Most that is expected of an honest filter.", labels=labels)
    for key, item in watch.nis.items():
        for metric, value in zip((ratio, low, high), (item.ratio, *item.band()), strict=True):
            metric.add_metric(list(key), value)
    return ratio, low, high
