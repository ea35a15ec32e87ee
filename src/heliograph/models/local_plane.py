"""Latitude, longitude and height as east, north and up of an origin, and back, on the ellipsoid WGS 84."""

import equinox as eqx
import numpy as np

from heliograph.numerics.check import array, fail, scalar
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float

SEMI_MAJOR = 6378137.0  # a in metres: WGS 84
FLATTENING = 1 / 298.257223563  # f
SQUARED_ECCENTRICITY = FLATTENING * (2 - FLATTENING)  # e^2
Numbers = np.ndarray | float
NEWTON_STEPS = 3  # from Bowring's latitude, where one is enough down to 5,000 km below the ground


@readable
class LocalPlane(Module):
    """Axes east, north, up about an origin on the ellipsoid WGS 84, in which a network's positions are metres.

    Exact, with no map projection in between: with N = a / sqrt(1 - e^2 sin^2 lat) a point is

        x = (N + h) cos lat cos lon,   y = (N + h) cos lat sin lon,   z = (N (1 - e^2) + h) sin lat

    earth-centred and earth-fixed, and R (x - x_0) in the plane; the rows of R are east, north and up at the origin.
    Distances are those of space; 10 km from the origin the ground is 7.8 m below the plane. All is computed of
    differences to the origin, so that nothing is lost there: there and back errs by the rounding of degrees in a
    double, at most 1e-9 m within 10 km (at longitudes beyond 64 degrees 2e-9 m) and 6e-9 m within 1,000 km.

    Args:
        latitude: of the origin, in degrees, north positive.
        longitude: of the origin, in degrees, east positive.
        height: of the origin above the ellipsoid, in metres (default 0). Receivers often give it above sea level, which
            differs by up to 107 m: the plane needs the same kind for the origin and for the points.

    Raises:
        ValueError: a latitude beyond 90 degrees, a longitude beyond 360, a height below -10 km or above 10^9 m.

    Source: EPSG guidance note 7-2 (2019), 4.1.1 and 4.1.2, methods 9602 and 9837; Bowring, Transformation from spatial
    to geographical coordinates (1976), for where the way back begins.
    """

    latitude: float = eqx.field(static=True)
    longitude: float = eqx.field(static=True)
    height: float = eqx.field(static=True)

    def __init__(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike = 0.0):
        """Check and hold the origin: latitude and longitude in degrees, and its height in metres over the ellipsoid."""
        self.latitude = float(scalar("latitude of a local plane", latitude, -90.0, 90.0))
        self.longitude = float(scalar("longitude of a local plane", longitude, -360.0, 360.0))
        self.height = float(scalar("height of a local plane", height, -1e4, 1e9))

    @property
    def _origin(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the origin's distance from the earth's axis and its height over the equator's plane, in metres."""
        return _locate_on_meridian(np.radians(self.latitude), self.height)

    def to_plane(self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike) -> Float[np.ndarray, "*points 3"]:
        """Return east, north and up of points, in metres; NaN where a coordinate is NaN.

        Args:
            latitude: degrees. Shape (*points,), like the others.
            longitude: degrees.
            height: metres above the ellipsoid.

        Raises:
            ValueError: shapes that do not fit, or a latitude beyond 90 degrees (perhaps a longitude).
        """
        # Differences to the origin of latitude, longitude (radians) and height; of the distance from the earth's axis,
        # r - r_0, and of the height over the equator's plane, z - z_0.
        phi, turn, rise = self._subtract_origin(latitude, longitude, height)
        radius, _ = self._origin  # r_0
        across, along = _subtract_on_meridian(np.radians(self.latitude), self.height, phi, rise)
        # Turn by the difference l in longitude: r cos l - r_0 = (r - r_0) - 2 r sin^2(l / 2), which loses no digits.
        out = across - 2 * (radius + across) * np.sin(turn / 2) ** 2
        return self._from_meridian((radius + across) * np.sin(turn), out, along)

    def to_geodetic(self, position: ArrayLike) -> Float[np.ndarray, "*points 3"]:
        """Return latitude and longitude in degrees (-180 to 180) and height in metres of points of the plane.

        The longitude has a closed form. The latitude is Bowring's, corrected by Newton steps; its error is below
        rounding for heights above -5,000 km.

        Args:
            position: east, north and up in metres. Shape (*points, 3).

        Raises:
            ValueError: an array of another shape.
        """
        points = _read_coordinates("position on a local plane", position, 3)
        east, out, along = self._to_meridian(points)
        radius, _ = self._origin  # r_0: the origin's distance from the earth's axis
        # r - r_0 = (east^2 + 2 r_0 out + out^2) / (r + r_0), which avoids a difference of large numbers.
        distance = np.hypot(east, radius + out)
        across = (east**2 + 2 * radius * out + out**2) / (distance + radius)
        turn = np.arctan2(east, radius + out)
        phi, rise = self._find_latitude_and_height(across, along)
        longitude = _wrap_degrees(self.longitude + np.degrees(turn))
        return np.stack([self.latitude + np.degrees(phi), longitude, self.height + rise], axis=-1)

    def to_earth(self, position: ArrayLike) -> Float[np.ndarray, "*points 3"]:
        """Return x, y and z in metres, earth-centred and earth-fixed, of points of the plane; rounding is about 1e-9 m.

        Args:
            position: east, north and up in metres. Shape (*points, 3).

        Raises:
            ValueError: an array of another shape.
        """
        east, out, along = self._to_meridian(_read_coordinates("position on a local plane", position, 3))
        radius, above = self._origin  # distance from the earth's axis, height over the equator's plane
        c, s = np.cos(np.radians(self.longitude)), np.sin(np.radians(self.longitude))
        return np.stack([c * (radius + out) - s * east, s * (radius + out) + c * east, above + along], axis=-1)

    def from_earth(self, position: ArrayLike) -> Float[np.ndarray, "*points 3"]:
        """Return east, north and up in metres of points that are earth-centred and earth-fixed.

        Args:
            position: x, y and z in metres. Shape (*points, 3).

        Raises:
            ValueError: an array of another shape.
        """
        points = _read_coordinates("earth-centred position", position, 3)
        radius, above = self._origin  # distance from the earth's axis, height over the equator's plane
        c, s = np.cos(np.radians(self.longitude)), np.sin(np.radians(self.longitude))
        x, y, z = np.moveaxis(points, -1, 0)
        return self._from_meridian(c * y - s * x, c * x + s * y - radius, z - above)

    def turn_covariance(
        self, latitude: ArrayLike, longitude: ArrayLike, covariance: ArrayLike
    ) -> Float[np.ndarray, "*points 3 3"]:
        """Return covariances of positions in the plane's axes, from those in the axes east, north and up of the points.

        They are T C T', where T turns from the axes at a point to those at the origin. The turn is the difference in
        longitude times sin(latitude), 1.4 degrees at 100 km at Berlin's latitude, plus the curvature of the ground.

        Args:
            latitude: of the points, degrees. Shape (*points,).
            longitude: of the points, degrees. Shape (*points,).
            covariance: of a receiver's fix in m^2, east, north, up. Shape (*points, 3, 3).

        Raises:
            ValueError: arrays of another shape, or a latitude beyond 90 degrees.
        """
        phi, turn, _ = self._subtract_origin(latitude, longitude, self.height)
        matrix = _read_coordinates("covariance of positions", covariance, 3, 3)
        # Rows: east, north, up. Columns: away from the earth's axis, east, along the axis.
        axes_at_points = _make_axes(np.radians(self.latitude) + phi, turn)
        axes_at_origin = _make_axes(np.radians(self.latitude), turn=0.0)
        T = axes_at_origin @ np.swapaxes(axes_at_points, -1, -2)
        return np.asarray(T @ matrix @ np.swapaxes(T, -1, -2))

    def _subtract_origin(
        self, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return latitude and longitude (radians, from -pi to pi) and height of points, minus the origin's.

        Args:
            latitude: of the points, in degrees.
            longitude: in degrees.
            height: in metres.

        Raises:
            ValueError: shapes that do not fit, or a latitude beyond 90 degrees.
        """
        named = {"latitude": latitude, "longitude": longitude, "height": height}
        values = [_read_coordinates(f"{name} of points", value) for name, value in named.items()]
        try:
            phi, turn, rise = np.broadcast_arrays(*values)
        except ValueError:
            raise fail("coordinates of points", "the same shape of all", [value.shape for value in values]) from None
        is_no_latitude = np.abs(phi) > 90
        if np.any(is_no_latitude):
            expected = "-90 to 90 degrees (radians, longitudes and whole numbers of 1e-7 degrees are none)"
            raise fail("latitude of points", expected, f"{phi[is_no_latitude].flat[0]:g}")
        return np.radians(phi - self.latitude), np.radians(_wrap_degrees(turn - self.longitude)), rise - self.height

    def _from_meridian(self, east: np.ndarray, out: np.ndarray, along: np.ndarray) -> np.ndarray:
        """Return east, north and up (..., 3) of points given in other axes: the inverse of `_to_meridian`.

        Args:
            east: metres east of the origin.
            out: metres farther from the earth's axis than the origin, in the plane of its meridian.
            along: metres along the earth's axis.
        """
        c, s = np.cos(np.radians(self.latitude)), np.sin(np.radians(self.latitude))
        return np.stack([east, c * along - s * out, c * out + s * along], axis=-1)

    def _to_meridian(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return points of the plane (..., 3) in other axes: east, away from the earth's axis, and along that axis.

        North and up are turned by the origin's latitude. All numbers are metres from the origin.
        """
        c, s = np.cos(np.radians(self.latitude)), np.sin(np.radians(self.latitude))
        east, north, up = np.moveaxis(points, -1, 0)
        return east, c * up - s * north, s * up + c * north

    def _find_latitude_and_height(self, across: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return latitude (radians) and height of points, minus the origin's.

        The points lie `across` metres farther from the earth's axis than the origin, and `along` metres along it. The
        Jacobian of (r, z) by (latitude, h) is a rotation by the latitude times diag(M + h, 1), with M the meridian's
        radius of curvature. A Newton step therefore rotates the residual and divides its first part by M + h.
        """
        origin = np.radians(self.latitude)
        radius, above = self._origin
        phi = _find_latitude_by_bowring(radius + across, above + along) - origin
        r, z = _subtract_on_meridian(origin, self.height, phi, np.zeros_like(phi))
        rise = np.cos(origin + phi) * (across - r) + np.sin(origin + phi) * (along - z)
        for _ in range(NEWTON_STEPS):
            r, z = _subtract_on_meridian(origin, self.height, phi, rise)
            c, s = np.cos(origin + phi), np.sin(origin + phi)
            curvature = SEMI_MAJOR * (1 - SQUARED_ECCENTRICITY) / (1 - SQUARED_ECCENTRICITY * s**2) ** 1.5  # M
            phi = phi + (c * (along - z) - s * (across - r)) / (curvature + self.height + rise)
            rise = rise + c * (across - r) + s * (along - z)
        return phi, rise


def _read_coordinates(name: str, value: ArrayLike, *last: int) -> np.ndarray:
    """Return coordinates as an array (..., *last): any leading axes, and last axes of given lengths.

    NaN stands for a missing coordinate. `name` is what the array is called in errors.

    Raises:
        ValueError: another shape, or no array of numbers.
    """
    try:
        leading_axes = max(np.ndim(value) - len(last), 0)
    except ValueError:  # rows of different lengths, which the check names
        leading_axes = 0
    shape = *[None] * leading_axes, *last  # None: any length
    return np.asarray(array(name, value, shape, missing=True))


def _locate_on_meridian(latitude: Numbers, height: Numbers) -> tuple[np.ndarray, np.ndarray]:
    """Return the distance r from the earth's axis and the height z above the plane of the equator, in metres.

    r = (N + h) cos lat and z = (N (1 - e^2) + h) sin lat, with the latitude in radians and N the radius of curvature
    across the meridian.
    """
    N = SEMI_MAJOR / np.sqrt(1 - SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    r = (N + height) * np.cos(latitude)
    z = (N * (1 - SQUARED_ECCENTRICITY) + height) * np.sin(latitude)
    return np.asarray(r), np.asarray(z)


def _subtract_on_meridian(
    origin: float, height: float, phi: np.ndarray, rise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return r - r_0 and z - z_0, in metres, of a point on the ellipsoid's meridian relative to the origin.

    They are the point's coordinates in the plane of its meridian: r = (N + h) cos lat is the distance from the earth's
    axis, z = (N (1 - e^2) + h) sin lat the height above the plane of the equator. N = a / w,
    w = sqrt(1 - e^2 sin^2 lat), is the radius of curvature across the meridian, with a the semi-major axis and e the
    eccentricity. All differences are written as products, since subtracting the large numbers themselves would lose
    digits.

    Args:
        origin: latitude lat_0 of the origin in radians.
        height: height h_0 of the origin in metres.
        phi: lat - lat_0 in radians.
        rise: h - h_0 in metres.
    """
    # Differences of sine and cosine, by the sum-to-product formulas.
    latitude, middle = origin + phi, origin + phi / 2
    sine_change = 2 * np.cos(middle) * np.sin(phi / 2)  # sin lat - sin lat_0
    cosine_change = -2 * np.sin(middle) * np.sin(phi / 2)  # cos lat - cos lat_0
    # w and N at the origin (w_0, N_0) and at the point.
    w_0 = np.sqrt(1 - SQUARED_ECCENTRICITY * np.sin(origin) ** 2)
    w = np.sqrt(1 - SQUARED_ECCENTRICITY * np.sin(latitude) ** 2)
    N_0 = SEMI_MAJOR / w_0
    # w_0^2 - w^2 = e^2 (sin^2 lat - sin^2 lat_0), so N - N_0 = a (w_0^2 - w^2) / (w w_0 (w + w_0)).
    squares_change = SQUARED_ECCENTRICITY * np.sin(2 * middle) * np.sin(phi)
    N_change = SEMI_MAJOR * squares_change / (w * w_0 * (w + w_0))
    # Products change by (change of the first) (second) + (first)_0 (change of the second).
    r_change = (N_change + rise) * np.cos(latitude) + (N_0 + height) * cosine_change
    squared_axis_ratio = 1 - SQUARED_ECCENTRICITY
    z_change = (N_change * squared_axis_ratio + rise) * np.sin(latitude)
    z_change = z_change + (N_0 * squared_axis_ratio + height) * sine_change
    return r_change, z_change


def _find_latitude_by_bowring(r: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return an approximate latitude (radians) by Bowring's formula.

    It is where Newton's method begins. With the ellipsoid's axes a and b, e^2 its eccentricity squared and
    e'^2 = e^2 / (1 - e^2), tan lat = (z + e'^2 b sin^3 beta) / (r - e^2 a cos^3 beta), where beta is the parametric
    latitude, estimated from the point's direction. r: metres from the earth's axis. z: metres above the plane of the
    equator.
    """
    axis_ratio = 1 - FLATTENING  # b / a
    distance = np.hypot(r, z)
    second_eccentricity = SQUARED_ECCENTRICITY / (1 - SQUARED_ECCENTRICITY)  # e'^2
    beta = np.arctan2(axis_ratio * z * (1 + second_eccentricity * axis_ratio * SEMI_MAJOR / distance), r)
    numerator = z + second_eccentricity * axis_ratio * SEMI_MAJOR * np.sin(beta) ** 3
    denominator = r - SQUARED_ECCENTRICITY * SEMI_MAJOR * np.cos(beta) ** 3
    return np.asarray(np.arctan2(numerator, denominator))


def _make_axes(latitude: Numbers, turn: Numbers) -> np.ndarray:
    """Return the axes east, north and up at points, as the rows of matrices (..., 3, 3).

    Their coordinates are: away from the earth's axis in the origin's meridian, east of that meridian, and along the
    axis. `latitude`: of the points. `turn`: their longitude minus the origin's. Both are in radians.
    """
    c, s, c_turn, s_turn = np.cos(latitude), np.sin(latitude), np.cos(turn), np.sin(turn)
    c, s, c_turn, s_turn = np.broadcast_arrays(c, s, c_turn, s_turn)
    east = [-s_turn, c_turn, np.zeros_like(c)]
    north = [-s * c_turn, -s * s_turn, c]
    up = [c * c_turn, c * s_turn, s]
    return np.moveaxis(np.array([east, north, up]), (0, 1), (-2, -1))


def _wrap_degrees(degrees: np.ndarray) -> np.ndarray:
    """Return angles in degrees, turned to the range -180 to 180; an angle within it is returned to the bit."""
    return np.where(np.abs(degrees) <= 180, degrees, degrees - 360 * np.round(degrees / 360))
