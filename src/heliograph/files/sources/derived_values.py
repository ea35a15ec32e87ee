"""Values that are computed from several fields of a message, or from one that may be absent.

Each class has `parts`, the dotted paths of the fields, and `of`, a function from their numbers to the value. It works
on the numbers of one message, or on arrays (messages,) of many.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from heliograph.models.local_plane import LocalPlane
from heliograph.numerics.check import TINY, fail, instance, scalar, show_value
from heliograph.numerics.module import readable

VERTICAL = 1e-6  # of the length of a forward axis: a horizontal part below which its heading is rounding of float32
SYMMETRIC = 1e-5  # of two deviations: what float32 may leave between two entries that are one


@readable
@dataclass(frozen=True)
class Yaw:
    """Heading of a quaternion, atan2(2 (w z + x y), 1 - 2 (y^2 + z^2)), in radians: a value in place of a path.

    Args:
        path: dotted path of the quaternion, which has the fields x, y, z and w. A body that points straight up or down
            has no heading: the value did not arrive.
    """

    path: str

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of x, y, z and w."""
        return tuple(f"{self.path}.{part}" if self.path else part for part in "xyzw")

    @staticmethod
    def of(x: Any, y: Any, z: Any, w: Any) -> Any:
        """Return the heading, of numbers or of arrays; NaN where a part is missing, all are 0, or it is vertical."""
        size = x * x + y * y + z * z + w * w
        # The body's forward axis in the world, its x and y there, of length `size`.
        x_axis, y_axis = size - 2 * (y * y + z * z), 2 * (w * z + x * y)
        return np.where(np.hypot(x_axis, y_axis) > VERTICAL * size, np.arctan2(y_axis, x_axis), np.nan)


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
        """Return the paths of the numbers that `of` takes: the diagonal, entries ij, ji, ii, jj, and the kind if any.

        The message holds the matrix (size, size) as a list, row by row, at `self.path`. The field `self.kind` says
        whether it is known; None if there is no such field.
        """
        i, j = self.row, self.row if self.column is None else self.column
        indices = [*((k, k) for k in range(self.size)), (i, j), (j, i), (i, i), (j, j)]
        entries = tuple(f"{self.path}.{self.size * row + column}" for row, column in indices)
        return entries if self.kind is None else (*entries, self.kind)

    def of(self, *numbers: Any) -> Any:
        """Return the entry ij of a covariance, from numbers or arrays; it is NaN where it is unknown."""
        # The numbers are in the order of `parts`: the diagonal, entries ij and ji, variances ii and jj, and the kind.
        diagonal = numbers[: self.size]
        entry, mirror, row_variance, column_variance = numbers[self.size : self.size + 4]
        # In messages of ROS, nothing is known if the first entry is -1 or if all variances are 0.
        known = np.asarray(diagonal[0]) != -1
        known &= np.any([np.asarray(variance) != 0 for variance in diagonal], axis=0)
        # A covariance is symmetric: ij and ji may differ by rounding only, SYMMETRIC sqrt(ii jj).
        deviations = np.sqrt(np.abs(np.asarray(row_variance) * column_variance))
        known &= np.abs(np.asarray(entry) - mirror) <= SYMMETRIC * deviations
        # If the message has a kind of covariance, the kind 0 means unknown.
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
        """Return the number itself, of which nothing is derived."""
        return value


@readable
@dataclass(frozen=True)
class Geodetic:
    """Latitude, longitude and height in a message, as a position on a local plane: what its values and covariances are.

        fix = hg.files.Geodetic(hg.models.LocalPlane(52.5, 13.4, 34.0))
        hg.files.json_field([fix.east, fix.north], node="gnss", output=["east", "north"])

    `east`, `north`, `up` and `covariance(row, column)` are values in place of paths; NaN where a coordinate is missing.

    Args:
        plane: the plane, by its origin.
        latitude: dotted path of the latitude (default "latitude").
        longitude: dotted path of the longitude (default "longitude").
        height: dotted path of the height above the ellipsoid (default "altitude"); None where there is none, and then
            it is that of the origin.
        degrees: degrees in one of the message's units of latitude and longitude: 1e-7 of u-blox and PX4 (default 1).
        metres: metres in one of the message's units of height: 1e-3 of the same (default 1).

    Raises:
        ValueError: no plane, paths that are no texts, units that are not positive.
    """

    plane: LocalPlane
    latitude: str = "latitude"
    longitude: str = "longitude"
    height: str | None = "altitude"
    degrees: float = 1.0
    metres: float = 1.0

    def __post_init__(self) -> None:
        """Raise ValueError unless latitude, longitude and height are dotted paths; the height may be None.

        `degrees` and `metres` say how many degrees or metres one unit of the message's numbers is; at least TINY.
        """
        instance("Geodetic, plane", self.plane, LocalPlane, "a hg.models.LocalPlane")
        for name in ("latitude", "longitude", "height"):
            path = getattr(self, name)
            if not isinstance(path, str) and not (name == "height" and path is None):
                raise fail(f"Geodetic, {name}", "a dotted path", show_value(path))
        scalar("Geodetic, degrees", self.degrees, TINY)
        scalar("Geodetic, metres", self.metres, TINY)

    @property
    def east(self) -> "PlaneCoordinate":
        """Return the value "metres east of the plane's origin", which is computed from each message; axis 0."""
        return PlaneCoordinate(self, axis=0)

    @property
    def north(self) -> "PlaneCoordinate":
        """Return the value "metres north of the plane's origin", which is computed from each message; axis 1."""
        return PlaneCoordinate(self, axis=1)

    @property
    def up(self) -> "PlaneCoordinate":
        """Return the value "metres above the plane", which is computed from each message; axis 2."""
        return PlaneCoordinate(self, axis=2)

    def covariance(
        self,
        row: int,
        column: int | None = None,
        path: str = "position_covariance",
        kind: str | None = "position_covariance_type",
    ) -> "PlaneCovariance":
        """Return an entry of the position's covariance in the plane's axes; the message has it in the fix's axes.

        The fix's axes are east, north and up at the position itself.

        Args:
            row: axis of the plane: 0 east, 1 north, 2 up.
            column: likewise; by default the row, which gives a variance.
            path: dotted path of the list of 9 numbers, row by row (by default that of NavSatFix).
            kind: as in `Covariance` (by default that of NavSatFix); None if the message has no kind.

        Raises:
            ValueError: the row or the column is not 0, 1 or 2.
        """
        row_and_column = row, row if column is None else column
        if any(index not in (0, 1, 2) for index in row_and_column):
            raise fail("Geodetic, covariance", "a row and a column from 0 to 2", show_value(row_and_column))
        return PlaneCovariance(self, row_and_column, partial(Covariance, path, kind=kind))

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of latitude, longitude, and height where there is one."""
        return (self.latitude, self.longitude, *(() if self.height is None else (self.height,)))

    def coordinates(self, latitude: Any, longitude: Any, *height: Any) -> tuple[Any, Any, Any]:
        """Return (latitude in degrees, longitude in degrees, height in metres) from a message's numbers in its units.

        `height` is left out if the message has none; then it is that of the plane's origin.
        """
        metres_high = np.asarray(height[0]) * self.metres if height else self.plane.height
        return np.asarray(latitude) * self.degrees, np.asarray(longitude) * self.degrees, metres_high


@readable
@dataclass(frozen=True)
class PlaneCoordinate:
    """East, north or up of a `Geodetic` position: a value in place of a path."""

    position: Geodetic
    axis: int  # 0 east, 1 north, 2 up

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of the position."""
        return self.position.parts

    def of(self, *numbers: Any) -> Any:
        """Return the coordinate in metres, from the numbers at `self.parts`; NaN where one is missing."""
        east_north_up = self.position.plane.to_plane(*self.position.coordinates(*numbers))
        return east_north_up[..., self.axis]


@readable
@dataclass(frozen=True)
class PlaneCovariance:
    """Entry of the covariance of a `Geodetic` position, in the plane's axes: a value in place of a path.

    `entry` makes the `Covariance` of a row and a column, in the axes of the position itself.
    """

    position: Geodetic
    row_and_column: tuple[int, int]
    entry: "partial[Covariance]"

    @property
    def parts(self) -> tuple[str, ...]:
        """Return the paths of the position, and of all entries of its covariance."""
        return (*self.position.parts, *(part for entry in self._entries for part in entry.parts))

    @property
    def _entries(self) -> list[Covariance]:
        """Return all nine entries in the axes of the position, row by row."""
        return [self.entry(row=row, column=column) for row in range(3) for column in range(3)]

    def of(self, *numbers: Any) -> Any:
        """Return the entry of the covariance in the plane's axes, from numbers or arrays; NaN if anything is unknown.

        `self._entries` are the nine entries in the fix's axes (east, north, up), each with the paths of its numbers.
        """
        # `numbers` are those of the position, and then those of each entry of the covariance, row by row.
        begin = len(self.position.parts)
        latitude, longitude, _height = self.position.coordinates(*numbers[:begin])
        entries = []
        for entry in self._entries:
            count = len(entry.parts)
            entries.append(entry.of(*numbers[begin : begin + count]))
            begin += count
        # The covariance (..., 3, 3) in the fix's axes, turned into the plane's.
        covariance = np.stack(np.broadcast_arrays(*entries), axis=-1).reshape(*np.shape(entries[0]), 3, 3)
        row, column = self.row_and_column
        return self.position.plane.turn_covariance(latitude, longitude, covariance)[..., row, column]


Computed = Yaw | Covariance | ZeroIfAbsent | PlaneCoordinate | PlaneCovariance
