"""Partition of the plants by a hash of their names: all messages of a plant are in one part.

A broker that hands each message to whichever process is free (a shared subscription of MQTT 5, a consumer with many
readers) would spread a plant over processes. So the plants are cut into a fixed number of parts, and a part is read by
one process at a time. The hash is FNV-1a of 32 bits modulo the number of parts, since that is what a NATS server
computes itself; a sender to MQTT writes the part into the topic.
"""

from typing import NamedTuple
from urllib.parse import quote

from heliograph.numerics.check import check_count, text

OFFSET, PRIME = 0x811C9DC5, 0x01000193
NAMELESS = "_"  # the word for the plant that has no name


class Part(NamedTuple):
    """One part of the plants: its `number`, counted from 0, and the number of parts, `of`."""

    number: int = 0
    of: int = 1


WHOLE = Part()


def word(plant: str) -> str:
    """Encode a plant's name as one word of a topic or subject: letters, digits and hyphens stay, others become %XX."""
    text("plant", plant)
    return quote(plant, safe="").replace(".", "%2E").replace("_", "%5F").replace("~", "%7E") or NAMELESS


def part_of(plant: str, parts: int) -> int:
    """Return the part that a plant is in.

    Args:
        plant: name of the plant.
        parts: number of parts, at least 1.

    Returns:
        The number of the part, 0 <= number < `parts`.
    """
    check_count("parts", parts)
    value = OFFSET
    for byte in word(plant).encode():
        value = (value ^ byte) * PRIME & 0xFFFFFFFF
    return value % parts
