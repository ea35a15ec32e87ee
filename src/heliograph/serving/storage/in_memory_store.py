"""Store in memory: nothing outlives the process."""

from collections.abc import Iterable, Mapping, Sequence

from heliograph.serving.output import Output
from heliograph.serving.storage.store_protocol import Entry, StoredPlant


class InMemoryStore:
    """Store that numbers outputs and keeps nothing; the plants stay in the memory of the service."""

    keeps, name = False, "memory"

    def __init__(self) -> None:
        self._number = 0

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """Return no plants: none are stored."""
        return {}

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Number the outputs, counting from 1."""
        begin = self._number + 1
        self._number += len(entries)
        return [entry.numbered(number) for number, entry in enumerate(entries, begin)]

    def unpublished(self) -> list[Output]:
        """Return no outputs: none are stored."""
        return []

    def count(self) -> int:
        """Return 0: no plants are stored."""
        return 0

    def close(self) -> None:
        """Do nothing: the store holds no resources."""
