"""Silences of a recording that are longer than the timeouts of its nodes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.model.plant import TIME_STEP
from heliograph.numerics.types import Float


class LongSilences(NamedTuple):
    """Silences of one node that are longer than its timeout.

    Args:
        timeout: for how long nothing need come, in steps, or in the unit of continuous time.
        rows: row from 0 after which each begins (silences,).
        lengths: from there to the next message, or to the last row (silences,).
    """

    timeout: float
    rows: np.ndarray
    lengths: Float[np.ndarray, " silences"]

    def describe(self) -> str:
        """Say how many there are, and where the longest one is."""
        longest = int(np.argmax(self.lengths))
        several = f"{len(self.rows)} times, the longest " if len(self.rows) > 1 else ""
        where = f"{several}after row {self.rows[longest] + 1}"
        return f"nothing came for {self.lengths[longest]:g}, and its timeout is {self.timeout:g}: {where}"


def find_long_silences(
    timeouts: Mapping[str, float | None],
    measurements: Mapping[str, np.ndarray],
    inputs: Float[np.ndarray, "steps inputs"],
    names: Sequence[str],
) -> dict[str, LongSilences]:
    """Return the silences that are longer than a node's timeout, by node that has some.

    A node is silent from the first row, or from a row in which something of it came, to the next such row, or to the
    last one. Time counts rows, or adds up the input dt.

    Args:
        timeouts: by node, None of one that may be silent for any time.
        measurements: by node, (steps, received), NaN where nothing came.
        inputs: of the plant (steps, inputs).
        names: of the inputs.
    """
    found = dict[str, LongSilences]()
    clock = np.cumsum(inputs[:, names.index(TIME_STEP)]) if TIME_STEP in names else np.arange(len(inputs), dtype=float)
    for node, z in measurements.items():
        timeout = timeouts[node]
        if timeout is None or not len(z):
            continue
        came = np.flatnonzero(np.any(~np.isnan(z), axis=1))
        ends = np.concatenate([[0], came, [len(z) - 1]])
        lengths = np.diff(clock[ends])
        long = lengths > timeout
        if long.any():
            found[node] = LongSilences(timeout, ends[:-1][long], lengths[long])
    return found
