"""What one message says of one node, or why it could not be read; checks that sources share."""

from collections.abc import Container, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import InputError, fail, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float


@readable
class Reading(NamedTuple):
    """What one message says of one node.

    Attributes:
        plant: name of the plant, "" for a single one.
        node: name of the node, or "inputs".
        sequence: the node's running count; None if the message has none.
        time: nanoseconds since 1970, or a step; None for the moment of arrival.
        values: all values of the node, NaN for those that this message has not. Shape (size,).
        period: after how many messages the count begins at 0 again; 0 if it does not.
    """

    plant: str
    node: str
    sequence: int | None
    time: int | None
    values: Float[np.ndarray, " size"]
    period: int = 0


class Unread(NamedTuple):
    """Why a source could not read a message.

    Attributes:
        error: the reason.
        counted: plant, node, count and time of the message where these were read; else None. Of one that is refused by
            its flag or counter without a count where it has none.
    """

    error: InputError
    counted: Reading | None


def is_allowed(value: object, allowed: Container[object]) -> bool:
    """Return whether a field's value is among those that are allowed.

    A flag (True or False) is also allowed as a word: "True", "true" or "TRUE", since a table of text has words for it.
    """
    if not isinstance(value, bool):
        return value in allowed
    return value in allowed or any(word in allowed for word in (str(value), str(value).lower(), str(value).upper()))


def read_texts(name: str, value: object) -> tuple[str, ...]:
    """Return a text or a sequence of texts as a tuple; `name` is the option's name, for errors."""
    items = [value] if isinstance(value, str) else value
    if not isinstance(items, Sequence) or not all(isinstance(text, str) for text in items):
        raise fail(f"json_field, {name}", "a text, or a list of texts", show_value(value))
    return tuple(items)
