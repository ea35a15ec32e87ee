"""Values of a message that are computed of several of its fields, or of one that may be absent."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from heliograph.numerics.module import readable

SYMMETRIC = 1e-5  # of two deviations: what float32 may leave between two entries that are one


@readable
@dataclass(frozen=True)
class Yaw:
    """Heading of a quaternion, atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)), in radians: a value in place of a path.

    Args:
        path: dotted path of the quaternion, which has the fields x, y, z and w.
    """

    path: str

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of x, y, z and w."""
        return tuple(f"{self.path}.{part}" if self.path else part for part in "xyzw")

    @staticmethod
    def of(x: Any, y: Any, z: Any, w: Any) -> Any:
        """Return the heading, of numbers or of arrays; NaN where a part is missing or all are 0."""
        size = x * x + y * y + z * z + w * w
        return np.where(size > 0, np.arctan2(2 * (w * z + x * y), size - 2 * (y * y + z * z)), np.nan)


@readable
@dataclass(frozen=True)
class Covariance:
    """Entry of a covariance that a message of ROS declares, row by row in a list: a value in place of a path.

    NaN where the message says that it does not know it: a first entry of -1, nothing but zeros on the diagonal, or a
    kind of 0 (of NavSatFix); and where the entry and its mirror image differ. Rows of a NavSatFix are east, north, up;
    of a pose x, y, z and rotations about these; of a twist the velocities of the same.

    Args:
        path: dotted path of the list, such as "position_covariance" or "pose.covariance".
        row: from 0.
        column: from 0; that of the row, a variance, unless given.
        size: rows of the matrix: 3 of NavSatFix and Imu, 6 of poses and twists (default 3).
        kind: dotted path of a number that is 0 where the covariance is unknown; None where there is none.
    """

    path: str
    row: int
    column: int | None = None
    size: int = 3
    kind: str | None = None

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of the diagonal, of the entry and its mirror image, and of the kind."""
        i, j = self.row, self.row if self.column is None else self.column
        places = [*((k, k) for k in range(self.size)), (i, j), (j, i), (i, i), (j, j)]
        entries = tuple(f"{self.path}.{self.size * row + column}" for row, column in places)
        return entries if self.kind is None else (*entries, self.kind)

    def of(self, *numbers: Any) -> Any:
        """Return the entry, of numbers or of arrays; NaN where it is unknown."""
        diagonal, (entry, mirror, one, other) = numbers[: self.size], numbers[self.size : self.size + 4]
        known = np.asarray(diagonal[0]) != -1
        known &= np.any([np.asarray(variance) != 0 for variance in diagonal], axis=0)
        known &= np.abs(np.asarray(entry) - mirror) <= SYMMETRIC * np.sqrt(np.abs(np.asarray(one) * other))
        for kind in numbers[self.size + 4 :]:
            known &= np.asarray(kind) != 0
        return np.where(known, entry, np.nan)


@readable
@dataclass(frozen=True)
class ZeroIfAbsent:
    """Number that a message leaves out where it is 0, as JSON of protobuf does: a value in place of a path.

    Args:
        path: dotted path of the number; what it is a field of has to be there.
    """

    path: str

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the path."""
        return (self.path,)

    @staticmethod
    def of(value: Any) -> Any:
        """Return the number."""
        return value


Computed = Yaw | Covariance | ZeroIfAbsent
