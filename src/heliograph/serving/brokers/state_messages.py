"""Messages of single states: one flat JSON object for each state, as Home Assistant and telegraf read them."""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from pydantic_core import from_json

from heliograph.numerics.times.dates import parse_instant
from heliograph.numerics.types import unit_of
from heliograph.serving.brokers.transport import encode_name

ONLINE, OFFLINE = b"online", b"offline"


class StateMessage(NamedTuple):
    """A message that the broker keeps for whoever comes later: its topic, and its body."""

    topic: str
    body: bytes


class _PublishedState(NamedTuple):
    """One state of one filter of a plant, and the topic of its messages."""

    plant: str
    node: str
    filter: str
    state: str
    topic: str

    @property
    def identity(self) -> str:
        """Return an identity of letters, digits, hyphens and underscores."""
        return self.topic.replace("%", "_").replace("/", "-")

    @property
    def label(self) -> str:
        """Return what it is called below its device."""
        return f"{self.state} ({self.node}, {self.filter})"


def availability_topic(topic: str) -> str:
    """Return the topic on which a service at `topic` says online and offline."""
    return f"{topic}/availability"


def make_state_messages(topic: str, states: Sequence[str], body: bytes) -> Iterator[StateMessage]:
    """Yield a message for each state of each filter of an estimate: value, deviation, dead, and time.

    The topic is TOPIC/state/PLANT/NODE/FILTER/STATE. `value` and `deviation` are numbers or null. `dead` is 1 if the
    sender of the node is dead, which means silent for longer than it may be, else 0. `time` is that of the estimate; a
    date is in seconds since 1970.

    Args:
        topic: the service's topic.
        states: names of the states.
        body: an estimate that a service published, as JSON.
    """
    estimate = from_json(body)
    moment = estimate["time"]
    time = parse_instant(moment).timestamp() if isinstance(moment, str) else moment
    dead = _read_dead_senders(estimate)  # {node: 1 or 0}
    # For each filter and each state i: the state with its topic, i, and the filter's part of the estimate.
    for published, i, message in _iterate_states(topic, states, estimate):
        covariance = message["covariance"]
        variance = None if covariance is None else covariance[i][i]
        deviation = None if variance is None or variance < 0 else math.sqrt(variance)
        content = {
            "value": message["mean"][i],
            "deviation": deviation,
            "dead": dead.get(published.node, 0),
            "time": time,
        }
        yield StateMessage(published.topic, json.dumps(content).encode())


def make_discovery_messages(topic: str, states: Sequence[str], body: bytes, prefix: str) -> Iterator[StateMessage]:
    """Yield messages that make Home Assistant show sensors of a plant's states: value, deviation, and dead sender.

    Args:
        topic: the service's topic.
        states: names of the states; a unit in a name is told to the sensor.
        body: an estimate that a service published, as JSON.
        prefix: the topic under which Home Assistant looks for sensors; "homeassistant" by default.
    """
    estimate = from_json(body)
    plant = str(estimate["plant"])
    device = {"identifiers": [f"{topic.replace('/', '-')}-{encode_name(plant).replace('%', '_')}"],
              "name": plant or topic, "manufacturer": "heliograph"}  # fmt: skip
    nodes_with_senders = _read_dead_senders(estimate).keys()
    for published, i, _ in _iterate_states(topic, states, estimate):  # i: the state's index
        common = {"state_topic": published.topic, "availability_topic": availability_topic(topic), "device": device}
        for sensor in _list_sensors(published, unit_of(states[i]), published.node in nodes_with_senders):
            identity = f"{published.identity}-{sensor.key}"
            named = {"name": sensor.name, "unique_id": identity, "value_template": f"{{{{ value_json.{sensor.key} }}}}"}
            content = json.dumps(named | common | sensor.settings).encode()  # in the words of Home Assistant
            yield StateMessage(f"{prefix}/{sensor.kind}/{identity}/config", content)


class _DiscoveredSensor(NamedTuple):
    """A sensor that Home Assistant shows: its kind there, the key of its value in a state's message, name, settings."""

    kind: str
    key: str
    name: str
    settings: dict[str, Any]


def _list_sensors(published: _PublishedState, unit: str | None, has_sender: bool) -> list[_DiscoveredSensor]:
    """Return the sensors of a state for Home Assistant: its value, its deviation, and whether its sender is dead.

    There is the last one only if the node has a sender that may be found dead (`has_sender`).
    """
    number = {"state_class": "measurement"} | ({"unit_of_measurement": unit} if unit else {})
    sensors = [
        _DiscoveredSensor("sensor", "value", published.label, number),
        _DiscoveredSensor(
            "sensor", "deviation", f"{published.label} deviation", number | {"entity_category": "diagnostic"}
        ),
    ]
    if has_sender:
        dead = {"payload_on": "1", "payload_off": "0", "device_class": "problem"}
        sensors.append(_DiscoveredSensor("binary_sensor", "dead", f"{published.label} sender dead", dead))
    return sensors


def _read_dead_senders(estimate: Mapping[str, Any]) -> dict[str, int]:
    """Return {node: 1 if its sender is dead, else 0}, of nodes with senders whose silence says something."""
    return {node: int(sender["dead"]) for node, sender in estimate.get("senders", {}).items()}


def _iterate_states(
    topic: str, states: Sequence[str], estimate: Mapping[str, Any]
) -> Iterator[tuple[_PublishedState, int, Mapping[str, Any]]]:
    """Yield (state with its topic, index of the state, message) for each node, filter and state of an estimate.

    The message is the filter's part of the published estimate, such as its mean. In topics each name is one word.
    """
    plant = str(estimate["plant"])
    for node, filters in estimate["estimates"].items():
        for name, message in filters.items():
            words = [encode_name(word) for word in (plant, node, name)]
            for i, state in enumerate(states):
                path = "/".join([topic, "state", *words, encode_name(str(state))])
                yield _PublishedState(plant, node, name, str(state), path), i, message
