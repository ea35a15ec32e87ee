"""All plants of a service, the worst first: what is wrong with each, as a page and for metrics."""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from html import escape
from typing import NamedTuple
from urllib.parse import quote

from heliograph.serving.observation.running_nis import FEWEST, RunningNis

Name = tuple[str, str]  # of a filter: node and filter
NEAR = 2.0  # deviations of a ratio within which no band ends


class FilterDoubt(NamedTuple):
    """A filter whose innovations are not what it claims: ratio, and the band in which it should be."""

    node: str
    filter: str
    ratio: float
    low: float
    high: float

    @property
    def size(self) -> float:
        """Return by how much the ratio is beyond the band, as the logarithm of a factor."""
        return math.log(max(self.ratio / self.high, self.low / max(self.ratio, 1e-300), 1.0))


class PlantTroubles(NamedTuple):
    """What is wrong with a plant: dead senders by node, doubted filters, and messages that were refused, in words."""

    plant: str
    dead: tuple[str, ...]
    doubts: tuple[FilterDoubt, ...]
    refused: str

    @property
    def severity(self) -> tuple[int, float, bool]:
        """Return what plants are sorted by: dead senders, then the largest doubt, then refused messages."""
        return len(self.dead), max((doubt.size for doubt in self.doubts), default=0.0), bool(self.refused)

    @property
    def describe(self) -> list[str]:
        """Return lines on what is wrong with the plant: dead senders, doubted filters, refused messages.

        `dead` holds nodes whose sender is dead, and `doubts` the filters with the ratio of their squared innovations to
        its expectation. `refused` is a line on refused messages, "" if there are none.
        """
        lines = [f"{node}: its sender is dead" for node in self.dead]
        for doubt in self.doubts:
            interval = f"({doubt.low:.2g} to {doubt.high:.2g})"
            ratio = f"squared innovations {doubt.ratio:.2g} times what its covariance says {interval}"
            lines.append(f"{doubt.node}/{doubt.filter}: {ratio}")
        return [*lines, self.refused] if self.refused else lines


class TroubleOverview:
    """Keeps what is wrong with each plant; only plants with new messages are examined again."""

    def __init__(self) -> None:
        """Begin without plants."""
        self.touched = set[str]()  # plants that had a message since `list_worst_plants` was last called
        self._wrong: dict[str, PlantTroubles] = {}  # by plant, of plants with something wrong

    def note_change(self, plant: str) -> None:
        """Note that a plant has had a message, or that its silence has changed, so that it is examined again."""
        self.touched.add(plant)

    def list_worst_plants(
        self,
        tests: Mapping[str, Mapping[Name, RunningNis]],
        dead: Mapping[str, Sequence[str]],
        refused: Mapping[str, str],
    ) -> list[PlantTroubles]:
        """Return the plants with something wrong, the worst first (`PlantTroubles.severity`).

        Only plants with a message since the last call (`touched`) are examined; of the others the last result stands.

        Args:
            tests: tests of each plant's filters, which show whether their covariances are doubtful.
            dead: nodes with a dead sender (silent for longer than it may be) of each plant that has one.
            refused: refused messages of each touched plant, in words.
        """
        for plant in self.touched:
            doubts = tuple(find_doubts(tests.get(plant, {})))
            troubles = PlantTroubles(plant, tuple(dead.get(plant, ())), doubts, refused.get(plant, ""))
            lines_on_troubles = troubles.describe  # a property
            if lines_on_troubles:
                self._wrong[plant] = troubles
            else:
                self._wrong.pop(plant, None)
        self.touched.clear()
        return sorted(self._wrong.values(), key=lambda wrong: wrong.severity, reverse=True)


def find_doubts(tests: Mapping[Name, RunningNis]) -> Iterable[FilterDoubt]:
    """Return the doubted filters of a plant, the most doubted first; `tests` holds their tests by node and filter.

    A filter is doubted if the ratio of its squared innovations to what its covariance says is outside its band.
    """
    doubts = []
    for (node, name), test in tests.items():
        # The standard deviation of the ratio is s = sqrt(variance) / mean. If |ratio - 1| < NEAR s, it is clearly in
        # its band, which need not be computed.
        is_near_1 = (test.ratio - 1.0) ** 2 * test.mean**2 < NEAR**2 * test.variance
        if test.numbers < FEWEST or is_near_1:
            continue
        low, high = test.band()
        if test.explain_doubt() is not None:
            doubts.append(FilterDoubt(node, name, test.ratio, low, high))
    return sorted(doubts, key=lambda doubt: doubt.size, reverse=True)


PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="refresh" content="5">
<title>{title}: plants</title>
<link rel="stylesheet" href="page.css">
</head>
<body>
<header><p class="kicker">heliograph, live</p><h1>{title}: {count:,} plants, {wrong:,} with something wrong</h1>
<p class="note">The worst first: dead senders, then filters whose innovations are not what they claim, then messages
that were refused.{more}</p></header>
<main><table>
<thead><tr><th scope="col">plant</th><th scope="col" class="words">what is wrong</th></tr></thead>
<tbody>
{rows}
</tbody></table></main>
</body>
</html>
"""


def make_plants_page(title: str, plants: Collection[str], wrong: Sequence[PlantTroubles], most: int) -> str:
    """Return the HTML page of all plants, those with something wrong first, with at most `most` rows."""
    plants_in_trouble = {item.plant for item in wrong}
    rows = [(item.plant, "<br>".join(escape(line) for line in item.describe), "doubt") for item in wrong]
    rows += [(plant, "nothing", "fine") for plant in sorted(plants) if plant not in plants_in_trouble]
    lines = [
        f'<tr><th scope="row"><a href="./?plant={quote(plant, safe="")}">{escape(plant) or "(no name)"}</a></th>'
        f'<td class="words {style}">{troubles}</td></tr>'
        for plant, troubles, style in rows[:most]
    ]
    more = f" The first {most:,} are shown." if len(rows) > most else ""
    counts = {"count": len(rows), "wrong": len(wrong), "more": more, "rows": "\n".join(lines)}
    return PAGE.format(title=escape(title or "heliograph"), **counts)
