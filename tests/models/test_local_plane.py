"""Latitude, longitude and height on a local plane: values of PROJ, there and back, covariances by displacements."""

import numpy as np
import pytest

import heliograph as hg

LocalPlane = hg.models.LocalPlane

# Longitude, latitude, height; earth-centred, by PROJ 9.5.1 (+proj=cart +ellps=WGS84).
EARTH = [
    ((-73.9857, 40.7484, 17.2), (1334939.261055741, -4651104.979723467, 4141307.246658667)),
    ((151.2153, -33.8568, 4.5), (-4646971.912554066, 2553078.719592267, -3533269.634526366)),
    ((-0.0015, 51.4779, 46.0), (3980601.155434927, -104.211894580, 4966867.440223435)),
    ((179.9, -16.5, 8000.0), (-6124796.706968204, 10689.797709521, -1802120.131968994)),
]


@pytest.mark.parametrize(("place", "earth"), EARTH)
def test_earth_centred_coordinates_are_those_of_proj(place, earth):
    """2e-9 m: both are rounded at 6e6 m, where a double is 9e-10 m apart from the next."""
    longitude, latitude, height = place
    plane = LocalPlane(latitude, longitude, height)
    np.testing.assert_allclose(plane.to_earth([0.0, 0.0, 0.0]), earth, rtol=0, atol=2e-9)
    np.testing.assert_allclose(plane.from_earth(earth), 0.0, atol=2e-9)
    other = LocalPlane(latitude - 0.3, longitude + 0.4)
    np.testing.assert_allclose(other.to_earth(other.to_plane(latitude, longitude, height)), earth, rtol=0, atol=3e-9)


def test_local_coordinates_are_those_of_proj_across_the_date_line():
    """By PROJ 9.5.1 (+proj=topocentric), which subtracts what is large: right to 2e-9 m."""
    plane = LocalPlane(-16.5, 179.9, 8000.0)
    expected = [
        [16022.839200540, 11060.395830690, -8017.767352040], [-95679.528966134, -88745.106973569, -9338.620308593],
    ]  # fmt: skip
    np.testing.assert_allclose(
        plane.to_plane([-16.4, -17.3], [-179.95, 179.0], [12.0, 0.0]), expected, rtol=0, atol=3e-9
    )
    assert plane.to_geodetic(expected[0])[1] == pytest.approx(-179.95, abs=1e-12)


def test_a_degree_of_latitude_is_the_meridian_s():
    """1 arc second about 45 degrees is 30.87 m (the textbook's number), here M dlat to the sagitta's fourth order."""
    plane, second = LocalPlane(45.0, 7.0), 1 / 3600
    east, north, up = plane.to_plane(45 + second, 7.0, 0.0)
    a, e2 = 6378137.0, 0.00669437999014
    M = a * (1 - e2) / (1 - e2 / 2) ** 1.5
    assert east == 0.0
    assert north == pytest.approx(M * np.radians(second), rel=1e-7)
    assert up == pytest.approx(-M * np.radians(second) ** 2 / 2, rel=1e-4)


@pytest.mark.parametrize(("far", "longitudes", "bound"), [(3e3, 60.0, 1e-9), (3e3, 180.0, 2e-9), (3e5, 180.0, 6e-9)])
def test_there_and_back(far, longitudes, bound):
    """What is left is the rounding of degrees: half of 7e-15 (longitudes to 64), 2.8e-14 (to 180), by 1.1e5 m."""
    draw = np.random.default_rng(0)
    for _ in range(100):
        plane = LocalPlane(draw.uniform(-89, 89), draw.uniform(-longitudes, longitudes), draw.uniform(-100, 9000))
        position = draw.normal(size=(200, 3)) * far * [1, 1, 0.3]
        back = plane.to_plane(*plane.to_geodetic(position).T)
        assert np.abs(back - position).max() < bound


@pytest.mark.parametrize("height", [-5e6, -1e4, 0.0, 1e4, 1e7])
def test_latitude_converges_everywhere(height):
    """From one origin to the whole globe: the numbers are 1e7 m, whose rounding is 2e-9 m each."""
    draw = np.random.default_rng(1)
    latitude, longitude = np.concatenate([[90.0, -90.0, 0.0], draw.uniform(-90, 90, 500)]), draw.uniform(-179, 179, 503)
    plane = LocalPlane(52.5, 13.4, 34.0)
    back = plane.to_geodetic(plane.to_plane(latitude, longitude, height))
    assert np.abs(back[:, 0] - latitude).max() * 1.1e5 < 2e-8
    apart = (back[:, 1] - longitude)[2:] * np.cos(np.radians(latitude[2:]))
    assert np.abs(apart).max() * 1.1e5 < 2e-8
    assert np.abs(back[:, 2] - height).max() < 2e-8


def test_covariances_turn_as_displacements_do():
    """T's columns are steps of a kilometre in the axes of the point, seen from the origin: exact, both are rigid."""
    plane, latitude, longitude = LocalPlane(52.5, 13.4), 53.1, 14.9
    there = LocalPlane(latitude, longitude)
    steps = plane.from_earth(there.to_earth(1e3 * np.eye(3))) - plane.from_earth(there.to_earth(np.zeros(3)))
    T = steps.T / 1e3
    covariance = np.array([[4.0, 1.0, 0.3], [1.0, 2.0, -0.2], [0.3, -0.2, 9.0]])
    turned = plane.turn_covariance(latitude, longitude, covariance)
    np.testing.assert_allclose(turned, T @ covariance @ T.T, atol=1e-10)  # 1e-9 m of a kilometre, of 9 m^2
    assert abs(turned[0, 1] - 1.0) > 0.02  # 1.2 degrees of the meridians
    many = plane.turn_covariance([latitude, 52.5], [longitude, 13.4], [covariance, covariance])
    np.testing.assert_allclose(many, [turned, covariance], atol=1e-14)


def test_missing_coordinates_are_missing():
    plane = LocalPlane(52.5, 13.4)
    assert np.isnan(plane.to_plane([52.5, np.nan], 13.4, 0.0)).tolist() == [[False] * 3, [True] * 3]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda: LocalPlane(525.0, 13.4), "latitude of a local plane: expected a number from -90 to 90, got 525"),
        (lambda: LocalPlane(52.5, 13.4).to_plane(13.4e7, 52.5, 0.0), "latitude of points: expected -90 to 90 degrees"),
        (lambda: LocalPlane(52.5, 13.4).to_plane([1.0, 2.0], [1.0, 2.0, 3.0], 0.0), "the same shape of all"),
        (lambda: LocalPlane(52.5, 13.4).to_geodetic([1.0, 2.0]), r"position on a local plane: expected shape \(3\)"),
        (lambda: LocalPlane(52.5, 13.4).turn_covariance(1.0, 1.0, np.eye(2)), "covariance of positions"),
    ],
)
def test_what_is_no_position_is_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        wrong()
