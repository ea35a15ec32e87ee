"""Timeouts of nodes: the silences of a recording that are longer, by node."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.model.plant import TIME_STEP
from heliograph.numerics.types import Float, units_in


class LongSilences(NamedTuple):
    """Silences of one node that are longer than its timeout.

    Args:
        timeout: for how long nothing need come, in steps, or in the unit of continuous time.
        rows: row from 0 after which each begins (silences,).
        lengths: from there to the next message, or to the last row (silences,).
        unit: of both, "steps", or of continuous time; "" where that has none.
    """

    timeout: float
    rows: np.ndarray
    lengths: Float[np.ndarray, " silences"]
    unit: str

    def describe(self) -> str:
        """Return in words how many silences of a node there are, and the length and row of the longest.

        `self.rows`: the row before each silence. `self.lengths`: their lengths, in the unit of `self.timeout`.
        """
        longest = int(np.argmax(self.lengths))
        several = f"{len(self.rows)} times, the longest " if len(self.rows) > 1 else ""
        where = f"{several}after row {self.rows[longest] + 1}"
        return f"{describe_silence(float(self.lengths[longest]), self.timeout, self.unit)}: {where}"


def describe_silence(quiet: float, timeout: float, unit: str) -> str:
    """Say for how long nothing came, and for how long nothing need come; `unit` of both, "" for none."""
    return f"nothing came for {quiet:g} {unit}".rstrip() + f", and its timeout is {timeout:g} {unit}".rstrip()


def name_timeout_unit(inputs: Sequence[str]) -> str:
    """Return the unit in which timeouts are: "steps", or that of the plant's time; "" where that has none."""
    return units_in(inputs).get(TIME_STEP, "") if TIME_STEP in inputs else "steps"


def find_long_silences(
    timeouts: Mapping[str, float | None],
    measurements: Mapping[str, np.ndarray],
    inputs: Float[np.ndarray, "steps inputs"],
    names: Sequence[str],
) -> dict[str, LongSilences]:
    """Return the silences that are longer than a node's timeout, by node that has some.

    A node is silent from the first row, or from a row in which something of it came, to the next such row, or to the
    last one. Time counts rows, or adds up the input dt. A report names such silences, since a device may have failed.

    Args:
        timeouts: longest usual silence by node; None for a node that may be silent for any time.
        measurements: measurements by node (steps, received), NaN where nothing came.
        inputs: inputs of the plant (steps, inputs).
        names: names of the inputs; TIME_STEP, "dt", is the length of a step.
    """
    found = dict[str, LongSilences]()
    # Time at each row: the sum of dt, or the row's number.
    clock = np.cumsum(inputs[:, names.index(TIME_STEP)]) if TIME_STEP in names else np.arange(len(inputs), dtype=float)
    for node, z in measurements.items():
        timeout = timeouts[node]
        if timeout is None or not len(z):
            continue
        # Silences lie between successive rows in which something came, the first and the last row added.
        rows_with_data = np.flatnonzero(np.any(~np.isnan(z), axis=1))
        ends = np.concatenate([[0], rows_with_data, [len(z) - 1]])
        lengths = np.diff(clock[ends])
        is_long = lengths > timeout
        if is_long.any():
            found[node] = LongSilences(
                timeout=timeout, rows=ends[:-1][is_long], lengths=lengths[is_long], unit=name_timeout_unit(names)
            )
    return found
