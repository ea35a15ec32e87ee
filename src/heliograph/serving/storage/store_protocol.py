"""Interface between a service and the store of its state, the network's identity there, and a store in memory."""

from collections.abc import Iterable, Mapping, Sequence
from shlex import quote
from typing import NamedTuple, Protocol

from heliograph.live.fleet import Fleet
from heliograph.live.stored.migration import describe_network
from heliograph.live.stored.network_changes import DESCRIPTION
from heliograph.live.stored.snapshot import Identity, network_identity
from heliograph.numerics.check import InputError, instance
from heliograph.serving.output import Kind, Output

LISTED = 10  # damaged plants in one line


class StoredPlant(NamedTuple):
    """A plant in the store; `version` counts its commits, 0 before the first.

    `damage` says what is wrong with the stored rows; there is no body then.
    """

    version: int
    body: bytes
    damage: str = ""


class DamagedRow(NamedTuple):
    """A row that is not as written: whether its name is, and the checksum that stands there."""

    named: bool
    checksum: object


class Entry(NamedTuple):
    """An output to publish exactly once; its line of JSON lacks the number, which the commit assigns."""

    plant: str
    kind: Kind
    body: bytes

    @staticmethod
    def numbered(entries: Iterable["Entry"], begin: int) -> list[Output]:
        """Return the outputs with their numbers, counted from `begin`, which become the first member of their JSON."""
        return [
            Output(number, plant, kind, b'{"id":%d,' % number + body[1:])  # body[0] is the opening brace
            for number, (plant, kind, body) in enumerate(entries, begin)
        ]


class ConflictError(Exception):
    """Conflict of commits: another process has committed the plant; read it and use the messages again."""


class AwayError(InputError):
    """A store that does not answer now, and may answer later."""


class StoreProtocol(Protocol):
    """Operations that a service needs of a store."""

    keeps: bool

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """Load the stored plants of these names; of some only damage may be left."""

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Commit plants and outputs, and return the outputs of the `entries` with their numbers.

        Plants must have the versions with which they were read. `malformed`: how many messages could not be read.
        `published`: the number of the last published output, None if it has not changed.

        Raises:
            ConflictError: another process has committed one of the plants.
        """

    def unpublished(self) -> list[Output]:
        """Return outputs that this process committed and may not have published."""

    @property
    def name(self) -> str:
        """Return the store's name for messages, without a password."""

    def count(self) -> int:
        """Return the number of stored plants."""

    def names(self) -> list[str]:
        """Return the names of all stored plants."""

    def words(self) -> dict[str, int]:
        """Return the last stored status of each device (online or not), as a number by topic."""

    def keep_words(self, words: Mapping[str, int]) -> None:
        """Store the last status of each device (online or not), as a number by topic."""

    def close(self) -> None:
        """Release the resources of the store."""


def identity(fleet: Fleet) -> Identity:
    """Return the identity that a store must have to continue this fleet: its network, compiled program and options.

    Args:
        fleet: the fleet whose plants the store keeps.
    """
    instance("fleet", fleet, Fleet, "a Fleet")
    return network_identity(fleet.network, fleet.program.step_rows.program, fleet.options._asdict()) | {
        DESCRIPTION: describe_network(fleet)
    }


class InMemoryStore:
    """Store that numbers outputs and keeps nothing; the plants stay in the memory of the service."""

    keeps, name = False, "memory"

    def __init__(self) -> None:
        """Begin before the first output, whose number is 1."""
        self._number = 0

    def load(self, names: Iterable[str]) -> dict[str, StoredPlant]:
        """Return no plants: none are stored."""
        return {}

    def commit(
        self, plants: Mapping[str, StoredPlant], entries: Sequence[Entry], malformed: int, published: int | None
    ) -> list[Output]:
        """Return the outputs of the entries, numbered on from 1; nothing is kept."""
        begin = self._number + 1
        self._number += len(entries)
        return Entry.numbered(entries, begin)

    def unpublished(self) -> list[Output]:
        """Return no outputs: none are stored."""
        return []

    def count(self) -> int:
        """Return 0: no plants are stored."""
        return 0

    def names(self) -> list[str]:
        """Return no names: no plants are stored."""
        return []

    def words(self) -> dict[str, int]:
        """Return no statuses of devices: none are kept."""
        return {}

    def keep_words(self, words: Mapping[str, int]) -> None:
        """Keep nothing."""

    def close(self) -> None:
        """Do nothing: the store holds no resources."""


def describe_damaged_plants(plants: Mapping[str, DamagedRow]) -> str:
    """Return a sentence for users on damaged plants, with the options that begin the first LISTED of them anew.

    A plant whose name is damaged has lost it: any new plant may be that one, so that none can begin.
    """
    options = " ".join(f"--anew {quote(name)}" for name in list(plants)[:LISTED])
    more = "" if len(plants) <= LISTED else f" and {len(plants) - LISTED} more"
    lost_name = ""
    if not all(plant.named for plant in plants.values()):
        lost_name = "; one has lost its name, so that no new plant begins before"
    return f"damaged plants, whose messages are refused until they begin anew ({options}{more}){lost_name}"
