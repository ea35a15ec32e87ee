"""Counts over all plants that a service has taken messages of, whichever of them are in memory."""

from collections import Counter
from collections.abc import Mapping
from typing import Protocol

from heliograph.live.event import VERDICTS
from heliograph.model.checks.refusal_reasons import OF_NODES, Reason

COUNTS = (*VERDICTS, *OF_NODES, "timeouts", "held")  # which never fall
FIELDS = (*COUNTS, "lost")


class LinkTotals(Protocol):
    """Counts of the messages of a node.

    Attributes:
        lost: gaps in the node's running count.
        refused: single values that their node refused, by reason, and messages for their flag or counter.
        timeouts: silences longer than the timeout that have ended.
        held: runs of equal readings that were longer than noise allows, and not refused.
        used, duplicate, conflict, late, future, implausible: numbers of messages by verdict.
    """

    lost: int
    timeouts: int

    @property
    def held(self) -> int:
        """Return the number of those runs."""

    @property
    def refused(self) -> Mapping[Reason, int]:
        """Return how many single values, and messages, were refused by reason."""

    used: int
    duplicate: int
    conflict: int
    late: int
    future: int
    implausible: int


def list_counts_of_link(link: LinkTotals) -> dict[str, int]:
    """Return the counts of a node by FIELDS."""
    refused = {str(reason): count for reason, count in link.refused.items()}
    return {name: refused.get(name, 0) if name in OF_NODES else getattr(link, name) for name in FIELDS}


class CountTotals:
    """Sums of counts over plants, by node; a plant that leaves the memory takes nothing with it.

    `by_node` has the counts of messages by verdict, of what nodes refused by reason, of timeouts, and
    of lost messages, which may fall.
    """

    def __init__(self) -> None:
        """Begin with no counts."""
        self.by_node: dict[str, Counter[str]] = {}
        # {(plant, node): its counts, in the order of FIELDS, as far as the sums contain them}.
        self._seen: dict[tuple[str, str], tuple[int, ...]] = {}

    def add_plant(self, plant: str, links: Mapping[str, LinkTotals]) -> None:
        """Add what has changed in a plant's counts since they were last added to the sums in `by_node`.

        `plant` is its name, and `links` has the counts of its messages by node.
        """
        for node, link in links.items():
            counts = tuple(list_counts_of_link(link).values())
            counts_before = self._seen.get((plant, node), (0,) * len(FIELDS))
            if counts != counts_before:
                self._seen[plant, node] = counts
                total = self.by_node.setdefault(node, Counter(dict.fromkeys(FIELDS, 0)))
                # Lost messages may become fewer. Any other count falls only if the plant began anew.
                for name, new, old in zip(FIELDS, counts, counts_before, strict=True):
                    total[name] += new - old if name == "lost" else max(new - old, 0)

    def as_table(self) -> dict[str, dict[str, int]]:
        """Return the sums by node and count."""
        return {node: dict(total) for node, total in self.by_node.items()}
