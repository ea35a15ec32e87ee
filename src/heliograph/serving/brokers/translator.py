"""Messages of topics that others make, to messages of a network by its sources."""

import json
from collections import Counter
from datetime import UTC, datetime, timedelta

from heliograph.files.sources import Reading, Sources
from heliograph.numerics.check import InputError, fail, shown
from heliograph.serving.message import LONGEST, Message
from heliograph.simulation.network import Network

EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
LISTED = 8  # unknown topics in one line
NAME = 200  # characters of a plant's name


class Translator:
    """Sources of a network, applied to messages as they come.

    A measurement without a time is of the moment of its arrival, and counted here. Where a time names it but no count,
    its count is 0, so that a message that comes again is known. A message that a broker had stored for new subscribers
    is left out where only its arrival would date it. Unknown topics are counted, never guessed.

    Args:
        table: sources by topic, as in a network's file.
        network: the network.

    Raises:
        ValueError: sources that do not fit the network.
    """

    def __init__(self, table: object, network: Network):
        self.sources = Sources(table, network)
        self._counts, self._stored = Counter[tuple[str, str]](), 0

    def read(self, topic: str, payload: bytes, arrival: datetime, stored: bool = False) -> list[Message | str]:
        """Return the messages in a payload of a topic, or the reason why it cannot be read; nothing of unknown topics.

        Args:
            topic: the topic.
            payload: JSON.
            arrival: when it arrived.
            stored: whether the broker had stored it for new subscribers.
        """
        try:
            return self._messages(topic, _decoded(payload, topic), arrival, stored)
        except InputError as error:
            return [str(error)]

    def line(self, payload: bytes) -> list[bytes | Message | str]:
        """Return a line of a pipe as it is, or the messages in it if it has a `topic` and a `payload`.

        So prints `mosquitto_sub -F %j` or `%J`.
        """
        try:
            content = json.loads(payload[:LONGEST])
        except (ValueError, RecursionError):
            return [payload]
        if not isinstance(content, dict) or not isinstance(content.get("topic"), str) or "payload" not in content:
            return [payload]
        inner = content["payload"]
        body = inner.encode() if isinstance(inner, str) else json.dumps(inner).encode()
        return list(self.read(content["topic"], body, datetime.now(UTC), bool(content.get("retain"))))

    def left_out(self) -> list[str]:
        """Return lines on messages that were not used: of unknown topics, and stored ones."""
        lines, unknown = [], +self.sources.unknown
        if unknown:
            named = ", ".join(f"{topic} ({count})" for topic, count in unknown.most_common(LISTED))
            more = "" if len(unknown) <= LISTED else f" and {len(unknown) - LISTED} more"
            lines.append(f"topics that are not among the sources: {named}{more}")
        if self._stored:
            lines.append(f"{self._stored} stored messages were left out: without time= they have no date")
        return lines

    def _messages(self, topic: str, content: object, arrival: datetime, stored: bool) -> list[Message | str]:
        results: list[Message | str] = []
        for reading in self.sources.read(topic, content, topic):
            if stored and reading.time is None:
                self._stored += 1
                continue
            results.append(self._message(topic, reading, arrival))
        return results

    def _message(self, topic: str, reading: Reading, arrival: datetime) -> Message:
        if len(reading.plant) > NAME or "\0" in reading.plant:
            raise fail(f"{topic}, plant", f"a name of at most {NAME} characters, without NUL", shown(reading.plant))
        time: datetime | float = arrival
        if reading.time is not None:
            counted = self.sources.steps and self.sources.step is None
            time = float(reading.time) if counted else EPOCH + timedelta(microseconds=reading.time // 1000)
        sequence, name = reading.sequence, (reading.plant, reading.node)
        if sequence is None:
            sequence = self._counts[name] if reading.time is None else 0
            self._counts[name] += 1
        # Checked already, and dates are no texts here.
        return Message.model_construct(
            plant=reading.plant,
            node=reading.node,
            sequence=sequence,
            time=time,
            values=[None if value != value else value for value in reading.values.tolist()],
            inputs=None,
            arrival=None,
        )


def _decoded(payload: bytes, topic: str) -> object:
    if len(payload) > LONGEST:
        raise fail(topic, f"at most {LONGEST} bytes", len(payload))
    try:
        return json.loads(payload)
    except ValueError:  # also bytes that are no text
        raise fail(topic, "JSON", shown(payload)) from None
    except RecursionError:
        raise fail(topic, "JSON", "brackets nested too deeply") from None
