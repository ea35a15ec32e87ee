"""Messages that come and cannot be read: refused alone, named as far as they are read, and none that was lost."""

import json

import pytest

import heliograph as hg
from heliograph.serving import LineReader
from heliograph.serving.brokers.source_translator import Translator
from heliograph.serving.service import Service
from heliograph.serving.storage import InMemoryStore
from tests.serving.worlds import fleet, lines, moving

BROKEN = [
    {"values": ["x"]},
    {"values": [1.0, 2.0]},
    {"arrival": "soon"},
    {"spare": 1},
]  # whose names are read


def served(payloads, size):
    """The link of node a after all messages, and what was refused."""
    service = Service(fleet(moving()), InMemoryStore())
    outputs = [out for i in range(0, len(payloads), size) for out in service.take(payloads[i : i + size])]
    refused = [body for out in outputs if (body := json.loads(out.body))["kind"] == "refused"]
    return service, service.plants["p"].links["a"], refused


@pytest.mark.parametrize("size", [1, 10])
@pytest.mark.parametrize("broken", BROKEN)
def test_what_is_named_is_none_that_was_lost(broken, size):
    """Counts 0 to 5: of 2 nothing but its name can be used, 4 never comes, 5 is implausible."""
    sent = [{"plant": "p", "node": "a", "sequence": k, "time": 1.0 + k, "values": [1.0]} for k in (0, 1, 2, 3, 5, 6)]
    sent[2] |= broken
    sent[4]["values"] = [1e300]
    service, link, refused = served(lines(sent), size)
    assert (link.used, link.lost, link.implausible, service.malformed) == (4, 1, 1, 1)
    named = [(item["plant"], item["node"], item["sequence"], item["time"], item["reason"]) for item in refused]
    assert sorted(named) == [("p", "a", 2, 3.0, "malformed"), ("p", "a", 5, 6.0, "implausible")]


def test_what_begins_a_plant_or_names_none_is_refused_alone():
    unread = {"plant": "p", "node": "a", "sequence": 0, "time": 1.0, "values": ["x"]}
    nobody = unread | {"node": "z", "values": [1.0]}
    sent = [unread, nobody, *({"plant": "p", "node": "a", "sequence": k, "time": 1.0, "values": [1.0]} for k in (1, 2))]
    service, link, refused = served(lines(sent), 1)
    assert (link.used, link.lost, service.malformed, len(refused)) == (2, 0, 2, 2)


@pytest.fixture
def translator():
    """Node a of a topic with a count; node b of the same messages."""
    names = {"plant": "plant", "time": "t", "time_unit": "s", "sequence": "n"}
    field = hg.files.json_field
    return Translator({"dev/up": [field("warm", node="a", **names), field("wet", node="b", **names)]}, moving())


def test_a_field_that_cannot_be_read_costs_that_node_alone_and_is_not_lost(translator):
    bodies = [{"plant": "p", "t": 1e9 + k, "n": k, "warm": 1.0, "wet": 1.0} for k in range(4)]
    bodies[1]["warm"] = "hot"
    texts = [json.dumps({"topic": "dev/up", "payload": json.dumps(body)}).encode() for body in bodies]
    service, link, refused = served(LineReader(moving(), translator).read(texts), 3)
    assert (link.used, link.lost) == (3, 0)
    assert service.plants["p"].links["b"].used == 4
    (only,) = refused
    assert (only["node"], only["sequence"]) == ("a", 1) and "field 'warm': expected a number" in only["detail"]


def test_a_service_says_while_it_runs_that_a_field_names_senders(caplog):
    """Once, after a power of two of messages, when each name has come again."""
    source = hg.files.json_field("v", node="a", time="t", time_unit="s")
    translator, said = Translator({"dev/up": source}, moving()), []
    lines = LineReader(moving(), translator)
    for k in range(40):
        body = {"v": 1.0, "t": 1e9 + k, "entity_id": ("attic", "cellar")[k % 2]}
        lines.read([json.dumps({"topic": "dev/up", "payload": json.dumps(body)}).encode()])
        said.append(len(caplog.messages))
    assert said[:4] == [0, 0, 0, 1] and said[-1] == 1
    assert "field 'entity_id' of dev/up has 2 values (attic, cellar)" in caplog.messages[0]
    assert not translator.left_out()
