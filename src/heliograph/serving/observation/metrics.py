"""Metrics of a watched service, in the text format of Prometheus."""

from collections.abc import Iterable
from functools import partial

from prometheus_client import generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from heliograph.live.event import VERDICTS
from heliograph.model.checks.refusal_reasons import OF_NODES
from heliograph.report.diagnosis.sensor_output_health import summarise_output
from heliograph.serving.observation.answers_between_batches import LastAnswers
from heliograph.serving.observation.service_watch import ServiceWatch

SHOWN = 50  # plants with metrics of their own; of more the worst
# Metrics of a filter's test and of an output, by the ends of their names: what Prometheus says they are.
NIS = {
    "nis": "Normalised innovation squared of what a filter used over its expectation, of a plant's last rows; 1.",
    "nis_low": "Least that is expected of an honest filter.",
    "nis_high": "Most that is expected of an honest filter.",
}
OUTPUTS = {
    "weight": "Mean weight of an output's values, of the last rows of a filter that weighs; 1 counts in full.",
    "share": "Share of an output's values that were down-weighted, below a weight of 1/2.",
    "share_low": "Lower end of its interval of 95 %.",
    "share_high": "Upper end of its interval of 95 %.",
    "bias": "Median of an output's innovations, in its unit.",
    "squared": "Mean square of an output's innovations over their variance; 1.",
}


class ServiceMetrics(Collector):
    """Collector of the metrics of a watch: by node and filter, and by plant where there are few, else of the worst."""

    def __init__(self, watch: ServiceWatch):
        """Register the metrics of the watched service, and write their text once before the first batch."""
        self.watch = watch
        watch.registry.register(self)
        write_text = partial(generate_latest, watch.registry)
        # Keeps the last text, which is returned while a batch takes long. It is asked only one question.
        self._texts = LastAnswers(watch.lock, answer=lambda _: write_text(), begin=write_text())

    def collect(self) -> Iterable[Metric]:
        """Yield the current metrics of all services that `watch` observes, as Prometheus asks for them."""
        yield from _collect_links(self.watch)
        yield from _collect_nis(self.watch)
        yield from _collect_outputs(self.watch)
        yield from _collect_plants(self.watch)
        yield _collect_crossings(self.watch)
        yield _collect_fusion_doubts(self.watch)
        yield _collect_dead_senders(self.watch)
        yield _collect_remarks(self.watch)
        yield GaugeMetricFamily("heliograph_plants", "Plants known.", sum(1 for _ in self.watch.plants()))
        malformed = sum(service.malformed for service in self.watch.services)
        yield CounterMetricFamily("heliograph_malformed", "Messages that could not be read.", malformed)

    def text(self) -> bytes:
        """Return all metrics in Prometheus's text format; while a batch takes long, those before it."""
        return self._texts.ask()


def _collect_plants(watch: ServiceWatch) -> Iterable[Metric]:
    """Yield the tests of each plant where there are few, else of the worst, and how many plants are wrong."""
    worst, labels = watch.list_worst_plants(), ["plant", "node", "filter"]
    wrong = GaugeMetricFamily("heliograph_plants_wrong", "Plants with something wrong.", labels=["what"])
    wrong.add_metric(["dead sender"], sum(bool(item.dead) for item in worst))
    wrong.add_metric(["doubted claim"], sum(bool(item.doubts) for item in worst))
    wrong.add_metric(["refused messages"], sum(bool(item.refused) for item in worst))
    families = [GaugeMetricFamily(f"heliograph_plant_{name}", words, labels=labels) for name, words in NIS.items()]
    dead = GaugeMetricFamily("heliograph_plant_dead_sender", "1: its sender is dead.", labels=["plant", "node"])
    # A few plants are all shown; of many, those with something wrong.
    names = [name for name, _ in watch.plants()]
    shown = names if len(names) <= SHOWN else [item.plant for item in worst[:SHOWN]]
    for plant in dict.fromkeys(shown):
        for key, test in watch.tests(plant).items():
            for family, value in zip(families, (test.ratio, *test.band()), strict=True):
                family.add_metric([plant, *key], value)
    for item in worst[:SHOWN]:
        for node in item.dead:
            dead.add_metric([item.plant, node], 1.0)
    return wrong, *families, dead


def _collect_crossings(watch: ServiceWatch) -> Metric:
    """Return the metric of thresholds that may be crossed, for the SHOWN plants in which this is most probable."""
    what = "Probability that a level of --threshold is passed by so far ahead."
    labels = ["plant", "node", "filter", "threshold", "ahead"]
    crossings = GaugeMetricFamily("heliograph_plant_passing", what, labels=labels)
    for key, probability in watch.crossings(SHOWN):
        crossings.add_metric(list(key), probability)
    return crossings


def _collect_links(watch: ServiceWatch) -> Iterable[Metric]:
    """Return the Prometheus metrics of the nodes' messages: by verdict, lost, values refused by reason, and timeouts.

    The verdict on a message says what became of it, such as used or a duplicate. Lost messages are known by gaps in a
    node's sequence numbers; a node whose messages carry no such number has no metric of lost ones.

    Args:
        watch: the counts of the running service: `links()` by node, and `outputs.left_out` by node and filter.
    """
    # The metrics, still without values, with the labels of each.
    messages = CounterMetricFamily("heliograph_messages", "Messages by node and verdict.", labels=["node", "verdict"])
    lost = GaugeMetricFamily("heliograph_lost", "Gaps in a node's sequence numbers, now.", labels=["node"])
    of_refused = "Values that count as not arrived, by reason; of flag and counter messages. A gate is of a filter."
    refused = CounterMetricFamily("heliograph_refused", of_refused, labels=["node", "filter", "reason"])
    of_timeouts = "Silences longer than a node's timeout that have ended; heliograph_dead_senders has those that last."
    timeouts = CounterMetricFamily("heliograph_timeouts", of_timeouts, labels=["node"])
    of_held = "Runs of equal readings longer than noise allows, of a node that does not refuse them (stuck=)."
    held = CounterMetricFamily("heliograph_held", of_held, labels=["node"])
    # Their values, by node; a count may be None where it cannot be known. A gate leaves out measurements that are
    # improbable under a filter's prediction, so that its counts are by filter.
    for node, tally in watch.links().items():
        for verdict in VERDICTS:
            messages.add_metric([node, verdict], tally[verdict] or 0)
        if tally["lost"] is not None:
            lost.add_metric([node], tally["lost"])
        for reason in OF_NODES:
            refused.add_metric([node, "", reason], tally[reason] or 0)
        timeouts.add_metric([node], tally["timeouts"] or 0)
        held.add_metric([node], tally["held"] or 0)
    for (node, filter_name), count in watch.outputs.left_out.items():
        refused.add_metric([node, filter_name, "gate"], count)
    return messages, lost, refused, timeouts, held


def _collect_dead_senders(watch: ServiceWatch) -> Metric:
    """Return the metric of dead senders: for each node, in how many plants its sender has been silent too long."""
    what = "Plants in memory whose sender at a node misses its heartbeats, and not by chance, or is past its timeout."
    dead = GaugeMetricFamily("heliograph_dead_senders", what, labels=["node"])
    for node, count in watch.dead_senders().items():
        dead.add_metric([node], count)
    return dead


def _collect_remarks(watch: ServiceWatch) -> Metric:
    """Return the metric of gates that gave in, by node and filter: a filter then accepts what it refused for long."""
    what = "Times that a gate gave in: it took up what it had refused for long."
    gave_in = CounterMetricFamily("heliograph_gave_in", what, labels=["node", "filter"])
    for key, count in watch.remarks().items():
        gave_in.add_metric(list(key), count)
    return gave_in


def _collect_fusion_doubts(watch: ServiceWatch) -> Metric:
    """Return the metric of doubted fusions: a fusion without its own test is judged by the filters that it fuses."""
    what = "1 if a filter whose estimates a fusion without a test of itself takes is doubted."
    doubted = GaugeMetricFamily("heliograph_fusion_doubted", what, labels=["filter"])
    for row in watch.judge_fusions(watch.nis):
        doubted.add_metric([str(row["filter"])], float(bool(row["doubt"])))
    return doubted


def _collect_nis(watch: ServiceWatch) -> Iterable[Metric]:
    """Return three metrics of each filter: the ratio of its NIS to the expected NIS, and the two ends of its band.

    NIS is the normalised innovation squared. The ratio should be near 1, and lies in the band if the filter is honest.
    """
    labels = ["node", "filter"]
    ratio = GaugeMetricFamily(
        "heliograph_nis", "Normalised innovation squared over its expectation, of the last rows; 1.", labels=labels
    )
    low = GaugeMetricFamily("heliograph_nis_low", "Least that is expected of an honest filter.", labels=labels)
    high = GaugeMetricFamily("heliograph_nis_high", "Most that is expected of an honest filter.", labels=labels)
    for key, nis in watch.nis.items():
        for metric, value in zip((ratio, low, high), (nis.ratio, *nis.band()), strict=True):
            metric.add_metric(list(key), value)
    return ratio, low, high


def _collect_outputs(watch: ServiceWatch) -> Iterable[Metric]:
    """Return the metrics in OUTPUTS, such as mean weight and bias, of each number that weighing filters receive.

    A metric is left out if there are too few rows for it.
    """
    metrics = {
        name: GaugeMetricFamily(f"heliograph_output_{name}", words, labels=["node", "filter", "output"])
        for name, words in OUTPUTS.items()
    }
    for output in watch.outputs.summarise_outputs():
        numbers = summarise_output(output)
        for name, metric in metrics.items():
            if isinstance(value := numbers[name], float):
                metric.add_metric([output.node, output.filter, output.judged.output], value)
    return metrics.values()
