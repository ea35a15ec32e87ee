"""Interface of a transport: how messages reach a service and outputs leave it."""

from collections.abc import Awaitable, Callable, Sequence
from typing import NamedTuple, Protocol

from heliograph.numerics.check import InputError
from heliograph.serving.message import Payload
from heliograph.serving.output import Output


class Batch(NamedTuple):
    """Messages that were received together.

    Args:
        payloads: the messages: lines of JSON, and those that were read from topics of others.
        acknowledge: to be awaited after the commit; it tells the sender that the messages are stored.
    """

    payloads: Sequence[Payload]
    acknowledge: Callable[[], Awaitable[None]]


class TakenOverError(InputError):
    """Loss of the messages to another process, which reads them now."""


class Transport(Protocol):
    """Messages in, outputs out. A message that was not acknowledged may come again; an output may be sent twice."""

    async def receive(self) -> Batch | None:
        """Wait for messages and return those that are there, a bounded number; None at the end.

        It may be cancelled while it waits: messages that it has not returned are not acknowledged.
        """

    async def publish(self, outputs: Sequence[Output]) -> None:
        """Send outputs, in order; return when they have left, which a slow reader may delay."""

    async def close(self) -> None:
        """Release the resources of the transport."""


async def nothing() -> None:
    """Acknowledge to a sender that expects no answer."""
