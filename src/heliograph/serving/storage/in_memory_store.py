"""In place of a store: nothing outlives the process, and plants stay in memory."""

from collections.abc import Iterable, Mapping, Sequence

from heliograph.serving.output import Output
from heliograph.serving.storage.store_protocol import Entry, StoredPlant


class InMemoryStore:
    """Numbers what is told, and keeps nothing."""

    keeps, name = False, "memory"

    def __init__(self) -> None:
        self._number = 0

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """Nothing is kept."""
        return {}

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Number what is to be told."""
        begin = self._number + 1
        self._number += len(entries)
        return [entry.numbered(number) for number, entry in enumerate(entries, begin)]

    def unpublished(self) -> list[Output]:
        """Nothing was kept."""
        return []

    def count(self) -> int:
        """Nothing is kept."""
        return 0

    def close(self) -> None:
        """Nothing to let go of."""
