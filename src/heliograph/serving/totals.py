"""Counts over all plants that a service has taken messages of, whichever of them are in memory."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol

from heliograph.live.event import VERDICTS

COUNTS = (*VERDICTS, "dropped", "stuck", "timeouts", "held")  # which never fall
FIELDS = (*COUNTS, "lost")


class LinkTotals(Protocol):
    """Counts of the messages of a node.

    Attributes:
        lost: gaps in the node's running count.
        dropped: single values beyond limits.
        stuck: single values that repeated for too long.
        timeouts: silences longer than the timeout that have ended.
        held: runs of equal readings that were longer than noise allows, and not refused.
        used, duplicate, conflict, late, future, implausible: numbers of messages by verdict.
    """

    lost: int
    dropped: int
    stuck: int
    timeouts: int

    @property
    def held(self) -> int:
        """Return the number of those runs."""

    used: int
    duplicate: int
    conflict: int
    late: int
    future: int
    implausible: int


class Totals:
    """Sums of counts over plants, by node; a plant that leaves the memory takes nothing with it.

    `by_node` has the counts of messages by verdict, of dropped and stuck values, of timeouts, and of
    lost messages, which may fall.
    """

    def __init__(self) -> None:
        self.by_node: dict[str, Counter[str]] = {}
        self._seen: dict[tuple[str, str], tuple[int, ...]] = {}

    def add(self, plant: str, links: Mapping[str, LinkTotals]) -> None:
        """Add what has changed in a plant's counts since they were added last."""
        for node, link in links.items():
            now = tuple(getattr(link, name) for name in FIELDS)
            before = self._seen.get((plant, node), (0,) * len(FIELDS))
            if now != before:
                self._seen[plant, node] = now
                total = self.by_node.setdefault(node, Counter(dict.fromkeys(FIELDS, 0)))
                # A count that fell is of a plant that began anew; only lost messages may become fewer by themselves.
                for name, new, old in zip(FIELDS, now, before, strict=True):
                    total[name] += new - old if name == "lost" else max(new - old, 0)

    def as_table(self) -> dict[str, dict[str, int]]:
        """Return the sums by node and count."""
        return {node: dict(total) for node, total in self.by_node.items()}
