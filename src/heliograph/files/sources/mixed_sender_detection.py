"""Fields that tell several senders apart, such as `entity_id`, in messages that are read as those of one."""

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping

MANY = 50  # values above which a field names messages, not senders
LISTED = 4  # of them in a line
WORDS = re.compile(
    r"(addr|address|anchor|channel|device|entity|eui|field|host|id|location|mac|measurement|model|name|node|room|sensor"
    r"|serial|source|src|station|tag)",
    re.IGNORECASE,
)


class SenderCounter:
    """Counts the values of fields that are named as a sender's name is, in messages read as one node of one plant."""

    def __init__(self) -> None:
        """Begin with no message."""
        # By (topic, plant, node, field): how often each value of the field came.
        self._counts: dict[tuple[str, str, str, str], Counter[object]] = defaultdict(Counter)
        self._names: dict[str, bool] = {}  # {field: whether its name is that of a sender}
        self._noted = 0  # messages
        self._said = set[tuple[str, str]]()  # (topic, field) that were warned of

    def note_fields(self, topic: str, plant: str, node: str, message: object, asked: Collection[str]) -> None:
        """Count the fields of a message that was read as one of a node of a plant.

        Only fields that may name a sender are counted. If such a field has several values, senders are mixed. If it has
        more than MANY values, it names messages instead. Fields that a source has `asked` for are left out: they tell
        senders apart already, or they are values. `topic`: of the message.
        """
        self._noted += 1
        if not isinstance(message, Mapping):
            return
        for name, value in message.items():
            if isinstance(value, str | int) and name not in asked and self._is_sender_name(name):
                counts = self._counts[topic, plant, node, name]
                if len(counts) <= MANY:
                    counts[value] += 1

    def describe_at_powers_of_two_messages(self) -> list[str]:
        """Return what `describe_several_senders` does after 1, 2, 4, 8, ... messages; [] in between, to save time."""
        # n & (n - 1) is 0 for a power of two alone.
        return self.describe_several_senders() if self._noted & (self._noted - 1) == 0 else []

    def describe_several_senders(self) -> list[str]:
        """Return a line for each field of a topic that seems to name several senders; each is returned once.

        Such a field has 2 to MANY different values, and each came at least twice on average.
        """
        found: dict[tuple[str, str], list[object]] = {}
        for (topic, _, _, name), counts in self._counts.items():
            if (topic, name) not in self._said and 2 <= len(counts) <= MANY and counts.total() >= 2 * len(counts):
                found.setdefault((topic, name), list(counts))
        self._said |= found.keys()
        lines = []
        for (topic, name), values in found.items():
            more = "" if len(values) <= LISTED else ", ..."
            listed = ", ".join(map(str, values[:LISTED])) + more
            lines.append(
                f"field {name!r} of {topic} has {len(values)} values ({listed}) in what is read as one sensor: "
                f"plant={name!r}, node= or where= tells them apart"
            )
        return lines

    def _is_sender_name(self, field: str) -> bool:
        """Return whether a word in a field's name, as in `entity_id` or `devEui`, says that the field names a sender.

        WORDS matches such words. `self._names` keeps the answers.
        """
        if field not in self._names:
            words = re.split(r"[^A-Za-z]+|(?<=[a-z])(?=[A-Z])", field)
            self._names[field] = any(map(WORDS.fullmatch, words))
        return self._names[field]
