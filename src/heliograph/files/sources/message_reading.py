"""What one message says of one node, or why it could not be read."""

from collections.abc import Container
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import InputError
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
    """Return whether a field's value is among those that are allowed; a flag is there also as a word, such as "True".

    Cells of tables in text are flags where they say so.
    """
    if not isinstance(value, bool):
        return value in allowed
    return value in allowed or any(word in allowed for word in (str(value), str(value).lower(), str(value).upper()))
