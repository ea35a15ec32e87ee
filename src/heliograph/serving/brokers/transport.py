"""How messages travel: what a pipe and each broker does, and no more."""

from collections.abc import Awaitable, Callable, Sequence
from typing import NamedTuple, Protocol

from heliograph.numerics.check import InputError
from heliograph.serving.output import Output


class Batch(NamedTuple):
    """Messages that were received together, and what tells their sender that they are kept: after the commit."""

    payloads: Sequence[bytes]
    acknowledge: Callable[[], Awaitable[None]]


class TakenOverError(InputError):
    """Another process reads these messages now."""


class Transport(Protocol):
    """Messages in, outputs out. What was not acknowledged may come again; what is published may be told again."""

    async def receive(self) -> Batch | None:
        """Wait for messages and take those that are there, a bounded number; None at the end.

        It may be cancelled while it waits: what it had not returned is not acknowledged.
        """

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Hand outputs on, in order; return when they are out, which a slow reader may delay."""

    async def close(self) -> None:
        """Let go of what it holds."""


async def nothing() -> None:
    """Acknowledge to a sender that does not ask."""
