"""Availability of devices: the last word, online or offline, that came on a topic beside that of their values."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from typing_extensions import TypeAliasType

from heliograph.files.sources.message_fields import decode_json, field_at, match_topic
from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.module import readable

Words = TypeAliasType("Words", str | Sequence[str])


@readable
@dataclass(frozen=True)
class Available:
    """Condition on a source: the last word of its device on another topic is not offline.

    MQTT devices publish the word, stored by the broker for new subscribers, and leave it to the broker as their last
    will. The payload is the word itself, or an object of JSON that has it. Before the first word, and after an empty
    one, a device counts as online.

    Args:
        topic: topic of the word; + stands for what the topic of the values has at that level, so that
            "zigbee2mqtt/+/availability" is of the device of "zigbee2mqtt/garden" what "zigbee2mqtt/garden/availability"
            says.
        online: the word, or several, in letters of either case (default "online" and "true").
        offline: the word, or several (default "offline" and "false").
        path: dotted path of the word in a payload that is an object (default "state").

    Raises:
        ValueError: no topic, or one with #; words that are no text, or the same for both.
    """

    topic: str
    online: Words = ("online", "true")
    offline: Words = ("offline", "false")
    path: str = "state"

    def __post_init__(self) -> None:
        """Check the fields, and keep words as tuples in lower case.

        `topic`: where the devices say it. `path`: of the word in an object. `online`, `offline`: the words, compared in
        lower case.
        """
        if not isinstance(self.topic, str) or not self.topic or "#" in self.topic:
            raise fail(
                "Available, topic", "a topic, with + for what that of the values has there", show_value(self.topic)
            )
        if not isinstance(self.path, str):
            raise fail("Available, path", "a dotted path", show_value(self.path))
        for name in ("online", "offline"):
            words = getattr(self, name)
            several = (words,) if isinstance(words, str) else words
            if not isinstance(several, Sequence) or not several or not all(isinstance(w, str) and w for w in several):
                raise fail(f"Available, {name}", "a word, or a list of words", show_value(words))
            object.__setattr__(self, name, tuple(word.casefold() for word in several))
        if both := sorted(set(self.online) & set(self.offline)):
            raise fail("Available, offline", "other words than online", both[0])

    def of(self, topic: str) -> str:
        """Return the topic on which a device says whether it is online; `topic` is the one of its values.

        It is `self.topic` with each + replaced by the level of `topic` at the same place.
        """
        pattern, levels = self.topic.split("/"), topic.split("/")
        if "+" in pattern[len(levels) :]:
            raise fail(f"Available, topic {self.topic!r}", f"+ at levels that {topic!r} has", "more levels")
        return "/".join(levels[i] if level == "+" else level for i, level in enumerate(pattern))

    def says_offline(self, payload: object, where: str) -> bool:
        """Return whether a payload says offline (True) or online (False).

        The payload is a word, or an object with a word at `self.path`.

        Raises:
            ValueError: the word is neither in `self.online` nor in `self.offline`.
        """
        value = field_at(payload, self.path, where) if isinstance(payload, dict) else payload
        word = str(value).strip().casefold()
        if word not in (*self.online, *self.offline):
            raise fail(where, f"one of {', '.join((*self.online, *self.offline))}", show_value(payload))
        return word in self.offline


class DeviceStatuses:
    """Keeps the last word, online or offline, of each device that a condition is about.

    Args:
        conditions: the conditions.
    """

    def __init__(self, conditions: Iterable[Available]):
        """Begin before any device has sent a status. A condition tells on which topics and by which words they do."""
        self._by_pattern: dict[str, list[Available]] = {}  # conditions by their topic, which may have wildcards
        for condition in dict.fromkeys(conditions):
            self._by_pattern.setdefault(condition.topic, []).append(condition)
        self._offline = set[tuple[Available, str]]()  # (condition, topic) whose last word was offline
        self._heard = set[Available]()  # conditions for which any word came
        self._changed = set[str]()  # topics whose status changed since `pop_changed_statuses`

    @property
    def topics(self) -> list[str]:
        """Return the topics on which devices send their status, online or offline; they may have wildcards."""
        return list(self._by_pattern)

    @property
    def unheard_topics(self) -> list[str]:
        """Return the topics, wildcards included, on which no device has said a word."""
        return [topic for topic, several in self._by_pattern.items() if not self._heard.intersection(several)]

    def find_conditions(self, topic: str) -> list[Available]:
        """Return the conditions for which a message of this topic tells whether a device is online.

        Their order is always the same, so that bit i of a stored status means the i-th of them.
        """
        matching = [several for pattern, several in self._by_pattern.items() if match_topic(topic, pattern)]
        return [condition for several in matching for condition in several]

    def take_status_message(self, topic: str, payload: object, where: str) -> bool:
        """Note a device's word, online or offline, if a message is one; return whether it is.

        An empty message deletes a word that the broker stores, and counts as online. `self._changed` has the topics
        whose status must be stored anew.

        Args:
            topic: the topic of the message.
            payload: its payload, as text or decoded.
            where: place of the message, for errors.

        Raises:
            ValueError: the word is neither online nor offline.
        """
        conditions = self.find_conditions(topic)
        if not conditions:
            return False
        # The statuses of a topic are one bit for each condition. They are stored when they have changed.
        content = _decode_payload(payload, where)
        bits_before = self._encode_statuses_as_bits(topic)
        for condition in conditions:
            self._note_status(condition, topic, offline=content != "" and condition.says_offline(content, where))
        if self._encode_statuses_as_bits(topic) != bits_before:
            self._changed.add(topic)
        return True

    def pop_changed_statuses(self) -> dict[str, int]:
        """Return {topic: its statuses as a number, as `restore` takes it} of those changed since the last call."""
        changed, self._changed = self._changed, set()
        return {topic: self._encode_statuses_as_bits(topic) for topic in changed}

    def restore(self, stored: Mapping[str, int]) -> None:
        """Take over `stored` statuses: by topic a number whose bit i is 1 if its condition i is offline."""
        for topic, bits in stored.items():
            for i, condition in enumerate(self.find_conditions(topic)):
                self._note_status(condition, topic, offline=bool((bits >> i) & 1))

    def _note_status(self, condition: Available, topic: str, offline: bool) -> None:
        """Note the last status of a topic for a condition; a device counts as online until it says offline."""
        self._heard.add(condition)
        if offline:
            self._offline.add((condition, topic))
        else:
            self._offline.discard((condition, topic))

    def _encode_statuses_as_bits(self, topic: str) -> int:
        """Return the statuses of a topic as a number: bit i is 1 if its i-th condition says offline."""
        conditions = self.find_conditions(topic)
        return sum(1 << i for i, condition in enumerate(conditions) if (condition, topic) in self._offline)

    def is_offline(self, condition: Available, topic: str) -> bool:
        """Return whether the device of a topic of values has said that it is offline."""
        return bool(self._offline) and (condition, condition.of(topic)) in self._offline


def _decode_payload(payload: object, where: str) -> object:
    """Return the payload of a status message: decoded if it is JSON, such as {"state": "online"}, else its text.

    A payload that is neither bytes nor text was decoded already, and is returned as it is. `where`: place of the
    message, for errors.
    """
    if isinstance(payload, bytes):
        payload = payload.decode(errors="replace")
    if not isinstance(payload, str):
        return payload
    try:
        return decode_json(payload, where)
    except InputError:
        return payload.strip()
