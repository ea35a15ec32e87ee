"""The dashboard and the rules that are shipped know every metric by the name that it has."""

import json
import re
import shutil
import subprocess
from importlib.util import find_spec

import pytest

pytest.importorskip("prometheus_client")
from tests.serving.observation import monitoring
from tests.serving.watched import Scripted, metrics_of, observer_of

AGAIN = "python -m tests.serving.observation.monitoring writes it anew"


def families():
    """Every metric of a service that has taken some rows."""
    watch = observer_of(["x", "v"])
    watch.wrap(Scripted()).take([b"1", b"2"])
    metrics_of(watch)  # the page adds its own to the registry
    return sorted(watch.registry.collect(), key=lambda family: family.name)


def test_the_dashboard_has_each_metric_by_its_name():
    assert monitoring.DASHBOARD.read_text() == monitoring.dashboard(families()), AGAIN
    content = json.loads(monitoring.DASHBOARD.read_text())
    asked = set(monitoring.NAME.findall(" ".join(t["expr"] for panel in content["panels"] for t in panel["targets"])))
    missing = monitoring.exposed(families()) - asked
    assert all(re.search("_(sum|count)$", name) for name in missing)  # of histograms, whose quantiles are drawn
    places = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in content["panels"]]
    assert len(set(places)) == len(places) > 15


@pytest.mark.skipif(
    find_spec("grafana_foundation_sdk") is None, reason="no types of Grafana here: pip install grafana-foundation-sdk"
)
def test_the_types_of_grafana_know_all_of_the_dashboard():
    """Read by the classes that Grafana makes of its schema, and written again, nothing of it is lost or changed."""
    from grafana_foundation_sdk.cog.encoder import JSONEncoder
    from grafana_foundation_sdk.cog.plugins import register_default_plugins
    from grafana_foundation_sdk.models.dashboard import Dashboard

    register_default_plugins()
    content = json.loads(monitoring.DASHBOARD.read_text())
    again = json.loads(JSONEncoder().encode(Dashboard.from_json(content)))

    def kept(part, other):
        if isinstance(part, dict):
            return all(key in other and kept(value, other[key]) for key, value in part.items())
        if isinstance(part, list):
            return len(part) == len(other) and all(map(kept, part, other))
        return part == other

    assert kept(content, again) and len(content["panels"]) > 15


def test_the_rules_ask_for_metrics_that_are_there():
    assert monitoring.RULES.read_text() == monitoring.rules(families()), AGAIN
    text = monitoring.RULES.read_text()
    by_name = {family.name: family for family in families()}
    verdicts = {sample.labels["verdict"] for sample in by_name["heliograph_messages"].samples}
    assert set(monitoring.REFUSED.split('"')[1].split("|")) < verdicts
    said = {sample.labels["what"] for sample in by_name["heliograph_plants_wrong"].samples}
    assert set(re.findall(r'what=\\"([^\\]*)', text)) <= said


@pytest.mark.real("Prometheus")
def test_prometheus_takes_the_rules_and_they_fire(tmp_path):
    """Where a claim is doubted for ten minutes, and where a tenth of the messages are late."""
    tool = shutil.which("promtool")
    subprocess.run([tool, "check", "rules", monitoring.RULES], check=True, capture_output=True)
    series = {
        'heliograph_plants_wrong{what="doubted claim",instance="a"}': "1+0x30",
        'heliograph_messages_total{instance="a",node="n",verdict="used"}': "0+60x30",
        'heliograph_messages_total{instance="a",node="n",verdict="late"}': "0+10x30",
        'heliograph_plants{instance="a"}': "1+0x30",
    }
    fires = {"HeliographDoubted": 1, "HeliographRefused": 1, "HeliographSilent": 0, "HeliographAway": 0}
    expected = {
        "HeliographDoubted": (
            '{what: "doubted claim", instance: a}',
            monitoring.ALERTS[1][3].replace("{{ $value }}", "1"),
        ),
        "HeliographRefused": ("{instance: a, node: n}", monitoring.ALERTS[3][3].replace("{{ $labels.node }}", "n")),
    }
    lines = [
        f"rule_files: [{monitoring.RULES}]",
        "evaluation_interval: 1m",
        "tests:",
        "  - interval: 1m",
        "    input_series:",
    ]
    lines += [f"      - {{series: '{name}', values: '{values}'}}" for name, values in series.items()]
    lines += ["    alert_rule_test:"]
    for alert, count in fires.items():
        lines += [f"      - {{eval_time: 25m, alertname: {alert}, exp_alerts: ["]
        if count:
            labels, said = expected[alert]
            lines += [f"          {{exp_labels: {labels}, exp_annotations: {{summary: {json.dumps(said)}}}}}"]
        lines += ["        ]}"]
    (tmp_path / "test.yml").write_text("\n".join(lines) + "\n")
    result = subprocess.run([tool, "test", "rules", tmp_path / "test.yml"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
