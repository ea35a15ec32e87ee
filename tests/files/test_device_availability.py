"""Devices that say on another topic whether they are online: values of those that are not are left out and counted."""

import json
from datetime import UTC, datetime

import pytest

import heliograph as hg
from heliograph import cli
from heliograph.files.sources import TopicReader
from heliograph.serving import LineReader
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.device_status_service import DeviceStatusService
from heliograph.serving.storage import Store

json_field, Available = hg.files.json_field, hg.files.Available
NETWORK = """
import jax.numpy as jnp
import heliograph as hg

plant = hg.Plant(
    lambda x, u: x, lambda u: 1e-4 * jnp.eye(1) * u[0], [20.0], [[25.0]], states=["temperature"], inputs=["dt"]
)
sensor = hg.Sensor(lambda x: x, noise=0.04, outputs=["temperature"])
node = hg.Node(sensor, hg.perfect(), {"filter": hg.cubature_filter(plant, sensor, hg.perfect())})
network = hg.Network(plant, {"garden": node})
here = hg.files.Available("zigbee2mqtt/+/availability")
sources = {
    "zigbee2mqtt/+": hg.files.json_field("temperature", "garden", plant=hg.files.Level(1), where=here)
}
"""
LOG = """\
2026-11-20T10:00:00Z zigbee2mqtt/garden/availability online
2026-11-20T10:00:01Z zigbee2mqtt/garden {"temperature": 20}
2026-11-20T10:00:02Z zigbee2mqtt/garden/availability {"state": "offline"}
2026-11-20T10:00:03Z zigbee2mqtt/garden {"temperature": 90}
2026-11-20T10:00:04Z zigbee2mqtt/garden {"temperature": 90}
2026-11-20T10:00:05Z zigbee2mqtt/garden/availability online
2026-11-20T10:00:06Z zigbee2mqtt/garden {"temperature": 21}
"""
NOW = datetime(2026, 11, 24, 19, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("network") / "net.py"
    path.write_text(NETWORK)
    return path


@pytest.fixture(scope="module")
def network(file):
    return hg.files.load_network(str(file))


def table(where, topic="zigbee2mqtt/+", **more):
    return {topic: json_field("temperature", "garden", plant=hg.files.Level(1), where=where, **more)}


@pytest.mark.parametrize(
    ("offline", "online"),
    [
        ("offline", "online"),
        ('{"state": "offline"}', '{"state": "online"}'),
        (b"Offline", b"Online"),  # Tasmota
        ("false", "true"),  # Shelly
        ('"offline"', '"online"'),
        ("offline", ""),  # a stored word that was deleted
        ({"state": "offline"}, {"state": "online"}),  # a row of a table
    ],
)
def test_values_of_a_device_count_from_online_to_offline(network, offline, online):
    """Each device has its own word; before the first it is online."""
    sources, used = TopicReader(table(Available("zigbee2mqtt/+/availability")), network), []
    for word in (None, online, offline, offline, online):
        if word is not None:
            assert sources.device_statuses.take_status_message("zigbee2mqtt/a/availability", word, "m")
        used.append([bool(sources.read(f"zigbee2mqtt/{device}", {"temperature": 1}, "m")) for device in "ab"])
    assert used == [[True, True], [True, True], [False, True], [False, True], [True, True]]
    assert sources.notes == ["messages left out, of devices offline: zigbee2mqtt/a (2)"]
    assert not sources.unknown.total() and not sources.device_statuses.take_status_message("zigbee2mqtt/a", "1", "m")


def test_conditions_hold_together(network):
    """Of a list: the gateway, the device, and a field of the message."""
    gateway = Available("gateway/status", online="up", offline=["down", "gone"], path="word")
    where = [gateway, Available("+/+/LWT"), {"fix": 3}]
    sources = TopicReader(table(where, "zigbee2mqtt/#"), network)
    assert sources.subscribed_topics == ["zigbee2mqtt/#", "gateway/status", "+/+/LWT"]
    used = []
    for topic, word in [("gateway/status", '{"word": "UP"}'), ("gateway/status", "gone"), ("gateway/status", "up"),
                        ("zigbee2mqtt/a/LWT", "Offline")]:  # fmt: skip
        assert sources.device_statuses.take_status_message(topic, word, "m")
        used.append([bool(sources.read("zigbee2mqtt/a", {"temperature": 1, "fix": fix}, "m")) for fix in (2, 3)])
    assert used == [[False, True], [False, False], [False, True], [False, False]]
    assert sources.excluded["zigbee2mqtt/a"] == 4 and sources.offline["zigbee2mqtt/a"] == 2


def test_a_topic_on_which_no_word_came_is_named(network):
    assert TopicReader(table(Available("zigbe2mqtt/+/availability")), network).notes == [
        "no word of online or offline came: zigbe2mqtt/+/availability"
    ]


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"topic": ""}, "Available, topic: expected a topic"),
        ({"topic": "a/#"}, "Available, topic: expected a topic"),
        ({"topic": "a", "online": 3}, "Available, online: expected a word"),
        ({"topic": "a", "online": []}, "Available, online: expected a word"),
        ({"topic": "a", "online": "False"}, "Available, offline: expected other words than online, got false"),
        ({"topic": "a", "path": None}, "Available, path: expected a dotted path"),
    ],
)
def test_bad_conditions_are_one_line(arguments, line):
    with pytest.raises(ValueError, match=f"^{line}"):
        Available(**arguments)


def test_conditions_that_do_not_fit_are_one_line(network):
    with pytest.raises(ValueError, match=r"^json_field, where: expected .* or Available, got \['a'\]"):
        json_field("v", "garden", where=["a"])
    with pytest.raises(ValueError, match=r"^json_field, where: expected each path once\b, got 'a'"):
        json_field("v", "garden", where=[{"a": 1}, {"a": 2}])
    with pytest.raises(
        ValueError, match=r"^Available, topic 'a/b/\+': expected \+ at levels that 'zigbee2mqtt/\+' has"
    ):
        TopicReader(table(Available("a/b/+")), network)


def test_a_service_hears_the_words(network):
    """Stored words too; one that is neither is refused alone, and changes nothing."""
    translator = Translator(table(Available("zigbee2mqtt/+/availability")), network)

    def came(topic, payload, stored=False):
        return translator.read(topic, payload, NOW, stored)

    value = "zigbee2mqtt/garden", b'{"temperature": 1}'
    assert came("zigbee2mqtt/garden/availability", b"offline", True) == [] and came(*value) == []
    (said,) = came("zigbee2mqtt/garden/availability", b"asleep")
    assert said == "zigbee2mqtt/garden/availability: expected one of online, true, offline, false, got 'asleep'"
    assert came(*value) == []
    assert (
        LineReader(network, translator).read([b"zigbee2mqtt/garden/availability online"]) == []
        and len(came(*value)) == 1
    )
    assert translator.left_out() == ["messages left out, of devices offline: zigbee2mqtt/garden (2)"]


def test_a_word_is_kept_over_a_restart(network, tmp_path):
    """Nothing but a change of it is written; a later word takes its place, also for conditions with other words."""

    class Silent:
        def take(self, payloads):
            return []

    here = [Available("zigbee2mqtt/+/availability"), Available("zigbee2mqtt/+/availability", "offline", "online")]
    here.append(Available("heater/status"))

    def begun():
        translator = Translator(table(here[0]) | {"other/+": table(here[1:])["zigbee2mqtt/+"]}, network)
        return translator, DeviceStatusService(Silent(), translator.sources.device_statuses, store)

    identity = {"states": "temperature", "description": "{}"}
    value = b'{"temperature": 1}'
    for said, left_out in ((b"offline", True), (b"online", False)):
        store = Store(str(tmp_path / "words.db"), identity)
        translator, service = begun()
        translator.read("zigbee2mqtt/garden/availability", said, NOW, True)
        service.take([])
        writes = []
        store.keep_words = writes.append
        translator.read("zigbee2mqtt/garden/availability", said, NOW, True)
        service.take([])
        assert not writes
        store.close()
        store = Store(str(tmp_path / "words.db"), identity)
        translator, _ = begun()
        assert (translator.read("zigbee2mqtt/garden", value, NOW) == []) == left_out
        assert (translator.read("other/garden", value, NOW) == []) != left_out
        store.close()


@pytest.mark.parametrize("form", ["-v", "-F %j", "csv"])
def test_run_uses_what_a_log_says(file, tmp_path, network, form):
    lines = [line.split(" ", 2) for line in LOG.splitlines()]
    texts = {
        "-v": LOG,
        "-F %j": "\n".join(json.dumps({"tst": t, "topic": topic, "payload": word}) for t, topic, word in lines),
        "csv": "\n".join(["arrival,topic,payload"] + ['{},{},"{}"'.format(t, topic, word.replace('"', '""'))
                                                      for t, topic, word in lines]),
    }  # fmt: skip
    path = tmp_path / ("log.csv" if form == "csv" else "log.jsonl")
    path.write_text(texts[form])
    from tests.files.module import load_module

    events = hg.files.read_messages(path, network, load_module(str(file))[1]["sources"])
    assert [event.values[0] for event in events.sort_events()] == [20.0, 21.0]
    assert events.notes == [f"{path}: messages left out, of devices offline: zigbee2mqtt/garden (2)"]
    assert not events.reasons


@pytest.mark.slow
def test_run_and_replay_leave_out_the_same(file, tmp_path, capsys):
    path, out = tmp_path / "log.txt", tmp_path / "out.csv"
    path.write_text(LOG)
    assert cli.main(["run", str(file), "--measurements", str(path), "--out", str(out)]) == 0
    assert "left out, of devices offline: zigbee2mqtt/garden (2)" in "".join(capsys.readouterr())
    assert cli.main(["replay", str(path), "--network", str(file)]) == 0
    sent = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [message["values"] for message in sent] == [[20.0], [21.0]]
