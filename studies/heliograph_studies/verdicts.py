"""Judged statements as blocks of a page: how many fail, then each with its verdict."""

from collections import Counter
from collections.abc import Mapping, Sequence

from heliograph.report.page import Block, Judged, Statements, Text
from heliograph_studies.statement import Statement, Verdict

SAID: Mapping[Verdict, tuple[str, str]] = {
    "fails": ("fails", "fail"),
    "holds_vacuously": ("is true but empty", "are true but empty"),
    "holds": ("holds", "hold"),
}
EMPTY = "**True but empty**: it would be so without any measurement, or what it presupposes is not met."


def verdict_blocks(statements: Sequence[Statement]) -> list[Block]:
    """How many there are of each verdict, and all of them: those that fail first."""
    count = Counter(one.verdict for one in statements)
    told = ", ".join(
        f"{count[verdict]} {do if count[verdict] > 1 else does}"
        for verdict, (does, do) in SAID.items()
        if count[verdict]
    )
    text = f"Judged by the numbers of this very run: of {len(statements)} statements **{told}**."
    judged = [Judged(one.text, one.source, one.paper, one.ours, one.verdict) for one in statements]
    return [Text([f"{text} {EMPTY}" if count["holds_vacuously"] else text]), Statements(judged)]
