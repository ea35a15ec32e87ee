"""The dashboard and the rules of integrations/monitoring, made from the metrics that a service has.

`python -m tests.serving.observation.monitoring` writes both; a test holds that they are what would be written.
"""

import json
import re
from pathlib import Path
from typing import Any

from prometheus_client.metrics_core import Metric

FOLDER = Path(__file__).parents[3] / "integrations" / "monitoring"
DASHBOARD, RULES = FOLDER / "grafana.json", FOLDER / "rules.yml"
NAME = re.compile(r"heliograph_\w+")
SOURCE = {"type": "prometheus", "uid": "${source}"}
BANDS = {"low", "high"}  # the ends of what is expected, drawn with what should lie between them
REFUSED = 'verdict=~"late|future|implausible|conflict"'
ALERTS = (  # name, expression, for how long, what is said
    ("HeliographAway", "absent(heliograph_plants)", "5m", "no service of heliograph answers"),
    ("HeliographDoubted", 'heliograph_plants_wrong{what="doubted claim"} > 0', "10m",
     "{{ $value }} plants have a filter whose innovations are not what it claims: /plants of its page names them"),
    ("HeliographDeadSender", 'heliograph_plants_wrong{what="dead sender"} > 0', "10m",
     "{{ $value }} plants have a sender whose heartbeats do not come, and not by chance"),
    ("HeliographRefused",
     f"sum by (job, instance, node) (rate(heliograph_messages_total{{{REFUSED}}}[10m]))"
     " > 0.1 * sum by (job, instance, node) (rate(heliograph_messages_total[10m]))", "10m",
     "more than a tenth of the messages of {{ $labels.node }} are late, implausible or contradict others"),
    ("HeliographMalformed", "increase(heliograph_malformed_total[10m]) > 0", "1m",
     "messages that cannot be read: the refused lines say why"),
    ("HeliographPassing", "heliograph_plant_passing > 0.9", "1m",
     "{{ $labels.plant }} passes {{ $labels.threshold }} by {{ $labels.ahead }} ahead, with probability {{ $value }}"),
    ("HeliographSilent", "sum by (job, instance) (rate(heliograph_messages_total[10m])) == 0", "10m",
     "no message comes any more"),
    ("HeliographBehind", "histogram_quantile(0.99, rate(heliograph_lag_seconds_bucket[10m])) > 60", "10m",
     "one in a hundred batches is published more than a minute after its oldest message was measured"),
)  # fmt: skip


def exposed(families: list[Metric]) -> set[str]:
    """The names under which Prometheus keeps metrics: of a counter with _total, of a histogram its parts."""
    ends = {"counter": ("_total",), "histogram": ("_bucket", "_sum", "_count")}
    return {family.name + end for family in families for end in ends.get(family.type, ("",))}


def _panel(number: int, family: Metric, names: set[str]) -> dict[str, Any]:
    """One chart of a metric: rates of a counter, quantiles of a histogram, a gauge with the band it should be in."""
    targets = {
        "counter": [f"rate({family.name}_total[$__rate_interval])"],
        "histogram": [
            f"histogram_quantile({q}, sum by (le) (rate({family.name}_bucket[$__rate_interval])))" for q in (0.5, 0.99)
        ],
    }.get(
        family.type,
        [family.name, *(f"{family.name}_{end}" for end in sorted(BANDS) if f"{family.name}_{end}" in names)],
    )
    return {
        "id": number,
        "type": "timeseries",
        "title": family.name.removeprefix("heliograph_").replace("_", " "),
        "description": family.documentation,
        "datasource": SOURCE,
        "gridPos": {"x": 12 * ((number - 1) % 2), "y": 8 * ((number - 1) // 2), "w": 12, "h": 8},
        "fieldConfig": {"defaults": {"unit": "s" if family.name.endswith("_seconds") else "none"}, "overrides": []},
        "targets": [
            {"refId": chr(65 + i), "datasource": SOURCE, "expr": expression, "legendFormat": "__auto"}
            for i, expression in enumerate(targets)
        ],
    }  # fmt: skip


def dashboard(families: list[Metric]) -> str:
    """The dashboard for Grafana, whose data source is chosen in it, so that it is imported as it is."""
    names = exposed(families)
    shown = [family for family in families if family.name.rpartition("_")[2] not in BANDS]
    content = {
        "uid": "heliograph",
        "title": "heliograph",
        "tags": ["heliograph"],
        "schemaVersion": 39,
        "refresh": "30s",
        "time": {"from": "now-6h", "to": "now"},
        "templating": {
            "list": [{"name": "source", "label": "Data source", "type": "datasource", "query": "prometheus"}]
        },
        "panels": [_panel(number, family, names) for number, family in enumerate(shown, 1)],
    }
    return json.dumps(content, indent=1) + "\n"


def rules(families: list[Metric]) -> str:
    """The rules of Prometheus; each name in them is one that a service has."""
    names = exposed(families)
    lines = ["groups:", "  - name: heliograph", "    rules:"]
    for alert, expression, duration, said in ALERTS:
        unknown = set(NAME.findall(expression)) - names
        assert not unknown, f"{alert}: no service has {unknown}"
        lines += [f"      - alert: {alert}", f"        expr: {json.dumps(expression)}", f"        for: {duration}"]
        lines += ["        annotations:", f"          summary: {json.dumps(said)}"]
    return "\n".join(lines) + "\n"


def write() -> None:
    """Write both files anew."""
    from tests.serving.observation.test_monitoring import families

    FOLDER.mkdir(parents=True, exist_ok=True)
    DASHBOARD.write_text(dashboard(families()))
    RULES.write_text(rules(families()))


if __name__ == "__main__":
    write()
