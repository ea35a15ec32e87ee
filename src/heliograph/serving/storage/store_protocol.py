"""What a service asks of whatever keeps its state."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple, Protocol

from heliograph.serving.output import Kind, Output


class StoredPlant(NamedTuple):
    """A plant in the store; its version counts its commits, 0 before the first.

    `damage`: what is wrong with what the store has of it; then there is no body.
    """

    version: int
    body: bytes
    damage: str = ""


class Damage(NamedTuple):
    """A row that is not what was written: whether its name is, and the checksum that stands there."""

    named: bool
    checksum: object


class Entry(NamedTuple):
    """What is to be told once: its line of JSON lacks the number, which the commit gives."""

    plant: str
    kind: Kind
    body: bytes

    def numbered(self, number: int) -> Output:
        """The output with its number."""
        return Output(number, self.plant, self.kind, b'{"id":%d,' % number + self.body[1:])


class ConflictError(Exception):
    """Another process has committed a plant since it was read: read it again, and use the messages again."""


class StoreProtocol(Protocol):
    """What a service needs of a store."""

    keeps: bool

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """The plants of these names that are kept, and those of which only damage is left."""

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Keep plants, of the versions they had before, and what is to be told; `told`: up to where it was.

        Raises:
            ConflictError: a plant has another version.
        """

    def unpublished(self) -> list[Output]:
        """What this process committed and may not have told."""

    @property
    def name(self) -> str:
        """What to call it, without a password."""

    def count(self) -> int:
        """How many plants are kept."""

    def close(self) -> None:
        """Let go of what it holds."""
