"""Transports of messages: their interface, the one of a broker, partitions of plants, attempts with waits that grow.

A broker that hands each message to whichever process is free (a shared subscription of MQTT 5, a consumer with many
readers) would spread a plant over processes. So the plants are cut into a fixed number of parts, and a part is read by
one process at a time. The hash is FNV-1a of 32 bits modulo the number of parts, since that is what a NATS server
computes itself; a sender to MQTT writes the part into the topic.
"""

import asyncio
import logging
import random
import socket
import ssl
from collections.abc import Awaitable, Callable, Sequence
from typing import NamedTuple, Protocol
from urllib.parse import quote

from heliograph.numerics.check import InputError, check_count, text
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


class Part(NamedTuple):
    """One part of the plants: its `number`, counted from 0, and the number of parts, `of`."""

    number: int = 0
    of: int = 1


WHOLE = Part()


class TakenOverError(InputError):
    """Loss of the messages to another process, which reads them now."""


async def acknowledge_nothing() -> None:
    """Acknowledge to a sender that expects no answer."""


LOG = logging.getLogger("heliograph.serving")

FIRST, LONGEST = 0.25, 30.0  # seconds of the first wait between attempts to connect, and of the longest


def raise_if_cancelled() -> None:
    """Raise CancelledError if this task was cancelled; a client library may have caught the first one and gone on."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


def explain_failure(error: BaseException | None) -> str:
    """Return in words why there is no connection; the words hold no password."""
    if isinstance(error, ssl.SSLCertVerificationError):
        return f"its certificate is not trusted: {error.verify_message}"
    if isinstance(error, ssl.SSLError):
        return f"TLS failed: {(error.reason or 'unknown reason').replace('_', ' ').lower()}"
    if isinstance(error, socket.gaierror):
        return "no such host"
    if isinstance(error, TimeoutError):
        return "no answer"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror.lower()
    return "no connection" if error is None else type(error).__name__


class Retry:
    """Waits that double, each shortened at random by up to a half so that processes do not come back all at once."""

    def __init__(self, what: str):
        """Begin with the shortest wait; `what` is the name of the server in the log."""
        self.what, self._wait = what, FIRST

    async def wait(self, error: Exception) -> None:
        """Log the failure, and wait before the next attempt."""
        raise_if_cancelled()
        wait = self._wait * random.uniform(0.5, 1.0)
        LOG.warning("%s: %s; trying again in %.1f s", self.what, explain_failure(error), wait)
        self._wait = min(2 * self._wait, LONGEST)
        await asyncio.sleep(wait)

    def note_success(self) -> None:
        """Reset the wait after a success."""
        self._wait = FIRST


OFFSET, PRIME = 0x811C9DC5, 0x01000193  # the constants of FNV-1a with 32 bits

NAMELESS = "_"  # the word for the plant that has no name


def encode_name(plant: str) -> str:
    """Encode a plant's name as one word of a topic or subject: letters, digits and hyphens stay, others become %XX.

    Args:
        plant: name of a plant.
    """
    text("plant", plant)
    # `quote` keeps the characters . _ ~, which may have a meaning in topics and subjects.
    return quote(plant, safe="").replace(".", "%2E").replace("_", "%5F").replace("~", "%7E") or NAMELESS


def topic_of(topic: str, output: Output) -> str:
    """Return the topic of an output of the service at `topic`; a message to a node goes to that node's input topic.

    The topics of neighbouring nodes' services differ only in the last word, which is the node's name.
    """
    if output.kind == "message":
        return "/".join([*topic.split("/")[:-1], encode_name(output.to), "in", encode_name(output.plant)])
    return f"{topic}/out/{output.kind}/{encode_name(output.plant)}"


def part_of(plant: str, parts: int) -> int:
    """Return the part that a plant is in.

    Args:
        plant: name of the plant.
        parts: number of parts, at least 1.

    Returns:
        The number of the part, 0 <= number < `parts`.
    """
    check_count("parts", parts)
    hash_ = OFFSET  # FNV-1a, a hash of 32 bits that is the same in every process and program
    for byte in encode_name(plant).encode():
        hash_ = (hash_ ^ byte) * PRIME & 0xFFFFFFFF
    return hash_ % parts
