"""Schedules of gains: a filter computed before any data, as arrays over time with the covariance it claims."""

from pathlib import Path
from typing import NamedTuple, cast

import equinox as eqx
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.estimate import STRENGTH, Claim
from heliograph.numerics.check import array, fail, file_path, instance, shown
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float

Matrices = TypeAliasType("Matrices", Float[np.ndarray, "*time _ _"])  # one for each step; one step: no axis
Vectors = TypeAliasType("Vectors", Float[np.ndarray, "*time _"])


@readable
class Gains(NamedTuple):
    """Gains of a linear filter, s+ = F s + K z + c and xhat = L s + J z + d with s the state before the step.

    The prediction of z is G s + g: it replaces what did not arrive. Every array has a leading axis of time, but for
    the gains of one step.

    Args:
        transition: F (time, N, N).
        gain: K (time, N, m).
        offset: c (time, N).
        output: L (time, q, N).
        direct: J (time, q, m).
        output_offset: d (time, q).
        expected: G (time, m, N).
        expected_offset: g (time, m).
        covariance: covariance of x - xhat (time, q, q).
        predicted: covariance of x - L s - J (G s + g) - d, before z (time, q, q); NaN where unknown.
        innovation: covariance of z - G s - g (time, m, m); NaN where unknown.
    """

    transition: Matrices
    gain: Matrices
    offset: Vectors
    output: Matrices
    direct: Matrices
    output_offset: Vectors
    expected: Matrices
    expected_offset: Vectors
    covariance: Matrices
    predicted: Matrices
    innovation: Matrices


PERHAPS = ("predicted", "innovation")  # fields that may be unknown


@readable
class Schedule(Module):
    """Linear filter over time with precomputed gains, and the covariance that it claims for complete data.

    Args:
        gains: gains and covariances of each step.
        start: the filter's state before the first step (N,).
        claim: what the covariance is: "exact", "upper", "nominal" or "none".

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite (the last two fields may be NaN), an unknown
            claim.
    """

    gains: Gains
    start: Float[np.ndarray, "N"]
    claim: Claim = eqx.field(static=True)

    def __init__(self, gains: Gains, start: "Float[ArrayLike, ' N']", claim: Claim):
        instance("gains of a schedule", gains, Gains, "Gains")
        self.start = array("start of the schedule", start, (None,))
        time, n, m = np.shape(gains.gain)
        q = np.shape(gains.output_offset)[-1]
        shapes: tuple[tuple[int, ...], ...] = (
            (time, n, n), (time, n, m), (time, n), (time, q, n), (time, q, m), (time, q), (time, m, n), (time, m),
            (time, q, q), (time, q, q), (time, m, m),
        )  # fmt: skip
        named = zip(Gains._fields, gains, shapes, strict=True)
        self.gains = Gains(*((_known if f in PERHAPS else array)(f"schedule {f}", v, s) for f, v, s in named))
        if len(self.start) != n:
            raise fail("start of the schedule", f"shape ({n},)", f"shape {self.start.shape}")
        if not isinstance(claim, str) or claim not in STRENGTH:
            raise fail("claim", f"one of {list(STRENGTH)}", shown(claim))
        self.claim = claim

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return len(self.gains.offset)

    def save(self, path: str | Path) -> None:
        """Write the arrays to a NumPy file (.npz), for another program or another day."""
        with open(path, "wb") as file:
            np.savez(file, start=self.start, claim=np.array(self.claim), **self.gains._asdict())


def _known(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """An array of the given shape, NaN where it is not known."""
    unknown = np.isnan(value)
    checked = array(name, np.where(unknown, 0.0, value), shape)
    return np.where(unknown, np.nan, checked)


def load_schedule(path: str | Path) -> Schedule:
    """Read the schedule that `Schedule.save` wrote to the file `path`.

    Raises:
        ValueError: a file that holds no schedule.
    """
    path = file_path("schedule", path)
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (ValueError, EOFError, OSError) as error:
        raise fail(f"schedule {path}", "a file written by Schedule.save", str(error).splitlines()[0]) from None
    missing = sorted({*Gains._fields, "start", "claim"} - set(stored))
    if missing:
        raise fail(f"schedule {path}", "all arrays of a schedule", f"none for {missing}")
    claim = cast(Claim, str(stored["claim"]))  # a Schedule checks it
    return Schedule(Gains(*(stored[field] for field in Gains._fields)), stored["start"], claim)
