"""In place of a store: nothing outlives the process, and plants stay in memory."""

from collections.abc import Iterable, Mapping, Sequence

from heliograph.serving.keeping import Entry, Kept
from heliograph.serving.output import Output


class Nowhere:
    """Numbers what is told, and keeps nothing."""

    keeps, name = False, "memory"

    def __init__(self) -> None:
        self._number = 0

    def load(self, names: Iterable[str]) -> dict[str, Kept]:
        """Nothing is kept."""
        return {}

    def commit(
        self, plants: Mapping[str, Kept], entries: Sequence[Entry], malformed: int, told: int | None
    ) -> list[Output]:
        """Number what is to be told."""
        begin = self._number + 1
        self._number += len(entries)
        return [entry.numbered(number) for number, entry in enumerate(entries, begin)]

    def untold(self) -> list[Output]:
        """Nothing was kept."""
        return []

    def count(self) -> int:
        """Nothing is kept."""
        return 0

    def close(self) -> None:
        """Nothing to let go of."""
